"""The stages ``explain``, from recordings and a model to an answer, and ``check``, a first look at them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from go1exp import __version__
from go1exp.base.tensors.threads import one_thread
from go1exp.base.wording import counted
from go1exp.gap.answer import Answer, can_stand, concluded, evidence, not_excited
from go1exp.gap.comparison import FEWEST_WINDOWS, Comparison, NotComparable, Progress, compare, robot_from
from go1exp.gap.data.prepare import fingerprint
from go1exp.gap.replay.rows import Theta, variants
from go1exp.gap.report.words import ALL_UNITS, advice, sentence
from go1exp.gap.result import (
    EXIT_CODES,
    AngleErrors,
    Floors,
    GapResult,
    GapSettings,
    Localisation,
    NamedEffect,
    Overlay,
)
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.score.angle_errors import angle_errors, localise
from go1exp.gap.score.likelihood import Scorer, excess
from go1exp.gap.search import clocks
from go1exp.gap.search.fit import residuals
from go1exp.gap.search.state import Search, begun
from go1exp.gap.search.stepwise import run, with_signals
from go1exp.gap.search.tolerances import identification
from go1exp.logs.recording import Recording
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import declared

FEWEST_SWINGS = 24  # windows of legs in the air below which nothing is tested: each shows some of the legs only

SWING_ALONE = (
    "Only legs in the air were compared, so trunk, feet and ground were not tested; search.phase=whole compares all."
)


def explain(
    recordings: Sequence[Recording],
    robot: RobotConfig | Robot,
    settings: GapSettings | None = None,
    on_progress: Progress = lambda what, share: None,
) -> GapResult:
    """Compare recordings of a robot, the nominal Go1 or another one, with its model, and name what is missing.

    Of a robot that walks, the legs in the air come first: they show effects at joints whatever the ground does. If they
    name something, that is the answer. Otherwise the standing robot is compared too (``settings.phase``).
    ``on_progress`` is called with what is being done, and which share of the work is finished. ConfigError if the whole
    robot is compared, and recordings on the ground name different contacts.
    """
    settings, robot = settings or GapSettings(), robot_from(robot)
    if settings.phase != "auto":
        return _explained(recordings, robot, settings, on_progress)
    whole, notes, seconds = replace(settings, phase="whole"), tuple[str, ...](), 0.0
    robot.suited(recordings)  # refuses recordings of different contacts before the legs take their minutes
    if all(r.meta.base == "floating" for r in recordings):
        swing = replace(settings, phase="swing")
        legs = _explained(recordings, robot, swing, lambda what, share: on_progress(what, 0.5 * share))
        if legs.named:
            on_progress("done", 1.0)
            return replace(legs, warnings=(*legs.warnings, SWING_ALONE))
        notes, seconds = _of_legs(legs), legs.seconds
    result = _explained(recordings, robot, whole, lambda what, share: on_progress(what, 0.5 * (1.0 + share)))
    return replace(result, warnings=(*notes, *result.warnings), seconds=seconds + result.seconds)


def _of_legs(legs: GapResult) -> tuple[str, ...]:
    """Return what legs in the air say where they name nothing."""
    if not legs.excess:
        return ()
    agree = legs.verdict in ("no gap", "not excited")
    how = "agree with the model" if agree else "do not agree with the model, and nothing in the library explains it"
    return (f"Legs in the air {how}: error {1 + legs.excess['box']:.3g} times the floor.",)


def _explained(
    recordings: Sequence[Recording], robot: Robot, settings: GapSettings, on_progress: Progress
) -> GapResult:
    """Compare recordings in one way: legs in the air, or the whole robot."""
    start = time.perf_counter()
    rng, warnings = np.random.default_rng(settings.seed), list[str]()
    with one_thread():
        try:
            fewest = FEWEST_SWINGS if settings.phase == "swing" else FEWEST_WINDOWS
            comparison = compare(recordings, robot, settings, on_progress, fewest=fewest)
        except NotComparable as error:
            seconds = time.perf_counter() - start
            return GapResult("bad log", str(error), warnings=error.warnings, seconds=seconds)
        warnings += comparison.ready.warnings
        search = searched(comparison, rng, warnings, on_progress)
        on_progress("intervals", 0.88)
        search, answer = concluded(search, warnings)
        warnings += doubts(answer.named, search.state.machine.on_ground)
        on_progress("where it is wrong", 0.93)
        about = provenance(comparison, search, recordings, settings)
        result = written(comparison, search, answer, about, warnings, start)
    if result.verdict == "unexplained" and comparison.doubtful:
        result = _laid_to_the_log(result, comparison.ready.impossible)
    on_progress("done", 1.0)
    return result


def _laid_to_the_log(result: GapResult, rows: int) -> GapResult:
    """Return a gap that nothing explains as the verdict that logs with impossible ``rows`` allow."""
    error = f"error {1.0 + result.excess['box']:.3g} times the noise floor"
    line = (
        f"{counted(rows, 'row')} of these logs cannot be right and were left out. The rest does not agree with the "
        f"model ({error}), and nothing in the library explains it: others like them may remain. "
        "Record again without such rows (go1exp record audit lists them)."
    )
    return replace(result, verdict="bad log", sentence=line)


def doubts(named: Sequence[NamedEffect], on_ground: bool) -> list[str]:
    """Return what to look at before what is named is believed, where it has been wrong on sealed cases."""
    doubted = (identification(n.effect).standing_caveat for n in named if on_ground)
    return [line for line in doubted if line]


def searched(comparison: Comparison, rng: np.random.Generator, warnings: list[str], on_progress: Progress) -> Search:
    """Search for what is missing; episodes kept for a last check join where they show a gap that others do not."""
    settings, parts = comparison.settings, comparison.split(rng)
    if parts.alone:
        warnings.append(
            f"Of {counted(len(parts.alone), 'episode')} there is no other with the same motion and gains; stretches "
            "of them test what was fitted on the rest of them."
        )
    if parts.shared:
        warnings.append(
            f"The last check has stretches of {len(parts.shared)} episodes and few or no whole ones: of their "
            "motions there is no other episode."
        )
    if not len(parts.confirm):
        warnings.append("Too few episodes to keep some for a last check.")
    search = run(begun(comparison.scorer, parts, settings, comparison.dt, rng, on_progress))
    if not len(parts.confirm) or search.state.terms or search.first > settings.adequate:
        return search
    unseen = excess(search.state.held_out(windows=parts.confirm))
    if unseen <= settings.adequate:
        return search
    warnings.append(
        f"Windows kept for a last check show an error of {1 + unseen:.3g} times the floor, others do not: "
        "they were taken into the search, with nothing left for a last check."
    )
    parts = comparison.split(rng, confirm=0.0)
    return run(begun(comparison.scorer, parts, settings, comparison.dt, rng, on_progress))


def written(
    comparison: Comparison, search: Search, answer: Answer, about: dict[str, Any], warnings: Sequence[str], start: float
) -> GapResult:
    """Return the result: the answer, the evidence behind it, and where the model is wrong with and without it."""
    score, parts, settings, dt = search.state.scorer, search.splits, search.settings, search.dt
    shown = np.sort(np.concatenate([parts.select, parts.confirm]))
    before, after = residuals(score, [{}, search.state.theta], shown, dt)
    unexcited = not_excited(search.signal, held=can_stand(comparison.robot))
    suggestions = advice({n.effect: n.alias_set for n in answer.named})
    named = {n.effect: n for n in answer.named}
    of_clock = [clocks.sentence(comparison.clock)] if comparison.clock else []
    return GapResult(
        verdict=answer.verdict,
        sentence=" ".join([sentence(answer, search, unexcited, suggestions), *of_clock]),
        named=answer.named,
        candidates=evidence(search),
        floors=comparison.floors(),
        excess=answer.excess,
        closed=answer.closed,
        errors=_angle_errors(comparison, search),
        before=localise(score, before, shown, search.rng),
        after=localise(score, after, shown, search.rng),
        not_excited=unexcited,
        advice=suggestions,
        bootstrap_share=dict(search.shares),
        waterfall=(("nominal model", answer.excess["null"]), *search.steps),
        overlays=overlays(score, comparison.recordings, search.state.theta, parts.select, settings.overlays, dt),
        tolerances=comparison.robot.tolerances.by_effect(),
        contact=comparison.robot.tolerances.contact,
        clock=comparison.clock,
        box=_nested(answer.theta, score.windows.joints, named),
        provenance={**about, "simulation_steps": score.replayer.made},
        warnings=tuple(warnings),
        seconds=time.perf_counter() - start,
    )


def _angle_errors(comparison: Comparison, search: Search) -> AngleErrors:
    """Return the errors of the angles before and after, on windows that no fitted value has seen."""
    windows, plain, theta = search.splits.evaluated, comparison.scorer, search.state.theta
    # The same floors for both, whatever was named; only a trunk on a mount has an initial state of its own.
    last = search.state.scorer if search.state.scorer.common.any() else plain
    (before,), (after,) = (residuals(s, [values], windows, search.dt) for s, values in ((plain, {}), (last, theta)))
    names = [r.meta.episode for r in comparison.recordings]
    return angle_errors((plain, last), before, after, windows, names, search.settings.accept)


def provenance(
    comparison: Comparison, search: Search, logs: Sequence[Recording], settings: GapSettings
) -> dict[str, object]:
    """Return hashes of the logs, versions, the user's settings, and which episodes were for what."""
    recordings, episode, parts = comparison.recordings, comparison.windows.episode, search.splits
    kinds = {"train": parts.train, "select": parts.select, "confirm": parts.confirm}
    return {
        "robot": recordings[0].meta.robot,
        "logs": {r.meta.episode: fingerprint(r) for r in logs},
        "versions": {"go1exp": __version__, "mujoco": version("mujoco-core"), "numpy": np.__version__},
        "settings": asdict(settings),
        "seed": settings.seed,
        "physics_dt": comparison.dt,
        "windows": len(comparison.windows),
        "evaluated": [int(k) for k in parts.evaluated],
        "split": {name: sorted({recordings[e].meta.episode for e in episode[w]}) for name, w in kinds.items()},
    }


