"""From a search to an answer: named effects with intervals, the verdict, the sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from go1exp.effects.tolerances import declared, effect_class, sizes
from go1exp.gap.replay.rows import Key, Theta
from go1exp.gap.result import Candidate, NamedEffect, Verdict
from go1exp.gap.score.linear import Layout
from go1exp.gap.search import significance, tolerances
from go1exp.gap.search.evidence import inaudible
from go1exp.gap.search.fit import fit
from go1exp.gap.search.stepwise import SILENT, Search
from go1exp.schema.registry import members

LAW = 0.04
"""Relative standard deviation of a value because no robot follows a law of the library exactly: the intervals of sealed
effects (265 values), widened to it, hold 89 % of the truths; with 2 %, 76 %."""


def told_apart(names: Sequence[str]) -> tuple[str, ...]:
    """Return what to record to tell apart effects that are confounded, each thing once; empty if none of them says."""
    how = {name: tolerances.identification(name) for name in names}
    return tuple(
        dict.fromkeys(
            how[first].told_apart_by if second in how[first].confounded else how[second].told_apart_by
            for first, second in combinations(names, 2)
            if second in how[first].confounded or first in how[second].confounded
        )
    )


def advice(aliases: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return what to record to tell apart the members of alias sets."""
    sentences = []
    for names in aliases.values():
        if len(names) > 1:
            what = ", and ".join(told_apart(names)) or "record chirp and steps"
            sentences.append(f"These logs cannot tell {' from '.join(names)}; {what} to separate them.")
    return tuple(sentences)


def not_excited(signal: Mapping[str, float], held: bool = True) -> dict[str, str]:
    """Return effects that these data cannot show, and the excitation that would; ``held``: the trunk is."""
    silent = [effect for effect, loud in signal.items() if loud < SILENT]
    unfelt = [effect for effect in members("effect") if held and tolerances.identification(effect).needs_ground]
    return {effect: tolerances.identification(effect).excitation for effect in (*silent, *unfelt)}


def finish(search: Search) -> tuple[Theta, dict[Key, np.ndarray]]:
    """Fit once more, on all windows but those for the last check, and resample them; nothing to do without terms.

    Returns:
        The values, and by parameter of the terms their resampled values (B, J) or (B, 1).
    """
    scorer, machine = search.scorer, search.scorer.replayer.machine
    known = search.robot_tolerances
    if not search.terms:
        return search.theta, {}
    fitted = np.sort(np.concatenate([search.splits.train, search.splits.select]))
    own = search.linear(search.theta, fitted)
    (best,) = fit(scorer, [search.model(search.theta)], own, 1, search.dt)
    assert best.chi2 is not None
    theta = best.theta
    layout = Layout.of(machine, own.probes)
    grams = own.grams(scorer)
    grams = grams / np.maximum(best.chi2, 1.0)[..., None, None]
    limits = tolerances.bounds(layout, own.probes, search.theta, search.may)
    episode = scorer.windows.episode[fitted]
    drawn: dict[Key, list[np.ndarray]] = {}
    spread = 1.0 / np.sqrt(limits.weight)
    for _ in range(max(search.settings.bags, 20)):
        matrix, right = layout.total(grams[significance.resampled(episode, search.rng)])
        # The nominal values are themselves uncertain by their tolerances, and motion fixes many of them only relative
        # to each other: drawing where they lie makes the interval say so.
        x = tolerances.solve(
            matrix, right, replace(limits, centre=limits.centre + spread * search.rng.standard_normal(layout.size))
        )
        values = tolerances.moved(search.theta, layout, own.probes, x, machine)
        for key, value in values.items():
            if key[0] in search.terms:
                null = known.param(key).null
                law = 1.0 + LAW * search.rng.standard_normal(value.shape)
                drawn.setdefault(key, []).append(null + (value - null) * law)
    return theta, {key: np.stack([np.ravel(v) for v in values]) for key, values in drawn.items()}


def name_terms(
    search: Search, theta: Theta, drawn: Mapping[Key, np.ndarray], adequate: bool, mostly: bool
) -> tuple[NamedEffect, ...]:
    """Return what was found, with intervals; the joints are those where it leaves its tolerance beyond doubt."""
    joints, known = search.scorer.windows.joints, search.robot_tolerances
    found = []
    for number, effect in enumerate(search.terms):
        keys = [key for key in theta if key[0] == effect]
        per_joint = [key for key in sizes(effect) if known.param(key).per == "joint"]
        beyond, at_best = np.zeros(len(joints), dtype=bool), np.zeros(len(joints), dtype=bool)
        for key in per_joint:
            p = known.param(key)
            low, high = np.quantile(drawn[key], [0.025, 0.975], axis=0)
            value = np.broadcast_to(theta[key], len(joints))
            at_best |= np.abs(value - p.null) > p.tolerance
            beyond |= (np.abs(value - p.null) > p.tolerance) & ((low > p.null) | (high < p.null))
        if not beyond.any():  # few windows show it: a sample without them says nothing of where it is
            beyond = at_best
        where = tuple(j for j, b in zip(joints, beyond, strict=True) if b)
        params: dict[str, dict[str, float]] = {}
        interval: dict[str, dict[str, tuple[float, float]]] = {}
        for key in keys:
            p = known.param(key)
            samples = drawn.get(key, np.ravel(theta[key])[None])
            low, high = np.quantile(samples, [0.025, 0.975], axis=0)
            names = joints if p.per == "joint" else ("robot",)
            value = np.broadcast_to(np.ravel(theta[key]), len(names))
            low, high = (np.broadcast_to(v, len(names)) for v in (low, high))
            kept = [k for k, n in enumerate(names) if n == "robot" or n in where]
            params[p.name] = {names[k]: float(value[k]) for k in kept}
            interval[p.name] = {names[k]: (float(min(low[k], value[k])), float(max(high[k], value[k]))) for k in kept}
        stable = search.shares.get(effect, 0.0) >= search.settings.certified
        somewhere = bool(where) or not per_joint
        certified = stable and somewhere and (adequate or (number == 0 and mostly))
        status = "certified" if certified else "compensating"
        found.append(
            NamedEffect(effect, where, params, interval, search.aliases[effect], status)  # type: ignore[arg-type]
        )
    return tuple(found)


