"""From a search to an answer: named effects with intervals, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from go1exp.config.schema.registry import members
from go1exp.gap.replay.rows import Key, Theta
from go1exp.gap.result import Candidate, NamedEffect, Verdict
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.score import angle_errors
from go1exp.gap.score.likelihood import excess, removed
from go1exp.gap.search import reduction, thresholds, tolerances
from go1exp.gap.search.candidates import beyond, bounded, deviation, unexcited_rows
from go1exp.gap.search.certainty import beside_a_gap, doubt, exact_aliases, resampled_values, widened
from go1exp.gap.search.fit import residuals
from go1exp.gap.search.screen import shows
from go1exp.gap.search.state import LastCheck, Search
from go1exp.sim.effects.base import Param
from go1exp.sim.effects.tolerances import Tolerances, declared, sizes


def can_stand(robot: Robot) -> bool:
    """Whether a suspended robot has feet on which another recording could show it."""
    return not (robot.on_ground or isinstance(robot, FixedBase))


def _unexcited(signal: Mapping[str, float]) -> list[str]:
    return [effect for effect, level in signal.items() if not shows(level)]


def not_excited(signal: Mapping[str, float], held: bool = True) -> dict[str, str]:
    """Return effects that these data cannot show, and the excitation that would; ``held``: a trunk is that has feet."""
    unexcited = _unexcited(signal)
    unfelt = [effect for effect in members("effect") if held and tolerances.identification(effect).needs_ground]
    return {effect: tolerances.identification(effect).excitation for effect in (*unexcited, *unfelt)}


@dataclass(frozen=True)
class Answer:
    """What a search comes to."""

    verdict: Verdict  # one of six
    named: tuple[NamedEffect, ...]  # effects that the data ask for, strongest first
    theta: Theta  # values of the model with them
    excess: dict[str, float]  # as in :class:`~go1exp.gap.result.GapResult`
    closed: float  # share of the held-out excess that the named effects removed; NaN without one
    within: float = math.nan  # share of the held-out windows within what the user accepts; NaN if nothing is accepted


def concluded(search: Search, warnings: list[str]) -> tuple[Search, Answer]:
    """Return the answer, and the search without the terms that held-out episodes or resamples do not support."""
    settings = search.settings
    plain = excess(search.state.held_out({}))
    check = search.last_check()
    if search.state.terms and not check.helps and removed(search.first, search.steps[-1][1]) <= thresholds.HALF:
        warnings.append(f"Withdrawn, since the last check does not confirm it: {', '.join(search.state.terms)}.")
        search = search.withdrawn("the last check does not confirm it")
    theta, drawn = resampled_values(search)
    weak = frozenset((effect, j) for effect in search.state.terms for j in weak_joints(search, effect, theta, drawn))
    at_bound = frozenset((effect, j) for effect in search.state.terms for j in bounded_joints(search, effect, theta))
    parts = [part for part in (weak, at_bound - weak) if part]
    sparse = search
    for part in parts:
        sparse = reduction.keep_within(sparse, sparse.state.kept | part) or sparse
    if sparse is not search:
        search = sparse
        check = search.last_check()
        theta, drawn = resampled_values(search)
    first, final = search.first, search.steps[-1][1]
    named = name_terms(search, theta, drawn, final <= settings.adequate, check)
    if named and (why := why_withdrawn(search, named, first)):
        doubtful = ", ".join(n.effect for n in named)
        warnings.append(f"Withdrawn, since the tolerances explain these logs and {why}: {doubtful}.")
        search = search.withdrawn(f"the tolerances suffice, and {why}")
        final, theta, named = search.first, search.state.theta, ()
    within = share_accepted(search)
    verdict = decide(search, named, final, within >= thresholds.ACCEPTED_WINDOWS)
    reached = {"null": plain, "box": first, "final": final}
    if len(search.splits.confirm):
        confirmed = reached["confirm"] = excess(search.state.held_out(windows=search.splits.confirm))
        beyond = confirmed > 2.0 * settings.adequate and not within >= thresholds.ACCEPTED_WINDOWS
        if named and verdict == "explained" and beyond:
            verdict = "partly explained"
            warnings.append(f"On windows kept for a last check the error is {1 + confirmed:.3g} times the floor.")
    unsure = {n.effect for n in named if n.status != "certified"}
    certain = {key: value for key, value in theta.items() if key[0] not in unsure}
    reached["written"] = excess(search.state.finer().held_out(certain, search.splits.evaluated))
    return search, Answer(verdict, named, theta, reached, removed(first, final) if named else math.nan, within)


def why_withdrawn(search: Search, named: Sequence[NamedEffect], first: float) -> str:
    """Return why nothing is named after all where the tolerances suffice; empty if one effect is beyond doubt."""
    if search.marginal and not any(beyond_doubt(n, search.state.tolerances) for n in named):
        return "no interval lies beyond its tolerance"
    if first <= search.settings.adequate and not any(n.status == "certified" for n in named):
        return " and ".join(dict.fromkeys(n.reason for n in named))
    return ""


def share_accepted(search: Search) -> float:
    """Return the share of held-out windows that the user accepts, or of the last check if less there; NaN if none."""
    scorer, accept = search.state.scorer, search.settings.accept
    if not accept:
        return math.nan
    shares = []
    for windows in (search.splits.select, search.splits.confirm):
        if len(windows):
            (residual,) = residuals(scorer, [search.state.theta], windows, search.dt)
            shares.append(angle_errors.within(scorer, residual, windows, accept))
    return min(shares)


def name_terms(
    search: Search, theta: Theta, drawn: Mapping[Key, np.ndarray], adequate: bool, check: LastCheck
) -> tuple[NamedEffect, ...]:
    """Return the accepted effects with intervals, at the joints where they leave their tolerances beyond doubt."""
    joints, known = search.state.scorer.windows.joints, search.state.tolerances
    named = []
    for effect in search.state.terms:
        per_joint = [key for key in sizes(effect) if known.param(key).per == "joint"]
        at = _joints_beyond(per_joint, theta, drawn, joints, known)
        reason = doubt(search, effect, theta, at, adequate, check)
        unsure = 0.0 if adequate else beside_a_gap(search, effect)
        if per_joint and not at:
            away = [np.broadcast_to(deviation(theta, key, known), len(joints)) for key in per_joint]
            at = (joints[int(np.max(away, axis=0).argmax())],)  # the joint that is furthest from null
        params: dict[str, dict[str, float]] = {}
        interval: dict[str, dict[str, tuple[float, float]]] = {}
        for key in (key for key in theta if key[0] == effect):
            params[key[1]] = _by_joint(key, theta[key], joints, at)
            if key in drawn:
                interval[key[1]] = _intervals(known.param(key), theta[key], drawn[key], joints, at, unsure)
        status: Literal["certified", "compensating"] = "compensating" if reason else "certified"
        share = search.share_of(effect)
        alike = exact_aliases(search, effect, at)
        if alike and not reason:
            reason = f"on these data it acts just as {' and '.join(alike)}"
        aliases = tuple(dict.fromkeys([*search.aliases[effect], *alike]))
        named.append(NamedEffect(effect, at, params, interval, aliases, status, reason, share))
    return tuple(named)


def _joints_beyond(
    keys: Sequence[Key], theta: Theta, drawn: Mapping[Key, np.ndarray], joints: Sequence[str], known: Tolerances
) -> tuple[str, ...]:
    """Return the joints at which one of the parameters leaves its tolerance and its interval does not hold null."""
    beyond = np.zeros(len(joints), dtype=bool)
    for key in keys:
        p = known.param(key)
        low, high = np.quantile(drawn[key], thresholds.QUANTILES, axis=0)
        beyond |= (deviation(theta, key, known) > 1.0) & ((low > p.null) | (high < p.null))
    return tuple(j for j, b in zip(joints, beyond, strict=True) if b)


def weak_joints(search: Search, effect: str, theta: Theta, drawn: Mapping[Key, np.ndarray]) -> tuple[int, ...]:
    """Return the joints at which a term leaves its tolerance neither beyond doubt nor by much.

    There the 95 % interval reaches into the tolerance, and the deviation is less than ``MUCH`` of the largest one.
    ``drawn`` holds resampled values (B, J) or (B, 1) by parameter.
    """
    joints, known = search.state.scorer.windows.joints, search.state.tolerances
    outside, strong = np.zeros(len(joints), dtype=bool), np.zeros(len(joints), dtype=bool)
    if tolerances.identification(effect).common:
        return ()
    for key in sizes(effect):
        p = known.param(key)
        if p.per == "joint":
            low, high = np.quantile(drawn[key], thresholds.QUANTILES, axis=0)
            away = np.broadcast_to(deviation(theta, key, known), len(joints))
            sure = (low > p.null + p.tolerance) | (high < p.null - p.tolerance)
            outside |= away > 1.0
            strong |= (away > 1.0) & (sure | (away >= thresholds.MUCH * away.max()))
    return tuple(int(j) for j in np.flatnonzero(outside & ~strong))


def bounded_joints(search: Search, effect: str, theta: Theta) -> tuple[int, ...]:
    """Return joints at which a term lies on a bound, drawn there where little shows; none if all of its joints do."""
    joints, known = search.state.scorer.windows.joints, search.state.tolerances
    if tolerances.identification(effect).common:
        return ()
    at_bound = bounded(effect, theta, joints, known)
    free = beyond(effect, theta, joints, known) & ~at_bound
    return tuple(int(j) for j in np.flatnonzero(at_bound)) if free.any() else ()


def beyond_doubt(effect: NamedEffect, known: Tolerances) -> bool:
    """Return whether all of one of an effect's 95 % intervals lies beyond its tolerance."""
    params = {key[1]: known.param(key) for key in sizes(effect.effect)}
    return any(
        low > p.null + p.tolerance or high < p.null - p.tolerance
        for name, p in params.items()
        for low, high in effect.interval.get(name, {}).values()
    )


