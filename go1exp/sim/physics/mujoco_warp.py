"""``backend=warp``: MuJoCo Warp, N simulations on one GPU, its memory shared with torch.

Numbers are float32. Contacts of a step are collected in whatever order the GPU's threads find them, so that sums over
them differ in the last bits from run to run (its option to order them left differences when tried).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, TypeVar

import mujoco
import torch
from torch import Tensor

from go1exp.config.schema.registry import ConfigError, Expected
from go1exp.sim.physics.scene import Sensors

try:
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # it would name every kernel that it loads
    import mujoco_warp as mjw
except ImportError as error:
    raise Expected(
        f"backend=warp needs the packages mujoco-warp and warp-lang ({error}): pip install 'go1exp[gpu]', or use "
        "backend=cpu"
    ) from error

from go1exp.sim.physics.warp_constants import DERIVED, DerivedConstants
from go1exp.sim.physics.warp_kernels import (
    ContactReadings,
    side_by_side,
    units_kernel,
    use_mujocos_law,
    without_contact_sensors,
)

use_mujocos_law()  # of contacts with a height field, before any kernel is built

T = TypeVar("T")

STATE_FIELDS = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl")
"""What one simulation carries from step to step, named as on the CPU."""

WARM_UP = 2
"""Runs of what is to be captured, before it is: they compile kernels and make what is made once."""

LOST = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "HFIELD", "CONTACT_MATCH")
"""Overflows by which contacts or constraints are lost (the others are limits of iterations)."""


@dataclass(frozen=True)
class _Replay:
    """A CUDA graph, and what owns the memory that it works on."""

    graph: torch.cuda.CUDAGraph
    kept: tuple[object, ...]

    def __call__(self) -> None:
        self.graph.replay()


class MujocoWarp:
    """N simulations on one device (see ``PhysicsBackend``)."""

    def __init__(
        self,
        model: mujoco.MjModel,
        sensors: Sensors,
        num_envs: int,
        *,
        device: str = "cuda",
        nconmax: int = 48,
        njmax: int = 160,
    ) -> None:
        """Allocate.

        Args:
            model: the compiled scene.
            sensors: where its sensors lie.
            num_envs: N.
            device: ``cuda``, ``cuda:1`` or, to look for faults slowly, ``cpu``.
            nconmax: contacts, and pairs of shapes near each other, that an environment has room for on average.
            njmax: constraint rows that one environment has room for.

        Raises:
            ConfigError: if the device is not there.
        """
        if device != "cpu" and not torch.cuda.is_available():
            raise ConfigError([f"backend.device = {device!r}: torch finds no CUDA device; use backend=cpu"])
        wp.init()
        self._streams: dict[int, wp.Stream] = {}
        self.model, self.sensors, self.num_envs = model, sensors, num_envs
        self.device = torch.device("cuda", torch.cuda.current_device()) if device == "cuda" else torch.device(device)
        self._wp_device = wp.device_from_torch(self.device)
        supported = copy.copy(model)
        supported.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # it has none to disable
        with self._scope():
            self._model = mjw.put_model(supported)
            self._model.opt.warn_overflow = 0  # kernels that print are slow; see ``overflowed``
            without_contact_sensors(self._model)
            if not model.dof_damping.any():  # it would factorise the inertia once more for nothing
                self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
            self._data = mjw.make_data(supported, nworld=num_envs, nconmax=nconmax, njmax=njmax)
            self._contacts = ContactReadings(supported, sensors, self._data.naconmax)
            self._constants = DerivedConstants(supported, num_envs)
            none = wp.zeros(num_envs, dtype=wp.bool)
            with side_by_side(self._wp_device):
                self._advance()
                self._constants.update(self._model, none)
        d = self._data
        self.qpos, self.qvel, self._ctrl = wp.to_torch(d.qpos), wp.to_torch(d.qvel), wp.to_torch(d.ctrl)
        self.sensordata = wp.to_torch(d.sensordata)
        self._memory = {"time": wp.to_torch(d.time), "qacc_warmstart": wp.to_torch(d.qacc_warmstart)}
        self._memory |= {"qpos": self.qpos, "qvel": self.qvel, "ctrl": self._ctrl}
        self._overflow = wp.to_torch(d.overflow)
        self._qfrc_applied, self._qfrc_bias = wp.to_torch(d.qfrc_applied), wp.to_torch(d.qfrc_bias)
        self._fields: dict[str, Tensor] = {}
        self._ids: dict[tuple[str, tuple[str, ...]], Tensor] = {}
        self._compiled: dict[str, Tensor] = {}
        self._baseline: dict[str, Tensor] = {}

    @contextmanager
    def _scope(self) -> Iterator[None]:
        """Let warp work on our device, in torch's present stream."""
        if self.device.type == "cpu":
            with wp.ScopedDevice(self._wp_device):
                yield
        else:
            with wp.ScopedStream(self._stream(torch.cuda.current_stream(self.device)), sync_enter=False):
                yield

    def _stream(self, stream: torch.cuda.Stream) -> wp.Stream:
        """Return warp's name for a stream of torch, always the same object: a capture is known by it."""
        if stream.cuda_stream not in self._streams:
            self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
        return self._streams[stream.cuda_stream]

    # ------------------------------------------------------------------ the step

    def step(self, torque: Tensor) -> None:
        """Advance one physics step under joint torques (N, 12), N m."""
        self._ctrl.copy_(torque)
        with self._scope():
            self._advance()

    def _advance(self) -> None:
        mjw.step(self._model, self._data)
        self._contacts.update(self._model, self._data)

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the rows of ``mask`` into a state at rest in memory: no warm start, time 0, sensors current.

        Every row's sensors are worked out and those of the others put back: no row waits for the host.
        """
        rows = mask.unsqueeze(1)
        self.qpos.copy_(torch.where(rows, qpos.to(self.qpos.dtype), self.qpos))
        self.qvel.copy_(torch.where(rows, qvel.to(self.qvel.dtype), self.qvel))
        for memory in (self._memory["qacc_warmstart"], self._ctrl, self._qfrc_applied):
            memory.masked_fill_(rows, 0.0)
        self._memory["time"].masked_fill_(mask, 0.0)
        before = self.sensordata.clone()
        with self._scope():
            mjw.forward(self._model, self._data)
            self._contacts.update(self._model, self._data)
        self.sensordata.copy_(torch.where(rows, self.sensordata, before))

    # ------------------------------------------------------------------ the model

    def field(self, name: str) -> Tensor:
        """Live per-environment values of a model field."""
        if name not in self._fields:
            if name == "dof_damping":
                self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
            place, attribute = self._place(name)
            shared = getattr(place, attribute)
            per_env = wp.to_torch(shared).repeat_interleave(self.num_envs, 0)
            with self._scope():
                array = wp.from_torch(per_env.contiguous(), dtype=shared.dtype)
            array._is_batched = True  # as mujoco_warp marks its own
            setattr(place, attribute, array)
            self._fields[name] = wp.to_torch(array)
        return self._fields[name]

    def _place(self, name: str) -> tuple[object, str]:
        *path, attribute = name.split(".")
        return (attrgetter(".".join(path))(self._model) if path else self._model), attribute

    def compiled(self, name: str) -> Tensor:
        """The compiled model's values of that field (a copy)."""
        values = torch.as_tensor(attrgetter(name)(self.model))
        return values.to(self.device, torch.float32 if values.is_floating_point() else values.dtype, copy=True)

    def rebase(self, values: Mapping[str, Tensor]) -> None:
        """Set what randomisation starts from, and the fields themselves."""
        for name, value in values.items():
            self.field(name).copy_(value)
            self._baseline[name] = value.to(self.field(name).dtype, copy=True)

    def nominal(self, name: str) -> Tensor:
        """The values that randomisation starts from."""
        if name in self._baseline:
            return self._baseline[name]
        if name not in self._compiled:  # fetched once: a captured step cannot wait for the host
            self._compiled[name] = self.compiled(name).unsqueeze(0)
        return self._compiled[name]

    def applied(self) -> Tensor:
        """Live generalised forces added to the actuators'."""
        return self._qfrc_applied

    def bias(self) -> Tensor:
        """Live torques that hold the links against weight and inertia at their speeds."""
        return self._qfrc_bias

    def ids(self, kind: str, names: tuple[str, ...]) -> Tensor:
        """Indices of named bodies or geoms."""
        key = (kind, tuple(names))
        if key not in self._ids:
            self._ids[key] = torch.tensor([getattr(self.model, kind)(name).id for name in names], device=self.device)
        return self._ids[key]

    def derive_constants(self, mask: Tensor) -> None:
        """Work out what follows from masses and inertias in the rows of ``mask``."""
        for name in DERIVED:
            self.field(name)
        with self._scope():
            self._constants.update(self._model, wp.from_torch(mask, dtype=wp.bool))

    def drain_metrics(self) -> dict[str, float]:
        """Return the share of environments that lost contacts or constraints since the last call, for want of room."""
        share = float(self.overflowed().float().mean())
        self._overflow.zero_()
        return {"physics/overflow": share}

    # ------------------------------------------------------------------ abilities of this backend alone

    def overflowed(self) -> Tensor:
        """(N,) bool, environments that lost contacts or constraints since ``drain_metrics``."""
        lost = sum(int(getattr(mjw.OverflowType, name)) for name in LOST)
        return (self._overflow & lost) != 0

    def units(self, key: Tensor, counter: Tensor, count: int) -> Tensor:
        """Do what ``go1exp.base.tensors.randomness.unit_numbers`` does, in one kernel."""
        out = torch.empty(len(key), count, device=self.device)
        with self._scope():
            wp.launch(
                units_kernel,
                out.shape,
                inputs=[wp.from_torch(key), wp.from_torch(counter)],
                outputs=[wp.from_torch(out)],
            )
        return out

    def capture(self, work: Callable[[], T]) -> tuple[Callable[[], None], T]:
        """Record what ``work()`` does to the device as one CUDA graph.

        ``work`` runs some times first; it must leave no trace of that which matters, change no shape and not look at a
        value. What it returns is written again by every replay, in place.

        Returns:
            the replay, and what ``work`` returned.
        """
        stream = torch.cuda.Stream(self.device)
        stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                work()
        torch.cuda.synchronize(self.device)
        graph, warp_stream = torch.cuda.CUDAGraph(), self._stream(stream)
        capture = torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local")
        with wp.ScopedStream(warp_stream, sync_enter=False), capture:
            wp.capture_begin(stream=warp_stream, external=True)
            try:
                result = work()
            finally:
                recorded = wp.capture_end(stream=warp_stream)
        return _Replay(graph, (self, work, recorded)), result

    # ------------------------------------------------------------------ state

    def state_dict(self) -> dict[str, Any]:
        """Return the simulations' states and every model field that differs between them, in the CPU backend's form."""
        return {
            "engine": "warp",
            "state": {name: self._memory[name].clone() for name in STATE_FIELDS},
            "fields": {name: value.clone() for name, value in self._fields.items()},
            "baseline": {name: value.clone() for name, value in self._baseline.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, of this backend or of the CPU's, which knows further fields."""
        same_engine = "engine" in state
        for name, value in state["fields"].items():
            if same_engine or name in self._fields:
                self.field(name).copy_(value)
        for name, value in state["baseline"].items():
            self._baseline.setdefault(name, torch.empty_like(self.field(name))).copy_(value)
        for name in STATE_FIELDS:
            self._memory[name].copy_(state["state"][name].reshape(self._memory[name].shape))
        if not same_engine and DERIVED[0] in state["fields"]:
            self.derive_constants(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))
