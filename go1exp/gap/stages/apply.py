"""The stage ``apply``: an answer written as a choice of ``effect`` for training, and the proof that it holds there."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.base.files import write_text
from go1exp.base.tensors.threads import one_thread
from go1exp.base.wording import NOT_FOR_TRAINING
from go1exp.config.schema.joint_values import spread
from go1exp.config.schema.physics import contact_text
from go1exp.config.schema.registry import Term, members
from go1exp.gap.comparison import Comparison, compare, robot_from
from go1exp.gap.data.prepare import fingerprint, tolerances_of
from go1exp.gap.files import CALIBRATION, COMPENSATING, EFFECT, GapFileError
from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import GapResult, GapSettings, NamedEffect
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.go1 import SuspendedGo1
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.score.likelihood import excess, removed
from go1exp.gap.search.fit import scores
from go1exp.logs.recording import Recording
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.base import Param
from go1exp.sim.effects.tolerances import Tolerances, effect_class
from go1exp.sim.task import parse_parts

ROBOT = "robot"  # key of a value that belongs to no joint

Values = Mapping[str, Mapping[str, Mapping[str, float]]]
"""Effect -> parameter -> joint or ``robot`` -> value."""


@dataclass(frozen=True)
class Applied:
    """What the written files do in replay at the step of training."""

    files: tuple[Path, ...]  # that were written
    physics_dt: float  # the step, s
    before: float  # held-out excess of the plain model at that step
    after: float  # with ``effect.yaml`` and ``calibration.yaml`` as training reads them
    effect_only: float  # with ``effect.yaml`` alone
    reported: float  # excess that the search had at its own step with what ``effect.yaml`` holds
    closed: float  # share of the excess that the files remove
    # whether the model with the files is as good at this step as was reported, and not worse than the plain one
    holds: bool


def write(result: GapResult, folder: Path) -> tuple[Path, ...]:
    """Write the effect files of a result, return those there are; GapFileError for what is not in the library."""
    folder.mkdir(parents=True, exist_ok=True)
    certified = [n for n in result.named if n.status == "certified"]
    rest = [n for n in result.named if n.status != "certified"]
    written = []
    for name, about, lines in (
        (EFFECT, "Missing effects.", _named_lines(certified)),
        (
            CALIBRATION,
            "The model's own parameters, within their tolerances.",
            _box_lines(result.box, tolerances_of(result)),
        ),
        (COMPENSATING, f"Makes up for something that no effect describes. {NOT_FOR_TRAINING}", _named_lines(rest)),
    ):
        path = folder / name
        path.unlink(missing_ok=True)
        if lines or name == EFFECT:
            head = [f"# {about}", *_provenance(result)]
            write_text(path, "\n".join([*head, *(lines or ["{}"])]) + "\n")
            written.append(path)
    return tuple(written)


def _named_lines(named: Sequence[NamedEffect]) -> list[str]:
    lines = []
    for n in named:
        params = _params(n.effect, n.params)
        others = [a for a in n.alias_set if a != n.effect]
        known = f"; these logs cannot tell it from {', '.join(others)}" if others else ""
        lines += [f"{n.effect}:  # {n.status}{known}"]
        widths: dict[str, float] = {}
        for name, places in n.params.items():
            lines.append(f"  {name}: {_value(places, params[name])}  # {params[name].unit}")
            for place, (low, high) in n.interval.get(name, {}).items():
                lines.append(
                    f"    # {place}: {places.get(place, params[name].null):.4g}, 95 % within {low:.4g} to {high:.4g}"
                )
            halves = [0.5 * (high - low) for low, high in n.interval.get(name, {}).values() if np.isfinite(high - low)]
            if halves:  # an alias may be the truth: twice as wide
                widths[name] = float(f"{max(halves) * (2.0 if others else 1.0):.3g}")
        if widths:
            lines.append(f"  spread: {json.dumps(widths)}  # each robot's own, from the intervals")
    return lines


def _box_lines(box: Values, tolerances: Tolerances) -> list[str]:
    lines = []
    for effect, params in box.items():
        kind = {name: tolerances.param((effect, name)) for name in _params(effect, params)}
        body = [
            f"  {name}: {_value(places, kind[name])}  # {kind[name].unit}"
            for name, places in params.items()
            if any(abs(v - kind[name].null) > 1e-3 * kind[name].tolerance for v in places.values())
        ]
        lines += [f"{effect}:", *body] if body else []
    return lines


def _value(places: Mapping[str, float], param: Param) -> str:
    """Write values per joint, or one number; rounding must not carry them out of their range (3.1416 > pi)."""
    rounded = {place: min(max(float(f"{value:.5g}"), param.low), param.high) for place, value in places.items()}
    if set(places) == {ROBOT}:
        return json.dumps(rounded[ROBOT])
    return json.dumps(rounded)


def _params(effect: str, names: Collection[str]) -> dict[str, Param]:
    """Return the declarations of an effect by name, of which ``names`` must be some."""
    registered = effect in members("effect")
    known = {p.name: p for p in effect_class(effect).params} if registered else {}
    strange = [f"{effect}.{name}" for name in names if name not in known] if registered else [effect]
    if strange:
        raise GapFileError(f"{strange[0]}: not in the library; the result is of another version of go1exp")
    return known


def _provenance(result: GapResult) -> list[str]:
    about = result.provenance
    lines = [f"# Found by go1exp gap, {date.today().isoformat()}: {result.verdict}.", f"# {result.sentence}"]
    lines.append(f"# versions {json.dumps(about.get('versions', {}))}")
    lines.append(f"# seed {about.get('seed')}, step {about.get('physics_dt')} s")
    if result.contact:
        lines.append(f"# contact of the feet: {contact_text(result.contact)}; train with the same `contact`")
    return lines + [f"# log {name}: sha256 {digest}" for name, digest in about.get("logs", {}).items()]


# ---------------------------------------------------------------------- the proof


def terms_of(plain: Mapping[str, object]) -> tuple[Term, ...]:
    """Return the effects of a file's content, as training reads them; ValueError if training would refuse it."""
    parts, problems = parse_parts({"effect": plain}, ("effect",))
    if problems:
        raise ValueError("\n".join(problems))
    return parts["effect"]


