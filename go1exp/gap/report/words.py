"""An answer in words, for the page, its figures and the terminal; and units, joints, effects and next recordings."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

import go1exp.logs.excitations  # noqa: F401  (registers every effect and excitation)
from go1exp.base.report.table import NOTHING, number, share
from go1exp.config.schema.registry import members
from go1exp.gap.answer import Answer
from go1exp.gap.result import (
    AngleErrors,
    Clock,
    ClockChoice,
    GapResult,
    GapSettings,
    Localisation,
    NamedEffect,
    Verdict,
)
from go1exp.gap.robots.go1 import GO1
from go1exp.gap.score.likelihood import removed
from go1exp.gap.search import thresholds, tolerances
from go1exp.gap.search.candidates import at_bounds, deviation, on_bound
from go1exp.gap.search.clocks import OF_CLOCK, span
from go1exp.gap.search.screen import free_shapes
from go1exp.gap.search.state import Search
from go1exp.sim.effects.base import Param
from go1exp.sim.effects.tolerances import DECLARED, Tolerances, declared, effect_class
from go1exp.sim.effects.tolerances import sizes as keys_of

UNITS: dict[str, str] = {"q": "rad", "qd": "rad/s", "tau_est": "N m"}
"""Logged quantity of a joint -> unit."""

TRUNK_UNITS: dict[str, str] = {"imu_gyro": "rad/s", "imu_acc": "m/s²"}
"""Logged quantity of the trunk, along x, y and z -> unit."""

ALL_UNITS: dict[str, str] = UNITS | TRUNK_UNITS  # logged quantity -> unit

ERRORS: dict[str, str] = {
    "null": "nominal model",
    "box": "within its tolerances",
    "final": "with the identified effects",
    "confirm": "on windows reserved for confirmation",
}
"""Key of ``GapResult.excess`` -> label."""

GROUND = ("squat", "drop")  # excitations of a standing robot; all others are of a suspended one


def errors(result: GapResult) -> list[tuple[str, str]]:
    """Return (label, normalised chi2) of the available held-out errors."""
    keys = [k for k in ERRORS if k in result.excess and (result.named or k != "final")]
    return [(ERRORS[k], number(1.0 + result.excess[k])) for k in keys]


def angles(errors: AngleErrors) -> str:
    """Return the errors of the angles as sentences."""
    before, after = (number(1e3 * value) for value in errors.median)
    accepted = ""
    if errors.within is not None:
        first, second = (share(value) for value in errors.within)
        accepted = f" Within the accepted error: {first} of the windows before, {second} after."
    return (
        f"Median angle error of {errors.windows} held-out windows: {before} mrad of the nominal model, {after} mrad of "
        f"the fitted one. The error of a window decreases by {share(errors.removed)} in the median; "
        f"{share(errors.worse)} of the windows are worse.{accepted}"
    )


def angle_rows(errors: AngleErrors, most: int | None = None) -> list[tuple[str, str, str]]:
    """Return (joint or episode, before, after) of the errors of the angles, mrad; of ``most`` episodes, the worst."""
    episodes = list(errors.by_episode.items())
    if most is not None:
        episodes = sorted(episodes, key=lambda item: -item[1][1])[:most]
    both = [*errors.by_joint.items(), *episodes]
    return [(name, number(1e3 * before), number(1e3 * after)) for name, (before, after) in both]


def clock_rows(choice: ClockChoice) -> list[tuple[str, str, str, str, str]]:
    """Return (clock, rate of rows in Hz, error within the tolerances and with the first terms in mrad, these terms)."""

    def milli(errors: Mapping[Clock, float], clock: Clock) -> str:
        return number(1e3 * errors[clock]) if clock in errors else NOTHING

    rows = []
    for clock, name in OF_CLOCK.items():
        rate = span(*choice.rate_hz[clock]) if clock in choice.rate_hz else NOTHING
        terms = ", ".join(choice.terms.get(clock, ())) or NOTHING
        rows.append((name, rate, milli(choice.nominal_errors, clock), milli(choice.errors, clock), terms))
    return rows


def params(effect: str) -> tuple[Param, ...]:
    """Return the declared parameters of an effect; none of an unregistered one."""
    return effect_class(effect).params if effect in members("effect") else ()


def param(effect: str, name: str, tolerances: Tolerances = DECLARED) -> Param | None:
    """Return the declaration of a parameter; None for an unregistered one."""
    return tolerances.param((effect, name)) if any(p.name == name for p in params(effect)) else None


def unit(effect: str, name: str) -> str:
    """Return the unit of a parameter, empty for none."""
    declared = param(effect, name)
    return "" if declared is None or declared.unit == "-" else declared.unit


def meaning(effect: str) -> str:
    """Return the description of an effect."""
    entry = members("effect").get(effect)
    return entry.doc.replace("``", "") if entry else ""


def everyone(result: GapResult) -> tuple[str, ...]:
    """Return all joints that were compared."""
    return result.before.joints if result.before else ()


def place(effect: str, joints: Sequence[str], all_joints: Sequence[str]) -> str:
    """Return the location of an effect."""
    if not joints:
        return "the whole robot" if {p.per for p in params(effect)} == {"robot"} else NOTHING
    if not set(joints) <= set(all_joints):
        return ", ".join(joints)
    return where(joints, all_joints)


def sizes(named: NamedEffect) -> list[tuple[str, str, str]]:
    """Return (parameter, mean ± half width of the 95 % interval, spread over joints) of each magnitude of an effect."""
    rows = []
    for name, by_joint in named.params.items():
        values = np.array(list(by_joint.values()), dtype=float)
        declared = param(named.effect, name)
        if not len(values) or (declared and not math.isfinite(declared.tolerance)):  # a shape
            continue
        widths = [0.5 * (b - a) for a, b in named.interval.get(name, {}).values()]
        half, in_unit = number(float(np.mean(widths)) if widths else math.nan, 2), unit(named.effect, name)
        mean = f"{number(float(values.mean()))} ± {half} {in_unit}".rstrip()
        spread = f"{number(float(values.min()))} to {number(float(values.max()))} {in_unit}".rstrip()
        rows.append((name, mean, f"{spread} over {len(values)} joints" if len(values) > 1 else ""))
    return rows


def rivals(named: NamedEffect) -> tuple[str, ...]:
    """Return the effects that are not distinguishable from this one."""
    return tuple(name for name in named.alias_set if name != named.effect)


def limit(result: GapResult, name: str) -> float:
    """Return a limit of the settings (``adequate``, ``certified``), from the provenance if available."""
    settings = result.provenance.get("settings")
    value = settings.get(name) if isinstance(settings, Mapping) else None
    return float(value if isinstance(value, int | float) else getattr(GapSettings(), name))


def worst(cells: Localisation | None) -> str:
    """Return the joint and regime of the largest flagged excess, empty if there is none."""
    if cells is None or not cells.flagged.any():
        return ""
    left = np.where(cells.flagged & np.isfinite(cells.excess), cells.excess, -np.inf)
    row, column = np.unravel_index(int(np.argmax(left)), left.shape)
    return f"{cells.joints[row]}, {cells.regimes[column]}" if np.isfinite(left[row, column]) else ""


def would_change(result: GapResult) -> list[str]:
    """Return the observations that would change the verdict, a sentence each."""
    allowed = number(1.0 + limit(result, "adequate"))
    final, box = (result.excess.get(k, math.nan) for k in ("final", "box"))
    rest, left = worst(result.after), final if result.named else box
    changes = []
    if result.verdict == "bad log":
        changes.append("Recordings without these flaws; go1exp record audit FILE checks for them.")
    elif result.verdict == "not excited":
        changes.append("Recordings with more excitation; the section on next recordings lists them.")
    elif result.verdict in ("no gap", "explained") and limit(result, "accept") and left > limit(result, "adequate"):
        changes.append(
            f"An accept below {number(1e3 * limit(result, 'accept'))} mrad: relative to the noise, "
            f"{number(1.0 + left)} is above {allowed}."
        )
    elif result.verdict == "no gap":
        changes.append(f"A held-out error above {allowed} within the tolerances; it is {number(1.0 + box)}.")
    elif result.verdict == "explained":
        changes.append(f"A held-out error above {allowed} with the identified effects; it is {number(1.0 + final)}.")
    else:
        at = f", largest at {rest}" if rest else ""
        changes.append(
            f"An effect that reduces the held-out error to {allowed} or less; it is {number(1.0 + final)}{at}. "
            "No fitted candidate does."
        )
    for named in result.named:
        if rivals(named):
            others = " and ".join(rivals(named))
            changes.append(f"Data that distinguish {named.effect} from {others} may change the effect.")
        if named.status == "compensating":
            least = share(limit(result, "certified"))
            needs = f"that needs {least} of the bootstrap resamples and a small residual"  # of an older result
            changes.append(f"{named.effect} is not certified: {named.reason or needs}.")
    if result.verdict == "unexplained" and result.candidates:
        near = max(result.candidates, key=lambda c: c.log_gain)
        if near.status == "rejected":
            changes.append(f"The best candidate was {near.effect}: {near.reason}.")
    if result.verdict in ("no gap", "explained") and result.not_excited:
        changes.append("Motions that excite further effects (section on next recordings) may reveal more.")
    return changes


@dataclass(frozen=True)
class Next:
    """A recording to make next: its purpose, the command for a shell, and the effects that it excites."""

    why: str
    command: str
    effects: tuple[str, ...] = ()


def motions(result: GapResult, names: Sequence[str], *settings: str, out: str) -> str:
    """Return the command that records excitations; for a robot other than the Go1, the one that designs excitations."""
    if result.provenance.get("robot", GO1) == GO1:
        return shlex.join(["go1exp", "record", f"excitation=[{','.join(names)}]", *settings, f"out={out}"])
    call = result.provenance.get("next", "go1exp gap next logs=RECORDINGS model=MODEL out=GAP")
    return f"{call}  # for your robot; like {', '.join(names)}"


def next_recordings(result: GapResult) -> list[Next]:
    """Return the next recordings: first to distinguish alias effects, then to excite further effects."""
    known = members("excitation")
    recordings: list[Next] = []
    if result.verdict == "bad log":
        return recordings
    for sentence in result.advice:
        names = [name for name in known if re.search(rf"\b{re.escape(name)}\b", sentence)]
        settings = re.findall(r"\b((?:gains|hang)=\[\[[-\d.,\[\]]*\]\])", sentence)
        if names or settings:
            out = f"recordings/apart{len(recordings) + 1 if recordings else ''}"
            recordings.append(Next(sentence, motions(result, names or ["chirp", "steps"], *settings, out=out)))
    by_name: dict[str, list[str]] = {}
    for effect, name in result.not_excited.items():
        if name in known:
            by_name.setdefault(name, []).append(effect)
    for ground, out in ((False, "recordings/next"), (True, "recordings/ground")):
        names = [name for name in by_name if (name in GROUND) == ground]
        if names:
            effects = tuple(effect for name in names for effect in by_name[name])
            why = f"Excites effects that {'only a standing robot shows' if ground else 'these logs do not show'}."
            recordings.append(Next(why, motions(result, names, out=out), effects))
    return recordings


# ---------------------------------------------------------------------- the answer in one paragraph


def advice(aliases: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return what to record to separate the members of alias sets, each thing once."""
    sentences = []
    for names in aliases.values():
        if len(names) > 1:
            how = {name: tolerances.identification(name) for name in names}
            ways = dict.fromkeys(
                how[first].separated_by if second in how[first].confounded else how[second].separated_by
                for first, second in combinations(names, 2)
                if tolerances.confounded(first, second)
            )
            what = ", and ".join(ways) or "record chirp and steps"
            sentences.append(f"These logs cannot tell {' from '.join(names)}; {what} to separate them.")
    return tuple(sentences)


