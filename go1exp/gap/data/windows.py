"""Windows of recordings, and which of them are for fitting, for held-out tests and for the last check."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.logs.recording import Meta

PAST_S = 0.064
"""Commands before a window that are kept, s: the longest command delay that an effect may have, and a little."""


@dataclass(frozen=True)
class Windows:
    """W windows of at most n samples of C quantities of J joints; what is missing has weight 0."""

    joints: tuple[str, ...]  # their names
    quantities: tuple[str, ...]  # names of the C quantities
    period: float  # the logger's, s
    episode: np.ndarray  # (W,) index of the recording
    begin: np.ndarray  # (W,) time of the initial state by the recording's clock, s
    origin: np.ndarray  # (W,) time at which the recording begins, by the same clock, s
    q: np.ndarray  # (W, J) initial state, rad
    qd: np.ndarray  # (W, J) rad/s
    qdd: np.ndarray  # (W, J) rad/s2
    q_sd: np.ndarray  # (W, J) its standard deviation
    qd_sd: np.ndarray  # (W, J)
    kp: np.ndarray  # (W, J) gains
    kd: np.ndarray  # (W, J)
    t: np.ndarray  # (W, n) times of the samples since the initial state, s
    y: np.ndarray  # (W, n, C, J) what was measured
    scale: np.ndarray  # (W, C, J) standard deviation of its noise
    valid: np.ndarray  # (W, n) bool
    # per window, times (E,) since the initial state and targets (E, J) in force from each on
    edges: tuple[tuple[np.ndarray, np.ndarray], ...]
    # per window, times (E,) and whether the drives are on from each on
    switches: tuple[tuple[np.ndarray, np.ndarray], ...]
    length: float  # time to replay, s

    def __len__(self) -> int:
        return len(self.episode)

    @property
    def elapsed(self) -> np.ndarray:
        """(W,) time of the initial state since the episode began, s."""
        return self.begin - self.origin

    @property
    def of_joints(self) -> int:
        """How many of the quantities, the first ones, are the joints'."""
        return len(self.quantities)

    @property
    def compared(self) -> np.ndarray:
        """(W, J) bool, which joints are: some of their quantities have a noise that is finite."""
        return np.asarray(np.isfinite(self.scale[:, : self.of_joints]).any(axis=1))

    @property
    def base_sd(self) -> np.ndarray:
        """(W, B) standard deviations of a free base's initial state; B is 0 for one that is held."""
        return np.empty((len(self), 0))

    @property
    def channels(self) -> tuple[tuple[str, int, int], ...]:
        """Name, quantity and place of every reading."""
        return tuple((f"{q}_{j}", c, i) for c, q in enumerate(self.quantities) for i, j in enumerate(self.joints))

    def demanded(self, windows: np.ndarray) -> np.ndarray:
        """Return torques (V, n, J), N m, of the PD law on measurements, or torque targets; 0 while drives are off."""
        q, qd, t = self.y[windows, :, 0], self.y[windows, :, 1], self.t[windows]
        target, on = np.empty_like(q), np.empty(t.shape, dtype=bool)
        for row, k in enumerate(windows):
            target[row] = held(self.edges[k], t[row])
            on[row] = held(self.switches[k], t[row])
        kp, kd = self.kp[windows][:, None], self.kd[windows][:, None]
        asked = np.where((kp == 0.0) & (kd == 0.0), target, kp * (target - q) - kd * qd)
        return np.asarray(asked * on[..., None])

    def by_quantity(self, values: np.ndarray) -> dict[str, float]:
        """Return the median of values (W, C, J) by quantity."""
        return {name: float(np.median(values[:, c])) for c, name in enumerate(self.quantities)}

    def unknown(self, y: np.ndarray) -> list[np.ndarray]:
        """Return changes of the readings ``y`` (W, n, C, J) per standard deviation of what sensors may be off by."""
        return []

    def loads(self) -> np.ndarray | None:
        """Return which joints' legs carry weight (W, n, J) bool; None for a robot that is held."""
        return None

    @property
    def observable(self) -> tuple[str, ...]:
        """Quantities that a simulation can tell, whether they are compared or not."""
        return (*self.quantities[:2], "tau_est")

    def moved(self, x: np.ndarray) -> Windows:
        """Return windows whose initial states are moved by ``x`` (W, 2 J + B) standard deviations."""
        joints = len(self.joints)
        q, qd = x[:, :joints], x[:, joints : 2 * joints]
        return dataclasses.replace(self, q=self.q + q * self.q_sd, qd=self.qd + qd * self.qd_sd)


def averaged(changes: tuple[np.ndarray, np.ndarray], times: np.ndarray) -> np.ndarray:
    """Return the means (K, ...) of a held signal over the even steps that begin at ``times`` (K,).

    That is second order in the step for changes between steps too, as the plant lets a change at the beginning of a
    step count for half of it.
    """
    at, values = changes
    place = (at - times[0]) / (times[1] - times[0])
    index = np.searchsorted(place, np.arange(len(times)) + 1e-6, side="right") - 1
    mean = np.array(values[index.clip(0)], dtype=float)
    step = np.floor(place + 1e-6).astype(int)
    share = 1.0 - (place - step)
    for k in np.flatnonzero((step >= 0) & (step < len(times)) & (place - step > 1e-6)):
        if k:  # the first is in force from the beginning
            mean[step[k]] += share[k] * (values[k] - values[k - 1])
    return mean


