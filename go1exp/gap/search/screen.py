"""Which missing effects could explain what the model cannot, to first order: one pass of replays for all of them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.rows import Key, Machine, Probe, Theta, variants
from go1exp.gap.score.likelihood import Scorer, log_chi2
from go1exp.gap.score.linear import Layout, Table, differences, predicted
from go1exp.gap.search import thresholds, tolerances
from go1exp.sim.effects.base import Identification, Periodic
from go1exp.sim.effects.tolerances import Tolerances, sizes

BEYOND = 1.5  # times a probe of twice the tolerance: a larger change may not be scaled down to that


@dataclass(frozen=True)
class Variant:
    """One way for an effect to be there."""

    effect: str  # registered name
    probes: tuple[Probe, ...] = ()  # what was changed to see it; empty for one whose columns the box has
    shapes: Theta = field(default_factory=dict)  # values of its shapes
    # whether it is evaluated and begun just as it was probed, since it is far from linear: half a torque limit may clip
    # nothing
    exact: bool = False

    @property
    def quadrature(self) -> bool:
        """Whether the two halves of the probes are amplitudes at phases 0 and pi / 2."""
        return tolerances.identification(self.effect).periodic is not None

    def start(self, theta: Theta, layout: Layout, x: np.ndarray, machine: Machine) -> Theta:
        """Return where a fit begins: ``theta`` with this effect as large as the linear model has it."""
        periodic = tolerances.identification(self.effect).periodic
        if periodic:
            sine, cosine = np.zeros(len(machine.joints)), np.zeros(len(machine.joints))
            for i in range(layout.size):
                (sine if layout.probe[i] < len(self.probes) // 2 else cosine)[layout.joint[i]] = x[i]
            return {
                **theta,
                **{key: np.broadcast_to(value, sine.shape).copy() for key, value in self.shapes.items()},
                (self.effect, periodic.amplitude): np.hypot(sine, cosine),
                (self.effect, periodic.phase): np.arctan2(cosine, sine),
            }
        return tolerances.moved({**theta, **self.shapes}, layout, self.probes, x, machine)

    @property
    def free(self) -> tuple[Key, ...]:
        """Parameters that a full fit changes."""
        return (*sizes(self.effect), *free_shapes(self.effect))


def free_shapes(effect: str) -> tuple[Key, ...]:
    """Return the shape parameters of an effect that a full fit may change."""
    return tuple((effect, name) for name in tolerances.identification(effect).free_shapes)


@dataclass(frozen=True)
class Motion:
    """What joints did in the recordings: where shapes and thresholds of effects are looked for."""

    mean: np.ndarray  # (J,) average angles, rad
    least: np.ndarray  # (J,) least angles
    largest: np.ndarray  # (J,) largest angles
    demand: np.ndarray  # (J,) largest torque that was asked for, over the peak torque

    def angle(self, value: float) -> np.ndarray:
        """Return what a shape's value stands for (J,) or (1,); see ``sim/effects/base.py``."""
        if math.isnan(value):
            return self.mean.copy()
        if math.isinf(value):
            return (self.least if value < 0 else self.largest).copy()
        return np.array([value])


def motion(windows: Windows, effort: Sequence[float]) -> Motion:
    """Return what joints did in the windows; ``effort`` (J,) are their peak torques, N m."""
    which = np.arange(len(windows))
    q, valid = windows.y[:, :, 0], windows.valid[..., None] & windows.compared[:, None]
    asked = np.abs(windows.demanded(which)) * valid
    least, largest = (np.where(valid, q, other).reshape(-1, q.shape[-1]) for other in (np.inf, -np.inf))
    mean = (q * valid).sum((0, 1)) / np.maximum(valid.sum((0, 1)), 1)
    return Motion(mean, least.min(0), largest.max(0), asked.max((0, 1)) / np.asarray(effort))


def library(machine: Machine, moved: Motion, exclude: Collection[str] = ()) -> list[Variant]:
    """Return every way in which an effect could be missing in recordings of some motion."""
    variants: list[Variant] = []
    within = tolerances.nominal(machine)
    for effect in tolerances.felt(machine):
        how = tolerances.identification(effect)
        if effect in exclude:
            continue
        if effect in within and not how.levels:
            variants.append(Variant(effect))  # its columns are there
        elif how.periodic:
            variants += _periods(machine, effect, how.periodic)
        else:
            variants += _levels(machine, effect, how, moved)
    return variants


def _periods(machine: Machine, effect: str, periodic: Periodic) -> Iterator[Variant]:
    """Yield a variant for each number of periods per turn, with amplitudes at phases 0 and pi / 2."""
    key = (effect, periodic.amplitude)
    plain = tolerances.probes(machine, [key], {}, thresholds.PROBE)
    for count in periodic.counts:
        at: Theta = {(effect, periodic.count): np.array([count])}
        phases = [{**at, (effect, periodic.phase): np.array([phase])} for phase in (0.0, math.pi / 2)]
        yield Variant(effect, tuple(Probe(key, p.place, p.delta, also) for also in phases for p in plain), at)


