"""The nominal model within its tolerances: which parameters may move, how far, and which bounds are active.

An effect counts as a gap only where the data ask for more of it than its declared tolerance, so everything that a model
has or obviously could have moves freely inside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from go1exp.config.schema.registry import members
from go1exp.gap.replay.rows import Key, Machine, Probe, Theta
from go1exp.gap.score.likelihood import Scorer
from go1exp.gap.score.linear import Layout, Table
from go1exp.gap.search import thresholds
from go1exp.sim.effects.base import Identification, Param
from go1exp.sim.effects.tolerances import Tolerances, effect_class, sizes
from go1exp.sim.physics.dynamics import box_minimum


def identification(effect: str) -> Identification:
    """Return how a registered effect is looked for."""
    return effect_class(effect).identification


def confounded(one: str, other: str) -> bool:
    """Return whether an effect is easily taken for another; for none (""), it is not."""
    return bool(other) and (other in identification(one).confounded or one in identification(other).confounded)


def felt(machine: Machine) -> tuple[str, ...]:
    """Return the registered effects that a robot can feel; one whose trunk is held has no use for ground."""
    free = bool(machine.base_probe)
    return tuple(
        name
        for name in sorted(members("effect"))
        if not (identification(name).needs_ground and not machine.on_ground)
        and not (identification(name).needs_stand and free)
    )


def nominal(machine: Machine) -> tuple[str, ...]:
    """Return the effects that every model of the robot has a value for, which move within their tolerances."""
    names = [name for name in felt(machine) if identification(name).nominal]
    return tuple(sorted(names, key=lambda name: identification(name).rank))


def step(p: Param, value: float | None = None, factor: float = 1.0) -> float:
    """Return a change of a parameter to learn its influence from, in the direction in which there is room."""
    at = p.null if value is None else value
    size = p.tolerance if math.isfinite(p.tolerance) else 0.05 * min(p.high - p.low, 4.0 * max(abs(p.null), 0.1))
    return factor * size if at + factor * size <= p.high else -factor * size


def present(effect: str, theta: Mapping[Key, np.ndarray], machine: Machine) -> np.ndarray:
    """Return at which joints (J,) an effect with one value for several joints is; at all if it is at none yet."""
    away = np.zeros(len(machine.joints), dtype=bool)
    for key in sizes(effect):
        null = machine.tolerances.param(key).null
        away |= np.broadcast_to(theta.get(key, np.array([null])) != null, away.shape)
    return away if away.any() else ~away


def probes(
    machine: Machine, keys: Sequence[Key], theta: Mapping[Key, np.ndarray], factor: float = thresholds.DIFFERENCE
) -> list[Probe]:
    """Return the probes of parameters at their present values."""
    columns: list[Probe] = []
    joints = len(machine.joints)
    for key in keys:
        p = machine.tolerances.param(key)
        wide = joints if p.per == "joint" else 1
        values = np.broadcast_to(theta.get(key, np.array([p.null])), (wide,))
        delta = np.array([step(p, float(v), factor) for v in values])
        by_joint = p.per == "joint" and not identification(key[0]).common
        if p.per == "joint" and not by_joint:
            at = present(key[0], theta, machine)
            delta = np.where(at, delta[int(at.argmax())], 0.0)
        places: list[int | None] = list(range(len(machine.groups[0]))) if by_joint else [None]
        columns += [Probe(key, place, delta) for place in places]
    return columns


@dataclass(frozen=True)
class Bounds:
    """Limits and priors of unknowns, as increments on the present values; all (size,)."""

    low: np.ndarray
    high: np.ndarray
    centre: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Freedom:
    """What may leave its tolerance."""

    tolerances: Tolerances  # of all parameters
    effects: frozenset[str] = frozenset()  # that may
    # effects and joints that may not although their effect may elsewhere
    kept: frozenset[tuple[str, int]] = frozenset()
    # whether all others stay at their nominal values, and not only within their tolerances (an ablation)
    rigid: bool = False

    def also(self, *effects: str) -> Freedom:
        """Return the same with more effects."""
        return replace(self, effects=self.effects | {*effects})

    def reach(self, key: Key, joint: int) -> float:
        """Return how far from null a parameter may go, as far as tolerances are concerned."""
        tolerance = self.tolerances.param(key).tolerance
        if key[0] in self.effects:
            return tolerance if (key[0], joint) in self.kept else math.inf
        return 0.0 if self.rigid else tolerance


def _beyond_tolerance(effect: str, theta: Mapping[Key, np.ndarray], joint: int, tolerances: Tolerances) -> bool:
    """Return whether an effect leaves its tolerance at a joint: where it does not, its shape hardly matters."""
    for key in sizes(effect):
        p = tolerances.param(key)
        value = np.ravel(theta.get(key, np.array([p.null])))
        if abs(float(value[joint if value.size > 1 else 0]) - p.null) > p.tolerance:
            return True
    return False


def unknowns(
    layout: Layout, columns: Sequence[Probe], theta: Mapping[Key, np.ndarray], tolerances: Tolerances
) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of unknowns (size,), and what counts as one of each: its tolerance, or else its range."""
    values, unit = np.empty(layout.size), np.empty(layout.size)
    params = _params(columns, tolerances)
    for i in range(layout.size):
        probe, p = columns[layout.probe[i]], params[layout.probe[i]]
        by_joint = np.ravel(theta.get(probe.key, np.array([p.null])))
        values[i] = by_joint[_joint(layout, probe, i) if by_joint.size > 1 else 0]
        unit[i] = p.tolerance if math.isfinite(p.tolerance) else p.high - p.low
    return values, unit


