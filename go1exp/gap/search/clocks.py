"""Two clocks as competing models of the time between rows: which of them lets the robot's model explain the recordings.

A model that lacks things can do better by a wrong clock: a wrong rate looks like wrong inertias. So for each clock the
nominal parameters move within their tolerances, and a search finds the first terms. Both are then judged on held-out
windows of the same rows, by one floor.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from go1exp.gap.data.windows import Splits, stretches
from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import DEFAULT_CLOCK, Clock, ClockChoice, GapSettings
from go1exp.gap.score.angle_errors import of_angles
from go1exp.gap.score.initial_state import rescaled
from go1exp.gap.score.likelihood import Scorer, log_chi2
from go1exp.gap.search import significance, thresholds
from go1exp.gap.search.fit import residuals
from go1exp.gap.search.search import Search, begun
from go1exp.gap.search.stepwise import run


@dataclass(frozen=True)
class Contestant:
    """Windows by one clock.

    Attributes:
        scorer: of them.
        dt: physics step, s.
    """

    scorer: Scorer
    dt: float


def contest(
    sides: Mapping[Clock, Contestant],
    parts: Splits,
    settings: GapSettings,
    on_progress: Callable[[str, float], None] = lambda what, share: None,
) -> ClockChoice:
    """Fit the model by both clocks on one half of the windows, judge both on the other, and the other way round.

    A clock is taken if the sign-flip test over stretches of neighbouring windows is significant (``settings.alpha``),
    the mean of log chi2 differs by more than what means the same (``SAME_GAIN``), and the model without terms
    does not significantly want the other one. Otherwise it is not decided, and the default is taken.

    Args:
        sides: the windows by the clocks ``recorded`` and ``speeds``, of the same rows.
        parts: the two halves, ``train`` and ``select``, which take turns.
        settings: of the search.
        on_progress: called with what is being done, and which share of the work is finished.
    """
    asked = dataclasses.replace(settings, max_terms=min(thresholds.CLOCK_TERMS, settings.max_terms), bootstraps=0)
    halves = (parts, dataclasses.replace(parts, train=parts.select, select=parts.train))
    nominal, last = _Judged(), _Judged()
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
    nominal_gain, _, nominal_p = judged(nominal.log_chi2, stretch, rng)
    gain, interval, p = judged(last.log_chi2, stretch, rng)
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


def judged(
    log_chi2_of: Mapping[Clock, np.ndarray], stretch: np.ndarray, rng: np.random.Generator
) -> tuple[float, tuple[float, float], float]:
    """Return by how much log chi2 (V,) is larger by the written times: mean, 95 % interval, two-sided p.

    Windows of one stretch (V,) are neighbours and not independent, so signs are flipped, and samples drawn, by stretch.
    """
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
class _Judged:
    """What was found of windows that were held out: by clock, log chi2 (V,) and errors of the angles (V,), rad."""

    log_chi2: dict[Clock, np.ndarray] = field(default_factory=dict)
    errors: dict[Clock, np.ndarray] = field(default_factory=dict)

    @property
    def median_errors(self) -> dict[Clock, float]:
        """Of the angles in the median window, rad."""
        return {name: float(np.median(values)) for name, values in self.errors.items()}

    def also(
        self, models: Mapping[Clock, tuple[Scorer, Theta]], sides: Mapping[Clock, Contestant], which: np.ndarray
    ) -> _Judged:
        """Return the same with more windows (numbers), scored by models with one floor.

        Each scorer has the error of the step of its own model in its noise. The larger of the two counts.
        """
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
        return _Judged(logs, errors)


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
