"""One effect of the whole robot against a hundred tolerances: what a robot on its feet hides from the stepwise search.

A payload makes every leg bear more; so does every drive that is a little weak, each within its tolerance. On the ground
the tolerances of twelve joints together imitate any effect on the trunk up to several times its own tolerance, so a
search that lets them move first finds no gap. An effect of the whole robot has a few numbers. If one of them alone, all
else at its nominal value, removes nearly all of the error, and no common weakness of the drives does as well, then it
is the explanation, not a hundred numbers that happen to agree.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from go1exp.effects.tolerances import sizes
from go1exp.gap.score.likelihood import Scorer
from go1exp.gap.score.linear import table
from go1exp.gap.search import profile_likelihood, significance, tolerances
from go1exp.gap.search.fit import Model, fit, scores
from go1exp.gap.search.trial import excess, removed
from go1exp.schema.registry import members

if TYPE_CHECKING:
    from collections.abc import Callable

    from go1exp.gap.data.splits import Splits
    from go1exp.gap.replay.rows import Theta
    from go1exp.gap.result import GapSettings

ITERATIONS = 4
"""Gauss-Newton steps of a fit: joints that stick make a payload's first ones short."""

STRETCHES = (1.0, 0.85, 1.15, 1.4)
"""Factors on what a fit found that are tried after it: where joints stick, small changes tell less than large ones."""

TURNS = 2
"""Times that first states are moved to suit the best effect, and it is fitted again."""

NEARLY_ALL = 0.8
"""Share of the held-out excess that an effect must remove alone."""


def stretched(scorer: Scorer, model: Model, windows: np.ndarray, dt: float) -> Model:
    """Return a model with all that it departs from the null made as much larger or smaller as fits best."""
    if not model.theta:
        return model
    for _ in range(2):
        tries = []
        for factor in STRETCHES:
            theta = {}
            for key, value in model.theta.items():
                p = model.may.tolerances.param(key)
                theta[key] = (p.null + factor * (value - p.null)).clip(p.low, p.high)
            tries.append(theta)
        chi2 = scores(scorer, tries, windows, dt)
        k = int(np.log(chi2).mean(axis=(1, 2)).argmin())
        model = replace(model, theta=tries[k], chi2=chi2[k])
        if k == 0:
            break
    return model


def refitted(scorer: Scorer, model: Model, windows: np.ndarray, dt: float) -> Model:
    """Return a model fitted from where it is, by first states that suit it."""
    empty = table(scorer, {}, windows, [], dt)
    (found,) = fit(scorer, [model], empty, ITERATIONS, dt)
    return stretched(scorer, found, windows, dt)


def clearest(begun: Scorer, search: Seeker) -> Model | None:
    """Return the effect of the whole robot that does best, every model by first states of its own.

    Args:
        begun: scores from the first states that sensors tell (``gap/search/profile_likelihood.py``).
        search: whose windows count.

    Returns:
        None unless, on windows that no fit has seen, it does clearly better than all others, joints that are all off
        alike, and nothing at all.
    """
    train, select, dt = search.splits.train, search.splits.select, search.dt
    none = profile_likelihood.cost(begun, {}, train, dt)
    machine = begun.replayer.machine
    fits = {
        name: profile_likelihood.fitted(begun, sizes(name), train, dt, none)
        for name in tolerances.nominal(machine)
        if tolerances.identification(name).needs_ground
    }
    name = min(fits, key=lambda n: fits[n][1])
    best = fits.pop(name)[0]
    if not best:
        return None
    chi2 = profile_likelihood.chi2(begun, best, select, dt)

    def loses(rival: Theta) -> bool:
        return bool(
            significance.gains(chi2, profile_likelihood.chi2(begun, rival, select, dt)[None]).mean()
            < -significance.SAME
        )

    # In the order of what they cost: the first that does as well ends it.
    if not loses({}) or not all(loses(rival) for rival, _ in fits.values() if rival):
        return None
    weights = [effect for effect in members("effect") if tolerances.identification(effect).weighs_on_legs]
    clear = all(loses(profile_likelihood.fitted(begun, sizes(effect), train, dt, none)[0]) for effect in weights)
    return Model(name, best, search.may.also(name), sizes(name)) if clear else None


class Seeker(Protocol):
    """What is needed of a search in progress (``gap/search/stepwise.py``)."""

    scorer: Scorer
    splits: Splits
    settings: GapSettings
    dt: float
    single: str

    @property
    def progress(self) -> Callable[[str, float], None]:
        """Told what goes on, and which share of all is done."""

    @property
    def may(self) -> tolerances.Freedom:
        """What may leave its tolerance."""

    def held_out(self, theta: Theta) -> np.ndarray:
        """Return chi2 on windows no fit has seen."""

    def judged(
        self, stage: int, fitted: list[Model], train: np.ndarray, now: np.ndarray, small: bool = False
    ) -> tuple[Model | None, Model | None]:
        """Test fitted candidates and note the evidence."""


def cause(search: Seeker) -> Model | None:
    """Return the effect of the whole robot that explains nearly everything by itself, if there is one.

    First states that suit the nominal model hide a part of what is missing: effects are compared by first states of
    their own, and the best is fitted again at states that suit it. The evidence is noted in the search.
    """
    train, select, dt = search.splits.train, search.splits.select, search.dt
    settings, kept = search.settings, search.scorer
    plain, now = (scores(kept, [{}], part, dt)[0] for part in (train, select))
    if excess(now) < settings.material:
        return None
    search.progress("looking for one cause alone", 0.08)
    best = clearest(profile_likelihood.begun(kept, dt), search)
    if best is None or (settings.effects and best.name not in settings.effects):
        return None
    for _ in range(TURNS):
        assert kept.renewed is not None
        search.scorer = kept.renewed(best.theta)
        best = refitted(search.scorer, best, train, dt)
    share = removed(excess(now), excess(search.held_out(best.theta)))
    accepted, _ = search.judged(1, [best], plain, now)
    search.scorer = kept
    if accepted is None or share < NEARLY_ALL:
        return None
    search.single = best.name
    return best