def where(joints: Sequence[str], everyone: Sequence[str]) -> str:
    """Say which joints, by kind or leg if they are all of one."""
    chosen = set(joints)
    if chosen == set(everyone):
        return "all joints"
    kinds, legs = {j.rsplit("_", 1)[-1] for j in chosen}, {j.split("_", 1)[0] for j in chosen}
    for names, kind in ((kinds, lambda j: j.rsplit("_", 1)[-1]), (legs, lambda j: j.split("_", 1)[0])):
        if chosen == {j for j in everyone if kind(j) in names} and len(names) < len(chosen):
            return f"the {' and '.join(sorted(names))} joints"
    return ", ".join(joints)


def sentence(answer: Answer, search: Search, unexcited: Mapping[str, str], suggestions: Sequence[str]) -> str:
    """Put the answer into words."""
    everyone = search.state.scorer.windows.joints
    first, final = 1.0 + answer.excess["box"], 1.0 + answer.excess["final"]
    parts = [
        _opening(answer.verdict, first, search),
        *(_effect_sentence(effect, everyone, search.state.tolerances) for effect in answer.named),
    ]
    if ends := at_range_ends(answer, search):
        parts.append(
            f"{'; '.join(ends)}: a value at the end of its range stands for more of it, or for something else."
        )
    if answer.named:
        parts.append(
            f"With that the held-out error falls from {first:.3g} to {final:.3g} times the noise floor (floor 1)."
        )
    if not math.isnan(answer.within):
        accepted = 1e3 * search.settings.accept
        parts.append(f"{answer.within:.0%} of the held-out windows are within the {accepted:.3g} mrad accepted.")
    if answer.verdict == "partly explained":
        near = answer.excess["final"] <= search.settings.adequate
        parts.append(
            "That is near the floor, but nothing of what is named is certain, so it may stand for something else."
            if near and not any(effect.status == "certified" for effect in answer.named)
            else "The rest is explained by nothing in the library, so what is named may stand for something else."
        )
    named = {effect.effect for effect in answer.named}  # a simpler one may have taken the place of what was accepted
    first_tried = [c for c in search.candidates if c.stage == 1 and c.effect not in named]
    rejected = [c.effect for c in first_tried if c.status == "rejected"][:2]
    if answer.named and rejected:
        parts.append(f"{' and '.join(rejected)} {'was' if len(rejected) == 1 else 'were'} considered and rejected.")
    quiet = [
        effect for effect in unexcited if effect in search.signal or not tolerances.identification(effect).needs_ground
    ]
    if quiet:
        parts.append(f"These logs cannot show {', '.join(quiet)}.")
    return " ".join([*filter(None, parts), *suggestions])


