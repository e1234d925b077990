"""Recordings -> a trained actuator net, its report, and its pictures."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from go1exp import __version__
from go1exp.base.files import replacing
from go1exp.base.report.plots import COLOURS
from go1exp.gap.actuator_net.dataset import JointTorque, Rows, Split, fingerprint, split, windows
from go1exp.gap.actuator_net.report import Reference, Report, linear, recorded, report, rmse, thresholds
from go1exp.gap.actuator_net.settings import FitError, FitSettings
from go1exp.gap.actuator_net.train import Trained, train
from go1exp.logs.audit.copies import copies
from go1exp.logs.audit.signals import Log
from go1exp.logs.recording import Recording
from go1exp.sim.actuator.actuator_net import ActuatorNet, NetInfo, Provenance, group_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OnProgress = Callable[[str, int, int, float, float], None]
"""``on_progress(what, done, total, train, validation)``: ``net hip`` or ``half net hip``, epochs, RMSE in N m."""

SLACK = 0.9
"""Smallest distance of taps in sampling periods: a nominal 500 Hz clock that runs at 498 Hz still allows 2 ms."""


@dataclass(frozen=True, eq=False)
class FitResult:
    """The result of a fit."""

    net: ActuatorNet  # the network
    report: Report  # errors of the network and of the references on the held-out episodes
    rows: Rows  # the held-out rows; ``rows.episode`` indexes ``episodes``
    episodes: tuple[str, ...]  # names of all episodes
    torque: dict[str, np.ndarray]  # model -> torque at ``rows`` ``(R,)``, N m: ``net`` and the available references
    curves: dict[str, np.ndarray]  # group -> (epochs, 2) root mean square errors of training and validation, N m


def fit(
    recordings: Sequence[Recording],
    settings: FitSettings,
    on_progress: OnProgress | None = None,
    joint_torque: JointTorque | None = None,
) -> FitResult:
    """Train an actuator net on recordings of one robot and report on the episodes that were held out.

    ``on_progress`` is called after every epoch; ``joint_torque`` is for ``settings.target = "joint_torque"``. FitError
    if recordings do not fit together, or there are too few. RecordingError if one has no channel that the inputs or the
    target need.
    """
    robot, joints, period = _common(recordings, settings)
    _refuse_copies(recordings, settings)
    parts = split(recordings, settings.holdout, settings.validation, settings.seed)
    episodes = tuple(r.meta.episode for r in recordings)
    rows = windows(
        recordings, settings.inputs, settings.history, period, settings.target, joint_torque, settings.smoothing
    )
    info = _describe(recordings, settings, parts, robot, joints, period)
    shares = _share_out(rows, parts, episodes, np.array(info.group_of))
    held_out = shares["held_out"]
    if len(held_out.rows) == 0:
        raise FitError("no rows to report on: the held-out episodes are shorter than the history, or actuators are off")
    trained = _train_groups("net", info.groups, shares, settings, settings.hidden, on_progress)
    net = _assemble(info, trained, shares["train"])
    torque = _predict(net, held_out)
    references = _references(info, shares, settings, on_progress)
    held_out_report = report(
        held_out.rows, torque, references, thresholds(rows, joints), episodes, parts, settings.target
    )
    # The net's file contains its held-out error, which is known only now.
    provenance = replace(info.provenance, held_out_rmse=rmse(torque - held_out.rows.y))
    net = replace(net, info=replace(info, provenance=provenance))
    torques = {"net": torque} | {r.name: r.torque for r in references if r.torque is not None}
    curves = {name: one.curve for name, one in zip(info.groups, trained, strict=True)}
    return FitResult(net, held_out_report, held_out.rows, episodes, torques, curves)


@dataclass(frozen=True, eq=False)
class _Share:
    """The rows of one part of the episodes, and for each row the index ``(R,)`` of the net of its joint."""

    rows: Rows
    group: np.ndarray

    def of_group(self, k: int) -> Rows:
        """Return the rows of the joints of net ``k``."""
        return self.rows.take(self.group == k)


def _share_out(rows: Rows, parts: Split, episodes: tuple[str, ...], group_index: np.ndarray) -> dict[str, _Share]:
    """Split rows by episode; ``group_index`` (J,) is the net of each joint."""
    shares = {}
    for part in ("train", "validation", "held_out"):
        picked = rows.take(np.isin(rows.episode, [episodes.index(name) for name in getattr(parts, part)]))
        shares[part] = _Share(picked, group_index[picked.joint])
    return shares


def _describe(
    recordings: Sequence[Recording],
    settings: FitSettings,
    parts: Split,
    robot: str,
    joints: tuple[str, ...],
    period: float,
) -> NetInfo:
    """Return the metadata of the net's file, with a held-out error of 0 until that is known."""
    kp, kd = _gains(recordings, settings)
    provenance = Provenance(
        recordings={r.meta.episode: fingerprint(r) for r in recordings},
        **asdict(parts),
        held_out_rmse=0.0,
        seed=settings.seed,
        settings=json.dumps(asdict(settings)),
        versions={"go1exp": __version__} | {name: version(name) for name in ("torch", "numpy")},
    )
    return NetInfo(
        robot=robot,
        joints=joints,
        share=settings.share,
        groups=group_names(joints, settings.share),
        inputs=settings.inputs,
        history=settings.history,
        period=period,
        hidden=settings.hidden,
        target=settings.target,
        kp=kp,
        kd=kd,
        provenance=provenance,
    )