def _params(columns: Sequence[Probe], tolerances: Tolerances) -> list[Param]:
    """Return the declaration of each probe's parameter."""
    return [tolerances.param(probe.key) for probe in columns if isinstance(probe.key, tuple)]  # all of them


def _joint(layout: Layout, probe: Probe, i: int) -> int:
    """Return the joint at which unknown ``i`` is read off: of one that several joints share, any of them."""
    return int(layout.joint[i]) if layout.joint[i] >= 0 else int(np.argmax(np.abs(probe.delta)))


def bounds(
    layout: Layout, columns: Sequence[Probe], theta: Mapping[Key, np.ndarray], may: Freedom, back: bool = False
) -> Bounds:
    """Return the limits of unknowns.

    Args:
        layout: of the unknowns.
        columns: their probes.
        theta: present values.
        may: what may leave its tolerance.
        back: whether what is outside must come back inside, and not only no further.

    A shape stays as it is where its effect is within tolerance.
    """
    low, high, centre, weight = (np.zeros(layout.size) for _ in range(4))
    values, unit = unknowns(layout, columns, theta, may.tolerances)
    params = _params(columns, may.tolerances)
    for i, value in enumerate(values):
        probe, p = columns[layout.probe[i]], params[layout.probe[i]]
        assert isinstance(probe.key, tuple)
        j = _joint(layout, probe, i)
        reach = may.reach(probe.key, int(layout.joint[i]))
        wide = not math.isfinite(reach)
        low[i] = max(p.low, p.null - reach) - value
        high[i] = min(p.high, p.null + reach) - value
        centre[i] = p.null - value
        weight[i] = 1.0 / ((thresholds.FREE_PRIOR_SD if wide else thresholds.PRIOR_SD) * unit[i]) ** 2
        if not math.isfinite(p.tolerance) and not _beyond_tolerance(probe.key[0], theta, j, may.tolerances):
            low[i] = high[i] = 0.0
    if not back:
        low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    return Bounds(low, high, centre, weight)


