"""What a comparison of recordings with the model is asked for, and what it answers: the contract of the gap workflow.

Scores are chi2 per sample, in units of the noise: a model that is right scores 1. The excess is what lies above that.
"""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field

from go1exp.base.errors import EXIT_CODES as EXIT_CODES
from go1exp.config.schema.physics import ContactConfig, Threads
from go1exp.config.schema.registry import STRICT, Count, Fraction, NonNegative, Positive

Verdict = Literal["no gap", "explained", "partly explained", "unexplained", "not excited", "bad log"]

Phase = Literal["auto", "whole", "swing"]
"""What of a robot that walks is compared: everything, or the legs that are in the air."""

Clock = Literal["recorded", "speeds"]
"""Where times are from: the recording says them, or recorded speeds and angles tell them."""

DEFAULT_CLOCK: Clock = "recorded"
"""The clock that is taken where two were compared and neither is better: it asks nothing of the speeds."""

Share = Annotated[float, Field(gt=0, lt=1)]


ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180}
"""Unit of an angle -> rad."""


def in_rad(given: object) -> object:
    """Return an angle with a unit, such as ``2mrad``, in rad; anything else as it is."""
    if not isinstance(given, str):
        return given
    match = re.fullmatch(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([a-z]+)\s*", given)
    if match is None or match[2] not in ANGLES:
        raise ValueError(f"must be a number of rad, or one with {', '.join(ANGLES)}, such as 2mrad")
    return float(match[1]) * ANGLES[match[2]]


def small(angle: float) -> float:
    """Refuse an angle (rad) that is no error of an angle: 2 was meant in mrad or degrees."""
    if not 0 <= angle <= LARGEST:
        raise ValueError(f"must be from 0 to {LARGEST:g} rad; with a unit such as 2mrad or 0.1deg")
    return angle


LARGEST = 1.0  # largest error of an angle that can be accepted, rad

Angle = Annotated[float, BeforeValidator(in_rad), AfterValidator(small)]


@dataclass(frozen=True)
class GapSettings:
    """How recordings are compared with the model.

    Attributes:
        window_s: scored length of a window, s.
        burn_s: time replayed before it and not scored, s: filters and delay lines settle.
        stride_s: from the beginning of one window to that of the next, s.
        physics_dt: longest physics step, s; the one used divides the logger's period.
        clock_s: standard deviation of the time by which readings may be stamped early or late against commands, window
            by window; a hundredth of a control step, which nothing in training would notice.
        phase: what of standing robots is compared: ``whole``, the whole robot; ``swing``, legs while they are in
            the air, which show effects at joints; ``auto``, legs in the air first, and the whole robot if those agree
            with the model or hardly swing.
        torque: also score the torque that the drives report, where it was logged.
        calibrate: whether nominal parameters may move within their tolerances first; without, small errors of the model
            are taken for effects (for comparison).
        selection: how candidates are tested: ``max_t`` on held-out windows; for comparison ``gain``, any gain there, or
            ``bic``, Schwarz's criterion on the windows of the fit.
        alpha: significance that a term needs; ten times that if it removes three quarters of a gap.
        min_share: share of the remaining excess that a term must remove.
        max_terms: most terms that are named.
        effects: names of the effects to consider; all that the recordings could show if empty.
        shortlist: candidates that are fitted in full, of all that are screened.
        iterations: Gauss-Newton steps of a fit.
        adequate: excess up to which the model counts as right (floor 1 is excess 0).
        material: excess of the model within its tolerances below which there is no gap.
        accept: error of an angle that the user does not care about, rad: what remains counts as right if no joint is
            further off in nine of ten held-out windows; 0 for none.
        confirm_fraction: share of the episodes that is kept for the last check.
        bootstraps: resamples of the episodes.
        certified: share of the bootstraps that must name a term again; half if it closes what the tolerances leave.
        overlays: windows whose curves are kept for pictures.
        max_rows: simulations side by side.
        threads: threads of the physics engine; 0 takes all cores.
        seed: of splits, sign flips and bootstraps.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    window_s: Positive = 0.3
    burn_s: NonNegative = 0.07
    stride_s: Positive = 0.4
    physics_dt: Annotated[float, Field(ge=1e-5, le=0.002)] = 0.001
    clock_s: NonNegative = 0.00015
    phase: Phase = "auto"
    torque: bool = False
    calibrate: bool = True
    selection: Literal["max_t", "gain", "bic"] = "max_t"
    alpha: Share = 0.01
    min_share: Fraction = 0.1
    max_terms: Count = 4
    effects: tuple[str, ...] = ()
    shortlist: Count = 5
    iterations: Count = 3
    adequate: Positive = 0.5
    material: Positive = 0.1
    accept: Angle = 0.0
    confirm_fraction: Fraction = 0.2
    bootstraps: Annotated[int, Field(ge=0)] = 40
    certified: Fraction = 0.8
    overlays: Annotated[int, Field(ge=0)] = 4
    max_rows: Count = 1024
    threads: Threads = 1
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Floors:
    """What no model can get below, as standard deviations."""

    # sensor noise by quantity (``q`` rad, ``qd`` rad/s, ``tau_est`` N m), median over joints and episodes
    noise: dict[str, float]
    # error of the physics step, twice what half the step changes, median of windows, by quantity
    numerical: dict[str, float]
    # difference between repeated episodes over sqrt(2), root mean square, by quantity; None if no episode was repeated
    repeatability: dict[str, float] | None


@dataclass(frozen=True)
class Localisation:
    """Where the model is wrong."""

    joints: tuple[str, ...]  # rows
    regimes: tuple[str, ...]  # columns
    samples: np.ndarray  # (J, R) number of samples
    excess: np.ndarray  # (J, R) mean excess; NaN where there is no sample
    p: np.ndarray  # (J, R) p-values of block permutation; NaN where nothing can be said
    flagged: np.ndarray  # (J, R) bool, significant at a false discovery rate of 5 %


@dataclass(frozen=True)
class Candidate:
    """One row of the evidence."""

    effect: str  # registered name
    joints: tuple[str, ...]  # where it would act; empty for an effect of the whole robot
    params: dict[str, list[float] | float]  # parameter -> one value per joint of ``joints``, or one number
    excess_after: float  # held-out excess with it
    log_gain: float  # mean over held-out windows of the fall of log chi2
    p: float  # sign-flip max-T p-value over all candidates
    size_over_tolerance: float  # largest deviation from null over the tolerance
    alias_class: tuple[str, ...]  # effects that do as well on these data, itself included
    status: Literal["accepted", "rejected", "alias", "not excited"]  # what became of it
    reason: str  # why, in a sentence
    stage: int = 1  # at which term of the stepwise search it was tested, from 1


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the data ask for.

    Attributes:
        effect: registered name.
        joints: where it acts; empty for an effect of the whole robot.
        params: parameter -> joint (or ``robot``) -> value.
        interval: parameter -> joint (or ``robot``) -> 95 % interval.
        alias_set: effects that do as well on these data, this one first.
        status: ``certified``, or ``compensating`` if it may stand for something that no effect describes.
        reason: why it is not certified; empty if it is.
        share: part of the held-out excess within the tolerances that comes back without this effect; NaN if not known.
    """

    effect: str
    joints: tuple[str, ...]
    params: dict[str, dict[str, float]]
    interval: dict[str, dict[str, tuple[float, float]]]
    alias_set: tuple[str, ...]
    status: Literal["certified", "compensating"]
    reason: str = ""
    share: float = math.nan


@dataclass(frozen=True)
class Overlay:
    """One held-out window to look at: arrays over its samples, by channel (``q_FR_calf``)."""

    episode: str  # where it is from
    t: np.ndarray  # (T,) time in the episode, s
    measured: dict[str, np.ndarray]  # (T,) by channel
    # (T,) of the model within its tolerances; only channels that are compared in this window
    before: dict[str, np.ndarray]
    after: dict[str, np.ndarray]  # (T,) with what was named
    noise: dict[str, float]  # standard deviation of the noise, by channel


@dataclass(frozen=True)
class AngleErrors:
    """Root mean square errors of the angles on windows that no fitted value has seen: medians of windows, rad.

    Each pair is of the model as it is, and with what was named and the tolerances used. What the unknown initial state
    of a window explains is taken out.
    """

    windows: int  # how many
    median: tuple[float, float]  # of all joints together
    removed: float  # share of the error that is gone, median of windows
    worse: float  # share of the windows that are worse
    by_joint: dict[str, tuple[float, float]]  # joint -> pair
    by_episode: dict[str, tuple[float, float]]  # episode -> pair, of all joints together
    # share of the windows in which no joint is further off than accepted; None if nothing is
    within: tuple[float, float] | None = None


@dataclass(frozen=True)
class ClockChoice:
    """Which of two clocks the recordings are read by, and what that rests on.

    Both are tested on readings of the same rows, by the same floor, on windows that no fit has seen and that are not
    of the last check. By clock: of the written times (``recorded``), and of the speeds (``speeds``).
    """

    taken: Clock  # the clock that is used
    decided: bool  # whether held-out windows prefer it; otherwise it is the default, or the only one that is usable
    reason: str = ""  # why it is not decided; empty if it is
    # clock -> least and largest rate of rows of the recordings, Hz
    rate_hz: dict[Clock, tuple[float, float]] = field(default_factory=dict)
    # 5 % and 95 % quantile of the steps of the written times over their median; (1, 1) is an even clock
    steps: tuple[float, float] = (math.nan, math.nan)
    windows: int = 0  # number of windows
    stretches: int = 0  # of neighbouring windows, which count as one in the test
    # clock -> error of the angles in the median window, rad, of the model within its tolerances
    nominal_errors: dict[Clock, float] = field(default_factory=dict)
    # clock -> the same with the first terms that a search finds by that clock
    errors: dict[Clock, float] = field(default_factory=dict)
    terms: dict[Clock, tuple[str, ...]] = field(default_factory=dict)  # clock -> names of these terms
    # mean over windows by how much log chi2 is larger by the written times, with those terms; positive where the speeds
    # tell the better clock
    gain: float = math.nan
    interval: tuple[float, float] = (math.nan, math.nan)  # its 95 % interval, from resampled stretches
    p: float = math.nan  # two-sided sign-flip test over stretches
    nominal_gain: float = math.nan  # the same mean within the tolerances
    nominal_p: float = math.nan  # its p


@dataclass(frozen=True)
class GapResult:
    """The answer.

    Attributes:
        verdict: one of six.
        sentence: the answer in words, one paragraph.
        named: what the data ask for, strongest first.
        candidates: the evidence, best first.
        floors: None if the log is bad.
        excess: held-out excess of the plain model (``null``), within its tolerances (``box``), with what was named
            (``final``), that on windows kept for the last check (``confirm``), and that of what the written files
            hold, on the windows whose numbers are ``evaluated`` in the provenance (``written``).
        closed: share of the held-out excess that the named effects removed; NaN without one.
        errors: of the angles, in rad, before and after; None if the log is bad.
        before: localisation of the plain model; None if the log is bad.
        after: localisation with what was named.
        not_excited: effect -> excitation to record next.
        advice: what to record to separate what these data do not, a sentence each.
        bootstrap_share: effect -> share of the bootstraps in which it was named again.
        waterfall: (label, excess) from the plain model down to what remains.
        overlays: windows to look at.
        box: parameters within their tolerances: effect -> parameter -> joint or ``robot`` -> value.
        tolerances: that counted: effect -> parameter -> tolerance; where there is none, the effect's declared one.
        contact: of the feet in the model; None of a suspended robot, and in older results.
        clock: which of two clocks was taken; None if the model did not ask for a comparison.
        provenance: hashes, versions, seeds, steps.
        warnings: what a reader must know, a sentence each.
        seconds: time it took.
    """

    verdict: Verdict
    sentence: str
    named: tuple[NamedEffect, ...] = ()
    candidates: tuple[Candidate, ...] = ()
    floors: Floors | None = None
    excess: dict[str, float] = field(default_factory=dict)
    closed: float = math.nan
    errors: AngleErrors | None = None
    before: Localisation | None = None
    after: Localisation | None = None
    not_excited: dict[str, str] = field(default_factory=dict)
    advice: tuple[str, ...] = ()
    bootstrap_share: dict[str, float] = field(default_factory=dict)
    waterfall: tuple[tuple[str, float], ...] = ()
    overlays: tuple[Overlay, ...] = ()
    box: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    tolerances: dict[str, dict[str, float]] = field(default_factory=dict)
    contact: ContactConfig | None = None
    clock: ClockChoice | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    seconds: float = math.nan

    @property
    def exit_code(self) -> int:
        """Of the command that found this."""
        return EXIT_CODES[self.verdict]

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values that JSON can hold; a number that is not finite is None."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {"exit_code": self.exit_code, **{name: _plain(value) for name, value in plain.items()}}


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