def at_range_ends(answer: Answer, search: Search) -> list[str]:
    """Return which fitted parameters lie at the end of the range that is searched, with joints and value."""
    everyone, known, lines = search.state.scorer.windows.joints, search.state.tolerances, []
    for key in sorted(key for key in answer.theta if math.isfinite(known.param(key).tolerance)):
        for bound, near in at_bounds(key, answer.theta, known).items():
            if near.any():
                whole = len(near) != len(everyone)
                at = "" if whole else where([j for j, on in zip(everyone, near, strict=True) if on], everyone)
                lines.append(f"{key[0]}: {on_bound(key, bound, at, known)}")
    return lines


def _opening(verdict: Verdict, first: float, search: Search) -> str:
    """Return the sentence of a verdict that names nothing; ``first`` is the error within the tolerances, in floors."""
    return {
        "no gap": f"The model agrees with these logs within its tolerances: error {first:.3g} times the noise floor.",
        "not excited": "These logs move too little to compare the model with.",
        "unexplained": f"The model is wrong, with an error of {first:.3g} times the noise floor, {_nearest(search)}",
    }.get(verdict, "")


def _nearest(search: Search) -> str:
    """Return the end of a sentence about a gap for which nothing is named: what came near, if anything did."""
    tried = [c for c in search.candidates if c.stage == 1 and math.isfinite(c.excess_after)]
    near = min(tried, key=lambda c: c.excess_after, default=None)
    share = removed(search.first, near.excess_after) if near else 0.0
    if near is None or share <= thresholds.HALF:
        return "and no effect of the library explains it."
    title = f"{effect_class(near.effect).title} ({near.effect})"
    return f"of which {title} takes {share:.0%} away and yet is not named: {near.reason}."