def _definite(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix with a diagonal of ones (n, n), made positive definite by the least of the ridges that does."""
    for ridge in thresholds.RIDGES:
        raised = matrix + ridge * np.eye(len(matrix))
        try:
            np.linalg.cholesky(raised)
        except np.linalg.LinAlgError:
            continue
        return raised
    raise np.linalg.LinAlgError("normal equations are indefinite by far more than their rounding")


def solve(matrix: np.ndarray, right: np.ndarray, limits: Bounds) -> np.ndarray:
    """Return the minimum of x' A x - 2 b' x + weight (x - centre)^2 within limits; A (n, n) >= 0."""
    scale = 1.0 / np.sqrt(np.diag(matrix) + limits.weight)
    full = _definite((matrix + np.diag(limits.weight)) * scale[:, None] * scale)
    aim = (right + limits.weight * limits.centre) * scale
    low, high = limits.low / scale, limits.high / scale
    x, moves = low.copy(), low < high
    slope = full[np.ix_(moves, ~moves)] @ x[~moves] - aim[moves]
    x[moves] = box_minimum(full[np.ix_(moves, moves)], slope, low[moves], high[moves])
    return np.asarray(x * scale)


def moved(theta: Theta, layout: Layout, columns: Sequence[Probe], x: np.ndarray, machine: Machine) -> Theta:
    """Return ``theta`` with increments ``x`` (size,) added."""
    values = {key: value.copy() for key, value in theta.items()}
    for i in range(layout.size):
        probe = columns[layout.probe[i]]
        assert isinstance(probe.key, tuple)
        p = machine.tolerances.param(probe.key)
        wide = len(machine.joints) if p.per == "joint" else 1
        full = np.broadcast_to(values.get(probe.key, np.array([p.null])), (wide,)).copy()
        shared = probe.delta != 0.0 if len(probe.delta) == wide else slice(None)
        full[layout.joint[i] if layout.joint[i] >= 0 else shared] += x[i]
        values[probe.key] = full.clip(p.low, p.high)
    return values


def without(theta: Theta, name: str, tolerances: Tolerances) -> Theta:
    """Return the values without a term; a nominal effect goes back within its tolerance."""
    values = {}
    for key, value in theta.items():
        if key[0] == name:
            p = tolerances.param(key)
            if not identification(name).nominal or not math.isfinite(p.tolerance):
                continue
            value = value.clip(p.null - p.tolerance, p.null + p.tolerance)
        values[key] = value
    return values


def values(scorer: Scorer, linear: Table) -> float:
    """Return how many values are compared in the windows of ``own``."""
    return float(scorer.size[linear.windows].sum()) * len(scorer.replayer.machine.groups)


def cost(scorer: Scorer, linear: Table) -> Callable[[Freedom], float]:
    """Return a function that says how small chi2 and priors can be, to first order about ``own``, with some freedom."""
    layout = Layout.from_probes(scorer.replayer.machine, linear.probes)
    chi2 = scorer.chi2(linear.residual, linear.windows)
    matrix, right = layout.total(linear.grams(scorer) / np.maximum(chi2, 1.0)[..., None, None])

    def smallest(may: Freedom) -> float:
        limits = bounds(layout, linear.probes, linear.theta, may, back=True)
        return price(matrix, right, limits)

    return smallest


def price(matrix: np.ndarray, right: np.ndarray, limits: Bounds) -> float:
    """Return the bounded minimum that :func:`go1exp.gap.search.tolerances.solve` reaches."""
    x = solve(matrix, right, limits)
    return float(x @ matrix @ x - 2.0 * right @ x + (limits.weight * (x - limits.centre) ** 2).sum())


def relief(scorer: Scorer, linear: Table, may: Freedom) -> dict[str, float]:
    """Return by how much chi2 and priors would fall if an effect might leave its tolerance."""
    effects = dict.fromkeys(p.key[0] for p in linear.probes)
    smallest = cost(scorer, linear)
    return {effect: smallest(may) - smallest(may.also(effect)) for effect in effects}


def active_bounds(relieved: Mapping[str, float], count: float, but: Collection[str]) -> list[str]:
    """Return the effects that would leave their tolerance, largest gain first; ``count`` values were compared."""
    order = sorted((e for e in relieved if e not in but), key=lambda e: -relieved[e])
    return [
        e
        for e in order[: thresholds.MOST_ACTIVE_BOUNDS]
        if relieved[e] > max(thresholds.ACTIVE_BOUND * count, relieved[order[0]] / thresholds.RIVAL_RATIO)
    ]
