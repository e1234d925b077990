"""What is raised, and kept, when a number stops being finite."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from go1exp.config.schema.registry import Expected


class NumericalFault(Expected):
    """A value is NaN or infinite.

    Attributes:
        quantity: what it was, such as ``reward.foot_force`` or ``gradient of policy.action_net.bias``.
        dump: arrays that describe the moment, to be saved beside the run.
    """

    def __init__(self, quantity: str, where: str, dump: Mapping[str, np.ndarray]) -> None:
        self.quantity, self.dump = quantity, dict(dump)
        super().__init__(f"{quantity} is not finite {where}")
