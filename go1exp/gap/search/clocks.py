"""Two clocks as competing models of the time between rows: which of them lets the robot's model explain the recordings.

An incomplete model can do better by a wrong clock: a wrong rate looks like wrong inertias. So for each clock the
nominal parameters move within their tolerances, and a search finds the first terms. Both are then tested on held-out
windows of the same rows, by one floor.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from go1exp.gap.data.cutting import FIT_S, Place, even_clock
from go1exp.gap.data.standing import rows_at
from go1exp.gap.data.windows import PAST_S, Splits, Windows, stretches
from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import DEFAULT_CLOCK, Clock, ClockChoice, GapSettings
from go1exp.gap.score.angle_errors import of_angles
from go1exp.gap.score.initial_state import rescaled
from go1exp.gap.score.likelihood import Scorer, log_chi2
from go1exp.gap.search import significance, thresholds
from go1exp.gap.search.fit import residuals
from go1exp.gap.search.state import Search, begun
from go1exp.gap.search.stepwise import run
from go1exp.logs.recording import Recording, RecordingError

TRIES = 9  # rows at which a window may begin: the one with the smoothest motion about it is taken
SMOOTH_ROWS = 3  # rows to both sides in which motion is looked at for that

Key = TypeVar("Key", bound=str)
Cut = Callable[[Sequence[Sequence[Place]]], Windows]
"""Cuts recordings by one clock at places of each."""


def rows_of(windows: Windows, which: np.ndarray, recordings: Sequence[Recording]) -> list[np.ndarray]:
    """Return which rows of each recording (T,) bool have a part in some windows (numbers), first state included."""
    masks = []
    for e, recording in enumerate(recordings):
        t, mask = even_clock(recording), np.zeros(len(recording.t), dtype=bool)
        for k in which[windows.episode[which] == e]:
            mask |= (t >= windows.begin[k] - FIT_S) & (t <= windows.begin[k] + windows.length)
        masks.append(mask)
    return masks


def beginnings(clocks: Sequence[np.ndarray], q: np.ndarray, settings: GapSettings, spared: np.ndarray) -> list[int]:
    """Return rows of one recording at which windows may begin by every clock (times (T,), s, by each).

    About one stride apart, where the motion of the angles ``q`` (T, J) is smooth within a third of it, as for windows
    of one clock. Smoothness is computed from the rows alone, so that no clock has its way. No window has rows that are
    ``spared`` (T,) bool.
    """
    length = settings.burn_s + settings.window_s
    bend = np.abs(np.diff(q, 3, axis=0, prepend=q[:1], append=q[-2:]))
    bend = (bend / np.maximum(np.median(bend, axis=0), 1e-9)).max(axis=1)
    rough = np.convolve(bend, np.ones(2 * SMOOTH_ROWS + 1), "same")
    stride = max(round(settings.stride_s / float(np.median(np.diff(t)))) for t in clocks)
    taken = np.concatenate([[0], np.cumsum(spared)])

    def free(row: int) -> bool:
        ends = [int(np.searchsorted(t, t[row] + length)) for t in clocks]
        first = min(int(np.searchsorted(t, t[row] - FIT_S)) for t in clocks)
        return max(ends) < len(q) and taken[max(ends)] == taken[first]

    begun: list[int] = []
    row = max(int(np.searchsorted(t, t[0] + PAST_S)) for t in clocks)
    while row < len(q):
        tries = [r for r in np.unique(np.linspace(row, row + stride / 3, TRIES).astype(int)) if r < len(q) and free(r)]
        if tries:
            begun.append(int(min(tries, key=lambda r: rough[r])))
        row += stride
    return begun


def same_rows(
    recordings: Mapping[Key, Sequence[Recording]],
    cuts: Mapping[Key, Cut],
    settings: GapSettings,
    spared: Sequence[np.ndarray],
) -> tuple[dict[Key, Windows], dict[Key, int]]:
    """Return windows by each clock that begin at the same rows, compare the same rows, and have the same floor.

    Beside them, how many of the places that were tried each clock leaves: no window may have a hole by its clock.

    Noise is the smaller of what is seen by the clocks, since a wrong one makes motion look like noise. The first states
    are as uncertain as by the clock that knows them less. RecordingError if not one window fits by all clocks.
    """
    clocks = {name: [even_clock(r) for r in logs] for name, logs in recordings.items()}
    first = next(iter(recordings.values()))
    order = list(range(len(first)))
    rows = [beginnings([c[e] for c in clocks.values()], first[e].joint("q"), settings, spared[e]) for e in order]
    windows = _cut_at(rows, clocks, cuts)
    begun = {name: _begun(w, clocks[name]) for name, w in windows.items()}
    left = {name: len(each) for name, each in begun.items()}
    common = set.intersection(*(set(each) for each in begun.values()))
    if not common:
        raise RecordingError("no window is whole by both clocks")
    windows = _cut_at([[r for r in rows[e] if (e, r) in common] for e in order], clocks, cuts)
    return _shared({n: _masked(w, clocks[n], list(clocks.values()), settings) for n, w in windows.items()}), left


def _cut_at(
    rows: Sequence[Sequence[int]], clocks: Mapping[Key, Sequence[np.ndarray]], cuts: Mapping[Key, Cut]
) -> dict[Key, Windows]:
    """Cut windows that begin at rows of each recording, by each clock."""
    return {
        name: cuts[name]([[Place(t[r], t[r]) for r in rows[e]] for e, t in enumerate(clock)])
        for name, clock in clocks.items()
    }


def _begun(windows: Windows, clock: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Return recording and row at which each window begins."""
    pairs = zip(windows.episode.tolist(), windows.begin, strict=True)
    return [(e, int(rows_at(clock[e], np.array([begin]))[0])) for e, begin in pairs]