def held(changes: tuple[np.ndarray, np.ndarray], times: np.ndarray) -> np.ndarray:
    """Return the values (K, ...) of a held signal at even ``times`` (K,); it changes at the nearest of them."""
    index = np.searchsorted(changes[0], times + 0.49 * (times[1] - times[0]), side="right") - 1
    return np.asarray(changes[1][index.clip(0)])


STRETCH = 3  # windows of a stretch
KEPT_EVERY = 5  # of this many stretches of an episode one is kept for the last check, where whole episodes cannot be


@dataclass(frozen=True)
class Splits:
    """Numbers of the windows that models are fitted on, chosen by, and finally confirmed on."""

    train: np.ndarray  # to fit
    select: np.ndarray  # for held-out tests
    confirm: np.ndarray  # whole episodes, or stretches of them, that nothing is decided on; may be empty
    alone: tuple[str, ...] = ()  # episodes of which some stretches are in ``train`` and some in ``select``
    shared: tuple[str, ...] = ()  # those of them that also lend stretches to ``confirm``

    @property
    def evaluated(self) -> np.ndarray:
        """Windows that no fitted value has seen: those of the last check, or if there are none the held-out ones."""
        return self.confirm if len(self.confirm) else self.select


def stretches(episode: np.ndarray) -> np.ndarray:
    """Return the number of the stretch of ``STRETCH`` windows that each window (W,) is in."""
    place = np.arange(len(episode)) - np.searchsorted(episode, episode)
    return np.asarray(np.unique(episode * len(episode) + place // STRETCH, return_inverse=True)[1])


def _kept_whole(kinds: Sequence[tuple[object, ...]], wanted: int, rng: np.random.Generator) -> list[int]:
    """Return which units to keep whole for the last check: never the only one of a motion that is left."""
    motions = [kind[0] for kind in kinds]
    likes = [(kinds.count(k), motions.count(k[0]), rng.random()) for k in kinds]
    kept: list[int] = []
    for u in sorted(range(len(kinds)), key=lambda u: likes[u], reverse=True):
        left = [motions[v] for v in range(len(kinds)) if v not in kept]
        if len(kept) < wanted and left.count(motions[u]) > 1:
            kept.append(u)
    return kept


def splits(metas: Sequence[Meta], episode: np.ndarray, confirm: float, rng: np.random.Generator) -> Splits:
    """Split windows, whose recordings are ``episode`` (W,), by episode, or within one that is the only one of its kind.

    What only one episode shows cannot be fitted if that episode is for tests, nor tested if it is fitted.
    So of episodes of one motion and gain set half are fitted and half tested; one that is alone is cut into
    stretches of three windows, which take turns. For the last check whole episodes are kept of motions of which there
    are more; if those are fewer than the share ``confirm`` asks for, every fifth stretch of episodes that are alone
    is. Of fewer than four episodes none is kept whole, and of short ones no stretch. An episode and its repetition
    count as one.
    """
    shown, episode = np.unique(episode, return_inverse=True)  # one without any window can be neither tested nor fitted
    metas = [metas[k] for k in shown]
    units = list(dict.fromkeys(m.repeat_of or m.episode for m in metas))
    unit = np.array([units.index(m.repeat_of or m.episode) for m in metas])[episode]
    about = {m.repeat_of or m.episode: m for m in reversed(metas)}
    kinds = [(about[u].excitation, about[u].kp, about[u].kd) for u in units]
    last = max(1, round(confirm * len(units))) if confirm and len(units) > 3 else 0
    kept = _kept_whole(kinds, last, rng)
    select, confirmed = np.zeros(len(episode), dtype=bool), np.isin(unit, kept)
    cut, alone, shared = len(kept) < max(last, 1 if confirm else 0), [], []
    before = 0  # stretches of episodes that are alone so far; those of few episodes count from each one's beginning
    for kind in dict.fromkeys(kinds):
        shuffled = rng.permutation([u for u in range(len(units)) if kinds[u] == kind and u not in kept])
        if len(shuffled) == 1:
            name, inside = units[shuffled[0]], unit == shuffled[0]
            alone.append(name)
            stretch = np.unique(stretches(episode)[inside], return_inverse=True)[1]
            count = int(stretch.max(initial=-1)) + 1
            spared = (before + stretch) % KEPT_EVERY == KEPT_EVERY - 1
            if cut and spared.any() and (len(units) > 3 or count >= KEPT_EVERY):
                shared.append(name)
                confirmed[inside] = spared
            before += count if len(units) > 3 else 0
            select[inside] = (stretch + len(alone)) % 2 == 1
        else:
            select |= np.isin(unit, shuffled[: len(shuffled) // 2])
    train, held, last_check = (np.flatnonzero(m) for m in (~select & ~confirmed, select & ~confirmed, confirmed))
    return Splits(train, held, last_check, tuple(alone), tuple(shared))
