"""The robot below the policy: position targets in, motion out, one physics step at a time.

Training, evaluation, recording and identification all step this, so that an effect means the same to each.

Numerics. MuJoCo's Euler step is a leapfrog: qpos belongs to the step's instant, qvel to half a step before it. An
actuator that took both at face value would see the velocity of half a step ago and the target of half a step ahead,
which at 2 ms moves a 0.2 rad step by 5 mrad against 0.25 ms. So the actuator gets the velocity extrapolated to the
instant of qpos, and a target that changes counts for half of the step in which it changes: second order in the step,
0.3 mrad. Dry friction changes its sign within the step in which a joint turns. MuJoCo's has the sign of the speed at
its end all the step long; the difference is added.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.mdp.types import Snapshot
from go1exp.robot.actuators import ActuatorSetup
from go1exp.robot.config import RobotConfig
from go1exp.sim.actuator.motors import Actuator, TakesFeedforward, takes_feedforward
from go1exp.sim.effects.base import Measured
from go1exp.sim.effects.stack import EffectStack
from go1exp.sim.physics.backend import PhysicsBackend

FRICTION, ARMATURE = "dof_frictionloss", "dof_armature"


def actuator_setup(config: RobotConfig, physics_dt: float, backend: PhysicsBackend, random: EnvRandom) -> ActuatorSetup:
    """Describe the Go1's actuators on ``backend``."""

    def spread(hip_thigh_calf: tuple[float, float, float]) -> Tensor:
        return torch.as_tensor(robot.per_joint(hip_thigh_calf), dtype=like.dtype, device=like.device)

    like = backend.qpos
    freedom = backend.qvel.shape[1]
    floating = like.shape[1] != freedom  # a free joint has a quaternion
    return ActuatorSetup(
        num_envs=backend.num_envs,
        physics_dt=physics_dt,
        joints=robot.JOINTS,
        effort_limit=spread(config.effort_limit),
        velocity_limit=spread(config.velocity_limit),
        armature=spread(config.armature),
        random=random,
        device=like.device,
        dtype=like.dtype,
        floating=floating,
        mounted=not floating and freedom > robot.NUM_JOINTS,
    )


