"""Observation terms and policy as one graph: sensor readings in, joint targets out.

The terms in the graph are the functions of ``go1exp.mdp.observations``, traced by torch; so are the network, the
clipping of the actions and the targets. There is no second implementation that could differ.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor, nn

from go1exp import robot
from go1exp.base.tensors.rotation import projected_gravity
from go1exp.config.schema.history import frame_width, frames_of, width
from go1exp.config.schema.registry import Expected, Term
from go1exp.deploy.runtime.metadata import Block, Port
from go1exp.mdp.derived import joint_target, limited
from go1exp.mdp.types import Snapshot
from go1exp.sim.task import ActionConfig

if TYPE_CHECKING:
    from go1exp.train.network import GaussianPolicy

OPSET = 20
J = robot.NUM_JOINTS


class ExportError(Expected):
    """A part of a run that cannot be exported; the message names it."""


READINGS = (
    Port("joint_pos", J, "rad", "joint", "joint angles of the encoders"),
    Port("joint_vel", J, "rad/s", "joint", "joint velocities of the motors"),
    Port("imu_gyro", 3, "rad/s", "trunk", "angular velocity of the trunk"),
    Port("imu_quat", 4, "1", "trunk to world", "attitude of the trunk, unit quaternion w-x-y-z"),
    Port("base_lin_vel_b", 3, "m/s", "trunk", "velocity of the trunk's origin, from the state estimator"),
    Port("joint_torque", J, "N m", "joint", "torques reported by the motors"),
    Port("joint_target", J, "rad", "joint", "present position targets; the nominal stance at the start"),
    Port("command", 3, "m/s, m/s, rad/s", "trunk", "commanded velocity: x, y and yaw rate"),
    Port("previous_action", J, "1", "joint", "mean of the output `action` over the last training period; 0 at first"),
    Port("lowest_action", J, "1", "joint", "lowest output `action` of the last training period; 0 before the first"),
    Port("highest_action", J, "1", "joint", "highest output `action` of the last training period; 0 before the first"),
    Port("walked", 1, "s", "-", "time since walking began: a gait clock is a function of it"),
)
"""Inputs that the robot's computer can provide. A graph has those that its terms read, in this order."""

PAST = Port(
    "past", 0, "as each term", "-", "earlier frames of the terms with a history, a training period apart, newest first"
)
"""Input of a graph whose observation has a history, behind the others; before there is a past, the first frame."""

SOURCES = {
    **{name: name for name in ("base_lin_vel_b", "joint_pos", "joint_vel", "joint_torque", "joint_target", "command")},
    "base_ang_vel_b": "imu_gyro",
    "base_quat_w": "imu_quat",
    "projected_gravity_b": "imu_quat",
    "action": "previous_action",
    "episode_time": "walked",
}
"""Field of the Snapshot -> the reading that it is computed from. The robot does not measure the other fields."""

BOUNDING = ("lowest_action", "highest_action")
"""Readings that the change of an action is bounded from: no two actions of a training period differ by more."""

LAWS: dict[str, Callable[[Tensor], Tensor]] = {
    "projected_gravity_b": projected_gravity,
    "episode_time": lambda reading: reading.squeeze(-1),
}
"""Field -> its function of the reading, where it is not the reading itself."""

OUTPUTS = (
    Port("joint_target", J, "rad", "joint", "position targets for the motors"),
    Port("observation", 0, "as each term", "-", "input of the network: the concatenated terms"),
    Port("action", J, "1", "joint", "the network's output, limited; `previous_action` is its recent mean"),
)
"""Outputs of the graph; the observation's size is the policy's."""


def outputs(size: int) -> tuple[Port, ...]:
    """Return the outputs of a graph whose observation has ``size`` numbers."""
    return tuple(dataclasses.replace(port, size=port.size or size) for port in OUTPUTS)


class Sensed:
    """Stands in for a Snapshot, with only those fields that the robot measures.

    Attributes:
        read: names of the readings that were used.

    Raises:
        ExportError: where a term reads another field.
    """

    def __init__(self, readings: Mapping[str, Tensor], term: str) -> None:
        """Take readings (N, size) by name; ``term`` is named in errors."""
        self._readings, self._term = readings, term
        self.read: set[str] = set()

    def __getattr__(self, name: str) -> Tensor:
        """Return a field, computed from the readings."""
        if name not in {f.name for f in dataclasses.fields(Snapshot)}:
            raise AttributeError(f"a Snapshot has no {name!r}")
        source = SOURCES.get(name)
        if source is None:
            raise ExportError(
                f"observation.{self._term}: reads {name}, which the robot does not measure; a policy for the robot may "
                f"read {', '.join(SOURCES)}"
            )
        self.read.add(source)
        return LAWS[name](self._readings[source]) if name in LAWS else self._readings[source]


def blocks(terms: Sequence[Term]) -> tuple[Block, ...]:
    """Return the terms with their place in the flat observation."""
    placed, start = [], 0
    for term in terms:
        size, noise = width(term), float(term.slots.get("noise", 0.0))
        placed.append(Block(term.key, term.entry.name, start, size, noise, frames_of(term)))
        start += size
    return tuple(placed)


def required_inputs(terms: Sequence[Term], action: ActionConfig | None = None) -> tuple[Port, ...]:
    """Return the readings that the terms, and the bound of ``action``'s change, need, in the order of ``READINGS``.

    Raises:
        ExportError: if a term reads what the robot does not measure, or remembers the past.
    """
    read: set[str] = set() if action is None or action.max_step is None else {*BOUNDING}
    for term in terms:
        if term.entry.remembers:
            raise ExportError(
                f"observation.{term.key}: has a memory; observations on the robot must be functions of the present"
            )
        # Two rows of zeros: only which fields a term reads matters here.
        sensed = Sensed({port.name: torch.zeros(2, port.size) for port in READINGS}, term.key)
        term(cast(Snapshot, sensed))
        read |= sensed.read
    return tuple(port for port in READINGS if port.name in read)


