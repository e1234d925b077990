"""An actuator network as a file and as a function: recent history of one joint -> its torque.

The form is the paper's (section II-B.2; Margolis and Agrawal 2022, "Walk These Ways"): a window of joint history goes
through three hidden layers of 64 with softsign between them. Two published traps are closed by what the file says:
its sample ``period``, at which the window's taps were taken, and the gains in force while it was recorded.

Features of one row, input by input, newest first: with ``inputs = (position_error, velocity)`` and ``history = 3``
they are e(t), e(t-P), e(t-2P), qd(t), qd(t-P), qd(t-2P). The position error is **target minus angle**; the network
that Walk These Ways published takes angle minus target.

A file is a NumPy ``.npz`` of plain numbers and one JSON string; nothing in it is ever unpickled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass

from go1exp.base.errors import Unusable
from go1exp.base.files import opened, write_bytes
from go1exp.config.schema.registry import STRICT, Count, NonNegative, Positive, explain

if TYPE_CHECKING:
    from onnx import NodeProto, TensorProto


InputName = Literal["position_error", "velocity", "tau_cmd", "position"]
"""Inputs: target minus angle, rad; angular velocity, rad/s; commanded torque, N m; angle, rad."""

Share = Literal["all", "kind", "none"]
"""One net for all joints, one for each kind of joint (``FR_hip``: ``hip``), or one for each joint."""

Target = Literal["tau_est", "joint_torque"]
"""Training target: torque that the actuator reports, or torque at the joint from inverse dynamics."""

Name = Annotated[str, Field(min_length=1)]

MAGIC = "go1exp actuator net"


class NetFileError(Unusable):
    """A file that is no actuator net, or a damaged one; the message starts with the file."""


@checked_dataclass(frozen=True, config=STRICT)
class Provenance:
    """Where a net comes from.

    Attributes:
        recordings: episode -> SHA-256 of its content (``go1exp.gap.actuator_net.dataset.fingerprint``).
        train: episodes whose rows moved the weights.
        validation: episodes that decided when to stop.
        held_out: held-out episodes; ``held_out_rmse`` is theirs.
        held_out_rmse: root mean square error over their rows, N m.
        seed: of split, initial weights and minibatches.
        settings: the fit's other settings, as JSON text.
        versions: package -> version.
    """

    recordings: dict[str, str]
    train: tuple[str, ...]
    validation: tuple[str, ...]
    held_out: tuple[str, ...]
    held_out_rmse: NonNegative
    seed: int
    settings: str
    versions: dict[str, str]


@checked_dataclass(frozen=True, config=STRICT)
class NetInfo:
    """Description of a net. K is the number of nets in it, J that of joints.

    Attributes:
        robot: whose joints these are.
        joints: their names, J.
        share: how joints share nets.
        groups: names of the K nets: ``all``, kinds, or joints.
        inputs: names of the inputs, in the order of the features.
        history: taps of each input.
        period: time between taps, s; at another spacing the weights mean another actuator.
        hidden: widths of the hidden layers.
        target: its training target.
        kp: position gains in force during the recordings, N m/rad, one per joint; None where unknown.
        kd: velocity gains, N m s/rad.
        provenance: where it comes from.
        activation: between the layers.
        format: version of the file format.
    """

    robot: Name
    joints: Annotated[tuple[Name, ...], Field(min_length=1)]
    share: Share
    groups: Annotated[tuple[Name, ...], Field(min_length=1)]
    inputs: Annotated[tuple[InputName, ...], Field(min_length=1)]
    history: Count
    period: Positive
    hidden: Annotated[tuple[Count, ...], Field(min_length=1)]
    target: Target
    kp: tuple[NonNegative, ...] | None
    kd: tuple[NonNegative, ...] | None
    provenance: Provenance
    activation: Literal["softsign"] = "softsign"
    format: Literal[1] = 1

    @model_validator(mode="after")
    def _consistent(self) -> NetInfo:
        wrong = []
        if len(set(self.inputs)) != len(self.inputs):
            wrong.append(f"inputs: each only once, not {', '.join(self.inputs)}")
        if self.groups != group_names(self.joints, self.share):
            wrong.append(f"groups: share {self.share!r} gives {', '.join(group_names(self.joints, self.share))}")
        for key in ("kp", "kd"):
            values = getattr(self, key)
            if values is not None and len(values) != len(self.joints):
                wrong.append(f"{key}: has {len(values)} values for {len(self.joints)} joints")
        if wrong:
            raise ValueError("\n".join(wrong))
        return self

    @property
    def features(self) -> int:
        """Length F of a row."""
        return len(self.inputs) * self.history

    @property
    def group_of(self) -> tuple[int, ...]:
        """Index of each joint's net, J values."""
        return tuple(self.groups.index(group_name(joint, self.share)) for joint in self.joints)


