"""The ONNX graph of a foreign policy: its network, read from a file, and the bundle's graph around it."""

from __future__ import annotations

import hashlib
import io
import warnings
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from go1exp import robot
from go1exp.deploy.export.foreign import Back, Front
from go1exp.deploy.export.graph import OPSET, OUTPUTS, ExportError, exported, quiet
from go1exp.deploy.runtime.metadata import Port


class Network:
    """A foreign network in onnxruntime: (N, size) -> (N, 12).

    Attributes:
        model: its graph, with a free number of rows.
        props: metadata of the file.
        sha256: of the file.
    """

    def __init__(self, file: Path, size: int | None) -> None:
        """Read a file; ``size`` is that of its input where the file does not say it.

        Raises:
            ExportError: if it is not the graph of one observation and one action, or remembers.
        """
        import onnx

        data = file.read_bytes()
        self.sha256 = hashlib.sha256(data).hexdigest()
        if data[:2] == b"PK":
            self.model = _converted(file, size)
        else:
            try:
                self.model = onnx.load(str(file))
                onnx.checker.check_model(self.model)
            except Exception as error:  # protobuf's, the checker's and the file system's errors have no common class
                reason = str(error).strip().partition("\n")[0]
                raise ExportError(f"{file}: neither ONNX nor TorchScript ({reason})") from None
        self.props = {p.key: p.value for p in self.model.metadata_props}
        stored = {i.name for i in self.model.graph.initializer}
        inputs = [i for i in self.model.graph.input if i.name not in stored]
        if len(inputs) != 1:
            names = ", ".join(i.name for i in inputs)
            raise ExportError(f"{file}: has the inputs {names}; one observation is needed, and no recurrent state")
        outputs = {o.name: o for o in self.model.graph.output}
        output = next((outputs[n] for n in ("actions", "action") if n in outputs), self.model.graph.output[0])
        self.input, self.output = inputs[0].name, output.name
        for what, value in (("input", inputs[0]), ("output", output)):
            given, rank = value.type.tensor_type, len(value.type.tensor_type.shape.dim)
            if given.elem_type != onnx.TensorProto.FLOAT or (given.HasField("shape") and rank != 2):
                held = onnx.TensorProto.DataType.Name(given.elem_type).lower()
                raise ExportError(
                    f"{file}: {what} {value.name} is {held}, {rank}-D; must be float32, 2-D (rows, numbers)"
                )
        shape = inputs[0].type.tensor_type.shape.dim
        self.size = int(shape[-1].dim_value) if shape and shape[-1].dim_value else None
        for value in (inputs[0], *outputs.values()):
            if value.type.tensor_type.shape.dim:
                value.type.tensor_type.shape.dim[0].dim_param = "rows"
        del self.model.graph.value_info[:]
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = 1, 4
        self._session = ort.InferenceSession(self.model.SerializeToString(), options, ["CPUExecutionProvider"])
        self._check(file, self.size or size)

    def _check(self, file: Path, size: int | None) -> None:
        if size is None:
            return
        probe = np.random.default_rng(0).normal(size=(3, size)).astype(np.float32)
        try:
            rows, each = self(probe), np.concatenate([self(probe[k : k + 1]) for k in range(3)])
        except Exception as error:  # of classes that onnxruntime does not export
            reason = str(error).strip().partition("\n")[0]
            raise ExportError(f"{file}: does not take rows of {size} numbers ({reason}); export dynamic rows") from None
        if rows.shape != (3, robot.NUM_JOINTS):
            raise ExportError(f"{file}: output {self.output} has {rows.shape[-1]} numbers; 12 actions are needed")
        if not np.allclose(rows, each, rtol=1e-4, atol=1e-4) or not np.array_equal(each, each):
            raise ExportError(f"{file}: rows act on one another, or it is not a function of its input")

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return raw actions for rows of the network's input, float32."""
        return cast(np.ndarray, self._session.run([self.output], {self.input: observation})[0])


def _converted(file: Path, size: int | None) -> Any:
    """Return the ONNX graph of a TorchScript file."""
    import onnx

    try:
        script = torch.jit.load(str(file), map_location="cpu").eval()
    except RuntimeError:
        raise ExportError(
            f"{file}: not TorchScript; a checkpoint of weights has no network: export policy.pt or policy.onnx first"
        ) from None
    if any(getattr(m, "original_name", "") in ("LSTM", "GRU", "RNN", "LSTMCell", "GRUCell") for m in script.modules()):
        raise ExportError(f"{file}: remembers (a recurrent layer): recurrent policies are not imported")
    if size is None:
        raise ExportError(f"{file}: TorchScript does not say the size of its input; give spec=")
    probe, made = torch.linspace(-1, 1, 2 * size).reshape(2, size), io.BytesIO()
    try:
        with torch.no_grad(), quiet(), warnings.catch_warnings():
            wanted = script(probe)
            if not isinstance(wanted, torch.Tensor):
                raise ExportError(f"{file}: returns a {type(wanted).__name__}; one tensor of 12 actions is needed")
            if not torch.equal(wanted, script(probe)):
                raise ExportError(f"{file}: gives other actions the second time: recurrent policies are not imported")
            rows = {"obs": {0: "rows"}, "actions": {0: "rows"}}
            torch.onnx.export(
                script, (probe,), cast(Any, made), dynamo=False, opset_version=17, input_names=["obs"],
                output_names=["actions"], dynamic_axes=rows,
            )  # fmt: skip
    except ExportError:
        raise
    except Exception as error:  # torch raises whatever the user's code and its converter do, the cause last
        reason = str(error).strip().rpartition("\n")[2]
        raise ExportError(
            f"{file}: TorchScript that does not take {size} numbers or has no form in ONNX ({reason})"
        ) from None
    return onnx.load_from_string(made.getvalue())


def compose_graph(front: Front, back: Back, network: Network) -> bytes:
    """Return the bundle's graph: front, network and back in one.

    Raises:
        ExportError: if the network's operators cannot be brought to this version of ONNX.
    """
    import onnx
    from onnx import compose as join
    from onnx import version_converter

    head = exported(front, front.inputs, ["observation", "network_input"])
    tail = exported(back, (Port("raw", robot.NUM_JOINTS, "1", "joint", ""),), ["joint_target", "action"])
    try:
        middle = version_converter.convert_version(network.model, OPSET)
    except Exception as error:  # the converter's are C++ exceptions without a class
        raise ExportError(f"its operators cannot be converted to opset {OPSET} ({error})") from None
    del middle.metadata_props[:]
    middle.ir_version = tail.ir_version = head.ir_version
    middle, tail = join.add_prefix(middle, "network_"), join.add_prefix(tail, "back_")
    first = join.merge_models(head, middle, io_map=[("network_input", f"network_{network.input}")])
    whole = join.merge_models(first, tail, io_map=[(f"network_{network.output}", "back_raw")])
    names = {"back_joint_target": "joint_target", "back_action": "action", "observation": "observation"}
    for node in whole.graph.node:
        node.output[:] = [names.get(name, name) for name in node.output]
        node.input[:] = [names.get(name, name) for name in node.input]
    for value in whole.graph.output:
        value.name = names.get(value.name, value.name)
    by_name = {value.name: value for value in whole.graph.output}
    del whole.graph.output[:], whole.graph.value_info[:], whole.metadata_props[:]
    whole.graph.output.extend(by_name[port.name] for port in OUTPUTS)
    whole.producer_name, whole.graph.name = "go1exp", "policy"
    onnx.checker.check_model(whole, full_check=True)
    return bytes(whole.SerializeToString())
