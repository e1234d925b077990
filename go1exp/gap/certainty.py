"""Whether a term that helps is certain, or only makes up for something: ``certified`` or ``compensating``, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from go1exp.gap.replay.rows import Theta
from go1exp.gap.score.robust import excess, removed
from go1exp.gap.search import thresholds
from go1exp.gap.search.evidence import at_bound
from go1exp.gap.search.ledger import LastCheck, Ledger
from go1exp.sim.effects.tolerances import sizes


def on_bound(search: Ledger, effect: str, theta: Theta, joints: Sequence[str]) -> str:
    """Return which value of a term lies on the bound of its parameter, in words; empty if none does.

    Args:
        search: that found it.
        effect: the term.
        theta: fitted values.
        joints: where it is named; empty for an effect of the whole robot.
    """
    everyone = search.state.scorer.windows.joints
    for key in sizes(effect):
        p = search.state.tolerances.param(key)
        of_joint = p.per == "joint"
        for k in np.flatnonzero(np.broadcast_to(at_bound(key, theta, search.state.tolerances), len(everyone))):
            if of_joint and everyone[k] not in joints:
                continue
            value = np.ravel(theta[key])[k if theta[key].size > 1 else 0]
            nearest = min((p.low, p.high), key=lambda bound: abs(value - bound))
            unit = "" if p.unit == "-" else f" {p.unit}"
            at = f" at {everyone[k]}" if of_joint else ""
            return f"{p.name}{at} lies on its bound, {nearest:g}{unit}"
    return ""


def doubt(search: Ledger, effect: str, theta: Theta, joints: Sequence[str], adequate: bool, check: LastCheck) -> str:
    """Return why a term is not certified; empty if it is.

    Args:
        search: that found it.
        effect: the term.
        theta: fitted values.
        joints: where it is named.
        adequate: whether the model with all terms counts as right.
        check: what the terms do on the last check.
    """
    stable, alone = search.shares.get(effect, 0.0), search.removes(effect)
    rivals = [name for name in search.aliases.get(effect, ()) if name != effect]
    if not check.helps:
        return "the last check does not bear it out"
    if not math.isnan(check.closed) and check.closed < thresholds.HALF:
        return f"on the last check only {max(check.closed, 0.0):.0%} of the excess goes"
    closes = adequate and search.first > search.settings.adequate
    if stable < (min(thresholds.MAJORITY, search.settings.certified) if closes else search.settings.certified):
        return f"it is named again in {stable:.0%} of the resamples only"
    if not joints and any(search.state.tolerances.param(key).per == "joint" for key in sizes(effect)):
        return "it leaves its tolerance at no joint beyond doubt"
    if bound := on_bound(search, effect, theta, joints):
        return bound
    if len(joints) == 1 and search.strained and search.first - excess(search.select_chi2) < search.settings.material:
        return "the tolerances do nearly as well, and at one joint many effects act alike"
    if adequate:
        return ""
    if not alone > thresholds.BESIDE_GAP_SHARE:  # NaN too
        share = "less" if math.isnan(alone) else f"{max(alone, 0.0):.0%}"
        return f"a gap remains, and of what there is without it, it removes only {share}"
    return f"a gap remains, and {' and '.join(rivals)} would do as well" if rivals else ""


def beside_a_gap(search: Ledger, effect: str) -> float:
    """Return the relative half width that what remains adds to the 95 % intervals of a term's values.

    Args:
        search: that accepted the term, and whose model leaves a gap.
        effect: the term.
    """
    goes = search.removes(effect)
    if math.isnan(goes):
        goes = removed(search.first, excess(search.select_chi2))
    return thresholds.HALF_WIDTH * thresholds.BIAS_SD * math.sqrt(min(max(1.0 - goes, 0.0), 1.0))


def widened(
    value: np.ndarray, low: np.ndarray, high: np.ndarray, null: float, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return intervals (low, high) of values, wider by a share of what each is off null; independent errors add up.

    Args:
        value: fitted.
        low: ends of their intervals, of the same shape.
        high: the same.
        null: of the parameter.
        share: half width, relative.
    """
    astray = share * np.abs(value - null)
    return value - np.hypot(value - low, astray), value + np.hypot(high - value, astray)