_INFO = TypeAdapter(NetInfo)


def group_name(joint: str, share: Share) -> str:
    """Name the net that drives ``joint``."""
    return {"all": "all", "kind": joint.rpartition("_")[2], "none": joint}[share]


def group_names(joints: tuple[str, ...], share: Share) -> tuple[str, ...]:
    """Name the nets of all joints, each once, in the order of the joints."""
    return tuple(dict.fromkeys(group_name(joint, share) for joint in joints))


@dataclass(frozen=True, eq=False)
class ActuatorNet:
    """K networks of one shape.

    Net k maps a row x to a torque in N m::

        z = (x - input_mean[k]) / input_std[k]
        h = softsign(... softsign(z @ weights[0][k] + biases[0][k]) ...)
        tau = output_mean[k] + output_std[k] * (h @ weights[-1][k] + biases[-1][k] + z @ skip[k])

    Attributes:
        info: its description.
        weights: layer by layer ``(K, in, out)``; the last has out = 1.
        biases: layer by layer ``(K, out)``.
        skip: ``(K, F)`` linear map parallel to the layers, which learn its residual; zeros in the paper's form.
        input_mean: ``(K, F)``, in the inputs' units.
        input_std: ``(K, F)``, positive.
        output_mean: ``(K,)``, N m.
        output_std: ``(K,)``, N m, positive.
        input_low: ``(K, inputs)`` smallest value of each input in training; below it the net extrapolates.
        input_high: ``(K, inputs)`` largest value.

    All are float64. Raises ValueError if shapes do not fit or a number is not finite.
    """

    info: NetInfo
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    skip: np.ndarray
    input_mean: np.ndarray
    input_std: np.ndarray
    output_mean: np.ndarray
    output_std: np.ndarray
    input_low: np.ndarray
    input_high: np.ndarray

    def __post_init__(self) -> None:
        shapes = _shapes(self.info)
        if (len(self.weights), len(self.biases)) != (len(self.info.hidden) + 1,) * 2:
            raise ValueError(f"weights: {len(self.weights)} layers for {len(self.info.hidden)} hidden ones")
        for name, values in self.arrays().items():
            if values.dtype != np.float64 or values.shape != shapes[name]:
                raise ValueError(f"{name}: must be float64 {shapes[name]}, not {values.dtype} {values.shape}")
            if not np.isfinite(values).all():
                raise ValueError(f"{name}: must be finite")
            if name.endswith("_std") and not (values > 0).all():
                raise ValueError(f"{name}: must be positive")

    def arrays(self) -> dict[str, np.ndarray]:
        """Return every array under its name in the file."""
        layers = {f"weight_{i}": w for i, w in enumerate(self.weights)}
        layers |= {f"bias_{i}": b for i, b in enumerate(self.biases)}
        return layers | {name: getattr(self, name) for name in _PLAIN}

    @cached_property
    def folded(self) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...], np.ndarray]:
        """Weights, biases and skip ``(K, F, 1)`` of the same map without normalisation: x in raw units, tau in N m."""
        weights, biases = list(self.weights), list(self.biases)
        scale, shift = 1 / self.input_std, -self.input_mean / self.input_std
        biases[0] = biases[0] + np.einsum("kf,kfo->ko", shift, weights[0])
        weights[0] = weights[0] * scale[:, :, None]
        gain = self.output_std[:, None]
        offset = np.einsum("kf,kf->k", shift, self.skip)[:, None]
        biases[-1] = gain * (biases[-1] + offset) + self.output_mean[:, None]
        weights[-1] = weights[-1] * gain[:, :, None]
        return tuple(weights), tuple(biases), (gain * scale * self.skip)[:, :, None]

    def torque(self, rows: np.ndarray, group: int = 0) -> np.ndarray:
        """Return the torques ``(R,)``, N m, of net ``group`` for ``rows`` (R, F), in float64."""
        z = (rows - self.input_mean[group]) / self.input_std[group]
        h = z
        for w, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            h = h @ w[group] + b[group]
            h = h / (1 + np.abs(h))
        out = (h @ self.weights[-1][group] + self.biases[-1][group])[:, 0] + z @ self.skip[group]
        return np.asarray(self.output_mean[group] + self.output_std[group] * out)

    def save(self, path: Path) -> None:
        """Write the net, whole or not at all; ``path`` should end in ``.npz``."""
        path = Path(path)
        header = f'{{"{MAGIC}": {_INFO.dump_json(self.info).decode()}}}'
        path.parent.mkdir(parents=True, exist_ok=True)
        with opened(path) as file:
            np.savez(file, allow_pickle=False, header=np.array(header), **self.arrays())

    def export_onnx(self, path: Path) -> None:
        """Write an ONNX model, ``features`` -> ``torque``, one file, opset 20.

        Features (R, F) to torque (R,) of a single net; (K, R, F) to (K, R) of several.
        """
        info = self.info
        about = {
            "robot": info.robot,
            "joints": ",".join(info.joints),
            "groups": ",".join(info.groups),
            "inputs": ",".join(info.inputs),
            "history": str(info.history),
            "period_s": repr(info.period),
            "position_error": "target minus angle",
        }
        write_onnx(Path(path), *self.folded, about)


