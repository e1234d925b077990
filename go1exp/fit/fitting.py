"""Recordings -> a trained actuator net and its report."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version

import numpy as np

from go1exp import __version__
from go1exp.fit.dataset import JointTorque, Rows, fingerprint, split, windows
from go1exp.fit.net import ActuatorNet, NetInfo, Provenance, group_names
from go1exp.fit.references import Reference, command, linear, pd
from go1exp.fit.regimes import thresholds
from go1exp.fit.report import Report, report, rmse
from go1exp.fit.settings import FitError, FitSettings
from go1exp.fit.train import Trained, train
from go1exp.recording import Recording

OnProgress = Callable[[str, int, int, float, float], None]
"""``on_progress(what, done, total, train, validation)``: ``net hip`` or ``half net hip``, epochs, RMSE in N m."""

SLACK = 0.9
"""Taps may lie this part of a sampling period apart: a nominal 500 Hz clock that runs at 498 Hz still takes 2 ms."""


@dataclass(frozen=True, eq=False)
class FitResult:
    """What a fit found.

    Attributes:
        net: the network.
        report: its errors, and the references', on the held-out episodes.
        rows: the held-out rows; ``rows.episode`` indexes ``episodes``.
        episodes: names of all episodes.
        torque: model -> torque at ``rows`` ``(R,)``, N m: ``net`` and the references that there are.
        curves: group -> (epochs, 2) root mean square errors of training and validation, N m.
    """

    net: ActuatorNet
    report: Report
    rows: Rows
    episodes: tuple[str, ...]
    torque: dict[str, np.ndarray]
    curves: dict[str, np.ndarray]


def fit(
    recordings: Sequence[Recording],
    settings: FitSettings,
    on_progress: OnProgress | None = None,
    joint_torque: JointTorque | None = None,
) -> FitResult:
    """Train an actuator net and report on the episodes that were held out.

    Args:
        recordings: of one robot, one episode each.
        settings: how.
        on_progress: told of every epoch.
        joint_torque: torque at the joints of a recording, for ``settings.target = "joint_torque"``.

    Raises:
        FitError: if recordings do not fit together, or there are too few.
        RecordingError: if one lacks a channel that the inputs or the target need.
    """
    robot, joints, period = _common(recordings, settings)
    kp, kd = _gains(recordings, settings)
    parts = split(recordings, settings.holdout, settings.validation, settings.seed)
    episodes = tuple(r.meta.episode for r in recordings)
    rows = windows(
        recordings, settings.inputs, settings.history, period, settings.target, joint_torque, settings.smoothing
    )
    picked = {
        part: rows.take(np.isin(rows.episode, [episodes.index(name) for name in getattr(parts, part)]))
        for part in ("train", "validation", "held_out")
    }
    groups = group_names(joints, settings.share)
    provenance = Provenance(
        recordings={r.meta.episode: fingerprint(r) for r in recordings},
        **asdict(parts),
        held_out_rmse=0.0,
        seed=settings.seed,
        settings=json.dumps(asdict(settings)),
        versions={"go1exp": __version__} | {name: version(name) for name in ("torch", "numpy")},
    )
    info = NetInfo(
        robot=robot,
        joints=joints,
        share=settings.share,
        groups=groups,
        inputs=settings.inputs,
        history=settings.history,
        period=period,
        hidden=settings.hidden,
        target=settings.target,
        kp=kp,
        kd=kd,
        provenance=provenance,
    )
    group_of = np.array(info.group_of)
    in_group = {part: group_of[rows.joint] for part, rows in picked.items()}
    if len(picked["held_out"]) == 0:
        raise FitError("no rows to report on: the held-out episodes are shorter than the history, or drives are off")

    def networks(what: str, hidden: tuple[int, ...]) -> list[Trained]:
        found = []
        for k, group in enumerate(groups):
            rows, check = (picked[part].take(in_group[part] == k) for part in ("train", "validation"))
            tell = None if on_progress is None else partial(on_progress, f"{what} {group}")
            found.append(train(rows, check, settings, hidden, tell))
        return found

    trained = networks("net", settings.hidden)
    held_out, group = picked["held_out"], in_group["held_out"]
    net = _assemble(info, trained, picked["train"], in_group["train"])
    torque = _predict(net, held_out, group)
    others = [
        command(held_out),
        pd(held_out),
        linear(picked["train"], in_group["train"], held_out, group),
        Reference("half_net", None, "half_net is off"),
    ]
    if settings.half_net:
        hidden = tuple(max(1, width // 2) for width in settings.hidden)
        half = _assemble(replace(info, hidden=hidden), networks("half net", hidden), picked["train"], in_group["train"])
        others[-1] = Reference("half_net", _predict(half, held_out, group))
    found = report(held_out, torque, others, thresholds(rows, joints), episodes, parts, settings.target)
    provenance = replace(provenance, held_out_rmse=rmse(torque - held_out.y))
    net = replace(net, info=replace(info, provenance=provenance))
    torques = {"net": torque} | {r.name: r.torque for r in others if r.torque is not None}
    curves = {name: one.curve for name, one in zip(groups, trained, strict=True)}
    return FitResult(net, found, held_out, episodes, torques, curves)


def _predict(net: ActuatorNet, rows: Rows, group: np.ndarray) -> np.ndarray:
    torque = np.empty(len(rows))
    for k in np.unique(group):
        torque[group == k] = net.torque(rows.x[group == k], int(k))
    return torque


def _assemble(info: NetInfo, trained: list[Trained], rows: Rows, group: np.ndarray) -> ActuatorNet:
    """Put the groups' networks side by side; the ranges of the inputs are those of the training rows."""
    per_input = rows.x.reshape(len(rows), len(info.inputs), info.history)
    seen = [per_input[group == k] for k in range(len(info.groups))]
    return ActuatorNet(
        info,
        tuple(np.stack(layer) for layer in zip(*(one.weights for one in trained), strict=True)),
        tuple(np.stack(layer) for layer in zip(*(one.biases for one in trained), strict=True)),
        skip=np.stack([one.skip for one in trained]),
        input_mean=np.stack([one.input_mean for one in trained]),
        input_std=np.stack([one.input_std for one in trained]),
        output_mean=np.array([one.output_mean for one in trained]),
        output_std=np.array([one.output_std for one in trained]),
        input_low=np.stack([values.min(axis=(0, 2)) for values in seen]),
        input_high=np.stack([values.max(axis=(0, 2)) for values in seen]),
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
    """Return the gains that all recordings share, None where they differ and the net does not see the target."""
    found = []
    for key in ("kp", "kd"):
        values = {getattr(r.meta, key) for r in recordings}
        if len(values) > 1 and "position_error" in settings.inputs:
            raise FitError(
                f"{key} differs between the recordings, and a net of position errors holds for one set of gains: "
                f"{_sets(recordings)}"
            )
        found.append(values.pop() if len(values) == 1 else None)
    return found[0], found[1]