def _levels(machine: Machine, effect: str, how: Identification, moved: Motion) -> Iterator[Variant]:
    """Yield a variant for each law, each choice of shapes and each level at which the effect is probed."""
    levels: list[Mapping[str, float | np.ndarray]] = [*how.levels]
    if how.limits_torque:
        limit = machine.tolerances.param((effect, how.limits_torque))
        for part in np.array(machine.groups).T:  # the same place of each group
            largest = min(float(moved.demand[part].max()), limit.null)  # what is asked for beyond the peak is cut off
            for share in thresholds.TORQUE_SHARES:
                change = np.zeros(len(machine.joints))
                change[part] = np.clip(share * largest, limit.low, limit.null - limit.tolerance) - limit.null
                levels.append({how.limits_torque: change})
    wide = {key[1]: thresholds.PROBE * machine.tolerances.param(key).tolerance for key in sizes(effect)}
    within = [np.abs(change).max() <= BEYOND * wide[name] for level in levels for name, change in level.items()]
    if within and not any(within) and not how.nominal:
        levels.append({})  # narrow tolerances of the user's: what twice their width would show is measured, too
    for law, chosen in product(how.laws or ({},), how.shapes or ({},)):
        shapes: Theta = {(effect, name): moved.angle(value) for name, value in {**law, **chosen}.items()}
        for level in levels or [{}]:
            keys = [key for key in sizes(effect) if not level or key[1] in level]
            probes = []
            for p in tolerances.probes(machine, keys, {}, thresholds.PROBE):
                key = (effect, p.key[1])
                delta = _within(machine, key, level[key[1]], p.delta) if level else p.delta
                probes.append(Probe(p.key, p.place, delta, shapes))
            if any(not probe.delta.any() for probe in probes):
                continue  # no room for this level: a robot on hard ground has hardly any harder one
            exact = bool(how.limits_torque) and isinstance(level.get(how.limits_torque), np.ndarray)
            yield Variant(effect, tuple(probes), shapes, exact)


def _within(machine: Machine, key: Key, change: float | np.ndarray, like: np.ndarray) -> np.ndarray:
    """Return a change from null in the shape of ``like``, a number within bounds; all 0 if next to nothing is left."""
    delta, p = np.broadcast_to(change, like.shape).copy(), machine.tolerances.param(key)
    if isinstance(change, np.ndarray):
        return delta
    beyond = (p.null + delta < p.low) | (p.null + delta > p.high)
    delta[beyond] = (p.null + delta[beyond]).clip(p.low, p.high) - p.null
    delta[beyond & (np.abs(delta) < thresholds.DIFFERENCE * p.tolerance)] = 0.0
    return delta


@dataclass(frozen=True)
class Screened:
    """What the linear model predicts for one variant."""

    variant: Variant  # which
    theta: Theta  # where a fit would begin
    gain: float  # mean fall of log chi2 over the windows
    relief: float  # fall of chi2 and priors per value, if the effect may leave its tolerance
    signal: float  # largest chi2 that twice its tolerance adds to one value of a window, on average over the window


def screen(
    scorer: Scorer, theta: Theta, present: Table, may: tolerances.Freedom, library: Sequence[Variant], dt: float
) -> list[Screened]:
    """Rank variants by a linear model that adds their columns to those of ``present``, about the values ``theta``."""
    every = [p for v in library for p in v.probes]
    columns = _columns(scorer, theta, present.windows, every, dt)
    whole = np.concatenate([present.columns, columns], axis=-1)
    full = replace(present, probes=(*present.probes, *every), columns=whole, theta=theta)
    ranking = _Ranking(scorer, present, full, may)
    screened, at = [], len(present.probes)
    for variant in library:
        screened.append(ranking.screened(variant, at))
        at += len(variant.probes)
    return sorted(screened, key=lambda s: -s.gain)


class _Ranking:
    """The linear model of all variants together, from which each is evaluated by itself."""

    def __init__(self, scorer: Scorer, present: Table, full: Table, may: tolerances.Freedom) -> None:
        """Take the linear model ``own`` of what may move already, and ``full``, which adds the probes of variants."""
        self.present, self.full, self.may, self.machine = present, full, may, scorer.replayer.machine
        self.size = scorer.size[present.windows][:, None]
        self.grams = full.grams(scorer)
        self.before = self.grams[..., -1, -1] / self.size
        self.plain, self.count = tolerances.cost(scorer, present)(may), tolerances.values(scorer, present)

    def screened(self, variant: Variant, at: int) -> Screened:
        """Evaluate a variant whose probes begin at column ``at``."""
        theta, known = self.full.theta, len(self.present.probes)
        added = list(range(at, at + len(variant.probes)))
        pick = [*range(known), *added]
        probes = [*self.present.probes, *variant.probes]
        part = self.grams[:, :, [*pick, -1]][..., [*pick, -1]]
        layout = Layout.from_probes(self.machine, probes)
        matrix, right = layout.total(part * (1.0 / np.maximum(self.before, 1.0))[..., None, None])
        freed = self.may.also(variant.effect)
        limits, strict = (tolerances.bounds(layout, probes, theta, freed, back) for back in (False, True))
        for bounds in (limits, strict) if variant.quadrature else ():
            bounds.low[layout.part(np.arange(known, len(probes)))] = -np.inf
        if variant.exact:
            for i in layout.part(np.arange(known, len(probes))):
                delta, joint = probes[layout.probe[i]].delta, int(layout.joint[i])
                limits.low[i] = limits.high[i] = delta[joint if joint >= 0 else int(np.argmax(np.abs(delta)))]
        relief = (self.plain - tolerances.price(matrix, right, strict)) / self.count
        x = tolerances.solve(matrix, right, limits)
        after = np.maximum(predicted(part, layout, x), 0.0) / self.size  # rounding can make it negative
        gain = float(np.mean(log_chi2(self.before) - log_chi2(after)))
        start = _start(theta, variant, self.present.probes, layout, x, self.machine)
        columns = [*added, *(k for k, p in enumerate(self.present.probes) if p.key[0] == variant.effect)]
        signal = _signal(self.grams, self.full.probes, columns, self.size, self.may.tolerances)
        return Screened(variant, start, gain, relief, signal)


