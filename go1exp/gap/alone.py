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

from go1exp.gap import box, judge
from go1exp.gap.fit import Model, fit, scores
from go1exp.gap.likelihood import Scorer, table
from go1exp.gap.replay import Key, Probe
from go1exp.gap.trial import excess, removed

if TYPE_CHECKING:
    from collections.abc import Callable

    from go1exp.gap.judge import Splits
    from go1exp.gap.replay import Theta
    from go1exp.gap.result import GapSettings

COMMON: tuple[Key, ...] = (("strength", "scale"), ("kp_scale", "scale"), ("link_mass", "scale"))
"""What may be off for all joints at once, by one number; it moves the legs as weight and its place do."""

ITERATIONS = 4
"""Gauss-Newton steps of a fit: joints that stick make a payload's first ones short."""

STRETCHES = (1.0, 0.85, 1.15, 1.4)
"""Factors on what a fit found that are tried after it: where joints stick, small changes tell less than large ones."""

TURNS = 2
"""Times that effects are fitted and the first states are moved to suit the best of them."""

NEARLY_ALL = 0.8
"""Share of the held-out excess that an effect must remove alone."""


def fits(scorer: Scorer, windows: np.ndarray, may: box.Freedom, dt: float, begun: Model | None = None) -> list[Model]:
    """Return the effects of the whole robot, each fitted alone from the nominal model.

    Args:
        scorer: of a robot on its feet.
        windows: to fit.
        may: what may leave its tolerance so far.
        dt: physics step, s.
        begun: the one of them that first states suit, which goes on from where it is.
    """
    empty = table(scorer, {}, windows, [], dt)
    models = [Model(name, {}, may.also(name), box.sizes(name)) for name in box.ON_FEET]
    found = fit(scorer, models, empty, ITERATIONS, dt)
    if begun is not None:
        (again,) = fit(scorer, [Model(begun.name, begun.theta, begun.may, begun.keys)], empty, ITERATIONS, dt)
        found = [again if m.name == begun.name else m for m in found]
    return [stretched(scorer, m, windows, dt) for m in found]


def stretched(scorer: Scorer, model: Model, windows: np.ndarray, dt: float) -> Model:
    """Return a model with all that it departs from the null made as much larger or smaller as fits best."""
    if not model.theta:
        return model
    for _ in range(2):
        tries = []
        for factor in STRETCHES:
            theta = {}
            for key, value in model.theta.items():
                p = box.param(key)
                theta[key] = (p.null + factor * (value - p.null)).clip(p.low, p.high)
            tries.append(theta)
        chi2 = scores(scorer, tries, windows, dt)
        k = int(np.log(chi2).mean(axis=(1, 2)).argmin())
        model = replace(model, theta=tries[k], chi2=chi2[k])
        if k == 0:
            break
    return model


def rivals(scorer: Scorer, windows: np.ndarray, may: box.Freedom, dt: float) -> list[Model]:
    """Return models in which all joints are off alike, fitted from the nominal model."""
    joints = len(scorer.windows.joints)
    found: list[Model] = []
    for key in COMMON:
        probe = Probe(key, None, np.full(joints, box.step(key, factor=box.SMALL)))
        own = table(scorer, {}, windows, [probe], dt)
        found += fit(scorer, [Model(key[0], {}, may.also(key[0]), ())], own, ITERATIONS, dt)
    return [stretched(scorer, m, windows, dt) for m in found]


def beaten(scorer: Scorer, best: Model, others: list[Model], windows: np.ndarray, dt: float) -> bool:
    """Return whether ``best`` explains held-out ``windows`` better than each of the others."""
    chi2 = scores(scorer, [best.theta, *(m.theta for m in others)], windows, dt)
    gain = judge.gains(chi2[0], chi2[1:]).mean(axis=1)
    return bool((gain < -judge.SAME).all())


class Seeker(Protocol):
    """What is needed of a search in progress (``gap/search.py``)."""

    scorer: Scorer
    splits: Splits
    settings: GapSettings
    dt: float
    single: str

    @property
    def progress(self) -> Callable[[str, float], None]:
        """Told what goes on, and which share of all is done."""

    @property
    def may(self) -> box.Freedom:
        """What may leave its tolerance."""

    def held_out(self, theta: Theta) -> np.ndarray:
        """Return chi2 on windows no fit has seen."""

    def judged(
        self, stage: int, fitted: list[Model], train: np.ndarray, now: np.ndarray, small: bool = False
    ) -> tuple[Model | None, Model | None]:
        """Test fitted candidates and note the evidence."""


def cause(search: Seeker) -> Model | None:
    """Return the effect of the whole robot that explains nearly everything by itself, if there is one.

    First states suit the nominal model so far, and hide a part of what is missing: they are moved to suit the best
    effect, which is then fitted again. The evidence is noted in the search.
    """
    train, select, dt, may = search.splits.train, search.splits.select, search.dt, search.may
    settings, kept = search.settings, search.scorer
    plain, now = (scores(kept, [{}], part, dt)[0] for part in (train, select))
    if excess(now) < settings.material:
        return None
    search.progress("looking for one cause alone", 0.08)
    models = fits(kept, train, may, dt)
    best = min(models, key=lambda m: np.inf if m.chi2 is None else float(np.log(m.chi2).mean()))
    considered = not settings.effects or best.name in settings.effects
    if not considered or removed(excess(now), excess(search.held_out(best.theta))) < 0.5 * NEARLY_ALL:
        return None
    for _ in range(TURNS):
        assert search.scorer.renewed is not None
        search.scorer = search.scorer.renewed(best.theta)
        models = fits(search.scorer, train, may, dt, best)
        best = next(m for m in models if m.name == best.name)
    others = [m for m in models if m is not best]
    others += rivals(search.scorer, train, may, dt)
    clear = beaten(search.scorer, best, others, select, dt)
    share = removed(excess(now), excess(search.held_out(best.theta)))
    accepted, _ = search.judged(1, [best], plain, now)
    search.scorer = kept
    if accepted is None or not clear or share < NEARLY_ALL:
        return None
    search.single = best.name
    return best
