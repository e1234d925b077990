"""The experiment that separates the remaining explanations best: power of a design, and a search over designs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from go1exp.gap.data.windows import Splits
from go1exp.gap.design.plan import Attitude, Design, DesignError, DesignSettings, library, neighbours
from go1exp.gap.design.rehearsal import Rehearsal, Stage
from go1exp.gap.replay.rows import Theta, variants
from go1exp.gap.result import GapSettings
from go1exp.gap.score.likelihood import Scorer, log_chi2
from go1exp.gap.score.linear import Layout, Table, predicted
from go1exp.gap.search import tolerances
from go1exp.gap.search.screen import shows
from go1exp.gap.search.state import State

FITTED = 24  # windows of the recordings at hand on which rivals are fitted and compared, at most

NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
"""Of a mean over a normal distribution (Gauss and Hermite)."""


@dataclass(frozen=True)
class Pair:
    """Two explanations."""

    truth: str  # effect that is taken to be there
    rival: str  # effect that might be there in its place; empty for none at all
    theta: Theta  # values of the model with the truth
    without: Theta  # values without it, from which the rival is fitted
    terms: tuple[str, ...]  # effects that may leave their tolerances under the rival, itself included
    spread: float  # standard deviation of the truth's size, as a share of it
    # mean difference of log chi2 that counts as none (``significance.same``); without a rival ``screen.shows`` decides
    same: float

    @property
    def name(self) -> str:
        """In words."""
        return f"{self.truth} vs. {self.rival or 'none'}"


@dataclass(frozen=True)
class Evidence:
    """What some recordings say about a pair."""

    grams: np.ndarray  # (V, G, p+1, p+1) of the rival's columns, and of what it leaves of the truth
    size: np.ndarray  # (V,) values in a window and group
    signal: np.ndarray  # (V, G) chi2 sum of all that the truth does
    weight: float  # how many windows each stands for
    episode: np.ndarray  # (V,) number of the recording

    def one(self, episode: int, weight: float = 1.0) -> Evidence:
        """Return that of one recording, each of whose windows stands for ``weight``."""
        chosen = self.episode == episode
        return Evidence(self.grams[chosen], self.size[chosen], self.signal[chosen], weight, self.episode[chosen])


@dataclass(frozen=True)
class Worth:
    """How well recordings separate a pair."""

    distance: float  # T, in units of the noise, squared
    imitated: float  # share of what the truth does that the rival imitates
    gain: float  # mean difference of log chi2 over windows and groups of joints
    # chance that the difference is larger than noise makes it in 1 of 100 cases, and than the search takes for the same
    power: float


def power(distance: float, gain: float, same: float, values: float, spread: float, alpha: float) -> float:
    """Return the chance to separate two explanations, averaged over the size of the true one.

    With the truth, the log likelihood ratio (twice) is normal about T (``distance``) with variance 4 T; with the rival
    about -T. It must exceed what the rival would reach in ``alpha`` of cases. The mean difference of log chi2 without
    noise (``gain``) of that many ``values`` must exceed what counts as the ``same``. ``spread`` is the relative
    standard deviation of the true size; T grows with its square.
    """
    total = 0.0
    for node, weight in zip(NODES, WEIGHTS / WEIGHTS.sum(), strict=True):
        scale = max(1.0 + spread * node, 0.0) ** 2
        t, visible = scale * distance, scale * gain * values
        by_noise = norm.cdf(np.sqrt(t) - norm.isf(alpha))
        material = norm.cdf((visible - same * values) / (2.0 * np.sqrt(visible))) if visible > 0.0 else 0.0
        total += weight * min(by_noise, material)
    return float(total)


class Evaluator:
    """A pair, the rival fitted to what the truth does on the recordings at hand."""

    def __init__(self, pair: Pair, scorer: Scorer, settings: GapSettings, dt: float) -> None:
        """Fit the rival; ``dt``: physics step, s."""
        self.pair, self.alpha = pair, settings.alpha
        everything = np.arange(len(scorer.windows))
        few = np.unique(np.linspace(0, len(everything) - 1, min(FITTED, len(everything))).astype(int))
        nothing = np.empty(0, dtype=int)
        measured = _measured(scorer, pair.theta, few, dt)
        start = {key: value.copy() for key, value in pair.without.items()}
        state = State(measured, Splits(few, nothing, nothing), settings, dt, start, pair.terms)
        self.state = state.converged(2)
        assert self.state.fitted is not None
        self.layout = Layout.from_probes(self.state.machine, self.state.fitted.probes)
        self.at_hand = self._evidence(measured, self.state.fitted, len(everything) / len(few), dt)

    def evidence(self, scorer: Scorer, dt: float) -> Evidence:
        """Return what the windows of other recordings say."""
        windows = np.arange(len(scorer.windows))
        measured = _measured(scorer, self.pair.theta, windows, dt)
        table = dataclasses.replace(self.state, scorer=measured, dt=dt).linear(self.state.theta, windows)
        return self._evidence(measured, table, 1.0, dt)

    def _evidence(self, measured: Scorer, table: Table, weight: float, dt: float) -> Evidence:
        windows, machine = table.windows, measured.replayer.machine
        residual = measured.residual(variants(machine, self.pair.without, windows, []), dt)
        signal = measured.chi2(residual, windows) * measured.size[windows][:, None]
        episode = measured.windows.episode[windows]
        return Evidence(table.grams(measured), measured.size[windows], signal, weight, episode)

    @property
    def known(self) -> tuple[Evidence, ...]:
        """What the recordings at hand say of the pair: nothing of an effect that they do not excite."""
        return (self.at_hand,) if self.pair.rival else ()

    def worth(self, *parts: Evidence) -> Worth:
        """Return how well recordings separate the pair, all of ``parts`` together."""
        if not parts:
            return Worth(0.0, 0.0, 0.0, 0.0)
        state, layout = self.state, self.layout
        totals = [(part.weight, layout.total(part.grams)) for part in parts]
        matrix = sum(weight * total[0] for weight, total in totals)
        right = sum(weight * total[1] for weight, total in totals)
        assert state.fitted is not None
        limits = tolerances.bounds(layout, state.fitted.probes, state.theta, state.may)
        x = tolerances.solve(np.asarray(matrix), np.asarray(right), limits)
        distance = gain = values = energy = 0.0
        for part in parts:
            left = np.maximum(predicted(part.grams, layout, x), 0.0)  # V G; rounding can make it negative
            distance += part.weight * float(left.sum())
            gain += part.weight * float((log_chi2(1.0 + left / part.size[:, None]) * part.size[:, None]).sum())
            values += part.weight * float(part.size.sum()) * left.shape[1]
            energy += part.weight * float(part.signal.sum())
        pair = self.pair
        chance = power(distance, gain / values, pair.same, values, pair.spread, self.alpha)
        if not (pair.rival or shows(max(float((part.signal / part.size[:, None]).max()) for part in parts))):
            chance = 0.0
        return Worth(distance, 1.0 - distance / max(energy, distance, 1e-12), gain / values, chance)


def _measured(scorer: Scorer, theta: Theta, windows: np.ndarray, dt: float) -> Scorer:
    """Return a scorer that takes what a model says, without noise, for what was measured in some windows."""
    replayer = scorer.replayer
    y = replayer.windows.y.copy()
    y[windows] = replayer.run(variants(replayer.machine, theta, windows, []), dt)
    copied = dataclasses.replace(replayer.windows, y=y)
    return dataclasses.replace(scorer, replayer=dataclasses.replace(replayer, windows=copied))


ENOUGH = 0.8  # power from which two explanations count as distinguishable
LOT = 20  # designs whose windows are replayed together; more would need more memory
FEW, MORE = 3, 8  # windows of a design in the quick look, and in the closer one
FINALISTS = 4  # designs of the library that are looked at closely, and neighbours in a round

COARSE = 2.0
"""Physics step of all comparisons over that of the search: both sides have the same, and it takes half the time."""


@dataclass(frozen=True)
class Choice:
    """What a search for a design came to."""

    best: Rehearsal | None  # the design; None if no pair is distinguishable
    worths: tuple[Worth, ...]  # of what is known and the best design together, pair by pair
    reach: tuple[Worth, ...]  # largest power that any design reached, pair by pair
    tried: int  # designs that were looked at
    beyond: int  # designs that were left out since they go beyond a limit


class _Search:
    """Designs tried so far."""

    def __init__(self, stage: Stage, evaluators: Sequence[Evaluator]) -> None:
        self.stage, self.evaluators = stage, evaluators
        self.dt = stage.comparison.dt  # of what is held against limits
        self.tried = self.beyond = 0
        self.reach = [evaluator.worth(*evaluator.known) for evaluator in evaluators]

    def within_limits(self, designs: Sequence[Design]) -> list[Rehearsal]:
        """Return the designs that stay within the limits, as the model plays them."""
        played = [r for k in range(0, len(designs), 64) for r in self.stage.rehearsed(designs[k : k + 64], self.dt)]
        allowed = [r for r in played if self.stage.limits.allow(r.used)]
        self.tried, self.beyond = self.tried + len(designs), self.beyond + len(played) - len(allowed)
        return allowed

    def evaluated(self, played: Sequence[Rehearsal], few: int) -> list[tuple[Worth, ...]]:
        """Return the worth of each design with the recordings at hand, pair by pair, from ``few`` of its windows."""
        dt = COARSE * self.dt
        results: list[tuple[Worth, ...]] = []
        for k in range(0, len(played), LOT):
            lot = played[k : k + LOT]
            score = self.stage.scored(lot, dt, few)
            evidences = [evaluator.evidence(score, dt) for evaluator in self.evaluators]
            whole = self.stage.seconds / self.stage.comparison.settings.stride_s
            for number in range(len(lot)):
                worths = []
                for evaluator, evidence in zip(self.evaluators, evidences, strict=True):
                    count = int((evidence.episode == number).sum())
                    evidence_of_one = [evidence.one(number, max(whole / count, 1.0))] if count else []
                    worths.append(evaluator.worth(*evaluator.known, *evidence_of_one))
                results.append(tuple(worths))
        return results


def _order(worth: Worth) -> tuple[float, float]:
    return worth.power, worth.gain


def _value(worths: Sequence[Worth], goals: Sequence[int]) -> tuple[float, float, float]:
    """Return by what designs are ranked: the least power over the goals, the mean, the least difference."""
    powers, gains = zip(*((worths[k].power, worths[k].gain) for k in goals), strict=True)
    return min(powers), float(np.mean(powers)), min(gains)


def attainable(worths: Sequence[tuple[Worth, ...]], fallback: bool) -> list[int]:
    """Return the pairs that some design separates; if there is none and ``fallback``, those that come nearest."""
    best = [max((w[k].power for w in worths), default=0.0) for k in range(len(worths[0]))] if worths else []
    goals = [k for k, reached in enumerate(best) if reached >= ENOUGH]
    return goals or ([k for k, reached in enumerate(best) if reached == max(best)] if fallback else [])


def choose(
    stage: Stage,
    evaluators: Sequence[Evaluator],
    attitudes: Sequence[Attitude],
    settings: DesignSettings,
    on_progress: Callable[[str, float], None],
) -> Choice:
    """Find the design of the largest least power over the pairs that any separates; DesignError if all are too much."""
    rng, search = np.random.default_rng(settings.seed), _Search(stage, evaluators)
    on_progress("designs within the limits", 0.2)
    played = search.within_limits(library(settings.designs, settings.gains, attitudes, rng))
    if not played:
        raise DesignError(f"limits: all of {search.tried} designs go beyond them; allow more (limits.speed=..., ...)")
    on_progress("a quick look at the designs", 0.3)
    quick = search.evaluated(played, FEW)
    goals = attainable(quick, True)
    order = sorted(range(len(played)), key=lambda k: _value(quick[k], goals), reverse=True)[:FINALISTS]
    # The best for each pair alone is looked at too: a quick look may be wrong about which are distinguishable.
    alone = [max(range(len(played)), key=lambda k, n=n: _order(quick[k][n])) for n in range(len(evaluators))]  # type: ignore[misc]
    finalists = [played[k] for k in dict.fromkeys([*order, *alone])]
    on_progress("a closer look at the best", 0.6)
    worths = search.evaluated(finalists, MORE)
    for turn in range(settings.refine):
        goals = attainable(worths, True)
        top = max(range(len(finalists)), key=lambda k: _value(worths[k], goals))
        on_progress("neighbours of the best", 0.7 + 0.3 * turn / settings.refine)
        near = search.within_limits(neighbours(finalists[top].design, FINALISTS, settings.gains, attitudes, rng))
        if near:
            finalists, worths = [*finalists, *near], [*worths, *search.evaluated(near, MORE)]
    for each in worths:
        search.reach = [max(a, b, key=_order) for a, b in zip(search.reach, each, strict=True)]
    goals = attainable(worths, False)
    if not goals:
        return Choice(None, tuple(search.reach), tuple(search.reach), search.tried, search.beyond)
    top = max(range(len(finalists)), key=lambda k: _value(worths[k], goals))
    return Choice(finalists[top], worths[top], tuple(search.reach), search.tried, search.beyond)