def decide(search: Search, first: float, final: float) -> Verdict:
    """Return the verdict from the held-out excesses within the tolerances, and with the terms."""
    settings = search.settings
    loud = [effect for effect, s in search.signal.items() if s >= SILENT]
    if search.terms:
        return "explained" if final <= settings.adequate else "partly explained"
    if first > settings.adequate:
        return "unexplained"
    return "not excited" if len(loud) < 0.5 * len(search.signal) else "no gap"


def where(joints: Sequence[str], everyone: Sequence[str]) -> str:
    """Say which joints, by kind or leg if they are all of one."""
    chosen = set(joints)
    if chosen == set(everyone):
        return "all joints"
    kinds, legs = {j.rsplit("_", 1)[-1] for j in chosen}, {j.split("_", 1)[0] for j in chosen}
    for names, own in ((kinds, lambda j: j.rsplit("_", 1)[-1]), (legs, lambda j: j.split("_", 1)[0])):
        if chosen == {j for j in everyone if own(j) in names} and len(names) < len(chosen):
            return f"the {' and '.join(sorted(names))} joints"
    return ", ".join(joints)


def sentence(
    verdict: Verdict,
    search: Search,
    named: Sequence[NamedEffect],
    excesses: Mapping[str, float],
    silent: Mapping[str, str],
    more: Sequence[str],
) -> str:
    """Word the answer."""
    everyone = search.scorer.windows.joints
    first, final = 1.0 + excesses["box"], 1.0 + excesses["final"]
    parts = []
    if verdict == "no gap":
        parts.append(
            f"The model agrees with these logs within its tolerances: error {first:.3g} times the noise floor."
        )
    elif verdict == "not excited":
        parts.append("These logs move too little to compare the model with.")
    elif verdict == "unexplained":
        parts.append(
            f"The model is wrong, with an error of {first:.3g} times the noise floor, and no effect of the library "
            "explains it."
        )
    for effect in named:
        texts = []
        for _, name in sizes(effect.effect):
            values = np.array(list(effect.params.get(name, {}).values()))
            if len(values):
                p = declared((effect.effect, name))
                half = np.mean([0.5 * (b - a) for a, b in effect.interval[name].values()])
                spread = f", {values.min():.3g} to {values.max():.3g}" if len(values) > 1 else ""
                unit = "" if p.unit == "-" else f" {p.unit}"
                texts.append(f"{p.name} {values.mean():.3g} ± {half:.2g}{unit}{spread}")
        at = f" at {where(effect.joints, everyone)}" if effect.joints else ""
        doubt = "" if effect.status == "certified" else " (compensating, not certified)"
        what = f"{effect_class(effect.effect).title} ({effect.effect})"
        parts.append(f"The model lacks {what}{at}: {'; '.join(texts)}{doubt}.")
    if named:
        parts.append(
            f"With that the held-out error falls from {first:.3g} to {final:.3g} times the noise floor (floor 1)."
        )
    if verdict == "partly explained":
        parts.append("The rest is explained by nothing in the library, so what is named may stand for something else.")
    rejected = [c.effect for c in search.candidates if c.status == "rejected" and c.stage == 1][:2]
    if named and rejected:
        parts.append(f"{' and '.join(rejected)} {'was' if len(rejected) == 1 else 'were'} considered and rejected.")
    quiet = [
        effect for effect in silent if effect in search.signal or not tolerances.identification(effect).needs_ground
    ]
    if quiet:
        parts.append(f"These logs cannot show {', '.join(quiet)}.")
    return " ".join([*parts, *more])


def evidence(search: Search) -> tuple[Candidate, ...]:
    """Return the candidates, best first, with those that the data cannot show."""
    quiet = inaudible(search.signal, SILENT, [c.effect for c in search.candidates])
    accepted = {c.effect for c in search.candidates if c.status == "accepted"} - set(search.terms)
    kept = [
        replace(c, status="rejected", reason="dropped: the other terms do as well without it")
        if c.status == "accepted" and c.effect in accepted
        else c
        for c in search.candidates
    ]
    order = {"accepted": 0, "alias": 1, "rejected": 2}
    return (*sorted(kept, key=lambda c: (c.stage, order[c.status])), *quiet)