def overlays(
    score: Scorer, recordings: Sequence[Recording], theta: Theta, windows: np.ndarray, count: int, dt: float
) -> tuple[Overlay, ...]:
    """Return curves of some held-out windows, from the worst to the median of the plain model."""
    w, machine = score.windows, score.replayer.machine
    if not count or not len(windows):
        return ()
    before = score.replayer.run(variants(machine, {}, windows, []), dt)
    off = (((before - w.y[windows]) / w.scale[windows][:, None]) ** 2).mean((1, 2, 3))
    order = np.argsort(-off)
    picked = order[np.unique(np.linspace(0, len(order) // 2, count).astype(int))]
    after = score.replayer.run(variants(machine, theta, windows[picked], []), dt)
    known = [at for at in w.channels if np.isfinite(w.scale[windows][:, *at[1:]]).any()]
    drawn = []
    for k, window, of_fitted in zip(picked, windows[picked], after, strict=True):
        valid = w.valid[window]
        noise = {name: float(w.scale[window, c, i]) for name, c, i in known if np.isfinite(w.scale[window, c, i])}
        measured = {name: w.y[window, valid, c, i] for name, c, i in known}
        plain, fitted = (
            {name: y[valid, c, i] for name, c, i in known if name in noise} for y in (before[k], of_fitted)
        )
        episode, t = recordings[w.episode[window]].meta.episode, w.begin[window] + w.t[window, valid]
        drawn.append(Overlay(episode, t, measured, plain, fitted, noise))
    return tuple(drawn)


def _nested(
    theta: Theta, joints: Sequence[str], named: Mapping[str, NamedEffect]
) -> dict[str, dict[str, dict[str, float]]]:
    """Return what stays within tolerance, by effect, parameter and joint: all but what is named, where it is."""
    nested: dict[str, dict[str, dict[str, float]]] = {}
    for (effect, name), value in theta.items():
        claim = named.get(effect)
        if declared((effect, name)).per == "robot":
            left = {} if claim else {"robot": float(value[0])}
        else:
            full = zip(joints, np.broadcast_to(value, (len(joints),)), strict=True)
            away = claim is not None and (claim.status != "certified" or not claim.joints)
            left = {} if away else {n: float(v) for n, v in full if claim is None or n not in claim.joints}
        if left:
            nested.setdefault(effect, {})[name] = left
    return nested


# ---------------------------------------------------------------------- a first look


@dataclass(frozen=True)
class CheckResult:
    """What a first look showed."""

    flaws: tuple[str, ...]  # why the logs cannot be compared; empty if they can
    floors: Floors | None = None  # what no model can get below
    windows: int = 0  # number of windows
    excess: float = float("nan")  # of the plain model, over all windows (floor 0)
    where: Localisation | None = None  # it is wrong
    not_excited: dict[str, str] | None = None  # effect -> excitation to record next
    warnings: tuple[str, ...] = ()  # what was chosen, a sentence each

    @property
    def exit_code(self) -> int:
        """0, or that of a bad log."""
        return EXIT_CODES["bad log"] if self.flaws else 0

    def text(self) -> str:
        """Return it as lines for people."""
        if self.flaws or self.floors is None:
            return "\n".join(["these logs cannot be compared with the model:", *(f"  {f}" for f in self.flaws)])
        lines = [f"{self.windows} windows; the plain model's error is {1 + self.excess:.3g} times the floor"]
        lines = [*self.warnings, *lines]
        for name, value in self.floors.noise.items():
            line = f"  {name}: noise {value:.2g} {ALL_UNITS[name]}, error of the step {self.floors.numerical[name]:.2g}"
            if self.floors.repeatability and name in self.floors.repeatability:
                line += f", repetitions differ by {self.floors.repeatability[name]:.2g}"
            lines.append(line)
        if self.not_excited:
            lines.append("not identifiable from these logs; record next:")
            lines += [f"  {effect}: {excitation}" for effect, excitation in self.not_excited.items()]
        return "\n".join(lines)


def check(
    recordings: Sequence[Recording],
    robot: RobotConfig | Robot,
    settings: GapSettings,
    on_progress: Progress = lambda what, share: None,
    screen: bool = True,
) -> CheckResult:
    """Take a first look at recordings of a robot."""
    robot = robot_from(robot)
    with one_thread():
        try:
            comparison = compare(recordings, robot, settings, on_progress)
        except NotComparable as error:
            return CheckResult(error.flaws)
        on_progress("where it is wrong", 0.4)
        score, everything = comparison.scorer, comparison.everything
        rng = np.random.default_rng(settings.seed)
        plain = residuals(score, [{}], everything, comparison.dt)[0]
        where = localise(score, plain, everything, rng)
        unexcited = None
        if screen:
            on_progress("what these logs can show", 0.6)
            parts = comparison.split(rng)
            search = with_signals(begun(score, parts, comparison.settings, comparison.dt, rng))
            unexcited = not_excited(search.signal, held=can_stand(comparison.robot))
    on_progress("done", 1.0)
    error_of_all = excess(score.chi2(plain, everything))
    return CheckResult(
        (), comparison.floors(), len(everything), error_of_all, where, unexcited, comparison.ready.warnings
    )
