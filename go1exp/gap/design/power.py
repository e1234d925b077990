"""How well recordings tell two explanations apart.

For a truth A with its fitted values and a rival B, recordings are worth

    T = min over B's values, tolerances and initial states of |Sigma^-1/2 (y_A - y_B)|^2

(T-optimality: Atkinson and Fedorov 1975; for several models Box and Hill 1967). B is first fitted to what A does on the
recordings at hand; about these values the minimum is taken to first order, over all recordings together, so that what
must hold in two attitudes, or at two gains, counts once. T is additive over recordings for given values.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from go1exp.gap.data.splits import Splits
from go1exp.gap.replay.rows import Theta, variants
from go1exp.gap.result import GapSettings
from go1exp.gap.score.likelihood import Scorer
from go1exp.gap.score.linear import Layout, Table, predicted
from go1exp.gap.score.robust import log_chi2
from go1exp.gap.search import tolerances
from go1exp.gap.search.state import State

FITTED = 24
"""Windows of the recordings at hand on which rivals are fitted and compared, at most."""

NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
"""Of a mean over a normal distribution (Gauss and Hermite)."""


@dataclass(frozen=True)
class Pair:
    """Two explanations.

    Attributes:
        truth: effect that is taken to be there.
        rival: effect that might be there in its place; empty for none at all.
        theta: values of the model with the truth.
        without: values without it, from which the rival is fitted.
        terms: effects that may leave their tolerances under the rival, itself included.
        spread: standard deviation of the truth's size, as a share of it.
        same: mean difference of log chi2 that counts as none (``significance.same``).
    """

    truth: str
    rival: str
    theta: Theta
    without: Theta
    terms: tuple[str, ...]
    spread: float
    same: float

    @property
    def name(self) -> str:
        """In words."""
        return f"{self.truth} from {self.rival}" if self.rival else f"{self.truth} from nothing"


@dataclass(frozen=True)
class Evidence:
    """What some recordings say about a pair.

    Attributes:
        grams: (V, G, p+1, p+1) of the rival's columns, and of what it leaves of the truth.
        size: (V,) values in a window and group.
        signal: (V, G) chi2 sum of all that the truth does.
        weight: how many windows each stands for.
        episode: (V,) number of the recording.
    """

    grams: np.ndarray
    size: np.ndarray
    signal: np.ndarray
    weight: float
    episode: np.ndarray

    def one(self, episode: int, weight: float = 1.0) -> Evidence:
        """Return that of one recording, each of whose windows stands for ``weight``."""
        chosen = self.episode == episode
        return Evidence(self.grams[chosen], self.size[chosen], self.signal[chosen], weight, self.episode[chosen])


@dataclass(frozen=True)
class Worth:
    """How well recordings tell a pair apart.

    Attributes:
        distance: T, in units of the noise, squared.
        imitated: share of what the truth does that the rival imitates.
        gain: mean difference of log chi2 over windows and groups of joints.
        power: chance that the difference is larger than noise makes it in 1 of 100 cases, and than the search takes
            for the same.
    """

    distance: float
    imitated: float
    gain: float
    power: float


def power(distance: float, gain: float, same: float, values: float, spread: float, alpha: float) -> float:
    """Return the chance to tell two explanations apart, averaged over the size of the true one.

    With the truth, the log likelihood ratio (twice) is normal about T with variance 4 T; with the rival about -T. It
    must exceed what the rival would reach in ``alpha`` of cases, and ``same`` per value on average.

    Args:
        distance: T.
        gain: mean difference of log chi2 without noise.
        same: difference that counts as none.
        values: number of values that were compared.
        spread: relative standard deviation of the true size; T grows with its square.
        alpha: level of the test.
    """
    total = 0.0
    for node, weight in zip(NODES, WEIGHTS / WEIGHTS.sum(), strict=True):
        scale = max(1.0 + spread * node, 0.0) ** 2
        t, visible = scale * distance, scale * gain * values
        by_noise = norm.cdf(np.sqrt(t) - norm.isf(alpha))
        material = norm.cdf((visible - same * values) / (2.0 * np.sqrt(visible))) if visible > 0.0 else 0.0
        total += weight * min(by_noise, material)
    return float(total)


class Judge:
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
        self.state = state.settled(2)
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

    def worth(self, *parts: Evidence) -> Worth:
        """Return how well recordings tell the pair apart, all of ``parts`` together."""
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
        return Worth(distance, 1.0 - distance / max(energy, distance, 1e-12), gain / values, chance)


def _measured(scorer: Scorer, theta: Theta, windows: np.ndarray, dt: float) -> Scorer:
    """Return a scorer that takes what a model says, without noise, for what was measured in some windows."""
    replayer = scorer.replayer
    y = replayer.windows.y.copy()
    y[windows] = replayer.run(variants(replayer.machine, theta, windows, []), dt)
    copied = dataclasses.replace(replayer.windows, y=y)
    return dataclasses.replace(scorer, replayer=dataclasses.replace(replayer, windows=copied))
