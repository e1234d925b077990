"""``engine=physx``: rigid bodies and contacts by PhysX 5 on the processor, all else as with MuJoCo.

Drives, effects and sensors stay ours. MuJoCo computes what is no dynamics: the model's fields and what follows from
them, the feet's places and speeds, the motors' torque limits and viscous friction. A robot is moved by PhysX alone.

What is not given by PhysX:

| quantity | how it is made |
|---|---|
| ``qvel`` of the trunk | PhysX has the velocity of its centre of mass and angular velocity in the world |
| places and speeds of the feet, gyroscope, attitude | MuJoCo's kinematics of the state before the step |
| accelerometer | change of ``qvel`` over the step at the IMU's place, without gravity |
| force along the ground on the feet | the equation of motion (``physx_contacts``) |
| sensors after ``reset`` | a step without torque that is taken back: PhysX finds contacts in a step only |

Staleness is the rule of ``backend.py``. Robots do not meet: each has a PhysX system of its own, and its bits do not
depend on the others or on the number of threads. State is single precision, in double-precision tensors.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from go1exp.base.tensors.rotation import rotate, rotate_inverse
from go1exp.config.schema.physics import PhysxBackend
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.physics.agreement import Built
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.physx_contacts import Contacts, FootFriction
from go1exp.sim.physics.physx_robot import APPLIED, PhysxRobot, ground_shape
from go1exp.sim.physics.scene import Sensors

BY_MUJOCO = ("dof_damping", "actuator_forcerange", "opt.gravity")
"""Further fields that may differ between robots: MuJoCo turns them into torques and forces."""

DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "actuator_acc0")
"""Fields that follow from others, to be read only."""

RIGID = {
    "geom_solref": "PhysX's contacts are rigid; leave out rand.foot_restitution, rand.ground_stiffness and "
    "effect.ground_compliance",
    **dict.fromkeys(
        ("jnt_solref", "jnt_range"),
        "PhysX's joint stops are rigid and where the model has them; leave out effect.joint_stop",
    ),
}
"""Fields that PhysX has no place for, and what asks for them."""

NO_DYNAMICS = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
"""What MuJoCo leaves to PhysX."""


class PhysxCpu(MujocoCpu):
    """N robots, each in a PhysX system of its own (see ``PhysicsBackend``)."""

    def __init__(self, model: mujoco.MjModel, sensors: Sensors, num_envs: int, settings: PhysxBackend) -> None:
        """Build the robots; ``settings.threads`` = 0 takes all cores.

        Raises:
            go1exp.config.schema.registry.Expected: if the model has a part that is not translated to PhysX.
        """
        kinematics = copy.copy(model)
        kinematics.opt.disableflags |= int(NO_DYNAMICS)
        super().__init__(kinematics, sensors, num_envs, settings.threads)
        self.model = model
        self._stale = self.sensordata
        self.sensordata = torch.zeros_like(self._stale)
        self._floating = model.nq > model.njnt
        ground = ground_shape(model, settings)
        self._robots = [PhysxRobot(model, settings, ground) for _ in range(num_envs)]
        self._order = self._robots[0].order
        threads = min(settings.threads or os.cpu_count() or 1, num_envs)
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._threads = threads
        self._contacts, self._friction = Contacts(model, num_envs), FootFriction(model)
        names = ("qfrc_smooth", "qfrc_bias", "M", "xanchor", "xaxis", "qacc")
        self._out = {name: self._batch.bind(name) for name in names}
        self._known = torch.full_like(self.qpos, torch.nan), torch.full_like(self.qvel, torch.nan)
        self._in_force: dict[str, Tensor] = {}
        self._trunk_centre = torch.tensor(model.body_ipos[1]).repeat(num_envs, 1)

    # ------------------------------------------------------------------ the model

    def field(self, name: str) -> Tensor:
        """Live per-environment values of a model field.

        Raises:
            ConfigError: if PhysX cannot give robots their own.
        """
        if name not in (*APPLIED, *BY_MUJOCO, *DERIVED, *self._fields):
            raise ConfigError([f"engine = physx: robots cannot differ in {name}: {RIGID.get(name, 'not supported')}"])
        live = super().field(name)
        if name in APPLIED:
            self._in_force.setdefault(name, live.clone())
        elif name == "opt.gravity":
            self.applied()
        return live

    def _refresh_fields(self) -> None:
        for name, old in self._in_force.items():
            live = self._fields[name]
            rows = (live != old).flatten(1).any(1)
            for env in rows.nonzero().squeeze(1).tolist():
                self._robots[env].set_field(name, live[env].numpy())
            old.copy_(live)
            if name == "body_ipos":
                self._trunk_centre.copy_(live[:, 1])
                self._known[1][rows] = torch.nan  # PhysX keeps the velocity of the centre of mass

    # ------------------------------------------------------------------ a step

    def step(self, torque: Tensor) -> None:
        """Advance one physics step under joint torques (N, 12), N m."""
        self._ctrl.copy_(torque)
        self._refresh_fields()
        changed = (self.qpos != self._known[0]).any(1) | (self.qvel != self._known[1]).any(1)
        rows = changed.nonzero().squeeze(1)
        if len(rows):
            self._put(rows)
        self._advance(range(self.num_envs))

    def reset(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put the rows of ``mask`` into a state, with the sensors that it has."""
        rows = mask.nonzero().squeeze(1)
        if len(rows) == 0:
            return
        self._refresh_fields()
        self.qpos[rows] = qpos[rows].to(self.qpos.dtype)
        self.qvel[rows] = qvel[rows].to(self.qvel.dtype)
        self._ctrl[rows] = 0.0
        if self._applied is not None:
            self._applied[rows] = 0.0  # as MuJoCo does
        self._put(rows)
        state = self.qpos.clone(), self.qvel.clone()
        self._advance(rows.tolist())
        for live, before in zip((self.qpos, self.qvel), state, strict=True):
            live[rows] = before[rows]
        self._put(rows)

    def _advance(self, rows: Sequence[int]) -> None:
        every = len(rows) == self.num_envs
        self._batch.forward(None if every else np.asarray(rows))
        before = self.qpos.clone(), self.qvel.clone()
        self._push(rows)
        robots = [self._robots[env] for env in rows]
        if self._pool and len(rows) > 1:
            list(self._pool.map(_step_all, [robots[k :: self._threads] for k in range(self._threads)]))
        else:
            _step_all(robots)
        for env, one in zip(rows, robots, strict=True):
            self._contacts.read(env, one.system.get_contacts(), one.shapes)
        self._read(rows, robots)
        self._sense(torch.as_tensor(rows), *before)

    def _push(self, rows: Sequence[int]) -> None:
        joints = self._out["qfrc_smooth"] + self._out["qfrc_bias"]  # all but gravity and inertia
        torque = np.empty((self.num_envs, len(self._order)), dtype=np.float32)
        torque[:, self._order] = joints[:, -len(self._order) :]
        for env in rows:
            self._robots[env].articulation.set_qf(torque[env])
        if self._floating and self._applied is not None and self._applied[:, :6].any():
            self._push_wrench(rows)
        if "opt.gravity" in self._fields:
            self._push_gravity(rows)

    def _push_wrench(self, rows: Sequence[int]) -> None:
        """Apply the trunk's forces; PhysX takes them at its centre of mass."""
        assert self._applied is not None
        force, torque = self._applied[:, :3], self._applied[:, 3:6]
        quat = self.qpos[:, 3:7]
        moment = rotate(quat, torque) - torch.linalg.cross(rotate(quat, self._trunk_centre), force)
        forces, moments = force.float().numpy(), moment.float().numpy()
        for env in rows:
            self._robots[env].links[0].add_force_torque(forces[env], moments[env])

    def _push_gravity(self, rows: Sequence[int]) -> None:
        """Add the difference of each robot's gravity from the common one."""
        difference = (self._fields["opt.gravity"].numpy() - self.model.opt.gravity).astype(np.float32)
        for env in rows:
            if difference[env].any():
                for link in self._robots[env].links:
                    link.add_force_torque(link.mass * difference[env], np.zeros(3, dtype=np.float32))

    # ------------------------------------------------------------------ state

    def _put(self, rows: Tensor) -> None:
        joints = len(self._order)
        pairs = torch.stack([self.qpos[:, -joints:], self.qvel[:, -joints:]], 1).float().numpy()
        root = self._root_to_physx().numpy() if self._floating else None
        for env in rows.tolist():
            self._robots[env].put(None if root is None else root[env], pairs[env])
        for known, live in zip(self._known, (self.qpos, self.qvel), strict=True):
            known[rows] = live[rows]

    def _root_to_physx(self) -> Tensor:
        """Return place, attitude, velocity of the centre of mass and angular velocity of the trunks (N, 13), world."""
        quat = self.qpos[:, 3:7]
        turn, centre = rotate(quat, self.qvel[:, 3:6]), rotate(quat, self._trunk_centre)
        return torch.cat([self.qpos[:, :7], self.qvel[:, :3] + torch.linalg.cross(turn, centre), turn], 1)

    def _read(self, rows: Sequence[int], robots: list[PhysxRobot]) -> None:
        index, joints = torch.as_tensor(rows), len(self._order)
        raw = torch.as_tensor(np.stack([one.read() for one in robots])).double()
        self.qpos[index, -joints:] = raw[:, 13 : 13 + joints][:, self._order]
        self.qvel[index, -joints:] = raw[:, 13 + joints :][:, self._order]
        if self._floating:
            quat, turn = torch.nn.functional.normalize(raw[:, :4], dim=1), raw[:, 10:13]
            centre = rotate(quat, self._trunk_centre[index])
            self.qpos[index, :7] = torch.cat([raw[:, 4:7], quat], 1)
            self.qvel[index, :6] = torch.cat(
                [raw[:, 7:10] - torch.linalg.cross(turn, centre), rotate_inverse(quat, turn)], 1
            )
        for known, live in zip(self._known, (self.qpos, self.qvel), strict=True):
            known[index] = live[index]

    # ------------------------------------------------------------------ sensors

    def _sense(self, rows: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Write the sensors of those rows, for the step that led from the state ``qpos``, ``qvel`` to the present."""
        out, read, s = self._out, self._contacts, self.sensors
        acceleration = ((self.qvel - qvel) / self.model.opt.timestep)[rows]
        at = rows.numpy()
        data = self._stale[rows]
        feet, normal = data[:, s.foot_pos_w].numpy().reshape(-1, 4, 3), read.foot_force[at]
        friction = self._fields.get("geom_friction")
        coefficients = self.model.geom_friction[None] if friction is None else friction[rows].numpy()
        left = self._friction.excess(out["M"][at], acceleration.numpy(), out["qfrc_smooth"][at])
        along = self._friction(left, out["xanchor"][at], out["xaxis"][at], feet, normal, coefficients)
        contact = np.concatenate([read.foot_points[at][..., None], normal + along], axis=-1)
        data[:, s.foot_contact] = torch.from_numpy(contact.reshape(len(at), -1))
        data[:, s.link_contacts] = torch.from_numpy(read.links[at])
        if s.imu_acc.stop > s.imu_acc.start:
            data[:, s.imu_acc] = self._accelerometer(rows, qpos[rows], qvel[rows], acceleration)
        self.sensordata[rows] = data

    def _accelerometer(self, rows: Tensor, qpos: Tensor, qvel: Tensor, acceleration: Tensor) -> Tensor:
        """Return the specific force at the IMU (n, 3), in its frame, m/s2."""
        site = self.model.site("imu")
        place, frame = torch.tensor(site.pos), torch.tensor(site.quat)
        gravity = self._fields["opt.gravity"][rows] if "opt.gravity" in self._fields else self.compiled("opt.gravity")
        if not self._floating:
            body = torch.tensor(self.model.body_quat[1]).expand(len(rows), 4)
            return rotate_inverse(frame.expand(len(rows), 4), rotate_inverse(body, -gravity.expand(len(rows), 3)))
        turn, change = qvel[:, 3:6], acceleration[:, 3:6]
        arm = place.expand_as(turn)
        of_turning = torch.linalg.cross(change, arm) + torch.linalg.cross(turn, torch.linalg.cross(turn, arm))
        in_trunk = of_turning + rotate_inverse(qpos[:, 3:7], acceleration[:, :3] - gravity)
        return rotate_inverse(frame.expand(len(rows), 4), in_trunk)

    # ------------------------------------------------------------------ saying what it is

    def built(self) -> Built:
        """Return what PhysX says that its first robot is."""
        one = self._robots[0]
        return Built(
            joints=tuple(one.articulation.get_active_joints()[k].name for k in self._order),
            masses={link.name: link.mass for link in one.links},
            limits=one.articulation.get_qlimits()[self._order],
            physics_dt=one.system.timestep,
        )

    # ------------------------------------------------------------------ saving

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the state and model of any backend; what PhysX remembers of contacts begins anew.

        Raises:
            ConfigError: if robots differ there in what PhysX cannot give them.
        """
        for name in state["fields"]:
            if name in RIGID:
                self.field(name)  # refuses
            super().field(name)  # MuJoCo's own constants are among them
        super().load_state_dict(state)
        for name in APPLIED:
            if name in self._fields:
                self._in_force.setdefault(name, torch.full_like(self._fields[name], torch.nan))
        self._refresh_fields()
        self._put(torch.arange(self.num_envs))


def _step_all(robots: list[PhysxRobot]) -> None:
    for one in robots:
        one.system.step()
