"""What the level above may ask of a physics engine that steps N robots.

Staleness rule, the same for every backend: after ``step``, ``qpos`` and ``qvel`` are current, and ``sensordata``
describes the state *before* the last substep (positions, velocities) and the forces *during* it, as after one
``mj_step``. Refreshing it would cost a forward pass per substep; a foot moves 4 mm in 2 ms at 2 m/s. After ``reset``
the sensors of the reset rows describe the new state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import mujoco
from torch import Tensor

from go1exp.sim.physics.scene import Sensors


class PhysicsBackend(Protocol):
    """N simulations of one compiled model. All tensors are live: they are written and read in place."""

    model: mujoco.MjModel
    """The compiled model that all environments start from."""
    sensors: Sensors
    num_envs: int
    qpos: Tensor
    """(N, 19): position in the world m, quaternion w-x-y-z, joint angles rad; of a held trunk (N, 12), the last."""
    qvel: Tensor
    """(N, 18): linear velocity in the world m/s, angular velocity in the trunk frame rad/s, joint velocities rad/s; of
    a held trunk (N, 12), the last."""
    sensordata: Tensor
    """(N, S), addressed by ``sensors``."""

    def step(self, torque: Tensor) -> None:
        """Advance one physics step under joint torques (N, 12), N m."""

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the rows of ``mask`` (N,) bool into the state of ``qpos`` and ``qvel``."""

    def field(self, name: str) -> Tensor:
        """Live per-environment values ``(N, ...)`` of a model field; made per-environment at the first call."""

    def compiled(self, name: str) -> Tensor:
        """The compiled model's values ``(...)`` of that field."""

    def rebase(self, values: Mapping[str, Tensor]) -> None:
        """Make ``values`` (N, ...) by field the robots that randomisation starts from, and what the fields hold now."""

    def nominal(self, name: str) -> Tensor:
        """The values ``(1 or N, ...)`` that randomisation starts from: those of ``rebase``, else the compiled ones."""

    def applied(self) -> Tensor:
        """Live generalised forces (N, nv) added to the actuators' torques, N and N m; kept until overwritten.

        The first six of a floating trunk are a force on its origin in the world frame and a torque in its own.
        """

    def bias(self) -> Tensor:
        """Live torques (N, nv) that hold the links against their weight, Coriolis and centrifugal forces, N and N m.

        MuJoCo's ``qfrc_bias``; no forces of contacts. Stale as ``sensordata`` is. Ask for it before it is needed: its
        values count from the next ``step`` or ``reset`` on.
        """

    def ids(self, kind: str, names: tuple[str, ...]) -> Tensor:
        """Indices ``(len(names),)`` of named objects; ``kind`` is ``body`` or ``geom``."""

    def derive_constants(self, mask: Tensor) -> None:
        """Recompute what follows from masses and inertias (``mj_setConst``) in the rows of ``mask``."""

    def units(self, key: Tensor, counter: Tensor, count: int) -> Tensor:
        """Return what ``go1exp.base.tensors.randomness.unit_numbers`` does, in the way that is quick on this device."""

    def drain_metrics(self) -> dict[str, float]:
        """Return figures about the engine since the last call, for a log."""

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue bit for bit, per-environment model fields included."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, of any backend."""