def _masked(
    windows: Windows, clock: Sequence[np.ndarray], everyone: Sequence[Sequence[np.ndarray]], settings: GapSettings
) -> Windows:
    """Return windows by one clock of which only rows are valid that are scored by all clocks."""
    valid = windows.valid.copy()
    for k, (e, start) in enumerate(_begun(windows, clock)):
        rows = rows_at(clock[e], windows.begin[k] + windows.t[k])
        for other in everyone:
            since = other[e][rows] - other[e][start]
            valid[k] &= (since >= settings.burn_s - 1e-7) & (since <= settings.burn_s + settings.window_s + 1e-7)
    return replace(windows, valid=valid)


def _shared(windows: Mapping[Key, Windows]) -> dict[Key, Windows]:
    """Return windows with the least noise, and the widest first states, of all."""
    every = list(windows.values())
    scale = np.min([w.scale for w in every], axis=0)
    q_sd, qd_sd = (np.max([getattr(w, name) for w in every], axis=0) for name in ("q_sd", "qd_sd"))
    return {name: replace(w, scale=scale, q_sd=q_sd, qd_sd=qd_sd) for name, w in windows.items()}


@dataclass(frozen=True)
class Contestant:
    """What scores windows by one clock, and the physics step, s."""

    scorer: Scorer
    dt: float


def contest(
    sides: Mapping[Clock, Contestant],
    parts: Splits,
    settings: GapSettings,
    on_progress: Callable[[str, float], None] = lambda what, share: None,
) -> ClockChoice:
    """Fit the model by both clocks on one half of the windows, test both on the other, and the other way round.

    A clock is taken if the sign-flip test over stretches of neighbouring windows is significant (``settings.alpha``),
    the mean of log chi2 differs by more than what means the same (``SAME_GAIN``), and the model without terms
    does not significantly want the other one. Otherwise it is not decided, and the default is taken.
    """
    asked = dataclasses.replace(settings, max_terms=min(thresholds.CLOCK_TERMS, settings.max_terms), bootstraps=0)
    halves = (parts, dataclasses.replace(parts, train=parts.select, select=parts.train))
    nominal, last = _HeldOut(), _HeldOut()
    terms: dict[Clock, dict[str, None]] = {name: {} for name in sides}
    for k, half in enumerate(halves):
        searches: dict[Clock, Search] = {}
        for name, side in sides.items():

            def show(what: str, share: float, name: str = name, k: int = k) -> None:
                on_progress(f"clock {name}, half {k + 1}: {what}", share)

            rng = np.random.default_rng(settings.seed)
            searches[name] = run(begun(side.scorer, half, asked, side.dt, rng, show))
            terms[name] |= dict.fromkeys(searches[name].state.terms)
        plain = {name: (side.scorer, searches[name].nominal) for name, side in sides.items()}
        nominal = nominal.also(plain, sides, half.select)
        last = last.also({n: (s.state.scorer, s.state.theta) for n, s in searches.items()}, sides, half.select)
    which = np.concatenate([half.select for half in halves])
    stretch = stretches(sides["recorded"].scorer.windows.episode)[which]
    rng = np.random.default_rng(settings.seed)
    nominal_gain, _, nominal_p = compared(nominal.log_chi2, stretch, rng)
    gain, interval, p = compared(last.log_chi2, stretch, rng)
    choice = ClockChoice(
        taken=DEFAULT_CLOCK,
        decided=False,
        windows=len(which),
        stretches=len(np.unique(stretch)),
        nominal_errors=nominal.median_errors,
        errors=last.median_errors,
        terms={name: tuple(names) for name, names in terms.items()},
        gain=gain,
        interval=interval,
        p=p,
        nominal_gain=nominal_gain,
        nominal_p=nominal_p,
    )
    return decided(choice, settings.alpha)


def decided(choice: ClockChoice, alpha: float) -> ClockChoice:
    """Return a choice with the clock that its figures prefer, or with why they prefer none."""
    reason = ""
    if abs(choice.gain) <= thresholds.SAME_GAIN:
        reason = "the two do as well"
    elif choice.p >= alpha:
        reason = f"the difference is not significant (p = {choice.p:.2g} of {choice.stretches} stretches)"
    elif choice.nominal_p < alpha and choice.nominal_gain * choice.gain < 0:
        reason = "without the first terms the other clock is the better one"
    if reason:
        return dataclasses.replace(choice, taken=DEFAULT_CLOCK, decided=False, reason=reason)
    taken: Clock = "speeds" if choice.gain > 0 else "recorded"
    return dataclasses.replace(choice, taken=taken, decided=True, reason="")


