"""Description of robot, batch and model from which actuators and effects are built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch

from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.joint_values import JointValues, spread

if TYPE_CHECKING:
    from torch import Tensor


class ModelFields(Protocol):
    """The per-environment physical model as randomisations and effects see it."""

    def field(self, name: str) -> Tensor:
        """Live values ``(N, ...)`` of a model field, such as ``body_mass``."""

    def nominal(self, name: str) -> Tensor:
        """The values ``(1 or N, ...)`` that randomisation starts from: the compiled model with its effects."""

    def ids(self, kind: str, names: tuple[str, ...]) -> Tensor:
        """Indices of named bodies or geoms."""


@dataclass(frozen=True)
class ActuatorSetup:
    """The actuators of N robots.

    Attributes:
        num_envs: N.
        physics_dt: period of the calls to come, s.
        joints: names of the J driven joints, which are the model's last J degrees of freedom.
        effort_limit: peak torque (J,), N m.
        velocity_limit: top speed (J,), rad/s.
        armature: reflected rotor inertia (J,), kg m2.
        random: the environments' random numbers.
        device: of the tensors to come.
        dtype: of the joint state to come (float64 on the CPU backend).
        floating: the trunk is free; else it is held.
        mounted: it is held by a mount that may give way, whose degrees of freedom stand before those of the joints.
    """

    num_envs: int
    physics_dt: float
    joints: tuple[str, ...]
    effort_limit: Tensor
    velocity_limit: Tensor
    armature: Tensor
    random: EnvRandom
    device: torch.device
    dtype: torch.dtype
    floating: bool = True
    mounted: bool = False

    def tensor(self, values: JointValues | Sequence[float]) -> Tensor:
        """Spread values over the joints, (J,), on the right device."""
        return torch.as_tensor(spread(values, self.joints), dtype=self.dtype, device=self.device)

    def rows(self, values: JointValues | Sequence[float]) -> Tensor:
        """Spread values over the joints and environments, (N, J), to be written in place."""
        return self.tensor(values).repeat(self.num_envs, 1)

    def zeros(self) -> Tensor:
        """Return (N, J) of zeros."""
        return torch.zeros(self.num_envs, len(self.joints), dtype=self.dtype, device=self.device)
