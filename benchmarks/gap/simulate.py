"""All episodes of one hidden robot at once: MuJoCo moves the links, everything else is computed here.

Semi-implicit Euler at 0.1 to 0.25 ms; the drive closes its loop at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from benchmarks.gap import laws, outside
from benchmarks.gap.motions import RATE
from benchmarks.gap.truth import Truth
from go1exp import robot
from go1exp.base.paths import data_root

SETTLE = 0.8
"""Time for which the first target is held before the log begins, s."""


@dataclass(frozen=True)
class Episode:
    """What is asked of the robot.

    Attributes:
        name: unique in its case.
        excitation: name of the motion.
        target: (T, J) rad, from row to row.
        on: (T,) bool, whether the drives are on.
        kp: N m/rad.
        kd: N m s/rad.
        hang: roll and pitch of the trunk that the log tells, rad.
        repeat_of: name of the episode that this one repeats.
    """

    name: str
    excitation: str
    target: np.ndarray
    on: np.ndarray
    kp: float
    kd: float
    hang: tuple[float, float]
    repeat_of: str | None = None


@dataclass(frozen=True)
class Samples:
    """What happened, at the rows of the log: (T, N, J) each; q and qd are the encoders', torque is the motors'."""

    q: np.ndarray
    qd: np.ndarray
    torque: np.ndarray


def build(truth: Truth, dt: float) -> mujoco.MjModel:
    """Compile the suspended robot: joints only, friction and damping none, since they are computed outside."""
    spec = mujoco.MjSpec.from_file(str(data_root() / "assets/go1/go1.xml"))
    spec.delete(spec.joint("root"))
    for geom in list(spec.geoms):
        spec.delete(geom)
    return compiled(spec, truth, dt)


def compiled(spec: mujoco.MjSpec, truth: Truth, dt: float) -> mujoco.MjModel:
    """Compile a Go1 with the hidden robot's masses, stops and inertias; friction and damping are computed outside."""
    for key in list(spec.keys):
        spec.delete(key)
    spec.option.timestep = dt
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    for j in np.flatnonzero(truth.carried).tolist():
        link = spec.joint(robot.JOINTS[j]).parent
        load = link.add_body(name=f"{robot.JOINTS[j]}_load", pos=truth.carried_at[j])
        load.explicitinertial, load.ipos = True, [0.0] * 3
        load.mass, load.inertia = truth.carried[j], [1e-12] * 3
    model = spec.compile()
    for j, name in enumerate(robot.JOINTS):
        joint = model.joint(name)
        body = int(model.jnt_bodyid[joint.id])
        model.body_mass[body] *= truth.mass[j]
        model.body_inertia[body] *= truth.mass[j] * truth.inertia[j]
        model.jnt_solref[joint.id, 0] = truth.stop[j]
        model.jnt_range[joint.id] += truth.stop_shift[j]
        model.body_ipos[body] += truth.com[j]
        model.dof_armature[joint.dofadr[0]] = 0.0 if truth.yielding[j] else truth.armature[j]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def attitude(hang: Sequence[float]) -> Rotation:
    """Return the rotation from the trunk to the world of a trunk with this roll and pitch, rad."""
    return Rotation.from_euler("xyz", [hang[0], hang[1], 0.0])


def simulate(truth: Truth, episodes: Sequence[Episode], dt: float, rng: np.random.Generator, on: np.ndarray) -> Samples:
    """Run the episodes side by side.

    Args:
        truth: the robot.
        episodes: of equal length.
        dt: step, s; divides the period of the log.
        rng: of what is random in the world (gusts, lost commands), not of the sensors.
        on: (J,) joints on which effects beyond the library act.
    """
    n, rows, per = len(episodes), len(episodes[0].target), round(1.0 / (RATE * dt))
    batch = Batch(build(truth, dt), n, nthread=1)
    gravity = batch.expand("opt.gravity")
    for k, e in enumerate(episodes):  # the trunk cannot move: turning gravity is turning the robot
        gravity[k] = attitude(np.add(e.hang, truth.tilt)).apply([0.0, 0.0, -9.81], inverse=True)
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    target = np.stack([e.target for e in episodes], axis=1)
    powered = np.stack([e.on for e in episodes], axis=1)[:, :, None]
    qpos[:] = target[0] - truth.offset
    batch.forward()
    kp, kd = (np.array([[getattr(e, gain)] for e in episodes]) for gain in ("kp", "kd"))
    drive = Drive(truth, kp, kd, dt, rng, on)
    forces = batch.bind("xfrc_applied") if "wind" in truth.outside else None
    calves = [mujoco.mj_name2id(batch.get_model(0), mujoco.mjtObj.mjOBJ_BODY, f"{leg}_calf") for leg in robot.LEGS]
    everyone = np.ones((n, 1), dtype=bool)
    for _ in range(round(SETTLE / dt)):
        ctrl[:] = drive.step(-1.0, target[0], everyone, qpos, qvel)
        batch.step()
    drive.begin()
    samples = Samples(*(np.empty((rows, n, robot.NUM_JOINTS)) for _ in range(3)))
    for row in range(rows):
        for sub in range(per):
            t = row / RATE + sub * dt
            ctrl[:] = drive.step(t, target[row], powered[row], qpos, qvel)
            if forces is not None:
                for effect in drive.outside:
                    push = effect.calves(t)
                    if push is not None:
                        forces[:, calves, :3] = push
            if sub == 0:
                samples.q[row], samples.qd[row], samples.torque[row] = drive.angle, drive.speed, drive.made
            batch.step()
            if sub == 0:  # a speed of Euler's belongs half a step earlier
                samples.qd[row] += 0.5 * (drive.rotor_speed(qpos, qvel) - drive.speed)
    return samples