def composed(*contents: Mapping[str, Any]) -> dict[str, Any]:
    """Return files' contents as one: later ones win, joint by joint, as when training composes them."""
    whole: dict[str, Any] = {}
    for effect, params in (item for content in contents for item in content.items()):
        merged = whole.setdefault(effect, {})
        for name, value in params.items():
            both = isinstance(value, Mapping) and isinstance(merged.get(name), Mapping)
            merged[name] = {**merged[name], **value} if both else value
    return whole


def theta_of(terms: Sequence[Term], joints: Sequence[str]) -> Theta:
    """Return the values of effects per joint (J,), or (1,) for one of the robot, by (effect, parameter)."""
    theta: Theta = {}
    for term in terms:
        for p in effect_class(term.entry.name).params:
            given = term.parameters[p.name]
            full = np.array([float(given)]) if p.per == ROBOT else np.nan_to_num(spread(given, joints), nan=p.null)
            theta[term.entry.name, p.name] = full
    return theta


def _reported(result: GapResult) -> float:
    """Return the excess that the search had on these windows; of older results on held-out ones; NaN if none."""
    if "written" in result.excess:
        return result.excess["written"]
    certified = [n.effect for n in result.named if n.status == "certified"]
    if len(certified) == len(result.named):
        return result.excess.get("final", float("nan"))
    steps = dict(result.waterfall)  # terms in the order in which they were found, the certified ones first
    return steps.get(certified[-1], float("nan")) if certified else result.excess.get("box", float("nan"))


def _same_search(
    recordings: Sequence[Recording], settings: GapSettings, result: GapResult, tolerances: Tolerances
) -> None:
    before, now = result.provenance.get("settings", {}), asdict(settings)
    changed = [f"search.{k}" for k in SPLITTING if k in before and before[k] != now[k]]
    if changed:
        raise GapFileError(f"{', '.join(changed)}: not as in the search that found this; run go1exp gap explain again")
    searched = tolerances_of(result)
    for key, value in tolerances.replaced.items():
        if value != searched.param(key).tolerance:
            raise GapFileError(
                f"model.tolerances.{'.'.join(key)} = {value:g}: not as in the search that found this "
                f"({searched.param(key).tolerance:g}); run go1exp gap explain again"
            )
    logs = result.provenance.get("logs")
    if logs and logs != {r.meta.episode: fingerprint(r) for r in recordings}:
        raise GapFileError("logs: not those of the search that found this; run go1exp gap explain again")


