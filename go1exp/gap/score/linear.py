"""The linear model of readings about some values: its columns, and the unknowns that they belong to."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.gap.replay.rows import Key, Machine, Probe, Theta, variants
from go1exp.gap.score.likelihood import Scorer, gram, grouped


@dataclass(frozen=True)
class Layout:
    """Which unknown each column of each group belongs to."""

    # (G, p) unknown of column p in group g: one for each group, but one in all for a parameter of the robot
    index: np.ndarray
    size: int  # number of unknowns
    joint: np.ndarray  # (size,) joint of each unknown, -1 for the robot
    probe: np.ndarray  # (size,) column of each

    @staticmethod
    def from_probes(machine: Machine, probes: Sequence[Probe]) -> Layout:
        """Number the unknowns, column by column."""
        groups = len(machine.groups)
        index = np.zeros((groups, len(probes)), dtype=int)
        joint: list[int] = []
        column: list[int] = []
        for p, probe in enumerate(probes):
            joints = [-1] if probe.place is None else [machine.groups[g][probe.place] for g in range(groups)]
            index[:, p] = len(joint) + (np.zeros(groups, dtype=int) if probe.place is None else np.arange(groups))
            joint += joints
            column += [p] * len(joints)
        return Layout(index, len(joint), np.array(joint, dtype=int), np.array(column, dtype=int))

    def total(self, grams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sum Grams (W, G, p+1, p+1) into the normal equations: matrix (size, size), right side (size,)."""
        summed = grams.sum(0)
        matrix, right = np.zeros((self.size, self.size)), np.zeros(self.size)
        for g, at in enumerate(self.index):
            np.add.at(matrix, (at[:, None], at[None]), summed[g, :-1, :-1])
            np.add.at(right, at, summed[g, :-1, -1])
        return matrix, right

    def part(self, columns: np.ndarray) -> np.ndarray:
        """Return the unknowns of some columns (bool mask or numbers)."""
        wanted = np.zeros(self.index.shape[1], dtype=bool)
        wanted[columns] = True
        return np.flatnonzero(wanted[self.probe])


@dataclass(frozen=True)
class Table:
    """A linear model of some windows about ``theta``."""

    windows: np.ndarray  # (V,) which
    probes: tuple[Probe, ...]  # the p columns
    residual: np.ndarray  # (V, G, m) in units of the noise
    columns: np.ndarray  # (V, G, m, p) fall of the residual per unit of each parameter
    theta: Theta  # where
    scale: np.ndarray  # (V, C, J) the noise that is the unit

    def part(self, which: np.ndarray) -> Table:
        """Return the model of some of the windows (numbers within it)."""
        return dataclasses.replace(
            self,
            windows=self.windows[which],
            residual=self.residual[which],
            columns=self.columns[which],
            scale=self.scale[which],
        )

    def grams(self, scorer: Scorer) -> np.ndarray:
        """Return the Gram matrices (V, G, p+1, p+1) of columns and residual."""
        return gram(np.concatenate([self.columns, self.residual[..., None]], axis=-1), scorer.state[self.windows])


ROUGH = 0.5
"""Share of a column's square by which two measurements of it may differ for that to be errors: beyond it, it is a
threshold such as a dead band."""

JUMPS = 0.03
"""Share of a window's columns, in units of tolerances, that may be errors. Beyond it something jumps there, such as a
stop that is met a step later."""

KEPT = 0.2  # share of a column's signal that windows without jumps must hold for those with jumps to be left out