def _named_places(per: str, joints: Sequence[str], at: Sequence[str]) -> tuple[int, dict[int, str]]:
    """Return how many values a parameter has, and under which name each that counts is written down, by number."""
    if per != "joint":
        return 1, {0: "robot"}
    return len(joints), {k: name for k, name in enumerate(joints) if name in at}


def _by_joint(key: Key, value: np.ndarray, joints: Sequence[str], at: Sequence[str]) -> dict[str, float]:
    """Return the values of a parameter by joint (those of ``at``), or by ``robot``."""
    count, kept = _named_places(declared(key).per, joints, at)
    values = np.broadcast_to(np.ravel(value), count)
    return {name: float(values[k]) for k, name in kept.items()}


def _intervals(
    param: Param, value: np.ndarray, samples: np.ndarray, joints: Sequence[str], at: Sequence[str], unsure: float
) -> dict[str, tuple[float, float]]:
    """Return the 95 % intervals of a parameter by joint (those of ``at``), or by ``robot``; each holds the value."""
    count, kept = _named_places(param.per, joints, at)
    values = np.broadcast_to(np.ravel(value), count)
    low, high = (np.broadcast_to(v, count) for v in np.quantile(samples, thresholds.QUANTILES, axis=0))
    low, high = widened(values, np.minimum(low, values), np.maximum(high, values), param.null, unsure)
    low, high = np.maximum(low, param.low), np.minimum(high, param.high)
    return {name: (float(low[k]), float(high[k])) for k, name in kept.items()}