SPLITTING = ("window_s", "burn_s", "stride_s", "confirm_fraction", "seed", "torque")
"""Settings that decide which windows were held out."""


def prove(
    recordings: Sequence[Recording],
    robot: RobotConfig | Robot,
    settings: GapSettings,
    result: GapResult,
    contents: Mapping[str, Mapping[str, Any]],
    physics_dt: float,
) -> Applied:
    """Score written files at the step of training, s, on the windows on which the search scored what they hold.

    ``recordings`` and ``settings`` are those of the search, ``result`` is its outcome, and ``contents`` is what was
    read back from the files, by file name. GapFileError if logs or settings are not those of the search: what it held
    out would not be known. NotComparable if the recordings do not suit the robot.
    """
    robot = read_as(robot_from(robot), result)
    phase = result.provenance.get("settings", {}).get("phase", "whole")  # what auto came to
    settings = replace(settings, phase=phase)
    _same_search(recordings, settings, result, robot.tolerances)
    with one_thread():
        comparison = compare(recordings, robot, settings, physics_dt=physics_dt, fewest=1)
        if comparison.robot.on_ground:
            _same_contact(comparison.robot.tolerances, tolerances_of(result))
        windows = _windows(comparison, result)
        calibration, missing = contents.get(CALIBRATION, {}), contents.get(EFFECT, {})
        files = (theta_of(terms_of(c), robot.joints) for c in (missing, composed(calibration, missing)))
        plain, effect_only, both = (excess(_held_out(comparison, theta, windows)) for theta in ({}, *files))
    reported = _reported(result)
    holds = both <= max(settings.adequate, min(plain, 1.5 * reported + 0.1))
    closed = removed(plain, both)
    return Applied((), comparison.dt, plain, both, effect_only, reported, closed, bool(holds))


def read_as(robot: Robot, result: GapResult) -> Robot:
    """Return the robot with the contact, and read by the clock, that a result was found by.

    Raises:
        GapFileError: if another contact is chosen now, or the model says now what the search was to compare.
    """
    if isinstance(robot, SuspendedGo1) and result.contact is not None:
        if robot.contact is not None:
            _same_contact(Tolerances(contact=robot.contact), tolerances_of(result))
        return replace(robot, contact=result.contact)
    clock = robot.config.clock if isinstance(robot, FixedBase) else None
    if (clock == "compare") == (result.clock is not None):
        return robot.by_clock(result.clock.taken) if isinstance(robot, FixedBase) and result.clock else robot
    before = "compare" if result.clock else "another one"
    raise GapFileError(f"model.clock = {clock}: {before} in the search that found this; run go1exp gap explain again")


def _same_contact(now: Tolerances, searched: Tolerances) -> None:
    """Raise a ``GapFileError`` unless the feet have the contact that they had in a search."""
    if now.contact != searched.contact and now.contact and searched.contact:
        texts = contact_text(now.contact), contact_text(searched.contact)
        raise GapFileError(
            f"contact: {texts[0]}; {texts[1]} in the search that found this; run go1exp gap explain again"
        )


def _windows(comparison: Comparison, result: GapResult) -> np.ndarray:
    """Return the windows on which the search scored what it wrote; GapFileError if recordings are cut otherwise now."""
    count, numbers = result.provenance.get("windows"), result.provenance.get("evaluated")
    if not numbers:  # an older version's result
        parts = comparison.split(np.random.default_rng(comparison.settings.seed))
        return parts.evaluated
    if count != len(comparison.windows):
        now = len(comparison.windows)
        raise GapFileError(f"logs: {now} windows, {count} in the search that found this; run go1exp gap explain again")
    return np.array(numbers, dtype=int)


def _held_out(comparison: Comparison, theta: Theta, windows: np.ndarray) -> np.ndarray:
    """Return chi2 (V, G) of a model on some windows, by floors and initial states that suit it."""
    updated = comparison.scorer.updated
    scorer = comparison.scorer if updated is None or not theta else updated(theta)
    return scores(scorer, [theta], windows, comparison.dt)[0]