_PLAIN = ("skip", "input_mean", "input_std", "output_mean", "output_std", "input_low", "input_high")


def _shapes(info: NetInfo) -> dict[str, tuple[int, ...]]:
    k, f, n = len(info.groups), info.features, len(info.inputs)
    widths = (f, *info.hidden, 1)
    shapes: dict[str, tuple[int, ...]] = {}
    for i in range(len(widths) - 1):
        shapes[f"weight_{i}"] = (k, widths[i], widths[i + 1])
        shapes[f"bias_{i}"] = (k, widths[i + 1])
    shapes |= {"skip": (k, f), "input_mean": (k, f), "input_std": (k, f), "output_mean": (k,), "output_std": (k,)}
    return shapes | {"input_low": (k, n), "input_high": (k, n)}


def load(path: Path) -> ActuatorNet:
    """Read a net that ``ActuatorNet.save`` wrote.

    Raises:
        NetFileError: if the file is missing, damaged, foreign, of another version, or inconsistent.
    """
    path = Path(path)
    if not path.is_file():
        raise NetFileError(f"{path}: no such file")
    try:
        with path.open("rb") as file:
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("no .npz archive")
            arrays = {name: np.asarray(archive[name]) for name in archive.files}
    except Exception as error:  # a flipped bit makes the zip and header parsers raise a dozen types, IndexError too
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        reason = "no zip archive of plain arrays" if "pickle" in reason else reason  # NumPy advises to unpickle it
        raise NetFileError(f"{path}: not an actuator net, or a damaged one ({reason})") from error
    info = _read_info(path, arrays.pop("header", np.array(0)))
    expected = _shapes(info)
    if set(arrays) != set(expected):
        missing, extra = sorted(set(expected) - set(arrays)), sorted(set(arrays) - set(expected))
        raise NetFileError(
            f"{path}: arrays missing: {', '.join(missing) or 'none'}; unknown: {', '.join(extra) or 'none'}"
        )
    layers = range(len(info.hidden) + 1)
    try:
        return ActuatorNet(
            info,
            tuple(arrays[f"weight_{i}"] for i in layers),
            tuple(arrays[f"bias_{i}"] for i in layers),
            **{name: arrays[name] for name in _PLAIN},
        )
    except ValueError as error:
        raise NetFileError(f"{path}: {error}") from error


