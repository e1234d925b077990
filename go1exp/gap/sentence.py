"""An answer in words: missing effects, where, how sure that is, and what to record next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from go1exp.gap.answer import Answer
from go1exp.gap.result import NamedEffect, Verdict
from go1exp.gap.score.likelihood import removed
from go1exp.gap.search import thresholds, tolerances
from go1exp.gap.search.candidates import deviation
from go1exp.gap.search.screen import free_shapes
from go1exp.gap.search.state import Search
from go1exp.sim.effects.tolerances import Tolerances, declared, effect_class, sizes


def separating(names: Sequence[str]) -> tuple[str, ...]:
    """Return what to record to separate confounded effects, each thing once; empty if none of them says."""
    how = {name: tolerances.identification(name) for name in names}
    return tuple(
        dict.fromkeys(
            how[first].separated_by if second in how[first].confounded else how[second].separated_by
            for first, second in combinations(names, 2)
            if second in how[first].confounded or first in how[second].confounded
        )
    )


def advice(aliases: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return what to record to separate the members of alias sets."""
    sentences = []
    for names in aliases.values():
        if len(names) > 1:
            what = ", and ".join(separating(names)) or "record chirp and steps"
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
    names = [name for _, name in sizes(effect.effect) if effect.params.get(name)]
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