class Drive:
    """Motors, their electronics, gears and friction of N robots.

    Attributes:
        angle: (N, J) what the encoders read in the last step, rad.
        speed: (N, J) the speed that the drives know, rad/s.
        made: (N, J) the motors' torque, N m.
    """

    def __init__(
        self, truth: Truth, kp: np.ndarray, kd: np.ndarray, dt: float, rng: np.random.Generator, on: np.ndarray
    ) -> None:
        """Switch on.

        Args:
            truth: the robot.
            kp: (N, 1) N m/rad, as commanded.
            kd: (N, 1) N m s/rad.
            dt: step, s.
            rng: of what is random in the world.
            on: (J,) joints on which effects beyond the library act.
        """
        n, j = len(kp), robot.NUM_JOINTS
        self.truth, self.dt = truth, dt
        self.kp, self.kd = kp * truth.kp, kd * truth.kd
        self.effort, self.top = robot.per_joint(robot.EFFORT_LIMIT), robot.per_joint(robot.VELOCITY_LIMIT)
        scene = outside.Scene(n, dt, on.astype(float), rng)
        self.outside = [outside.EFFECTS[name](scene, **values) for name, values in truth.outside.items()]
        for effect in self.outside:
            effect.reset()
        self.command = laws.Late(truth.command_delay, dt, n) if truth.command_delay.any() else None
        self.demand = laws.Late(truth.torque_delay, dt, n) if truth.torque_delay.any() else None
        self.lag = laws.Lag(truth.lag, dt) if truth.lag.any() else None
        self.limited = bool((truth.peak != 1).any() or truth.droop.any())
        self.gears = (
            laws.Gears(truth.armature, truth.compliance, truth.gap, truth.gear_damping, truth.yielding)
            if truth.yielding.any()
            else None
        )
        rubs = any(x.any() for x in (truth.forward, truth.backward, truth.stribeck, truth.load))
        self.friction = laws.LuGre((n, j), truth.bristle) if rubs else None
        self.angle = self.speed = self.made = np.zeros((n, j))

    def begin(self) -> None:
        """Start the episode's own clocks."""
        for effect in self.outside:
            effect.reset()

    def rotor_speed(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the speed (N, J) that encoders see, rad/s, for joints at ``q`` that turn at ``v``."""
        return v if self.gears is None else self.gears.at(q, v)[1]

    def step(self, t: float, target: np.ndarray, powered: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the torque on the joints (N, J); ``angle``, ``speed`` and ``made`` then say what the drive knows."""
        truth = self.truth
        q, v = q.copy(), v.copy()
        angle, speed = (q, v) if self.gears is None else self.gears.at(q, v)
        self.angle, self.speed = angle + truth.offset, speed.copy()
        asked = target if self.command is None else self.command.step(target)
        error = asked - self.angle
        error = error * (np.abs(error) > truth.band)
        for effect in self.outside:
            if type(effect).position is not outside.Outside.position:
                error = effect.position(t, asked, self.angle)
        torque = np.clip(self.kp * error - self.kd * self.speed, -self.effort, self.effort)
        torque = np.where(powered, torque, 0.0)
        if self.demand is not None:
            torque = self.demand.step(torque)
        if self.lag is not None:
            torque = self.lag.step(torque)
        torque = torque * (truth.strength * np.maximum(1.0 - truth.drift * max(t, 0.0), 0.5))
        for effect in self.outside:
            torque = effect.motor(t, torque, self.speed)
        if self.limited:
            torque = laws.limit(torque, self.speed, self.effort * truth.peak, self.top, truth.droop)
        self.made = torque
        total = torque if self.gears is None else self.gears.step(torque, q, v, self.dt)
        total = total - (truth.viscous + truth.drag * np.abs(v)) * v
        if truth.stiffness.any():
            total -= truth.stiffness * (q - truth.rest)
        if truth.cogging.any():
            total += truth.cogging * np.sin(truth.slots * q + truth.phase)
        for effect in self.outside:
            total = total + effect.joint(t, q, v, torque)
        return total if self.friction is None else total - self.friction.step(v, self._level(v, torque), self.dt)

    def _level(self, v: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return LuGre's steady friction at this speed, direction and load."""
        truth = self.truth
        level = np.where(v > 0, truth.forward, truth.backward) + truth.load * np.abs(torque)
        if truth.stribeck.any():
            level = level + truth.stribeck * np.exp(-((v / truth.stribeck_speed) ** 2))
        return level
