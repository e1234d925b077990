"""From recordings and a model to an answer."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version

import numpy as np

from go1exp import __version__
from go1exp.effects.tolerances import declared
from go1exp.gap import answer as words
from go1exp.gap.data.fingerprint import fingerprint
from go1exp.gap.data.prepare import prepare
from go1exp.gap.data.splits import splits
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.machine import Machine
from go1exp.gap.replay.rows import Theta, variants
from go1exp.gap.result import Floors, GapResult, GapSettings, NamedEffect, Overlay
from go1exp.gap.robots.hung import hung
from go1exp.gap.score.floors import measured, repeatability
from go1exp.gap.score.likelihood import Scorer
from go1exp.gap.score.localise import localise
from go1exp.gap.search.fit import residuals
from go1exp.gap.search.stepwise import Progress, Search
from go1exp.gap.search.trial import excess, removed
from go1exp.recording import Recording, RecordingError
from go1exp.robot import RobotConfig
from go1exp.tensors.threads import one_thread

MOST = 0.75
"""Share of the excess that terms must remove before the first of them is certified although a gap remains."""

FEWEST = 8
"""Windows below which nothing is judged."""


def explain(
    recordings: Sequence[Recording],
    config: RobotConfig | Machine,
    settings: GapSettings | None = None,
    on_progress: Progress = lambda what, share: None,
) -> GapResult:
    """Compare recordings of a held robot with the model, and name what is missing.

    Args:
        recordings: of one robot, its base fixed.
        config: the nominal Go1, or another robot as a :class:`~go1exp.gap.replay.replayer.machine.Machine`.
        settings: how; the defaults if None.
        on_progress: told what goes on and which share of the work is done.
    """
    machine = hung(config) if isinstance(config, RobotConfig) else config
    with one_thread():
        return _explain(recordings, machine, settings or GapSettings(), on_progress)


def _explain(
    recordings: Sequence[Recording], machine: Machine, settings: GapSettings, on_progress: Progress
) -> GapResult:
    start = time.perf_counter()
    on_progress("auditing the logs", 0.0)
    logs, ready = recordings, prepare(recordings, machine, settings)
    if ready.flaws:
        said = f"These logs cannot be compared with the model: {'; '.join(ready.flaws[:3])}."
        return GapResult("bad log", said, warnings=ready.flaws, seconds=time.perf_counter() - start)
    rng = np.random.default_rng(settings.seed)
    recordings, asked, settings = ready.recordings, settings, ready.settings
    try:
        windows = ready.windows()
    except RecordingError as error:
        return GapResult("bad log", f"{error}.", warnings=ready.warnings, seconds=time.perf_counter() - start)
    if len(windows) < FEWEST:
        said = f"These logs are too short: {len(windows)} windows of {settings.window_s:g} s, {FEWEST} are needed."
        return GapResult("bad log", said, warnings=(said,), seconds=time.perf_counter() - start)
    dt = float(windows.period / np.ceil(windows.period / settings.physics_dt - 1e-3))
    warnings = list(ready.warnings)

    on_progress("measuring the floors", 0.02)
    score, numerical = measured(ready, windows, dt, 2.0 * dt)
    parts = splits([r.meta for r in recordings], windows.episode, settings.confirm_fraction, rng)
    if parts.alone:
        warnings.append(
            f"Of {len(parts.alone)} episodes there is no other with the same motion and gains; stretches of them judge "
            "what was fitted on the rest of them."
        )
    if not len(parts.confirm):
        warnings.append("Too few episodes to keep some for a last check.")

    search = Search(score, parts, settings, float(dt), rng, on_progress)
    search.run()
    if len(parts.confirm) and not search.terms and search.first <= settings.adequate:
        unseen = excess(search.held_out(search.theta, parts.confirm))
        if unseen > settings.adequate:
            warnings.append(
                f"Episodes kept for a last check show an error of {1 + unseen:.3g} times the floor, others do not: "
                "they were taken into the search, with nothing left for a last check."
            )
            parts = splits([r.meta for r in recordings], windows.episode, 0.0, rng)
            search = Search(score, parts, settings, float(dt), rng, on_progress)
            search.run()
    score = search.scorer  # its floors and first states suit the model as it was found
    plain = search.held_out({})
    if search.terms and not search.confirmed():
        warnings.append(
            f"Withdrawn, since episodes kept for a last check do not bear it out: {', '.join(search.terms)}."
        )
        search.withdraw("episodes kept for a last check do not bear it out")
    first, final = search.first, search.steps[-1][1]
    on_progress("intervals", 0.88)
    theta, drawn = words.finish(search)
    named = words.name_terms(search, theta, drawn, final <= settings.adequate, removed(first, final) > MOST)
    sure = any(n.status == "certified" for n in named)
    if named and not sure and first <= settings.adequate:
        doubtful = ", ".join(n.effect for n in named)
        warnings.append(f"Withdrawn, since the tolerances explain these logs and nothing else is sure: {doubtful}.")
        search.withdraw("the tolerances suffice, and resamples of the logs do not agree on it")
        final, theta, named = search.first, search.theta, ()
    verdict = words.decide(search, first, final)
    excesses = {"null": excess(plain), "box": first, "final": final}
    if len(parts.confirm):
        confirmed = excess(search.held_out(search.theta, parts.confirm))
        excesses["confirm"] = confirmed
        if named and verdict == "explained" and confirmed > 2.0 * settings.adequate:
            verdict = "partly explained"
            warnings.append(f"On episodes kept for a last check the error is {1 + confirmed:.3g} times the floor.")

    on_progress("where it is wrong", 0.93)
    shown = np.sort(np.concatenate([parts.select, parts.confirm]))
    before, after = residuals(score, [{}, search.theta], shown, float(dt))
    silent = words.not_excited(search.signal, held=not ready.machine.base_probe)
    more = words.advice({n.effect: n.alias_set for n in named})
    result = GapResult(
        verdict=verdict,
        sentence=words.sentence(verdict, search, named, excesses, silent, more),
        named=named,
        candidates=words.evidence(search),
        floors=Floors(
            {name: value for name, value in windows.by_quantity(windows.scale).items() if np.isfinite(value)},
            numerical,
            repeatability(recordings),
        ),
        excess=excesses,
        closed=removed(first, final) if named else float("nan"),
        before=localise(score, before, shown, rng),
        after=localise(score, after, shown, rng),
        not_excited=silent,
        advice=more,
        bags=dict(search.shares),
        waterfall=(("model as it is", excesses["null"]), *search.steps),
        overlays=overlays(score, recordings, search.theta, parts.select, settings.overlays, float(dt)),
        tolerances=ready.machine.tolerances.by_effect(),
        box=_nested(theta, windows.joints, {n.effect: n for n in named}),
        provenance={
            "logs": {r.meta.episode: fingerprint(r) for r in logs},
            "versions": {"go1exp": __version__, "mujoco": version("mujoco-core"), "numpy": np.__version__},
            "settings": asdict(asked),
            "seed": settings.seed,
            "physics_dt": float(dt),
            "windows": len(windows),
            "split": {
                name: sorted({recordings[e].meta.episode for e in windows.episode[getattr(parts, name)]})
                for name in ("train", "select", "confirm")
            },
            "simulation_steps": score.replayer.made,
        },
        warnings=tuple(warnings),
        seconds=time.perf_counter() - start,
    )
    on_progress("done", 1.0)
    return result


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
    found = []
    compared = [at for at in w.channels if np.isfinite(w.scale[windows[0]][at[1:]])]
    for row, k in enumerate(picked):
        window = windows[k]
        valid = w.valid[window]

        def curves(y: np.ndarray, valid: np.ndarray = valid) -> dict[str, np.ndarray]:
            return {name: y[valid, c, i] for name, c, i in compared}

        noise = {name: float(w.scale[window, c, i]) for name, c, i in compared}
        found.append(
            Overlay(
                recordings[w.episode[window]].meta.episode,
                w.begin[window] + w.t[window, valid],
                curves(w.y[window]),
                curves(before[k]),
                curves(after[row]),
                noise,
            )
        )
    return tuple(found)


def _nested(
    theta: Theta, joints: Sequence[str], named: Mapping[str, NamedEffect]
) -> dict[str, dict[str, dict[str, float]]]:
    """Return what stays within tolerance, by effect, parameter and joint: all but what is named, where it is."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for (effect, name), value in theta.items():
        own = named.get(effect)
        if declared((effect, name)).per == "robot":
            left = {} if own else {"robot": float(value[0])}
        else:
            full = zip(joints, np.broadcast_to(value, (len(joints),)), strict=True)
            away = own is not None and (own.status != "certified" or not own.joints)
            left = {} if away else {n: float(v) for n, v in full if own is None or n not in own.joints}
        if left:
            found.setdefault(effect, {})[name] = left
    return found


__all__ = ["Windows", "explain", "fingerprint", "overlays", "repeatability"]