def decide(search: Search, named: Sequence[NamedEffect], final: float, accepted: bool) -> Verdict:
    """Return the verdict.

    Terms none of which is certified explain nothing, however near they bring the model to these logs. Without resamples
    (``search.bootstraps=0``) their certainty is unknown.
    """
    settings, first = search.settings, search.first
    excited = [effect for effect, level in search.signal.items() if shows(level)]
    if named:
        certain = not settings.bootstraps or any(n.status == "certified" for n in named)
        return "explained" if accepted or (certain and final <= settings.adequate) else "partly explained"
    if first > settings.adequate and not accepted:
        return "unexplained"
    return "not excited" if len(excited) < 0.5 * len(search.signal) else "no gap"


def evidence(search: Search) -> tuple[Candidate, ...]:
    """Return the candidates, best first, with those that the data cannot show."""
    quiet = unexcited_rows(_unexcited(search.signal), [c.effect for c in search.candidates])
    accepted = {c.effect for c in search.candidates if c.status == "accepted"} - set(search.state.terms)
    kept = [
        replace(c, status="rejected", reason="dropped: the other terms do as well without it")
        if c.status == "accepted" and c.effect in accepted
        else c
        for c in search.candidates
    ]
    order = {"accepted": 0, "alias": 1, "rejected": 2}
    return (*sorted(kept, key=lambda c: (c.stage, order[c.status])), *quiet)
