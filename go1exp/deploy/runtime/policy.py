"""The exported policy as a function of NumPy arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from go1exp.deploy.runtime.metadata import Port

if TYPE_CHECKING:
    from onnxruntime import NodeArg

# The published builds of onnxruntime send telemetry (its Privacy.md) unless this is set before they are loaded; 1.31
# writes an identifier and a database into the home folder for that. A value set by the user is kept.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


class OnnxPolicy:
    """Sensor readings in, joint targets out: one thread, the same numbers for the same readings.

    Attributes:
        inputs: names, sizes and meanings of the inputs, float32 (rows, size) each.
        outputs: the same of the outputs.
    """

    def __init__(self, model: bytes, inputs: Sequence[Port], outputs: Sequence[Port]) -> None:
        """Prepare the graph.

        Raises:
            ValueError: if it is not a valid graph, has other inputs and outputs, or onnxruntime is not installed.
        """
        try:  # here, since commands that run no bundle read the settings of those that do
            import onnxruntime as ort
        except ImportError as error:
            raise ValueError(f"needs the package onnxruntime ({error}): pip install 'go1exp[deploy]'") from None
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # errors are raised; no messages on stderr
        try:
            self._session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # of classes that onnxruntime does not export
            raise ValueError(f"not a graph that onnxruntime {ort.__version__} runs ({_first_line(error)})") from None
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)
        _compare("input", self._session.get_inputs(), self.inputs)
        _compare("output", self._session.get_outputs(), self.outputs)
        self._names = [port.name for port in self.outputs]
        # One row, as on the robot, uses buffers that are bound to the session in advance: a quarter faster.
        self._inputs_buffer = {port.name: np.zeros((1, port.size), np.float32) for port in self.inputs}
        self._outputs_buffer = {port.name: np.zeros((1, port.size), np.float32) for port in self.outputs}
        self._bound = self._session.io_binding()
        for name, values in self._inputs_buffer.items():
            self._bound.bind_input(name, "cpu", 0, np.float32, values.shape, values.ctypes.data)
        for name, values in self._outputs_buffer.items():
            self._bound.bind_output(name, "cpu", 0, np.float32, values.shape, values.ctypes.data)

    def __call__(self, readings: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the outputs (rows, size) by name for the inputs by name; other readings are ignored.

        Raises:
            ValueError: if one is missing or not float32 (rows, size).
        """
        given = {}
        for port in self.inputs:
            reading = readings.get(port.name)
            if reading is None:
                raise ValueError(f"{port.name}: missing")
            if reading.dtype != np.float32 or reading.ndim != 2 or reading.shape[1] != port.size:
                raise ValueError(
                    f"{port.name}: {reading.dtype} of shape {reading.shape}; must be float32 (rows, {port.size})"
                )
            given[port.name] = reading
        if all(len(reading) == 1 for reading in given.values()):
            for name, reading in given.items():
                self._inputs_buffer[name][:] = reading
            self._session.run_with_iobinding(self._bound)
            return {name: values.copy() for name, values in self._outputs_buffer.items()}
        return dict(zip(self._names, self._session.run(self._names, given), strict=True))


def _compare(what: str, nodes: Sequence[NodeArg], wanted: Sequence[Port]) -> None:
    names = [node.name for node in nodes]
    if names != [port.name for port in wanted]:
        raise ValueError(f"its {what}s are {', '.join(names)} instead of {', '.join(port.name for port in wanted)}")
    for node, port in zip(nodes, wanted, strict=True):
        if node.type != "tensor(float)" or list(node.shape[1:]) != [port.size]:
            raise ValueError(
                f"{what} {node.name}: {node.type} of shape {node.shape}; must be float (rows, {port.size})"
            )


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0]