def unbiased_grams(scorer: Scorer, one: Table, other: Table, unit: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """Return the Gram matrices (V, G, p+1, p+1) of columns that were measured twice, by other changes.

    Errors that the two do not share add nothing to the products of one with the other, as they do to squares (errors in
    variables; Fuller, Measurement Error Models, 1987): with the mean c of both and half their difference d,
    (a'b + b'a) / 2 = c'c - d'd.

    Where much is taken away, what is left is itself uncertain, and along what the data hardly tell it can be less than
    nothing. So a group's windows with jumps say nothing (zeros), unless a column that is needed lives there.

    Args:
        scorer: of the windows.
        one: with the residual that counts.
        other: of the same windows and parameters.
        unit: (p,) tolerance of each parameter; 0 for one without.
        needed: (p,) bool, columns whose intervals are wanted.
    """
    count = one.columns.shape[-1]
    mean, half = 0.5 * (one.columns + other.columns), 0.5 * (one.columns - other.columns)
    rough = (half**2).sum((0, 1, 2)) > ROUGH * (mean**2).sum((0, 1, 2))
    half = np.where(rough, 0.0, half).astype(np.float32)
    every = np.concatenate([mean, one.residual[..., None], half], axis=-1)
    products = gram(every, scorer.state[one.windows])
    errors, unbiased = products[..., count + 1 :, count + 1 :], products[..., : count + 1, : count + 1].copy()
    column = np.arange(count)
    signal, error = (g[..., column, column] * unit**2 for g in (unbiased, errors))  # V G p, of one tolerance
    jumps = error.sum(-1) > JUMPS * signal.sum(-1)  # V G
    total, elsewhere = signal.sum(0), (signal * ~jumps[..., None]).sum(0)  # G p
    shown = needed & (total > 1.0)  # beyond the noise
    jumps &= np.all((elsewhere >= KEPT * total) | ~shown, axis=1)
    unbiased[..., :count, :count] -= errors
    unbiased[jumps] = 0.0
    return unbiased


def differences(scorer: Scorer, y: np.ndarray, window: np.ndarray, probes: Sequence[Probe]) -> np.ndarray:
    """Return columns (V, G, m, p) from readings (V, 1 + p, n, C, J): changes per unit of the parameters."""
    groups = np.array(scorer.replayer.machine.groups)
    columns = []
    for k, probe in enumerate(probes):
        per = scorer.unit(y[:, 1 + k] - y[:, 0], window)
        largest = probe.delta[[int(np.argmax(np.abs(probe.delta)))]]  # of what is shared: 0 where it is not
        delta = largest if probe.place is None else probe.delta[groups[:, probe.place]]
        columns.append(per / delta.astype(np.float32)[:, None])
    shape = (*scorer.unit(y[:, 0], window).shape, 0)
    return np.stack(columns, axis=-1) if columns else np.zeros(shape, np.float32)


def table(scorer: Scorer, theta: Theta, windows: np.ndarray, probes: Sequence[Probe], dt: float) -> Table:
    """Replay windows with every probe, at the step of the residuals: at twice that, their errors would not cancel."""
    machine, replayer = scorer.replayer.machine, scorer.replayer
    y = replayer.run(variants(machine, theta, windows, probes), dt)
    y = y.reshape(len(windows), 1 + len(probes), *scorer.windows.y.shape[1:])
    if scorer.finer == 1:
        residual = scorer.unit(scorer.windows.y[windows] - y[:, 0], windows)
    else:
        residual = scorer.residual(variants(machine, theta, windows, []), dt)
    columns = differences(scorer, y, windows, probes)
    return Table(windows, tuple(probes), residual, columns, theta, scorer.scale[windows])


def borrowed(known: Table, scorer: Scorer, theta: Theta, probes: Sequence[Probe], fresh: set[Key], dt: float) -> Table:
    """Return a linear model about other values whose columns are those of ``known``, but for some that are measured."""
    measured = table(scorer, theta, known.windows, [p for p in probes if p.key in fresh], dt)
    one = np.ones_like(measured.scale)
    ratio = np.divide(known.scale, measured.scale, out=one, where=np.isfinite(measured.scale))[:, None]
    unit = grouped(scorer.replayer.machine, np.repeat(ratio, scorer.windows.t.shape[1], axis=1)).astype(np.float32)
    sources = {(p.key, p.place): known.columns[..., k] * unit for k, p in enumerate(known.probes) if p.key not in fresh}
    sources |= {(p.key, p.place): measured.columns[..., k] for k, p in enumerate(measured.probes)}
    columns = np.stack([sources[p.key, p.place] for p in probes], axis=-1)
    return dataclasses.replace(measured, probes=tuple(probes), columns=columns)


def corrected(linear: Table, layout: Layout, step: np.ndarray, unit: np.ndarray, residual: np.ndarray) -> Table:
    """Return columns that also say what a step did: the nearest to the present ones that do (Broyden, 1965).

    ``step`` (size,) was added to the unknowns, of which ``unit`` (size,) count alike, such as their tolerances;
    ``residual`` (V, G, m) is that after the step.
    """
    columns = linear.columns.copy()
    for g, at in enumerate(layout.index):
        scaled = step[at] / unit[at]
        if not scaled.any():
            continue
        missed = linear.residual[:, g] - residual[:, g] - linear.columns[:, g] @ step[at].astype(np.float32)
        share = scaled / unit[at] / (scaled @ scaled)
        columns[:, g] += missed[..., None] * share.astype(np.float32)
    return dataclasses.replace(linear, columns=columns, residual=residual)


def predicted(grams: np.ndarray, layout: Layout, x: np.ndarray) -> np.ndarray:
    """Return the chi2 sum (V, G) that the linear model promises for the unknowns ``x``."""
    chi2 = np.empty(grams.shape[:2])
    for g, at in enumerate(layout.index):
        full = np.append(-x[at], 1.0)
        chi2[:, g] = np.einsum("i,wij,j->w", full, grams[:, g], full)
    return chi2
