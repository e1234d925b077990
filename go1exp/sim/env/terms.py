"""The configured rewards, observations and terminations of a batch, called on one Snapshot after the other.

An observation has noise and a history. A term's newest value is its frame; with ``history: k`` a term has k times its
columns: the frame, that of one policy step before, and so on, each with the noise that it had when it was new.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.history import frame_width, history_columns, width
from go1exp.config.schema.physics import WarpBackend
from go1exp.config.schema.plugins import origin
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.mdp.feet import impossible
from go1exp.mdp.types import Snapshot, TermSetup
from go1exp.sim.schedule import WEIGHT
from go1exp.sim.task import TaskConfig


def reading(group: str, term: Term, call: Callable[..., Any]) -> Callable[..., Any]:
    """Return a plugin's function that its first call shows to write into none of the tensors that it is given.

    Its error is a ConfigError. A function of this package is returned as it is; attributes are kept.
    """
    if (plugin := origin(term.entry)) is None:
        return call
    untried = True

    @functools.wraps(call)
    def checked(*given: Any) -> Any:
        nonlocal untried
        if not untried:
            return call(*given)
        untried = False
        tensors: dict[str, Tensor] = {}
        for name, value in zip(inspect.signature(call).parameters, given, strict=False):
            parts = {name: value}
            if isinstance(value, Snapshot):
                parts = {f"{f.name} of the Snapshot": getattr(value, f.name) for f in fields(value)}
            tensors |= {key: part for key, part in parts.items() if isinstance(part, Tensor)}
        before = {name: (tensor._version, tensor.clone()) for name, tensor in tensors.items()}
        result = call(*given)
        # Views of NumPy and of ``data`` count no versions.
        written = [
            name
            for name, (version, copy) in before.items()
            if tensors[name]._version != version or not tensors[name].allclose(copy, 0.0, 0.0, equal_nan=True)
        ]
        if written:
            where = f"{group}.{term.key} ({plugin})"
            raise ConfigError([f"{where}: writes into {', '.join(written)}; clone what is to change"])
        return result

    return checked


def watched(group: str, term: Term, part: Any) -> Any:
    """Return an object that a term made; of a plugin, its ``advance`` and ``reset`` are checked by ``reading``."""
    for name in ("advance", "reset") if origin(term.entry) is not None else ():
        if hasattr(part, name):
            setattr(part, name, reading(group, term, getattr(part, name)))
    return part


class Frames(Memory):
    """Adds noise to the frames of N robots and puts earlier ones behind them.

    Attributes:
        size: F, numbers in a frame of all terms.
        noise: (F,) half-width of the uniform distribution of each number's noise.
        past: (N, H) earlier frames of the terms with a history: term by term, the newest first.
        error: (N, C) present noise of the numbers whose noise is correlated in time.
    """

    def __init__(self, terms: Sequence[Term], setup: TermSetup) -> None:
        """Prepare for the observations ``terms``."""
        widths = [frame_width(t) for t in terms]
        self.size = sum(widths)

        def numbers(slot: str) -> Tensor:
            each = torch.tensor([float(t.slots.get(slot, 0.0)) for t in terms])
            return each.repeat_interleave(torch.tensor(widths)).to(setup.device)

        def indices(columns: Sequence[int]) -> Tensor:
            return torch.tensor(columns, dtype=torch.int64, device=setup.device)

        self.noise = numbers("noise")
        kept = torch.exp(-setup.dt / numbers("correlation_time"))  # 0 for a time of 0
        self._correlated = kept.nonzero().squeeze(1)
        self._kept = kept[self._correlated]
        columns = history_columns(terms)
        self._newest, self._carried = indices(columns.newest), indices(columns.carried)
        earlier = set(columns.earlier)
        frames, past = iter(range(self.size)), iter(range(self.size, self.size + len(earlier)))
        self._order = indices([next(past if k in earlier else frames) for k in range(self.size + len(earlier))])
        self.past, self.error = setup.zeros(len(earlier)), setup.zeros(len(self._kept))
        self.memory = tuple(name for name in ("past", "error") if getattr(self, name).shape[1])

    def ended(self, frame: Tensor, unit: Tensor | None) -> Tensor:
        """Return the observation (N, O) at the end of a step, before any robot begins anew.

        Args:
            frame: (N, F) values of the terms.
            unit: (N, F) uniform from -1 to 1; None for no noise.
        """
        if unit is not None:
            if len(self._kept):
                fresh = torch.sqrt(1.0 - self._kept**2) * self._drawn(unit)
                self.error.copy_(self._kept * self.error + fresh)
            frame = self._noisy(frame, unit)
        return self._with_past(frame)

    def begun(self, frame: Tensor, unit: Tensor | None, anew: Tensor) -> Tensor:
        """Return what the policy sees next (N, O), and keep its frame for later steps.

        Args:
            frame: as for ``ended``.
            unit: as for ``ended``.
            anew: (N,) bool, robots whose episode begins: their earlier frames are all the first one.
        """
        rows = anew.unsqueeze(1)
        if unit is not None:
            if len(self._kept):
                self.error.copy_(torch.where(rows, self._drawn(unit), self.error))
            frame = self._noisy(frame, unit)
        if not self.past.shape[1]:
            return frame
        self.past.copy_(torch.where(rows, self._with_past(frame)[:, self._newest], self.past))
        observation = self._with_past(frame)
        self.past.copy_(observation[:, self._carried])
        return observation

    def _drawn(self, unit: Tensor) -> Tensor:
        """Return new noise (N, C) of the numbers whose noise is correlated."""
        return (unit * self.noise)[:, self._correlated]

    def _noisy(self, frame: Tensor, unit: Tensor) -> Tensor:
        """Return frames (N, F) with noise: drawn anew, or as the correlated one is now."""
        noise = unit * self.noise
        return frame + (noise.index_copy(1, self._correlated, self.error) if len(self._kept) else noise)

    def _with_past(self, frame: Tensor) -> Tensor:
        """Return frames (N, F) with the earlier ones of each term behind it, (N, O)."""
        return torch.cat([frame, self.past], dim=1)[:, self._order] if self.past.shape[1] else frame


Call = Callable[[Snapshot], Tensor]

TIME_LIMIT, LEFT_MAP, IMPOSSIBLE = "time limit", "left the map", "a force that physics cannot make"
"""Ends of an episode that are no failure."""


class StepTerms:
    """Rewards, observations and terminations of N robots.

    A term is a function, or a class whose object remembers something (``docs/extending.md``): it is called once a step,
    an observation's ``advance`` once a step before it is read, and ``reset(mask)`` where an episode begins.

    Attributes:
        rewards: terms with a weight that is not zero, or that may change.
        values: (N, R) of the rewards in the last step, without their weights.
        weights: (R,) times the policy's period.
        sums: (R,) float64, of weighted rewards since ``core.drain_metrics``.
        failed: (N, T) bool, which terminations were true in the last step.
        left_map: (N,) bool, robots at the edge of the ground in the last step.
        impossible: (N,) bool, robots with an impossible force on a foot in the last step (``mdp/feet.py``).
        distrusts: whether such a force ends an episode.
        privileged: terms that the critic alone sees.
        observed: terms of the observation, in the order of their columns; those of the critic are the last ones.
        observation_size: O.
        policy_size: columns that are the policy's.
        frames: noise and history of the observation.
        read: fields of the Snapshot that are computed only because an observation or a reward reads them.
    """

    def __init__(
        self,
        task: TaskConfig,
        num_envs: int,
        device: torch.device,
        critic: bool = False,
        changing: Collection[str] = (),
    ) -> None:
        """Build the terms of ``task``; with ``critic`` those that only the value function sees, too.

        ``changing`` has the keys of the settings that ``change`` may write, such as ``reward.gait.weight``.
        """
        setup = TermSetup(num_envs, device, task.sim.policy_dt)
        self._dt, self._changing = task.sim.policy_dt, {path: torch.zeros((), device=device) for path in changing}
        self._remembering: dict[str, Any] = {}

        def calls(group: str, terms: Sequence[Term]) -> list[Call]:
            """Return the terms as functions of a Snapshot."""
            made: list[Call] = [watched(group, t, t(setup)) if t.entry.remembers else t for t in terms]
            named = list(zip(terms, made, strict=True))
            self._remembering |= {f"{group}.{t.key}": call for t, call in named if t.entry.remembers}
            return [reading(group, t, call) for t, call in named]

        kept = (t for t in task.reward if t.slots[WEIGHT] != 0.0 or f"reward.{t.key}.{WEIGHT}" in changing)
        self.rewards = [self._with_changing(t) for t in kept]
        self._reward_calls = calls("reward", self.rewards)
        weights = [t.slots[WEIGHT] * task.sim.policy_dt for t in self.rewards]
        self.weights = torch.tensor(weights, dtype=torch.float32, device=device)
        self.values = setup.zeros(len(self.rewards))
        self.sums = torch.zeros(len(self.rewards), dtype=torch.float64, device=device)
        self._terminations = task.termination
        self._termination_calls = calls("termination", task.termination)
        self.failed = torch.zeros(num_envs, len(task.termination), dtype=torch.bool, device=device)
        # Seen with MuJoCo Warp alone; an engine that evaluates a policy must not hide a fall behind it.
        self.distrusts = isinstance(task.backend, WarpBackend)
        self.left_map, self.impossible = torch.zeros(2, num_envs, dtype=torch.bool, device=device).unbind(0)
        self.privileged = task.critic if critic else ()
        self._observation_calls = calls("observation", task.observation)
        self._critic_calls = calls("critic", self.privileged)
        self._advancing, self._critic_advancing = (
            [part for key, part in self._remembering.items() if key.startswith(f"{group}.")]
            for group in ("observation", "critic")
        )
        self.observed = (*task.observation, *self.privileged)
        self.read = {name for t in (*self.rewards, *self.observed) for name in t.entry.traits.get("reads", ())}
        widths = [width(t) for t in self.observed]
        self.observation_size, self.policy_size = sum(widths), sum(widths[: len(task.observation)])
        self.frames = Frames(self.observed, setup)

    def _with_changing(self, term: Term) -> Term:
        """Return a reward whose parameters that may change are tensors (), in the place of numbers."""
        live = {name: self._changing.get(f"reward.{term.key}.{name}") for name in term.parameters}
        tensors = {name: tensor.fill_(term.parameters[name]) for name, tensor in live.items() if tensor is not None}
        return replace(term, parameters={**term.parameters, **tensors}) if tensors else term

    def change(self, path: str, value: float) -> None:
        """Change ``reward.KEY.weight`` or a parameter ``reward.KEY.NAME``, in place, from the next step on."""
        key, _, name = path.removeprefix("reward.").rpartition(".")
        if name == WEIGHT:
            self.weights[[t.key for t in self.rewards].index(key)].fill_(value * self._dt)
        else:
            self._changing[path].fill_(value)

    def terminated(self, s: Snapshot) -> Tensor:
        """(N,) bool, any termination is true."""
        for k, term in enumerate(self._termination_calls):
            self.failed[:, k] = self._shaped("termination", self._terminations[k], term(s))
        return self.failed.any(-1)

    def cut_short(self, left_map: Tensor, s: Snapshot) -> Tensor:
        """(N,) bool, whose episode ends without a failure of the robot; ``left_map`` (N,) bool."""
        self.left_map.copy_(left_map)
        if not self.distrusts:
            return self.left_map
        self.impossible.copy_(impossible(s.foot_peak_force))
        return self.left_map | self.impossible

    def reward(self, s: Snapshot) -> Tensor:
        """(N,) sum of weight x term x policy period."""
        for k, term in enumerate(self._reward_calls):
            self.values[:, k] = self._shaped("reward", self.rewards[k], term(s))
        weighted = self.values * self.weights
        self.sums += weighted.sum(0)
        return weighted.sum(-1)

    def advance(self, sensed: Snapshot, s: Snapshot) -> None:
        """Let observations that remember something take in a step: as the sensors saw it, the critic's as it was."""
        for term in self._advancing:
            term.advance(sensed)
        for term in self._critic_advancing:
            term.advance(s)

    def observation(self, sensed: Snapshot, s: Snapshot) -> Tensor:
        """(N, F) values of all observations: what the sensors saw, and behind it the critic's, of the truth."""
        values = [*(term(sensed) for term in self._observation_calls), *(term(s) for term in self._critic_calls)]
        return torch.cat(
            [self._shaped("observation", t, v) for t, v in zip(self.observed, values, strict=True)], dim=-1
        )

    def _shaped(self, group: str, term: Term, value: Tensor) -> Tensor:
        """Return what a term gave; raise ConfigError unless it is one value, or ``size`` of them, for each robot."""
        if not isinstance(value, Tensor):
            raise ConfigError([f"{group}.{term.key}: gives {type(value).__name__}, must be a tensor"])
        size = (frame_width(term),) if group == "observation" else ()
        if value.shape == (self.values.shape[0], *size):
            return value
        wanted = f"(N, {size[0]}) as its size says" if size else "(N,), one value per robot"
        given = f"gives {tuple(value.shape)} for {self.values.shape[0]} robots"
        raise ConfigError([f"{group}.{term.key}: {given}, must be {wanted}"])

    def reset(self, mask: Tensor) -> None:
        """Begin new episodes in the rows of ``mask`` (N,)."""
        for term in self._remembering.values():
            term.reset(mask)

    def reward_terms(self) -> dict[str, Tensor]:
        """Return what each term contributed to the last step's reward, (N,) each, weight and period included."""
        weighted = self.values * self.weights
        return {t.key: weighted[:, k] for k, t in enumerate(self.rewards)}

    def end(self, env: int, terminated: bool, truncated: bool) -> str | None:
        """Say why an episode ended in the last step: the first termination that was true, or ``TIME_LIMIT`` ..."""
        if terminated:
            return self._terminations[int(self.failed[env].int().argmax())].key
        if truncated:
            return LEFT_MAP if self.left_map[env] else IMPOSSIBLE if self.impossible[env] else TIME_LIMIT
        return None

    def parts(self) -> dict[str, Any]:
        """Return what remembers something: terms by group and key, and the frames."""
        return {**self._remembering, **({"frames": self.frames} if self.frames.memory else {})}
