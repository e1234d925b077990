"""How well the model explains windows of data: Gaussian noise, with the unknown initial state and clock averaged out.

A window's residual r and its change J per parameter, both in units of the noise, have the covariance I + S S', where S
is the change per standard deviation of the initial state, and of the time between stamps of commands and of readings.
All that fits and scores need is the Gram matrix of [J r] in the metric of that covariance, window by window and group
of joints by group.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import MOUNT_LOAD, Machine, Probe, Rows, Theta, mounted, variants

KNEE = 10.0
"""chi2 per value from which a window counts by its logarithm, so that a few windows do not decide alone. Up to it the
level is the plain mean, to which all limits belong."""


def log_chi2(chi2: np.ndarray) -> np.ndarray:
    """Return the logarithm of chi2 per value, below 1 continued by its tangent, so never less than -1.

    A joint that rests in a model with dry friction can have a chi2 of 1e-11, whose logarithm would outweigh all else.
    The slope is 1 / max(chi2, 1), the weight that windows have in the fits.
    """
    return np.where(chi2 < 1.0, chi2 - 1.0, np.log(np.maximum(chi2, 1.0)))


def excess(chi2: np.ndarray) -> float:
    """Return the typical excess of chi2 per value (any shape) over its floor of 1; NaN of nothing."""
    return float(weighted_excess(chi2.ravel(), np.ones(chi2.size)))


def weighted_excess(chi2: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the typical excess (...) of chi2 per value (N, ...), each with its weight (N, ...); NaN without any.

    The mean f^-1(mean f(chi2)) of Kolmogorov (1930) with f the identity up to ``KNEE`` and a logarithm beyond: the
    plain mean where no window is wild, and close to the geometric mean where all are far from the floor.
    """
    value = np.minimum(chi2, KNEE) + KNEE * np.log(np.maximum(chi2, KNEE) / KNEE)
    whole = np.asarray(weight.sum(axis=0), dtype=float)
    level = np.divide((value * weight).sum(axis=0), whole, where=whole > 0, out=np.full(whole.shape, np.nan))
    return np.where(level > KNEE, KNEE * np.exp(level / KNEE - 1.0), level) - 1.0


def removed(before: float, after: float) -> float:
    """Return the share of an excess that is gone; what lies below the floor counts as nothing."""
    return 1.0 - max(after, 0.0) / before if before > 0 else 0.0


STATE_PROBE = (1.0e-3, 0.05)  # change of an initial angle, rad, and speed, rad/s, by which its influence is measured


def grouped(machine: Machine, y: np.ndarray) -> np.ndarray:
    """Sort (R, n, C, J) by groups of joints into (R, G, m), m = n C K."""
    split = y[..., np.array(machine.groups)]  # R n C G K
    return np.moveaxis(split, 3, 1).reshape(len(y), len(machine.groups), -1)


def gram(columns: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Return A' (I + S S')^-1 A (..., p, p) of columns A (..., m, p), states S (..., m, k), by Woodbury's identity."""
    shape, k = columns.shape, state.shape[-1]
    wide = np.concatenate([columns, state], axis=-1).reshape(-1, shape[-2], shape[-1] + k)
    # One product of matrices at a time goes to BLAS; NumPy's stacked product of transposed arrays does not.
    inner = np.stack([a.T @ a for a in wide]).astype(np.float64)
    plain, cross = inner[:, :-k, :-k], inner[:, -k:, :-k]
    metric = inner[:, -k:, -k:] + np.eye(k)
    weighted = plain - np.swapaxes(cross, -1, -2) @ np.linalg.solve(metric, cross)
    return np.asarray(weighted.reshape(*shape[:-2], shape[-1], shape[-1]))


