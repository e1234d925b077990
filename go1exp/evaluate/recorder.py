"""Recorder of the trace that measures need, from an environment on the CPU."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from go1exp import robot
from go1exp.base import memory
from go1exp.base.errors import Expected
from go1exp.base.wording import counted
from go1exp.mdp.derived import slip_speed
from go1exp.mdp.measures.trace import Trace
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig

SNAPSHOT_COLUMNS = ("command", "base_lin_vel_b", "projected_gravity_b", "joint_vel", "joint_torque", "joint_target")
"""Columns of a trace that are a Snapshot's fields of the same name."""


STEP_BYTES = 4 * (3 * robot.NUM_JOINTS + 3 * 3 + 6 * robot.NUM_LEGS + 2) + 1
"""Memory of a policy step of one robot without contact, B."""


def bytes_per_second(task: TaskConfig, robots: int) -> float:
    """Return the memory of a ``Recorder``, B/s."""
    return robots * bytes_per_step(task.sim.decimation) / task.sim.policy_dt


def bytes_per_step(decimation: int) -> int:
    """Return the memory of a policy step of one robot, of so many physics steps, B."""
    return STEP_BYTES + robot.NUM_LEGS * decimation


class Recorder:
    """Contact at every physics step and one row of everything else a policy step, of all robots.

    Takes about 0.3 MB a robot and 10 s. What a physics step left behind is read before the next one
    (``Plant.observer``), that of a policy step's last one in ``end_step``.
    """

    def __init__(self, core: Go1Core, steps: int) -> None:
        """Make room for ``steps`` policy steps; earlier observers stay; raise Expected if memory is too small."""
        seconds = steps * core.task.sim.policy_dt
        if wrong := memory.too_long(seconds, bytes_per_second(core.task, core.num_envs)):
            raise Expected(f"{seconds:g} s of {counted(core.num_envs, 'robot')}: what measures need of them {wrong}")
        n, self._samples = core.num_envs, core.task.sim.decimation
        self._core, self._plant, self._row, self._sample = core, core.plant, 0, 0
        self._before_us, self._listening = core.plant.observer, False
        blocks, readings = core.backend.sensors, core.backend.sensordata.numpy()
        self._foot = readings[:, blocks.foot_contact].reshape(n, robot.NUM_LEGS, 4)
        self._pos = readings[:, blocks.foot_pos_w].reshape(n, robot.NUM_LEGS, 3)
        self._vel = readings[:, blocks.foot_vel_w].reshape(n, robot.NUM_LEGS, 3)
        assert np.shares_memory(self._foot, readings)

        def room(*inner: int) -> NDArray[np.float32]:
            return np.zeros((steps, n, *inner), np.float32)

        legs = robot.NUM_LEGS
        self._contact = np.zeros((steps * self._samples, n, legs), bool)
        self._counts = np.zeros((steps, n), bool)
        joints = {name: room(robot.NUM_JOINTS) for name in ("joint_vel", "joint_torque", "joint_target")}
        feet = ("foot_height", "foot_depth", "foot_slip_speed", "foot_force", "foot_peak_force", "foot_touchdown_speed")
        self._columns = {name: room(3) for name in SNAPSHOT_COLUMNS if name not in joints} | joints
        self._columns |= {name: room(legs) for name in feet} | {n: room() for n in ("base_height", "positive_power")}
        self._touching = np.ones((n, legs), bool)
        self._mass = _masses(core)
        core.plant.observer = self._listen

    def begin_step(self) -> None:
        """Begin a policy step that is recorded."""
        self._listening, self._sample = True, -1

    def end_step(self, alive: Tensor) -> None:
        """End the step; ``alive`` (N,) are the robots that count in it."""
        self._take()
        self._listening = False
        row, columns = self._row, self._columns
        columns["foot_force"][row] /= self._samples
        columns["positive_power"][row] /= self._samples
        s = self._core.snapshot()
        for name in SNAPSHOT_COLUMNS:
            columns[name][row] = getattr(s, name).numpy()
        columns["foot_slip_speed"][row] = slip_speed(s).numpy()
        columns["base_height"][row] = (s.base_pos_w[:, 2] - self._core.ground_height(s.base_pos_w[:, :2])).numpy()
        self._counts[row] = alive.numpy()
        self._row += 1

    def trace(self, robots: slice | NDArray[np.intp]) -> Trace:
        """Return what was recorded of some robots."""
        rows = slice(0, self._row)
        columns = {name: values[rows, robots] for name, values in self._columns.items()}
        return Trace(
            contact=self._contact[: self._row * self._samples, robots],
            contact_dt=self._core.task.sim.physics_dt,
            counts=self._counts[rows, robots],
            mass=self._mass[robots],
            **columns,
        )

    def _listen(self, target: Tensor) -> None:
        """Take what the last physics step left, before the next."""
        if self._before_us:
            self._before_us(target)
        if self._listening:
            if self._sample < 0:  # the last step's, which has been taken
                self._touching[:] = self._foot[..., 3] != 0.0
                self._sample = 0
            else:
                self._take()

    def _take(self) -> None:
        row, columns = self._row, self._columns
        touching = self._foot[..., 3] != 0.0
        self._contact[row * self._samples + self._sample] = touching
        force = np.sqrt(np.einsum("nlk,nlk->nl", self._foot[..., 1:], self._foot[..., 1:]))
        columns["foot_force"][row] += force
        np.maximum(columns["foot_peak_force"][row], force, out=columns["foot_peak_force"][row])
        # The velocity is that at the start of the step whose force is the first: before the impact.
        descent = np.where(touching & ~self._touching, -self._vel[..., 2], 0.0)
        np.maximum(columns["foot_touchdown_speed"][row], descent, out=columns["foot_touchdown_speed"][row])
        height = self._pos[..., 2] - np.asarray(self._core.ground_height(torch.from_numpy(self._pos[..., :2])))
        top = columns["foot_height"][row]
        np.copyto(top, height if self._sample == 0 else np.maximum(top, height), casting="same_kind")
        np.maximum(columns["foot_depth"][row], robot.FOOT_RADIUS - height, out=columns["foot_depth"][row])
        # MuJoCo moves q by qd dt after it has changed qd: tau qd dt is the work of the step.
        power = self._plant.torque.numpy() * self._plant.qd.numpy()
        columns["positive_power"][row] += np.maximum(power, 0.0).sum(-1)
        self._touching, self._sample = touching, self._sample + 1


def _masses(core: Go1Core) -> NDArray[np.float64]:
    """(N,) mass of each robot as it is simulated, kg."""
    varied = {name for t in core.task.rand for name in t.entry.traits.get("fields", ())} | {*core.plant.effects.fields}
    mass = core.backend.field("body_mass") if "body_mass" in varied else core.backend.compiled("body_mass")
    return mass.double().sum(-1).expand(core.num_envs).numpy().copy()