class Plant:
    """N robots with their actuators and effects on a physics backend.

    Attributes:
        q: (N, J) true joint angles, live, rad.
        qd: (N, J) true joint velocities half a step before ``q``, live, rad/s.
        torque: (N, J) what the actuators made in the last step, N m.
        actuator: the actuators.
        effects: what else acts.
        enabled: (N,) bool, which robots' actuators are on, or None for all; one that is off asks for no torque.
        observer: called before every step with the target (N, J) that takes force in it.
    """

    enabled: Tensor | None = None
    observer: Callable[[Tensor], None] | None = None

    def __init__(self, backend: PhysicsBackend, setup: ActuatorSetup, actuator: Term, effects: Sequence[Term]) -> None:
        """Put actuators and effects on ``backend``, whose last J coordinates are the joints."""
        self.backend, self._dt = backend, setup.physics_dt
        joints = len(setup.joints)
        self._joints = slice(backend.qvel.shape[1] - joints, None)
        self.q, self.qd = backend.qpos[:, -joints:], backend.qvel[:, -joints:]
        self.actuator: Actuator = actuator(setup)
        self._gains = [getattr(self.actuator, name).clone() for name in ("kp", "kd") if hasattr(self.actuator, name)]
        self.effects = EffectStack(effects, setup)
        self.torque = setup.zeros()
        self._before, self._target, self._bound = setup.zeros(), setup.zeros(), setup.zeros()
        self._rotors, self._floating = self.effects.rotors, setup.floating
        self._inertia = setup.zeros()
        self._bounded = self.effects.acts("on_friction") or self.effects.acts("on_load")
        self._dry = self._bounded or FRICTION in self.effects.fields
        self._dry |= bool(backend.compiled(FRICTION).any())
        self._has_joint_torques = self._dry or self._rotors is not None or self.effects.acts("on_joint")
        self._outside: Tensor | None = None  # torque of the links' weight and speed, of a step ago
        if self.effects.acts("on_load"):
            self._bias, self._outside = backend.bias(), setup.zeros()
        self._fed: Tensor | None = None  # the feed-forward torque of the last step, from the first one on
        self._ease = setup.physics_dt * backend.compiled("dof_invweight0")[self._joints]
        live = [*self.effects.fields, *([FRICTION] if self._dry else []), *([ARMATURE] if self._rotors else [])]
        for name in live:
            backend.field(name)

    def set_gains(self, kp: Tensor, kd: Tensor) -> None:
        """Give each robot gains (N, J) of its own; effects on gains act on top of them."""
        for gains, given in zip(self._gains, (kp, kd), strict=True):
            gains.copy_(given)
        self.actuator.kp.copy_(kp)  # type: ignore[attr-defined]  # has gains, or there would be none to unpack
        self.actuator.kd.copy_(kd)  # type: ignore[attr-defined]
        self.effects.set_gains(self.actuator, *self._gains)

    def startup(self) -> None:
        """Draw the robots' effects and put them into the model."""
        self.effects.draw()
        self.refresh()

    def refresh(self) -> None:
        """Put the effects' present values into force: in their laws, the model and the actuators."""
        self.effects.prepare()
        if self.effects.fields:
            self.backend.rebase(self.effects.model_values(self.backend))
            self.backend.derive_constants(torch.ones(len(self.q), dtype=torch.bool, device=self.q.device))
        if self._gains:
            self.effects.set_gains(self.actuator, *self._gains)
        if self._bounded:
            self._bound.copy_(self.backend.nominal(FRICTION)[:, self._joints])
        if self._rotors:
            self._inertia.copy_(self.backend.nominal(ARMATURE)[:, self._joints])

    def reset(self, mask: Tensor, target: Tensor) -> None:
        """Begin anew in the rows of ``mask`` (N,), whose state is set, with ``target`` (N, J) long in force."""
        rows = mask.unsqueeze(1)
        self._before.copy_(torch.where(rows, self.qd, self._before))
        self._target.copy_(torch.where(rows, target, self._target))
        self.torque.masked_fill_(rows, 0.0)
        if self._fed is not None:
            self._fed.masked_fill_(rows, 0.0)
        self.actuator.reset(mask)
        self.effects.reset(mask)
        if self._rotors:
            self._rotors.reset(mask)
        if self._outside is not None:
            self._outside.copy_(torch.where(rows, -self._bias[:, self._joints], self._outside))

    def reported_torque(self) -> Tensor:
        """(N, J) what the actuators report of ``torque``, N m; never to be written to."""
        return self.effects.through("on_report", self.torque)

    def speed(self) -> Tensor:
        """(N, J) joint velocities at the instant of ``q``, rad/s."""
        return torch.lerp(self._before, self.qd, 1.5)

    def step(self, target: Tensor, feedforward: Tensor | None = None) -> None:
        """Advance one physics step.

        A torque that is fed forward is added where a Go1's motor adds ``LowCmd.tau``: to the actuator's own torque,
        before the actuator's limit and before what effects do to a torque (``strength``, ``lag``, ...). It travels with
        the target: where it changes it counts for half of the step, and ``command_delay`` delays both.

        - ``pd``: in the sum that is clipped at the peak torque.
        - ``dc_motor``: in the sum that is clipped at what the motor can make at that speed.
        - ``voltage``: in the duty that is clipped, before the back EMF.
        - ``delay``: delayed as the target is, then as in the actuator inside.
        - ``net``: added to what the net says or holds, and clipped at the peak torque; its history has no part of it.

        Args:
            target: (N, J) joint targets, in force from now on, rad.
            feedforward: (N, J) torque, in force from now on, N m; None for none. Once there was one, None means zeros.

        Raises:
            go1exp.config.schema.registry.ConfigError: if the actuator takes none.
        """
        if self.observer:
            self.observer(target)
        effects, q, qd = self.effects, self.q, self.speed()
        turn = self.qd - self._before if self._dry else None
        self._before.copy_(self.qd)
        command = effects.through("on_target", torch.lerp(self._target, target, 0.5))
        self._target.copy_(target)
        encoder = effects.on_encoder(q, qd)
        command = effects.through("on_error", command, encoder[0])
        if feedforward is None and self._fed is None:
            made = self.actuator.torque(command, *encoder)
        else:
            made = self._fed_forward(command, encoder, feedforward)
        if self.enabled is not None:  # a demand of zero, which a lag or a delay treats as any other
            made = made * self.enabled.unsqueeze(1)
        self.torque.copy_(effects.through("on_actuator", made, *encoder))
        if self._bounded:
            bound = effects.through("on_friction", self._bound, self.torque, qd)
            if self._outside is not None:
                bound = effects.through("on_load", bound, self.torque, self._outside)
            self.backend.field(FRICTION)[:, self._joints] = bound
        geared = effects.through("on_transmission", self.torque, q, qd)
        if self._has_joint_torques:
            geared = self._apply_joint_torques(geared, q, qd, turn)
        if self._floating and effects.acts("on_base"):
            wrench = self.backend.applied()[:, :6]
            wrench.copy_(effects.through("on_base", torch.zeros_like(wrench)))
        self.backend.step(geared)
        if self._outside is not None:
            torch.neg(self._bias[:, self._joints], out=self._outside)
        if self._rotors:
            # What is carried is this step's; constants that a reset derives from the model are the whole rotor's.
            self.backend.field(ARMATURE)[:, self._joints] = self._inertia
            self._rotors.follow(self.joint_acceleration())

    def _fed_forward(self, command: Tensor, encoder: tuple[Tensor, Tensor], feedforward: Tensor | None) -> Tensor:
        if self._fed is None:
            if not takes_feedforward(self.actuator):
                kind, known = type(self.actuator).__name__, "use actuator=pd, dc_motor, voltage, delay or net"
                raise ConfigError([f"actuator: {kind} takes no feed-forward torque; {known}"])
            self._fed = torch.zeros_like(self.torque)
        given = torch.zeros_like(self._fed) if feedforward is None else feedforward
        arriving = self.effects.through("on_feedforward", torch.lerp(self._fed, given, 0.5))
        self._fed.copy_(given)
        return cast("TakesFeedforward", self.actuator).torque(command, *encoder, arriving)

    def _apply_joint_torques(self, geared: Tensor, q: Tensor, qd: Tensor, turn: Tensor | None) -> Tensor:
        """Apply joint torques other than the actuator's ``geared``; return the part of that which acts rigidly."""
        extra = self.effects.on_joint(q, qd)
        if turn is not None:
            extra = extra + self._friction_correction(turn)
        if self._rotors:
            rigid, through, carried = self._rotors.transmit(self.effects.gears(), geared, self._inertia)
            self.backend.field(ARMATURE)[:, self._joints] = carried
            # The motor's torque limit is not the gears'.
            geared, extra = torch.where(rigid, geared, 0.0), torch.where(rigid, extra, extra + through)
        self.backend.applied()[:, self._joints] = extra
        return geared

    def _friction_correction(self, turn: Tensor) -> Tensor:
        """Return the torque by which dry friction differs from MuJoCo's, which changes its sign too early.

        A joint that goes on to change its speed by ``turn`` (N, J), rad/s, rests after ``share`` of the step; so long
        friction has the old sign. Where it would end up sticking this changes nothing, and it turns no joint by itself.
        """
        # Between -1 and 0 where the joint turns; at 0 it makes no difference.
        minus_share, twice = self.qd / turn, 2.0 * self.backend.field(FRICTION)[:, self._joints]
        turns = (minus_share.ceil() == 0.0) & (turn.abs() > twice * self._ease)
        return torch.where(turns, torch.copysign(minus_share * twice, turn), 0.0)

    def joint_acceleration(self) -> Tensor:
        """(N, J) change of joint velocity over the last step, rad/s2."""
        return (self.qd - self._before) / self._dt

    def sense(self, s: Snapshot) -> Snapshot:
        """Replace the truth about the present moment by what the robots' sensors say of it."""
        sensed = self.effects.measure(Measured(self.q, self.qd, s.projected_gravity_b, s.base_ang_vel_b))
        assert sensed.gravity is not None
        assert sensed.gyro is not None
        joints = {"joint_pos": sensed.joint_pos.float(), "joint_vel": sensed.joint_vel.float()}
        joints["joint_torque"] = self.reported_torque().float()
        return dataclasses.replace(s, **joints, projected_gravity_b=sensed.gravity, base_ang_vel_b=sensed.gyro)

    _STATE = ("before", "target", "bound", "inertia")

    def state_dict(self) -> dict[str, Any]:
        """Return what the actuators and effects remember."""
        physics = {name: getattr(self, f"_{name}").clone() for name in self._STATE}
        parts = {"actuator": self.actuator.state_dict(), "effects": self.effects.state_dict()}
        if self._rotors:
            parts["rotors"] = self._rotors.state_dict()
        fed = {} if self._fed is None else {"fed": self._fed.clone()}
        outside = {} if self._outside is None else {"outside": self._outside.clone()}
        return {**physics, "torque": self.torque.clone(), **parts, **fed, **outside}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``; the backend holds the model."""
        for name in self._STATE:
            getattr(self, f"_{name}").copy_(state[name])
        self.torque.copy_(state["torque"])
        self._fed = state["fed"].clone() if "fed" in state else None
        if self._outside is not None:
            self._outside.copy_(state["outside"])
        self.actuator.load_state_dict(state["actuator"])
        self.effects.load_state_dict(state["effects"])
        if self._rotors:
            self._rotors.load_state_dict(state["rotors"])
