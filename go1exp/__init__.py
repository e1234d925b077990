"""Train, test and deploy locomotion policies for the Unitree Go1 in MuJoCo."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from go1exp.sim.env.core import Go1Core

# Torch's idle OpenMP threads would spin on the cores that MuJoCo's threads need between two policy steps: on two cores
# that costs a third of the environment's speed. Read by OpenMP when torch is first imported; a user's choice stands.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.2.0"


def make(overrides: Sequence[str] = (), num_envs: int = 1024, seed: int = 0, **options: Any) -> Go1Core:
    """Return N robots that step together on torch tensors: see ``go1exp.sim.env.batch.make``."""
    from go1exp.sim.env.batch import make as batched

    return batched(overrides, num_envs, seed, **options)
