"""``backend=cpu``: MuJoCo's own batch of simulations on its C++ thread pool."""

from __future__ import annotations

import contextlib
import ctypes
import warnings
from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS, Batch
from torch import Tensor

from go1exp.base.tensors.randomness import unit_numbers
from go1exp.sim.physics.scene import Sensors

STATE_FIELDS = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl")
"""What one simulation carries from step to step (no activations in this model; applied forces are written anew)."""

DERIVED = "dof_M0"
"""A field that robots have of their own once constants have been derived from their models."""


_log = mujoco.MjLogConfig.get()
_log.logto_file = False  # MuJoCo would leave MUJOCO_LOG.TXT in the working folder
_log.set()

# The bindings time every step, which is 6 % of it; their own ``set_mjcb_time(None)`` leaves the clock in place.
with contextlib.suppress(AttributeError, OSError, ValueError):
    ctypes.c_void_p.in_dll(ctypes.CDLL(mujoco._callbacks.__file__), "mjcb_time").value = None


class MujocoCpu:
    """N simulations on ``threads`` threads; the same bits whatever their number (see ``PhysicsBackend``)."""

    def __init__(self, model: mujoco.MjModel, sensors: Sensors, num_envs: int, threads: int = 0) -> None:
        """Allocate; ``threads`` = 0 takes all cores."""
        self.model, self.sensors, self.num_envs = model, sensors, num_envs
        self._batch = Batch(model, num_envs, nthread=threads)
        self.qpos = torch.from_numpy(self._batch.bind("qpos"))
        self.qvel = torch.from_numpy(self._batch.bind("qvel"))
        self._ctrl = torch.from_numpy(self._batch.bind("ctrl"))
        self.sensordata = self._output("sensordata")
        self._fields: dict[str, Tensor] = {}
        self._baseline: dict[str, Tensor] = {}
        self._applied: Tensor | None = None

    def _output(self, name: str) -> Tensor:
        with warnings.catch_warnings():  # shared read-only: torch has no such notion
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            return torch.from_numpy(self._batch.bind(name))

    def step(self, torque: Tensor) -> None:
        """Advance one physics step under joint torques (N, 12), N m."""
        self._ctrl.copy_(torque)
        self._batch.step()

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the rows of ``mask`` into a state at rest in memory: no warm start, time 0, sensors current."""
        rows = mask.nonzero().squeeze(1)
        if len(rows) == 0:
            return
        ids = rows.numpy()
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.qpos[rows] = qpos[rows].to(self.qpos.dtype)
        self.qvel[rows] = qvel[rows].to(self.qvel.dtype)
        self._batch.forward(ids)

    def field(self, name: str) -> Tensor:
        """Live per-environment values of a model field."""
        if name not in self._fields:
            self._fields[name] = torch.from_numpy(self._batch.expand(name))
        return self._fields[name]

    def compiled(self, name: str) -> Tensor:
        """The compiled model's values of that field (a copy)."""
        return torch.tensor(attrgetter(name)(self.model))

    def rebase(self, values: Mapping[str, Tensor]) -> None:
        """Set what randomisation starts from, and the fields themselves."""
        for name, value in values.items():
            self.field(name).copy_(value)
            self._baseline[name] = value.clone()

    def nominal(self, name: str) -> Tensor:
        """The values that randomisation starts from."""
        return self._baseline[name] if name in self._baseline else self.compiled(name).unsqueeze(0)

    def applied(self) -> Tensor:
        """Live generalised forces added to the actuators'."""
        if self._applied is None:
            self._applied = torch.from_numpy(self._batch.bind("qfrc_applied"))
        return self._applied

    def bias(self) -> Tensor:
        """Live torques that hold the links against weight and inertia at their speeds."""
        return self._output("qfrc_bias")

    def ids(self, kind: str, names: tuple[str, ...]) -> Tensor:
        """Indices of named bodies or geoms."""
        return torch.tensor([getattr(self.model, kind)(name).id for name in names])

    def derive_constants(self, mask: Tensor) -> None:
        """Run ``mj_setConst`` in the rows of ``mask``."""
        rows = mask.nonzero().squeeze(1)
        if len(rows):
            self._batch.set_const(rows.numpy())

    def env_model(self, env: int) -> mujoco.MjModel:
        """Return environment ``env``'s model, randomised fields included, to render or inspect it."""
        return self._batch.get_model(env)

    def env_data(self, env: int) -> mujoco.MjData:
        """Return environment ``env``'s state as an MjData of ``env_model``, to render or inspect it."""
        return self._batch.get_data(env)

    def units(self, key: Tensor, counter: Tensor, count: int) -> Tensor:
        """Return the numbers of ``go1exp.base.tensors.randomness.unit_numbers``."""
        return unit_numbers(key, counter, count)

    def drain_metrics(self) -> dict[str, float]:
        """Return nothing: MuJoCo allocates as much as it needs."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return the simulations' states and every model field that differs between them, derived ones included."""
        expanded = {name: self._batch.expanded(name) for name in sorted(MODEL_FIELDS)}
        return {
            "state": {name: torch.from_numpy(np.array(self._batch.bind(name))) for name in STATE_FIELDS},
            "fields": {name: torch.from_numpy(np.array(v)) for name, v in expanded.items() if v is not None},
            "baseline": {name: value.clone() for name, value in self._baseline.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``: bit for bit if it is of this backend, else from the same state and model."""
        for name, value in state["fields"].items():
            self.field(name).copy_(value)
        if "engine" not in state and (DERIVED in state["fields"] or self._batch.expanded(DERIVED) is not None):
            # What was derived here before is not all among the fields saved. The mean inertia, to which the solver's
            # tolerance is relative, is no field at all.
            self._batch.set_const()
            for name, value in state["fields"].items():
                self.field(name).copy_(value)
        self._baseline = {n: v.to(self.field(n).dtype, copy=True) for n, v in state["baseline"].items()}
        for name in STATE_FIELDS:
            live = self._batch.bind(name)
            live[:] = state["state"][name].numpy().reshape(live.shape)
        if "engine" in state:  # another engine derives fewer constants from the model, and in float32
            self._batch.set_const()
