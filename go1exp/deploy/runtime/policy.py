"""The exported policy as a function of NumPy arrays, and the memory of its previous action and earlier frames.

A policy has learnt the effect of an action over one training period. At another rate it must get the action of one
training period ago, not that of the last cycle (``docs/deploy.md`` has the measurement); the same holds for frames.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from go1exp.config.schema.history import columns_of
from go1exp.deploy.runtime.metadata import Metadata, Port

if TYPE_CHECKING:
    from onnxruntime import NodeArg

# The published builds of onnxruntime send telemetry (its Privacy.md) unless this is set before they are loaded; 1.31
# writes an identifier and a database into the home folder for that. A value set by the user is kept.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


class OnnxPolicy:
    """The exported graph in onnxruntime: one thread, deterministic.

    Attributes:
        inputs: of the graph, float32 (rows, size) each.
        outputs: of the graph.
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
            reason = str(error).strip().partition("\n")[0]
            raise ValueError(f"not a graph that onnxruntime {ort.__version__} runs ({reason})") from None
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


A = TypeVar("A", bound=Any)  # an array of NumPy or torch


class Past(Generic[A]):
    """Newest values, of one training period of a policy that may run faster than it was trained.

    Args:
        trained: period of the policy in training, s.
        period: present period of the policy, s.

    Attributes:
        cycles: policy cycles in one training period, at least 1.
    """

    def __init__(self, trained: float, period: float) -> None:
        self.cycles = max(1, round(trained / period))
        self._kept: deque[A] = deque(maxlen=self.cycles)

    def add(self, newest: A) -> None:
        """Add the value of a cycle."""
        self._kept.append(newest)

    def earlier(self, before: A) -> A:
        """Return the value of one training period before the next cycle, ``before`` if there is none."""
        return before if len(self._kept) < self.cycles else self._kept[0]

    def extreme(self, rule: Callable[[A, A], A], before: A) -> A:
        """Return the lowest or highest value of the last training period; ``before`` counts until there is a whole one.

        ``rule`` takes two values, as ``np.minimum`` and ``torch.maximum`` do.
        """
        return reduce(rule, self._kept, before) if len(self._kept) < self.cycles else reduce(rule, self._kept)

    def mean(self) -> A:
        """Return the mean over the last training period, with 0 before the first value.

        Of actions: that of one training period ago would let the cycles between two of them go separate ways.
        """
        return sum(self._kept) / self.cycles


REMEMBERED = ("previous_action", "lowest_action", "highest_action", "past")


class PolicyMemory:
    """Runs a policy and keeps those of its inputs that are of earlier cycles (``REMEMBERED``) for the next one.

    Attributes:
        values: those of these inputs that the policy has, by name, float32 (rows, size).
    """

    def __init__(self, about: Metadata, period: float, rows: int = 1) -> None:
        """Start an episode of ``rows`` robots; ``period`` is the present one of the policy, s."""
        sizes = {port.name: port.size for port in about.inputs}
        self.values: dict[str, np.ndarray] = {
            name: np.zeros((rows, sizes[name]), np.float32) for name in REMEMBERED if name in sizes
        }
        self._columns = columns_of((block.size // block.history, block.history) for block in about.observation)
        self._actions = Past[np.ndarray](about.policy_dt, period)
        self._frames = Past[np.ndarray](about.policy_dt, period)
        self._first: np.ndarray | None = None

    def __call__(
        self, policy: Callable[[Mapping[str, np.ndarray]], dict[str, np.ndarray]], readings: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return the policy's outputs for the readings, to which the remembered inputs are added in place."""
        readings |= self.values
        if "past" in self.values and self._first is None:  # the first frame stands for those before it
            self._first = policy(readings)["observation"][:, self._columns.newest]
            readings["past"] = self.values["past"] = self._first
        outputs = policy(readings)
        self._actions.add(outputs["action"])
        if "previous_action" in self.values:
            self.values["previous_action"] = self._actions.mean()
        if "lowest_action" in self.values:
            nothing = np.zeros_like(outputs["action"])
            self.values["lowest_action"] = self._actions.extreme(np.minimum, nothing)
            self.values["highest_action"] = self._actions.extreme(np.maximum, nothing)
        if self._first is not None:
            self._frames.add(outputs["observation"][:, self._columns.carried])
            self.values["past"] = self._frames.earlier(self._first)
        return outputs
