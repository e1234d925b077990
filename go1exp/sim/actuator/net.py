"""``actuator=net``: an actuator learnt from recordings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import torch
from pydantic import AfterValidator
from pydantic_core import PydanticKnownError

from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.registry import ConfigError, actuator
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.grouped_mlp import GroupedMLP, padded_rows

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.sim.actuator.actuator_net import NetInfo

INPUTS = ("position_error", "velocity", "position")
"""Inputs of a net that a position controller has."""


def find(file: str) -> Path:
    """Return where ``file`` is: seen from the working directory, else from the folder that holds ``assets``."""
    return next((p for p in (Path(file), data_root() / file) if p.is_file()), Path(file))


def _net_file(file: str) -> str:
    if file == "???":  # what a YAML says for: to be given
        raise PydanticKnownError("missing")
    if not find(file).is_file():
        raise ValueError("no such file")
    if Path(file).suffix != ".npz":
        raise ValueError("must be an .npz, as go1exp fit-actuator writes it")
    return file


NetFile = Annotated[str, AfterValidator(_net_file)]
"""An actuator net as ``go1exp fit-actuator`` writes it."""


@actuator("net")
class Net(Memory):
    """A network from the recent history of a joint to its torque, as go1exp fit-actuator writes it.

    tau(t) = net(e(t), e(t - P), e(t - 2P), ..., qd(t), qd(t - P), ...) with e = target - q, clipped at the peak torque.
    The spacing P of the history is the net's own; at another one the same weights are another actuator. The net that
    walk-these-ways published shows it: fitted at 20 ms, it is kp 20 on the *previous* error with kd 0.5, a delay
    of 20 ms; stepped at 5 ms, as there and in Isaac Lab, it has a delay of 5 ms and kd 0.75 (computed from its
    weights). So where P is not the physics step, ``period`` must say what to do:

    - ``exact``: refuse.
    - ``hold``: sample every P and keep the torque in between, as an actuator with a clock of P does. P must be a whole
      multiple of the physics step. Each robot's clock starts with its episode.
    - ``resample``: evaluate at every physics step on the history P, 2P, ... ago, linear between the steps.

    After a reset, the present is taken for the whole past. Arithmetic is float32.
    """

    def __init__(
        self, setup: ActuatorSetup, *, file: NetFile, period: Literal["exact", "hold", "resample"] = "exact"
    ) -> None:
        """Load the net.

        Raises:
            NetFileError: if the file is no actuator net, or damaged.
            ConfigError: if the net is another robot's, wants what a position controller does not have, or has a period
                for which ``period`` will not do.
        """
        from go1exp.sim.actuator.actuator_net import load  # what fits nets takes seconds to import

        net = load(find(file))
        if problems := [*_misfits(net.info, setup), *_period_problems(net.info.period, setup.physics_dt, period)]:
            raise ConfigError([f"actuator net {file}: {problem}" for problem in problems])
        self._names, self._limit = net.info.inputs, setup.effort_limit
        group = [net.info.group_of[net.info.joints.index(joint)] for joint in setup.joints]
        used = sorted(set(group))
        order = sorted(range(len(group)), key=lambda j: group[j])  # net by net
        back = sorted(range(len(order)), key=lambda column: order[column])
        self._order, self._back = (torch.tensor(index, device=setup.device) for index in (order, back))
        n, joints, history = setup.num_envs, len(order), net.info.history
        counts = [group.count(k) for k in used]
        rows = padded_rows(n, counts, setup.device)
        weights, biases, skip = net.folded
        self._mlp = GroupedMLP(
            [[(w[k], b[k]) for w, b in zip(weights, biases, strict=True)] for k in used],
            [skip[k, :, 0] for k in used],
            [count * rows for count in counts],
            setup.device,
        )
        # Inputs x history x joints x robots; the joints' order is the nets'.
        self._taps = self._mlp.inputs.unflatten(0, (-1, history)).unflatten(2, (joints, rows))[..., :n]
        self._fresh = torch.ones(n, dtype=torch.bool, device=setup.device)
        self.memory = ("_taps", "_fresh")
        self._synchronous = setup.device.type == "cpu"  # to look at a value costs nothing
        ratio = net.info.period / setup.physics_dt
        self._every = round(ratio) if period == "hold" else 1
        if self._every > 1:
            self._wait = torch.zeros(n, dtype=torch.int64, device=setup.device)
            self._held = setup.zeros()
            self.memory = (*self.memory, "_wait", "_held")
        self._resamples = period == "resample" and not math.isclose(ratio, 1.0, rel_tol=1e-6)
        if self._resamples:
            self._prepare_ring(ratio, history)

    def _prepare_ring(self, ratio: float, history: int) -> None:
        """Allocate the inputs of the last physics steps, of which taps are ``ratio`` apart."""
        age = torch.arange(history, dtype=torch.float64) * ratio
        age = torch.where((age - age.round()).abs() < 1e-6 * ratio, age.round(), age)
        whole = age.floor()
        device = self._taps.device
        self._age, share = whole.long().to(device), (age - whole).float().to(device)
        self._share = share.reshape(-1, 1, 1, 1) if bool(share.any()) else None
        inputs, _, joints, n = self._taps.shape
        self._ring = torch.zeros(int(whole[-1]) + 2, inputs, joints, n, dtype=torch.float32, device=device)
        self._newest = torch.zeros(1, dtype=torch.int64, device=device)
        self.memory = (*self.memory, "_ring", "_newest")

    # ------------------------------------------------------------------ the step

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return the joint torques (N, J), N m; target and q in rad, qd in rad/s.

        ``feedforward`` is added at every step to what the net says or holds, and the sum is clipped: the recordings
        that a net learns from have none, so that it knows nothing of how an actuator would delay it.
        """
        made = self._made(target, q, qd)
        return made if feedforward is None else torch.clamp(made + feedforward, -self._limit, self._limit)

    def _made(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """(N, J) torques without feedforward."""
        if self._every > 1:
            return self._sampled(target, q, qd)
        if self._resamples:
            self._look_up(target, q, qd)
        else:
            self._shift(target, q, qd)
        return self._evaluate()

    def _evaluate(self) -> Tensor:
        """(N, J) the nets' torques for the present taps."""
        _, _, joints, n = self._taps.shape
        columns = self._mlp().unflatten(0, (joints, -1))[:, :n].index_select(0, self._back)
        tau = columns.t().to(self._limit.dtype, memory_format=torch.contiguous_format)
        return torch.clamp(tau, -self._limit, self._limit)

    def _read(self, into: Tensor, target: Tensor, q: Tensor, qd: Tensor) -> None:
        """Write the present inputs into (inputs, J, N)."""
        for row, name in zip(into, self._names, strict=True):
            value = qd if name == "velocity" else q if name == "position" else target - q
            row.copy_(value.t().index_select(0, self._order))

    def _any(self, mask: Tensor) -> bool:
        """Return whether any row may be meant; a device that would have to be waited for is not asked."""
        return not self._synchronous or bool(mask.any())

    def _shift(self, target: Tensor, q: Tensor, qd: Tensor) -> None:
        """Make all taps one period older and take the present."""
        taps = self._taps
        for k in range(taps.shape[1] - 1, 0, -1):
            taps[:, k].copy_(taps[:, k - 1])
        self._read(taps[:, 0], target, q, qd)
        if self._any(self._fresh):
            taps.copy_(torch.where(self._fresh, taps[:, :1], taps))
            self._fresh.zero_()

    def _sampled(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Let the robots whose clock strikes take a sample; return the torque in force."""
        due = self._wait == 0
        self._wait.copy_(torch.where(due, self._every, self._wait) - 1)
        if self._any(due):
            before = self._taps.clone()
            self._shift(target, q, qd)
            self._taps.copy_(torch.where(due, self._taps, before))
            self._held.copy_(torch.where(due.unsqueeze(1), self._evaluate(), self._held))
        return self._held.clone()

    def _look_up(self, target: Tensor, q: Tensor, qd: Tensor) -> None:
        """Take the present, and from the ring what the taps say of the past."""
        ring, size = self._ring, len(self._ring)
        self._newest.add_(1).remainder_(size)
        now = self._taps[:, 0]
        self._read(now, target, q, qd)
        ring.index_copy_(0, self._newest, now.unsqueeze(0))
        if self._any(self._fresh):
            ring.copy_(torch.where(self._fresh, now, ring))
            self._fresh.zero_()
        at = (self._newest - self._age).remainder_(size)
        sampled = ring.index_select(0, at)
        if self._share is not None:
            older = ring.index_select(0, at.sub_(1).remainder_(size))
            sampled.lerp_(older, self._share.expand_as(sampled))
        self._taps.copy_(sampled.transpose(0, 1))

    def reset(self, mask: Tensor) -> None:
        """Take the next inputs for the whole past in the rows of ``mask`` (N,), and sample them at once."""
        self._fresh |= mask
        if self._every > 1:
            self._wait.masked_fill_(mask, 0)


def _misfits(info: NetInfo, setup: ActuatorSetup) -> list[str]:
    problems = []
    if missing := [joint for joint in setup.joints if joint not in info.joints]:
        problems.append(f"is for {info.robot!r} with joints {', '.join(info.joints)}; there is none for {missing[0]}")
    elif setup.joints == robot.JOINTS and info.robot != "go1":
        problems.append(f"is for robot {info.robot!r}, not for 'go1'")
    if strange := [name for name in info.inputs if name not in INPUTS]:
        problems.append(
            f"wants {', '.join(strange)}, which a position controller does not have; fit a net with inputs "
            f"of {', '.join(INPUTS)}"
        )
    return problems


def _period_problems(period: float, dt: float, policy: str) -> list[str]:
    """Return why a net of that period, s, cannot be stepped every ``dt``, s, under this policy."""
    ratio = period / dt
    if math.isclose(ratio, 1.0, rel_tol=1e-6) or policy == "resample":
        return []
    whole = ratio > 1.0 and math.isclose(ratio, round(ratio), rel_tol=1e-6)
    if whole and policy == "hold":
        return []
    resample = "period=resample evaluates it at every step on a history of its own spacing"
    if policy == "hold":
        return [
            f"period=hold needs its period, {period:g} s, to be a whole multiple of the physics step, {dt:g} s "
            f"(sim.physics_dt); {resample}"
        ]
    able = "" if whole else ", if that is a whole number of steps"
    return [
        f"its history is spaced {period:g} s and the physics step is {dt:g} s (sim.physics_dt), at which it would be "
        f"another actuator; period=hold evaluates it every {period:g} s and holds the torque{able}; {resample}"
    ]