def _read_info(path: Path, header: np.ndarray) -> NetInfo:
    text = str(header) if header.dtype.kind == "U" and header.shape == () else ""
    start = f'{{"{MAGIC}": '
    if not text.startswith(start) or not text.endswith("}"):
        raise NetFileError(f"{path}: not an actuator net (no header {MAGIC!r})")
    try:
        return _INFO.validate_json(text.removeprefix(start)[:-1])
    except ValidationError as error:
        lines = explain(error, "header", NetInfo.__dataclass_fields__)
        raise NetFileError("\n".join(f"{path}: {line}" for line in lines)) from error


OPSET = 20
IR_VERSION = 10
"""Version of the intermediate representation that belongs to this opset."""


def write_onnx(
    path: Path, weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], skip: np.ndarray, about: Mapping[str, str]
) -> None:
    """Write ``features`` -> ``torque``: float32 (R, F) -> (R,) for one net, (K, R, F) -> (K, R) for several.

    The graph is batched over K, so all nets run in one call.

    Args:
        path: file to write.
        weights: layer by layer (K, in, out), normalisation folded in.
        biases: layer by layer (K, out).
        skip: linear map added to the output, (K, F, 1); left out if it is zero.
        about: metadata of the model: what a program must know to compute its inputs.
    """
    import onnx
    from onnx import TensorProto, helper

    nets, features, _ = skip.shape
    leading: list[int | str] = ["rows"] if nets == 1 else [nets, "rows"]
    nodes, constants = _layers(weights, biases, skip)
    graph = helper.make_graph(
        nodes,
        "actuator_net",
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, [*leading, features])],
        [helper.make_tensor_value_info("torque", TensorProto.FLOAT, leading)],
        constants,
    )
    model = helper.make_model(
        graph, producer_name="go1exp", opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    helper.set_model_props(model, dict(about))
    onnx.checker.check_model(model, full_check=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, model.SerializeToString())


def _layers(
    weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], skip: np.ndarray
) -> tuple[list[NodeProto], list[TensorProto]]:
    from onnx import helper, numpy_helper

    single = skip.shape[0] == 1
    nodes: list[NodeProto] = []
    constants: list[TensorProto] = []

    def constant(name: str, values: np.ndarray) -> str:
        constants.append(numpy_helper.from_array(np.ascontiguousarray(values, dtype=np.float32), name))
        return name

    def node(op: str, inputs: list[str], output: str) -> str:
        nodes.append(helper.make_node(op, inputs, [output], name=output))
        return output

    value = "features"
    for i, (w, b) in enumerate(zip(weights, biases, strict=True)):
        w, b = (w[0], b[0]) if single else (w, b[:, None, :])  # (in, out), (out,) or (K, in, out), (K, 1, out)
        value = node("MatMul", [value, constant(f"weight_{i}", w)], f"product_{i}")
        value = node("Add", [value, constant(f"bias_{i}", b)], f"sum_{i}")
        if i < len(weights) - 1:
            value = node("Softsign", [value], f"layer_{i}")
    if skip.any():
        linear = node("MatMul", ["features", constant("skip", skip[0] if single else skip)], "linear")
        value = node("Add", [value, linear], "sum")
    constants.append(numpy_helper.from_array(np.array([-1], dtype=np.int64), "last_axis"))
    node("Squeeze", [value, "last_axis"], "torque")
    return nodes, constants
