"""Delays and lags: ``effect=command_delay`` of targets, ``torque_delay`` and ``lag`` of the torque of the motor."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from go1exp.base.tensors.memory import DelayLine
from go1exp.config.schema.joint_values import JointValues
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import SHARP_EDGES, Identification


class Delayed(Effect):
    """Base of effects with a parameter ``delay`` in s, up to that parameter's upper bound."""

    delay: Tensor

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Allocate the past."""
        super().__init__(setup, **values)
        (longest,) = (p.high for p in self.params if p.name == "delay")
        self._line = DelayLine(setup.num_envs, len(setup.joints), longest, setup.physics_dt, setup.dtype, setup.device)
        self._steps = self._line.steps(self.delay)

    def prepare(self) -> None:
        """Work out how many samples ago the delays are."""
        self._steps.copy_(self._line.steps(self.delay))

    def late(self, signal: Tensor) -> Tensor:
        """Take the newest ``signal`` (N, J) and return that of ``delay`` ago; once a step."""
        return self._line.at(signal, self._steps)

    def reset(self, mask: Tensor) -> None:
        """Let the next signal stand for the whole past in the rows of ``mask`` (N,)."""
        self._line.reset(mask)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the values and the past."""
        return {**super().state_dict(), **self._line.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Write values and past back, in place."""
        super().load_state_dict(state)
        self._line.load_state_dict(state)


@effect("command_delay")
class CommandDelay(Delayed):
    """The actuator acts on the target of a while ago: target(t - delay); its own feedback is not delayed.

    Computer, bus and motor controller take their time: 2 to 40 ms on robots of this class (estimate). The published
    Go1 actuator net acts one policy step (20 ms) late. A log whose commands and states have clocks of their own shows a
    shift between them as a delay; in a narrow band so do ``kp_scale`` and armature.
    """

    title = "a delay of commands"
    params = (Param("delay", "s", 0.0, 0.06, 0.0, 0.001, "joint", "age of the target"),)
    identification = Identification(nominal=True, rank=10, levels=({"delay": 0.01},), excitation="steps")

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Allocate the past of targets; that of feed-forward torques is allocated with the first of them."""
        super().__init__(setup, **values)
        self._fed: DelayLine | None = None

    def on_feedforward(self, torque: Tensor) -> Tensor:
        """Return the feed-forward torque of ``delay`` ago: it comes with the target."""
        if self._fed is None:
            self._fed = self._line.twin()
        return self._fed.at(torque, self._steps)

    def reset(self, mask: Tensor) -> None:
        """Let the next target and torque stand for the whole past in the rows of ``mask`` (N,)."""
        super().reset(mask)
        if self._fed:
            self._fed.reset(mask)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the values and the past."""
        return {**super().state_dict(), **({"fed": self._fed.state_dict()} if self._fed else {})}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Write values and past back."""
        super().load_state_dict(state)
        self._fed = self._line.restored(state.get("fed"))

    def on_target(self, target: Tensor) -> Tensor:
        """Return the target of ``delay`` ago."""
        return self.late(target)


@effect("torque_delay")
class TorqueDelay(Delayed):
    """The motor makes the torque that the actuator asked for a while ago: tau(t) = demand(t - delay).

    Feedback is late too, unlike with ``command_delay``, so that a joint rings: the delay acts like a kd that is smaller
    by kp delay. Loops that run over the bus have 1 to 8 ms (estimate). To first order the same as ``lag``; sharp
    command edges tell them apart.
    """

    title = "a delay of torque"
    params = (Param("delay", "s", 0.0, 0.02, 0.0, 0.001, "joint", "age of the torque"),)
    identification = Identification(
        nominal=True, rank=11, excitation="steps", confounded=("lag",), separated_by=SHARP_EDGES
    )
    order = 30

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque asked for ``delay`` ago."""
        return self.late(torque)


@effect("lag")
class Lag(Effect):
    """The motor's torque follows the demand as a first-order lag: time d(tau)/dt = demand - tau.

    The current loop's bandwidth: 2 to 15 ms (estimate). Solved exactly for a demand that changes linearly between
    two steps, so that no step makes it unstable and a time of zero is the demand itself. To first order the same as
    ``torque_delay``; fast chirps, which it damps and a delay does not, tell them apart. An episode begins settled.
    """

    title = "a lag of torque"
    params = (Param("time", "s", 0.0, 0.05, 0.0, 0.001, "joint", "time constant"),)
    identification = Identification(confounded=("torque_delay",), separated_by=SHARP_EDGES)
    memory = ("_made", "_asked", "_fresh")
    order = 40
    time: Tensor

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Begin settled."""
        super().__init__(setup, **values)
        self._made, self._asked = setup.zeros(), setup.zeros()
        self._fresh = torch.ones(setup.num_envs, 1, dtype=torch.bool, device=setup.device)
        self._kept, self._before, self._now = setup.zeros(), setup.zeros(), setup.zeros()
        self._absent = torch.ones_like(self._kept, dtype=torch.bool)
        self.prepare()

    def prepare(self) -> None:
        """Work out the weights of torque made, last demand and demand."""
        steps = self.setup.physics_dt / self.time  # infinite at time 0, where only the demand counts
        self._kept.copy_(torch.exp(-steps))
        mean = -torch.expm1(-steps) / steps  # of the weight with which the past counts over the step
        self._before.copy_(mean - self._kept)
        self._now.copy_(1.0 - mean)
        self._absent.copy_(self.time == 0.0)

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque made, given the demand."""
        made = (self._kept * self._made).addcmul_(self._before, self._asked).addcmul_(self._now, torque)
        made = torch.where(self._fresh | self._absent, torque, made)
        self._made.copy_(made)
        self._asked.copy_(torque)
        self._fresh.zero_()
        return made

    def reset(self, mask: Tensor) -> None:
        """Begin settled at the next demand in the rows of ``mask`` (N,)."""
        self._fresh |= mask.unsqueeze(1)