def shows(level: float) -> bool:
    """Return whether recordings excite an effect, by the chi2 that twice its tolerance adds to their best window.

    The only such law: of the answer for the logs at hand, and of ``gap next`` for the recordings that it designs.
    """
    return level >= thresholds.NOT_EXCITED


def outside(screened: Sequence[Screened], within: Collection[str]) -> list[Screened]:
    """Return the effects to try if one that has no tolerance to move in would relieve the others most; none otherwise.

    Those that would relieve nearly as much are its rivals; held-out data decide between them.
    """
    order = sorted(screened, key=lambda s: -s.relief)
    if not order or order[0].variant.effect in within or order[0].relief < thresholds.OUTSIDE_BOX:
        return []
    return [s for s in order if s.relief > order[0].relief / thresholds.RIVAL_RATIO]


def rivals(screened: Sequence[Screened], active: Collection[str], within: Collection[str]) -> list[Screened]:
    """Return variants of effects that one with an active bound is easily taken for.

    Only effects without a tolerance, since the bounds of all others would be active too, that would relieve the model
    nearly as much as the first active one; of each the variant that would do so most.
    """
    most = max((s.relief for s in screened if s.variant.effect in active), default=0.0)
    best: dict[str, Screened] = {}
    for s in sorted(screened, key=lambda s: -s.relief):
        name = s.variant.effect
        if name not in within and any(tolerances.confounded(name, one) for one in active):
            best.setdefault(name, s)
    return [s for s in best.values() if s.relief > most / thresholds.RIVAL_RATIO]


def _start(
    theta: Theta, variant: Variant, known: Sequence[Probe], layout: Layout, x: np.ndarray, machine: Machine
) -> Theta:
    """Return the present values with the variant's effect alone moved: the linear model moves all else too far."""
    if variant.probes:
        extra = Layout.from_probes(machine, variant.probes)
        return variant.start(theta, extra, x[layout.size - extra.size :], machine)
    of_it = np.array([known[k].key[0] == variant.effect for k in layout.probe])
    return tolerances.moved(theta, layout, known, np.where(of_it, x, 0.0), machine)


def _signal(
    grams: np.ndarray, probes: Sequence[Probe], columns: Sequence[int], size: np.ndarray, declared: Tolerances
) -> float:
    """Return the largest mean square, in units of the noise, that a change by twice a tolerance makes in a window."""
    most = 0.0
    for k in columns:
        key = probes[k].key
        assert isinstance(key, tuple)
        reach = thresholds.PROBE * declared.param(key).tolerance
        if np.abs(probes[k].delta).max() <= BEYOND * reach:  # beyond, a threshold may lie between
            most = max(most, float((grams[..., k, k] / size).max()) * reach**2)
    return most


def _columns(scorer: Scorer, theta: Theta, windows: np.ndarray, probes: Sequence[Probe], dt: float) -> np.ndarray:
    """Return the columns of probes, replayed a few effects at a time: each one on the plant costs time."""
    machine, replayer = scorer.replayer.machine, scorer.replayer
    by_effect: dict[str, list[int]] = {}
    for k, p in enumerate(probes):
        by_effect.setdefault(p.key[0], []).append(k)
    lots: list[list[int]] = []
    for members in by_effect.values():
        if lots and len(lots[-1]) + len(members) <= 45:
            lots[-1] += members
        else:
            lots.append(list(members))
    values = scorer.windows.t.shape[1] * len(scorer.windows.quantities) * len(machine.groups[0])
    columns = np.zeros((len(windows), len(machine.groups), values, len(probes)), dtype=np.float32)
    for lot in lots:
        chosen = [probes[k] for k in lot]
        rows = variants(machine, theta, windows, chosen)
        y = replayer.run(rows, 2.0 * dt).reshape(len(windows), 1 + len(chosen), *scorer.windows.y.shape[1:])
        columns[..., lot] = differences(scorer, y, windows, chosen)
    return columns
