"""The net as an ONNX graph, built node by node: matrix product, sum, softsign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from go1exp.base.files import write_bytes

if TYPE_CHECKING:
    from onnx import NodeProto, TensorProto

OPSET = 20
IR_VERSION = 10
"""Version of the intermediate representation that belongs to this opset."""


def write_onnx(
    path: Path,
    weights: Sequence[np.ndarray],
    biases: Sequence[np.ndarray],
    skip: np.ndarray,
    about: Mapping[str, str],
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
    """Return the graph's nodes in order, and its constants."""
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
