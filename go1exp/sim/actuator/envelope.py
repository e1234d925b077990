"""What torque an electric motor can make at what speed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


def envelope(qd: Tensor, effort: Tensor, stall: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
    """Return the smallest and the largest torque that a DC motor can make at a speed.

    Its supply drives a current against the back voltage, which grows with speed; its electronics limit that current::

        high = min(effort, stall (1 - qd / speed))      low = max(-effort, -stall (1 + qd / speed))

    Beyond ``speed`` the motor can only brake, at most with ``effort``. Law of Isaac Lab's DC motor and of mjlab's; with
    ``effort = stall = 23.7`` and ``speed = 30`` the largest torque of a Go1's hip is 15.8 N m at 10 rad/s, 0 at 30.

    Args:
        qd: speed (N, J), rad/s.
        effort: peak torque that the electronics allow, positive, broadcasting to (N, J), N m.
        stall: torque of the line at rest, positive, N m; with ``stall > effort`` torque falls from a corner on only.
        speed: where the line reaches zero, positive, rad/s; infinite: torque does not fall with speed.
    """
    share = qd / speed
    low = torch.maximum(-stall * (1.0 + share), -effort)
    high = torch.minimum(stall * (1.0 - share), effort)
    return torch.minimum(low, effort), torch.maximum(high, -effort)