def _effect_sentence(effect: NamedEffect, everyone: Sequence[str], known: Tolerances) -> str:
    """Return the sentence about one missing effect: what leaves its tolerance, and its shapes."""
    names = [name for _, name in keys_of(effect.effect) if effect.params.get(name)]
    values_of = {name: np.array(list(effect.params[name].values())) for name in names}
    size = {name: deviation({(effect.effect, name): v}, (effect.effect, name), known) for name, v in values_of.items()}
    telling = [name for name in names if np.max(size[name]) > 1.0] or names
    texts = []
    for name in [*telling, *(shape for _, shape in free_shapes(effect.effect) if effect.params.get(shape))]:
        values = np.array(list(effect.params[name].values()))
        p = known.param((effect.effect, name))
        half = np.mean([0.5 * (b - a) for a, b in effect.interval[name].values()])
        spread = f", {values.min():.3g} to {values.max():.3g}" if len(values) > 1 else ""
        unit = "" if p.unit == "-" else f" {p.unit}"
        # A null that is the model's own is none that a reader could know.
        instead = f" (the model has {p.null:g}{unit})" if declared((effect.effect, name)).least is not None else ""
        texts.append(f"{p.name} {values.mean():.3g} ± {half:.2g}{unit}{spread}{instead}")
    held = dict.fromkeys(name for law in effect_class(effect.effect).identification.laws for name in law)
    laws = {name: effect.params[name].values() for name in held if effect.params.get(name)}
    texts += [f"{name} {np.mean(list(values)):.3g}" for name, values in laws.items()]
    at = f" at {where(effect.joints, everyone)}" if effect.joints else ""
    doubted = "" if effect.status == "certified" else f" (compensating, not certified: {effect.reason})"
    title = f"{effect_class(effect.effect).title} ({effect.effect})"
    return f"The model is missing {title}{at}: {'; '.join(texts)}{doubted}."