def _train_groups(
    what: str,
    groups: tuple[str, ...],
    shares: Mapping[str, _Share],
    settings: FitSettings,
    hidden: tuple[int, ...],
    on_progress: OnProgress | None,
) -> list[Trained]:
    nets = []
    for k, group in enumerate(groups):
        on_epoch = None if on_progress is None else partial(on_progress, f"{what} {group}")
        nets.append(train(shares["train"].of_group(k), shares["validation"].of_group(k), settings, hidden, on_epoch))
    return nets


def _references(
    info: NetInfo, shares: Mapping[str, _Share], settings: FitSettings, on_progress: OnProgress | None
) -> list[Reference]:
    training, held_out = shares["train"], shares["held_out"]
    references = [*recorded(held_out.rows), linear(training.rows, training.group, held_out.rows, held_out.group)]
    if not settings.half_net:
        return [*references, Reference("half_net", None, "half_net is off")]
    hidden = tuple(max(1, width // 2) for width in settings.hidden)
    trained = _train_groups("half net", info.groups, shares, settings, hidden, on_progress)
    half = _assemble(replace(info, hidden=hidden), trained, training)
    return [*references, Reference("half_net", _predict(half, held_out))]


def _predict(net: ActuatorNet, share: _Share) -> np.ndarray:
    torque = np.empty(len(share.rows))
    for k in np.unique(share.group):
        torque[share.group == k] = net.torque(share.of_group(k).x, int(k))
    return torque


def _assemble(info: NetInfo, trained: list[Trained], training: _Share) -> ActuatorNet:
    """Put the groups' networks side by side; the ranges of the inputs are those of the training rows."""
    per_input = training.rows.x.reshape(len(training.rows), len(info.inputs), info.history)
    inputs = [per_input[training.group == k] for k in range(len(info.groups))]
    return ActuatorNet(
        info,
        tuple(np.stack(layer) for layer in zip(*(one.weights for one in trained), strict=True)),
        tuple(np.stack(layer) for layer in zip(*(one.biases for one in trained), strict=True)),
        skip=np.stack([one.skip for one in trained]),
        input_mean=np.stack([one.input_mean for one in trained]),
        input_std=np.stack([one.input_std for one in trained]),
        output_mean=np.array([one.output_mean for one in trained]),
        output_std=np.array([one.output_std for one in trained]),
        input_low=np.stack([values.min(axis=(0, 2)) for values in inputs]),
        input_high=np.stack([values.max(axis=(0, 2)) for values in inputs]),
    )


def _common(recordings: Sequence[Recording], settings: FitSettings) -> tuple[str, tuple[str, ...], float]:
    """Return robot, joints and tap period that all recordings share."""
    if not recordings:
        raise FitError("no recordings to fit to")
    first = recordings[0].meta
    for meta in (r.meta for r in recordings):
        for key in ("robot", "joints"):
            if getattr(meta, key) != getattr(first, key):
                raise FitError(
                    f"{meta.episode}: {key} is {getattr(meta, key)}, but {getattr(first, key)} in {first.episode}; "
                    "fit one robot at a time"
                )
    rates = {r.meta.episode: r.meta.rate_hz for r in recordings}
    slowest = min(rates, key=lambda name: rates[name])
    if settings.period is None:
        fastest = max(rates, key=lambda name: rates[name])
        if rates[fastest] * SLACK > rates[slowest]:
            raise FitError(
                f"period: set it; {slowest} was recorded at {rates[slowest]:g} Hz, "
                f"but {fastest} at {rates[fastest]:g} Hz"
            )
        return first.robot, first.joints, 1 / rates[slowest]
    if settings.period < SLACK / rates[slowest]:
        raise FitError(
            f"period = {settings.period:g} s: {slowest} was recorded every {1 / rates[slowest]:.4g} s; "
            "taps closer than that are not in the data"
        )
    return first.robot, first.joints, settings.period


def _refuse_copies(recordings: Sequence[Recording], settings: FitSettings) -> None:
    """Raise FitError if a torque to learn, or a target that the net reads, holds another quantity."""
    needed = {"tau_est"} if settings.target == "tau_est" else set[str]()
    needed |= {"q_target"} if "position_error" in settings.inputs else set()
    for recording in recordings:
        log = Log(recording)
        for flaw in copies(log):
            if log.quantity[flaw.channel] in needed:
                what = f"{recording.meta.episode}: {flaw.channel} {flaw.message}"
                raise FitError(f"{what}: a net would learn nothing of the actuator from it")


def _sets(recordings: Sequence[Recording]) -> str:
    """Return the sets of gains in words, each with its number of recordings, and how one is chosen."""
    counts = Counter((r.meta.kp, r.meta.kd) for r in recordings)
    pairs = {key: tuple(set(values) if values else set() for values in key) for key in counts}
    plain = {key: (*kp, *kd) for key, (kp, kd) in pairs.items() if len(kp) == len(kd) == 1}
    texts = [
        f"kp {plain[key][0]:g}, kd {plain[key][1]:g} ({n})" if key in plain else f"by joint or unknown ({n})"
        for key, n in counts.items()
    ]
    chosen = next(iter(plain.values()), None)
    hint = f"; choose one, as gains=[{chosen[0]:g},{chosen[1]:g}]" if chosen else ""
    return f"{', '.join(texts)}{hint}"


def _gains(
    recordings: Sequence[Recording], settings: FitSettings
) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Return the gains that all recordings share; None where they differ and the net does not use the target."""
    gains = []
    for key in ("kp", "kd"):
        values = {getattr(r.meta, key) for r in recordings}
        if len(values) > 1 and "position_error" in settings.inputs:
            raise FitError(
                f"{key} differs between the recordings, and a net of position errors holds for one set of gains: "
                f"{_sets(recordings)}"
            )
        gains.append(values.pop() if len(values) == 1 else None)
    return gains[0], gains[1]


# ---------------------------------------------------------------------- pictures of torque on held-out episodes

STRETCH = 1.0  # duration of a plot, s (chosen: a few strides, with fast transients still visible)

MEASURED, NET, REFERENCE = "0.35", COLOURS[1], COLOURS[0]


def plot(result: FitResult, folder: Path) -> list[Path]:
    """Draw one picture per joint, ``actuator_net_<joint>.png``, from the held-out rows; return the files.

    A picture shows the second with the largest error of the net, and that with the median error: measured torque, that
    of the net and of the best reference that is not a net, and below it the errors of both.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for j, joint in enumerate(result.net.info.joints):
        index = np.flatnonzero(result.rows.joint == j)
        if not len(index):
            continue
        rows = result.rows.take(index)
        torque = {name: values[index] for name, values in result.torque.items()}
        best = min(torque, key=lambda n: (n in ("net", "half_net"), rmse(torque[n] - rows.y)))
        figure = Figure(figsize=(12, 9), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, 1, gridspec_kw={"height_ratios": [3, 1, 3, 1]})
        for (what, which), pair in zip(_stretches(rows, torque["net"]), (axes[:2], axes[2:]), strict=False):
            episode = result.episodes[rows.episode[which[0]]]
            _stretch(pair, rows.take(which), torque["net"][which], torque[best][which], best)
            pair[0].set_title(f"{what} stretch: {episode}", loc="left", fontsize=11)
        errors = f"net {rmse(torque['net'] - rows.y):.4f}, {best} {rmse(torque[best] - rows.y):.4f}"
        figure.suptitle(f"{joint}: {result.report.target} on held-out episodes, RMSE in N m: {errors}")
        file = folder / f"actuator_net_{joint}.png"
        with replacing(file, keep_suffix=True) as partial:
            figure.savefig(partial, dpi=110)
        files.append(file)
    return files


def _stretches(rows: Rows, net: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Cut the rows into stretches of one second; return the worst and the median by the net's error."""
    pieces = []
    for index in np.unique(rows.episode):
        in_episode = np.flatnonzero(rows.episode == index)
        number = ((rows.t[in_episode] - rows.t[in_episode[0]]) / STRETCH).astype(int)
        pieces += [in_episode[number == n] for n in np.unique(number)]
    longest = max(len(piece) for piece in pieces)
    # The last piece of an episode may be short; its error says little.
    whole = [piece for piece in pieces if len(piece) > longest / 2]
    order = sorted(whole, key=lambda piece: rmse(net[piece] - rows.y[piece]))
    return [("worst", order[-1]), ("median", order[len(order) // 2])]


def _stretch(pair: list[Axes], rows: Rows, net: np.ndarray, reference: np.ndarray, name: str) -> None:
    above, below = pair
    # NaN breaks the line where rows are missing
    t = np.where(np.concatenate([[False], np.diff(rows.t) > 10 * np.median(np.diff(rows.t))]), np.nan, rows.t)
    above.plot(t, rows.y, color=MEASURED, lw=2.2, alpha=0.6, label="measured")
    above.plot(t, reference, color=REFERENCE, lw=1.0, label=f"{name}, {rmse(reference - rows.y):.4f}")
    above.plot(t, net, color=NET, lw=1.2, label=f"net, {rmse(net - rows.y):.4f}")
    above.set_ylabel("torque, N m")
    above.legend(ncols=3, loc="upper right", fontsize=9)
    below.axhline(0, color="0.7", lw=0.8)
    below.plot(t, reference - rows.y, color=REFERENCE, lw=0.8)
    below.plot(t, net - rows.y, color=NET, lw=0.8)
    below.set_ylabel("error, N m")
    below.set_xlabel("t, s")
    for axes in pair:
        axes.set_xlim(rows.t[0], rows.t[-1])
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    above.tick_params(labelbottom=False)
    above.margins(y=0.25)