@dataclass(frozen=True)
class Scorer:
    """Scores replays of windows."""

    replayer: Replayer  # the model
    scale: np.ndarray  # (W, C, J) standard deviation of noise and numerical error
    # (W, G, m, k) change of the readings, in units of ``scale``, per standard deviation of the initial state and of the
    # clock
    state: np.ndarray
    # returns a scorer whose floors and initial states suit other values of the model
    updated: Callable[[Theta], Scorer] | None = None
    clock_s: float = 0.0  # what the clock was taken to be off by, s
    # the windows with their initial states as sensors tell them, where those were moved; None if not
    expected: Windows | None = None
    finer: int = 1  # residuals are replayed at this part of the step that columns and floors are measured at
    # (k,) bool, which columns of ``state`` are of a trunk on a mount, which all groups feel. In scores each group has
    # it to itself
    common: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @property
    def windows(self) -> Windows:
        """What is scored."""
        return self.replayer.windows

    @property
    def size(self) -> np.ndarray:
        """(W,) number of values in a window and group."""
        w = self.windows
        used = np.isfinite(self.scale).sum((1, 2)) / len(self.replayer.machine.groups)
        return np.asarray(w.valid.sum(1) * used)

    def unit(self, y: np.ndarray, window: np.ndarray) -> np.ndarray:
        """Return readings, or differences of them, (R, n, C, J) in units of the noise as (R, G, m)."""
        scaled = y / self.scale[window][:, None] * self.windows.valid[window][:, :, None, None]
        return grouped(self.replayer.machine, scaled.astype(np.float32))

    def residual(self, rows: Rows, dt: float) -> np.ndarray:
        """Return what was measured minus what each row says, (R, G, m) in units of the noise."""
        return self.unit(self.windows.y[rows.window] - self.replayer.run(rows, dt / self.finer), rows.window)

    def chi2(self, residual: np.ndarray, window: np.ndarray) -> np.ndarray:
        """Return chi2 per value (R, G) of residuals (R, G, m)."""
        whole = gram(residual[..., None], self.state[window])[..., 0, 0]
        return np.asarray(whole / self.size[window][:, None])


def state_probes(machine: Machine, theta: Theta | None = None) -> list[Probe]:
    """Return the probes of angles, then speeds, of each place in the groups; then of a base that can move."""
    places, joints = range(len(machine.groups[0])), len(machine.joints)
    joints_probes = [
        Probe(kind, place, np.full(joints, size))
        for kind, size in zip(("q", "qd"), STATE_PROBE, strict=True)
        for place in places
    ]
    of_base = [Probe("base", None, row) for row in np.diag(machine.base_probe)]
    on_mount = mounted(variants(machine, theta or {}, np.zeros(1, dtype=int), []))[0]
    return joints_probes + of_base + [Probe("mount", None, row) for row in np.diag(MOUNT_LOAD) if on_mount]


def _start_sd(windows: Windows, machine: Machine, probe: Probe) -> np.ndarray:
    """Return the standard deviation of a coordinate of the initial state (W, G), in changes by its probe."""
    if probe.key == "base":
        axis = int(np.argmax(probe.delta))
        return windows.base_sd[:, axis, None] / machine.base_probe[axis]
    if probe.key == "mount":
        return np.ones((len(windows), 1))
    sd = windows.q_sd if probe.key == "q" else windows.qd_sd
    return sd[:, np.array(machine.groups)[:, probe.place]] / STATE_PROBE[probe.key == "qd"]


def scorer(
    replayer: Replayer,
    theta: Theta,
    scale: np.ndarray,
    dt: float,
    clock_s: float = 0.0,
    subset: np.ndarray | None = None,
) -> Scorer:
    """Measure how initial states and a clock off by ``clock_s`` act on readings of ``subset``, all windows if None."""
    w, machine = replayer.windows, replayer.machine
    probes = state_probes(machine, theta)
    everything = np.arange(len(w)) if subset is None else subset
    rows = variants(machine, theta, everything, probes)
    empty = Scorer(replayer, scale, np.empty(0), clock_s=clock_s)
    y = replayer.run(rows, dt).reshape(len(everything), 1 + len(probes), *w.y.shape[1:])
    columns = []
    for k, probe in enumerate(probes):
        sd = _start_sd(w, machine, probe)[everything]
        per = empty.unit(y[:, 1 + k] - y[:, 0], everything)
        columns.append(per * sd[..., None].astype(np.float32))
    columns += [empty.unit(change, everything) for change in w.unknown(y[:, 0])]
    if clock_s:
        columns.append(empty.unit(clock_s * np.gradient(y[:, 0], w.period, axis=1), everything))
    common = np.zeros(len(columns), dtype=bool)
    common[: len(probes)] = [probe.key == "mount" for probe in probes]
    return dataclasses.replace(empty, state=np.stack(columns, axis=-1), common=common)