class Observing(nn.Module):
    """Observation terms as a module.

    Attributes:
        inputs: readings that the terms need, and ``past`` if one has a history.
        size: of the flat observation.
    """

    def __init__(self, terms: Sequence[Term], action: ActionConfig | None = None) -> None:
        """Take terms and limits of actions; raise ExportError if a term reads what the robot does not measure."""
        super().__init__()
        self._terms = tuple(terms)
        self._earlier = [width(term) - frame_width(term) for term in terms]
        past = (dataclasses.replace(PAST, size=sum(self._earlier)),) if any(self._earlier) else ()
        self.inputs = (*required_inputs(terms, action), *past)
        self.size = sum(map(width, terms))

    def _named(self, readings: Sequence[Tensor]) -> dict[str, Tensor]:
        return dict(zip([port.name for port in self.inputs], readings, strict=True))

    def _flat(self, frames: Sequence[Tensor], given: Mapping[str, Tensor]) -> Tensor:
        """Return the observation (N, size) of the newest frames (N, ...) of all terms and those in ``given``'s past."""
        if any(self._earlier):
            earlier = given["past"].split(self._earlier, dim=-1)
            frames = [torch.cat(pair, dim=-1) for pair in zip(frames, earlier, strict=True)]
        return torch.cat(list(frames), dim=-1)


def computed(term: Term, given: Mapping[str, Tensor]) -> Tensor:
    """Return a term (N, size) of readings (N, ...) by name."""
    return cast(Tensor, term(cast(Snapshot, Sensed(given, term.key))))


class DeployedPolicy(Observing):
    """The graph as a torch module.

    Attributes:
        outputs: of ``forward``, in order.
    """

    nominal: Tensor

    def __init__(self, network: GaussianPolicy, terms: Sequence[Term], action: ActionConfig) -> None:
        """Join a trained network with the observation terms and the action settings of its task.

        Raises:
            ExportError: if a term reads what the robot does not measure.
        """
        super().__init__(terms, action)
        self.outputs, self._action = outputs(self.size), action
        self.actor, self.head = network.mlp_extractor.policy_net, network.action_net
        self.register_buffer("nominal", torch.as_tensor(robot.NOMINAL_STANCE, dtype=torch.float32))
        self.eval()

    def forward(self, *readings: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return joint targets (N, 12), observation (N, O) and action in force (N, 12) for readings (N, size)."""
        given = self._named(readings)
        observation = self._flat([computed(term, given) for term in self._terms], given)
        lowest, highest = (given.get(name, observation) for name in BOUNDING)  # none where no change is bounded
        action = limited(self.head(self.actor(observation)), lowest, *self._action.limits, highest)
        return joint_target(action, self.nominal, self._action.scale), observation, action


def to_onnx(module: DeployedPolicy) -> bytes:
    """Return the module as an ONNX model: float32, any number of rows, the same bytes for the same module.

    Raises:
        ExportError: if onnxscript is missing, or a term uses an operation that ONNX does not have; names the term.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  (what torch exports with)
    except ImportError as error:
        raise ExportError(f"export: needs {error.name}; pip install 'go1exp[export]'") from None
    try:
        model = exported(module, module.inputs, [port.name for port in module.outputs])
    except torch.onnx.errors.OnnxExporterError as error:
        raise ExportError(f"observation{_culprit(module)}: has no form in ONNX ({_reason(error)})") from None
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def exported(module: nn.Module, inputs: Sequence[Port], outputs: Sequence[str]) -> Any:
    """Export the module, and remove everything that depends on where and when it was exported."""
    example = tuple(torch.zeros(2, port.size) for port in inputs)
    # any number of rows: 1 on the robot, many in tests
    rows = torch.export.Dim("rows", min=1)
    with quiet(), torch.no_grad():
        program = torch.onnx.export(
            module,
            example,
            dynamo=True,
            opset_version=OPSET,
            input_names=[port.name for port in inputs],
            output_names=list(outputs),
            dynamic_shapes={"readings": tuple({0: rows} for _ in inputs)},
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    del model.metadata_props[:], model.graph.metadata_props[:]
    model.producer_name, model.producer_version, model.doc_string = "go1exp", "", ""
    model.graph.name, model.graph.doc_string = "policy", ""
    for part in (*model.graph.node, *model.graph.initializer, *model.graph.input, *model.graph.output):
        part.doc_string = ""
        del part.metadata_props[:]
    del model.graph.value_info[:]
    return model


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Suppress messages of torch's exporter: about torchvision, its own deprecated calls, and its progress."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


class _OneTerm(nn.Module):
    """One term alone, to find out whether it can be exported."""

    def __init__(self, term: Term, inputs: Sequence[Port]) -> None:
        super().__init__()
        self._term, self._names = term, [port.name for port in inputs]

    def forward(self, *readings: Tensor) -> Tensor:
        return computed(self._term, dict(zip(self._names, readings, strict=True)))


def _culprit(module: DeployedPolicy) -> str:
    """Return ``.key`` of the first term that cannot be exported alone, or nothing."""
    for term in module._terms:
        inputs = required_inputs([term])
        try:
            exported(_OneTerm(term, inputs), inputs, [term.key])
        except torch.onnx.errors.OnnxExporterError:
            return f".{term.key}"
    return ""


def _reason(error: Exception) -> str:
    """Return the first line of the innermost error."""
    inner: BaseException = error
    while inner.__cause__ is not None:
        inner = inner.__cause__
    return f"{type(inner).__name__}: {str(inner).strip().splitlines()[0] if str(inner).strip() else ''}"