def compared(
    log_chi2_of: Mapping[Clock, np.ndarray], stretch: np.ndarray, rng: np.random.Generator
) -> tuple[float, tuple[float, float], float]:
    """Return by how much log chi2 (V,) is larger by the written times: mean, 95 % interval, p; by stretch (V,)."""
    units = np.unique(stretch)
    difference = log_chi2_of["recorded"] - log_chi2_of["speeds"]
    total = np.array([difference[stretch == u].sum() for u in units])
    count = np.array([np.sum(stretch == u) for u in units])
    drawn = rng.integers(0, len(units), (thresholds.CLOCK_RESAMPLES, len(units)))
    means = total[drawn].sum(1) / count[drawn].sum(1)
    low, high = np.quantile(means, thresholds.QUANTILES)
    p = significance.max_t(np.stack([total, -total]), rng).min()
    return float(difference.mean()), (float(low), float(high)), float(p)


@dataclass(frozen=True)
class _HeldOut:
    """What was found of windows that were held out: by clock, log chi2 (V,) and errors of the angles (V,), rad."""

    log_chi2: dict[Clock, np.ndarray] = field(default_factory=dict)
    errors: dict[Clock, np.ndarray] = field(default_factory=dict)

    @property
    def median_errors(self) -> dict[Clock, float]:
        """Of the angles in the median window, rad."""
        return {name: float(np.median(values)) for name, values in self.errors.items()}

    def also(
        self, models: Mapping[Clock, tuple[Scorer, Theta]], sides: Mapping[Clock, Contestant], which: np.ndarray
    ) -> _HeldOut:
        """Return the same with more windows (numbers), scored by models with one floor, the larger of the two."""
        floor = np.max([scorer.scale for scorer, _ in models.values()], axis=0)
        logs, errors = dict(self.log_chi2), dict(self.errors)
        for name, (scorer, theta) in models.items():
            with np.errstate(invalid="ignore"):  # what is not compared has an infinite scale
                same = rescaled(scorer, floor / scorer.scale)
            residual = residuals(same, [theta], which, sides[name].dt)[0]
            chi2 = log_chi2(same.chi2(residual, which)).mean(axis=1)
            off = np.sqrt(np.nanmean(of_angles(same, residual, which) ** 2, axis=1))
            logs[name] = np.concatenate([logs.get(name, np.empty(0)), chi2])
            errors[name] = np.concatenate([errors.get(name, np.empty(0)), off])
        return _HeldOut(logs, errors)


# ---------------------------------------------------------------------- in words

OF_CLOCK: dict[Clock, str] = {"recorded": "written times", "speeds": "times from the speeds"}
"""Clock -> what it is called in a sentence."""


def sentence(choice: ClockChoice) -> str:
    """Return in words which clock was taken, by how much it is better, and how sure that is."""
    taken = f"The {OF_CLOCK[choice.taken]} are taken"
    if not choice.errors:
        return f"The clocks could not be compared: {choice.reason}. {taken}."
    low, high = choice.interval
    figures = (
        f"in the median of {choice.windows} held-out windows of the same rows angles are off by "
        f"{_by_clock(choice.errors)}, and log chi2 by the written times less that by the speeds is "
        f"{choice.gain:.2g} ({low:.2g} to {high:.2g}), p = {choice.p:.2g}"
    )
    if choice.decided:
        return f"{taken}: {figures}."
    return f"Which clock is right is not decided: {choice.reason}. {taken} ({figures})."


def details(choice: ClockChoice) -> str:
    """Return that sentence, and what it rests on."""
    sentences = [sentence(choice)]
    if choice.rate_hz:
        rates = [f"{span(*rate)} Hz by {OF_CLOCK[name]}" for name, rate in choice.rate_hz.items()]
        sentences.append(f"Rows come at {' and '.join(rates)}.")
    low, high = choice.steps
    if high - low > thresholds.UNEVEN_CLOCK:
        sentences.append(f"The written times are uneven: nine of ten steps are {low:.2g} to {high:.2g} of the median.")
    if choice.errors:
        terms = [f"{', '.join(names) or 'none'} by {OF_CLOCK[name]}" for name, names in choice.terms.items()]
        sentences.append(
            f"The first terms that a search finds count there ({'; '.join(terms)}). Within the tolerances alone angles "
            f"are off by {_by_clock(choice.nominal_errors)} (log chi2 {choice.nominal_gain:.2g}, p = "
            f"{choice.nominal_p:.2g})."
        )
    return " ".join(sentences)


def _by_clock(errors: Mapping[Clock, float]) -> str:
    """Return errors, rad, as a list in mrad."""
    return " and ".join(f"{1e3 * value:.3g} mrad with {OF_CLOCK[name]}" for name, value in errors.items())


def span(low: float, high: float) -> str:
    """Return a range in words, one number if both ends read alike."""
    return f"{low:.4g}" if f"{low:.4g}" == f"{high:.4g}" else f"{low:.4g} to {high:.4g}"
