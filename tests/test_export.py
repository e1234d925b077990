"""Bundles: torch, ONNX and the environment agree; the same run gives the same bytes; tampering is refused by name."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import io
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import onnx
import pytest
import torch
from gymnasium.spaces import Box
from onnx import numpy_helper
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from go1exp import cli, robot
from go1exp.base.paths import data_root
from go1exp.config.compose import compose
from go1exp.config.schema.history import history_columns, width
from go1exp.config.schema.registry import Entry, Term
from go1exp.deploy.export import graph
from go1exp.deploy.export.build import build, command_ranges, gains, readings
from go1exp.deploy.export.graph import DeployedPolicy, ExportError, required_inputs, to_onnx
from go1exp.deploy.runtime import bundle
from go1exp.deploy.runtime.bundle import MEMBERS, Bundle, BundleError, as_json, loads, pack, seal, stored
from go1exp.deploy.runtime.controller import Controller, Stages
from go1exp.deploy.runtime.metadata import Metadata
from go1exp.deploy.runtime.policy import OnnxPolicy
from go1exp.deploy.runtime.safety import Safety
from go1exp.mdp.types import Snapshot
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import ActionConfig, TaskConfig, parse_task, parse_train
from go1exp.train import run_folder
from go1exp.train.policy import load_policy
from go1exp.train.ppo import GaussianPolicy
from tests.command import run_alone
from tests.made import FakeLink, low_state
from tests.small_run import trained

OBSERVATIONS = sorted(p.stem for p in (data_root() / "conf/observation").glob("*.yaml"))
ROWS = 250


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two tiny iterations, with settings that are not the usual ones."""
    changes = ("action.scale=0.3", "actuator.kp=[25,30,35]", "actuator.kd=0.7")
    return trained(tmp_path_factory.mktemp("export") / "run", *changes)


@pytest.fixture(scope="module")
def data(run: Path) -> bytes:
    return build(run, seconds=1.0)


@pytest.fixture(scope="module")
def good(data: bytes) -> Bundle:
    return loads(data, "good.zip")


@pytest.fixture(scope="module")
def members(data: bytes) -> dict[str, bytes]:
    """The content of the bundle without its manifest, in order."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in MEMBERS}


@pytest.fixture(scope="module")
def manifest(data: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return archive.read("manifest.json")


# ---------------------------------------------------------------------- torch, ONNX and the environment


def network(observations: int, seed: int = 0) -> GaussianPolicy:
    torch.manual_seed(seed)
    made = GaussianPolicy(
        Box(-np.inf, np.inf, (observations,), np.float32),
        Box(-1.0, 1.0, (12,), np.float32),
        lambda _: 0.0,
        net_arch={"pi": [64, 32], "vf": [8]},
    )
    cast(nn.Linear, made.action_net).weight.data.mul_(100.0)  # SB3 begins with hardly any action
    made.set_training_mode(False)
    return made


def scattered(core: Go1Core) -> Tensor:
    """Put every robot into a random state; return the environment's own observation of it."""
    rng, n = np.random.default_rng(0), core.num_envs
    core.reset()
    qpos, qvel = core.backend.qpos.clone(), core.backend.qvel.clone()
    qpos[:, 3:7] = torch.tensor(Rotation.random(n, rng=rng).as_quat(scalar_first=True))
    low, high = robot.JOINT_POS_LIMITS.T
    qpos[:, 7:] = torch.tensor(rng.uniform(low, high, (n, 12)))
    qvel.copy_(torch.tensor(rng.normal(size=qvel.shape) * ([2.0] * 6 + [15.0] * 12)))
    core.backend.reset(torch.ones(n, dtype=torch.bool), qpos, qvel)
    core.command.value.copy_(torch.tensor(rng.uniform(-2, 3, (n, 3))))
    core.action.copy_(torch.tensor(rng.normal(size=(n, 12)) * 4))
    return core.terms.frames.begun(*core._frame(core.snapshot()), torch.ones(n, dtype=torch.bool))


@pytest.mark.parametrize(
    ("choice", "max_step"), [*((choice, "null") for choice in OBSERVATIONS), (OBSERVATIONS[0], "0.1")]
)
def test_torch_onnx_and_the_environment_agree(choice: str, max_step: str, make_task: Callable[..., TaskConfig]) -> None:
    task = make_task("backend.threads=1", f"observation={choice}", "action.clip=2.0", f"action.max_step={max_step}")
    policy = network(sum(width(t) for t in task.observation))
    module = DeployedPolicy(policy, task.observation, task.action)
    session = OnnxPolicy(to_onnx(module), module.inputs, module.outputs)
    sensing = parse_task(compose("train", ["backend.threads=1", "effect=[encoder_offset,base_tilt]"])).effect
    for effects in ((), sensing):
        core = Go1Core(dataclasses.replace(task, effect=effects), ROWS, noise=False)
        observed = scattered(core)
        past = torch.randn(ROWS, len(history_columns(task.observation).earlier))
        observed[:, history_columns(task.observation).earlier] = past
        given = {**readings(core), "past": past}
        named = {port.name: given[port.name] for port in module.inputs}
        by_onnx = session({name: values.numpy() for name, values in named.items()})
        by_torch = dict(zip(by_onnx, module(*named.values()), strict=True))
        wanted = policy._predict(observed, deterministic=True).detach()
        core.step(wanted)
        action = wanted.clamp(-2.0, 2.0)
        if task.action.max_step is not None:
            step, before = task.action.max_step / task.action.scale, given["lowest_action"]
            action = torch.minimum(torch.maximum(action, before - step), before + step)
        target = torch.as_tensor(robot.NOMINAL_STANCE, dtype=torch.float32) + task.action.scale * action
        expected = {"joint_target": target, "observation": observed, "action": action}
        kept = core.steps > 0  # the others have fallen, and stand again
        assert kept.any()
        torch.testing.assert_close(core.target[kept], target[kept], rtol=0, atol=1e-6)
        for name, values in expected.items():
            assert by_onnx[name].shape == values.shape == (ROWS, values.shape[1])
            np.testing.assert_allclose(by_torch[name].detach(), values, rtol=0, atol=1e-5, err_msg=name)
            np.testing.assert_allclose(by_onnx[name], values, rtol=0, atol=1e-5, err_msg=name)
        assert (action.abs() == 2.0).any()  # or the cut was not tried
        if task.action.max_step is not None:  # lowest and highest differ between two training periods
            named["highest_action"] = named["lowest_action"] + 0.5 * step
            wanted = wanted.clamp(-2.0, 2.0)
            action = torch.minimum(torch.maximum(wanted, before - 0.5 * step), before + step)
            found = session({name: values.numpy() for name, values in named.items()})["action"]
            np.testing.assert_allclose(found, action, rtol=0, atol=1e-5)
        if effects:
            assert (given["joint_pos"] - core.snapshot().joint_pos).abs().max() > 1e-3


def test_the_trace_is_the_environments(run: Path, good: Bundle) -> None:
    """Played again from outside, with evaluation's policy and the environment's own observations."""
    config = parse_train(run_folder.read_config(run))
    policy, _ = load_policy(run, config)
    sim = dataclasses.replace(config.task.sim, spread_starts=False)
    core = Go1Core(dataclasses.replace(config.task, sim=sim), 1, 0, noise=False)
    observation, recorded = core.reset(), []
    for _ in range(50):
        observed = observation.clone()
        result = core.step(policy(observation))
        if not result.terminated:
            recorded.append((observed, core.target.clone(), core.action.clone()))
        observation = result.observation
    for k, name in enumerate(("observation", "joint_target", "action")):
        assert good.trace[f"output.{name}"].tobytes() == torch.cat([row[k] for row in recorded]).numpy().tobytes()
    fed, made = good.trace["input.previous_action"], good.trace["output.action"]
    follows = np.isclose(np.diff(good.trace["time"]), 0.02) & (fed[1:] != 0).any(axis=1)
    assert follows.sum() > 10
    assert (fed[1:] == made[:-1])[follows].all()
    assert max(good.differences.values()) < bundle.TOLERANCE


def test_a_bundle_says_what_its_run_was(run: Path, good: Bundle) -> None:
    about = good.metadata
    assert good.config == run_folder.read_as_written(run)
    assert good.versions["run"] == json.loads((run / "meta.json").read_text())
    assert good.versions["packages"]["torch"] == importlib.metadata.version("torch")
    assert about.joints == robot.JOINTS
    assert about.kp == (25.0, 30.0, 35.0) * 4
    assert about.kd == (0.7,) * 12
    assert about.action_scale == 0.3
    sim = good.config["sim"]
    assert (about.policy_dt, about.physics_dt) == (sim["policy_dt"], sim["physics_dt"])
    assert about.command_ranges == {"lin_vel_x": (-2.0, 3.0), "lin_vel_y": (-1.5, 1.5), "ang_vel_z": (-1.5, 1.5)}
    assert about.torque_limit == (23.7, 23.7, 35.55) * 4
    assert about.trained.checkpoint == "000002.pt"
    assert about.trained.sha256 == seal((run / "checkpoints/000002.pt").read_bytes())
    assert about.trained.num_timesteps == 32
    assert [(b.key, b.start, b.size) for b in about.observation][2:5] == [
        ("projected_gravity", 6, 3),
        ("velocity_command", 9, 3),
        ("joint_position", 12, 12),
    ]
    assert Metadata.from_dict(json.loads(as_json(about.as_dict()))) == about


def test_the_same_run_gives_the_same_bytes(run: Path, data: bytes) -> None:
    assert build(run, seconds=1.0) == data


def test_another_seed_gives_another_trace_of_the_same_policy(
    run: Path, members: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("go1exp.deploy.export.build.to_onnx", lambda module: members["policy.onnx"])
    built = build(run, seconds=0.5, seed=1)
    other = loads(built, "other.zip")
    with zipfile.ZipFile(io.BytesIO(built)) as archive:
        assert [name for name in MEMBERS if archive.read(name) != members[name]] == ["trace.npz"]
    assert len(other.trace["time"]) <= 25


def test_no_path_of_this_machine_is_in_the_graph(members: dict[str, bytes]) -> None:
    for path in (str(data_root()), sys.prefix, ".py"):
        assert path.encode() not in members[bundle.POLICY]


# ---------------------------------------------------------------------- which terms can be exported


def term(name: str, function: Callable[[Snapshot], Tensor | None], size: int) -> Term:
    return Term(name, Entry("observation", name, function, {"size": size}), {})


def test_a_graph_takes_only_what_its_terms_read() -> None:
    terms = [term("a", lambda s: s.joint_vel, 12), term("b", lambda s: s.projected_gravity_b[:, :2], 2)]
    assert [port.name for port in required_inputs(terms)] == ["joint_vel", "imu_quat"]
    module = DeployedPolicy(network(14), terms, ActionConfig(scale=0.2, clip=100.0))
    assert {port.name: port.size for port in module.outputs} == {"joint_target": 12, "observation": 14, "action": 12}


@pytest.mark.parametrize("field", ["foot_height", "base_pos_w", "trunk_contact", "joint_acc", "foot_air_time"])
def test_a_term_that_needs_the_truth_is_named(field: str) -> None:
    terms = [term("fine", lambda s: s.joint_pos, 12), term("cheat", lambda s: getattr(s, field), 4)]
    with pytest.raises(ExportError, match=rf"^observation\.cheat: reads {field}, which the robot does not measure"):
        DeployedPolicy(network(16), terms, ActionConfig(scale=0.2, clip=100.0))


def test_a_term_without_a_form_in_onnx_is_named() -> None:
    def branch(s: Snapshot) -> Tensor:
        return s.joint_pos if float(s.joint_pos.sum()) > 0 else s.joint_vel

    terms = [term("fine", lambda s: s.joint_pos, 12), term("branch", branch, 12)]
    module = DeployedPolicy(network(24), terms, ActionConfig(scale=0.2, clip=100.0))
    with pytest.raises(ExportError, match=r"^observation\.branch: has no form in ONNX \("):
        to_onnx(module)


def test_a_missing_exporter_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    module = DeployedPolicy(network(12), [term("a", lambda s: s.joint_pos, 12)], ActionConfig(scale=0.2, clip=1.0))
    with pytest.raises(ExportError, match=r"needs onnxscript; pip install 'go1exp\[export\]'"):
        to_onnx(module)


def test_a_missing_runtime_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ValueError, match=r"needs the package onnxruntime .*pip install 'go1exp\[deploy\]'"):
        OnnxPolicy(b"", [], [])


def test_every_source_is_a_field_and_every_reading_is_given(start_core: Callable[..., Go1Core]) -> None:
    assert set(graph.SOURCES) <= {f.name for f in dataclasses.fields(Snapshot)}
    names = [port.name for port in graph.READINGS]
    assert {*graph.SOURCES.values(), *graph.BOUNDING} == set(names)
    core = start_core(num_envs=2)
    given = readings(core)
    assert {name: values.shape[1] for name, values in given.items()} == {p.name: p.size for p in graph.READINGS}


# ---------------------------------------------------------------------- gains and commands


def test_gains_are_the_drives_or_those_that_a_net_was_learnt_from(make_net: Callable[..., Path]) -> None:
    def actuator(*overrides: str) -> Term:
        return parse_task(compose("train", overrides)).actuator

    assert gains(actuator("actuator=dc_motor", "actuator.kp={hip: 1.0, thigh: 2.0, calf: 3.0}"), "kp") == (1, 2, 3) * 4
    assert gains(actuator("actuator=delay"), "kd") == (0.5,) * 12
    known = make_net(kp=tuple(map(float, range(12))), kd=(0.5,) * 12)
    assert gains(actuator("actuator=net", f"actuator.file={known}"), "kp") == tuple(map(float, range(12)))
    unknown = actuator("actuator=net", f"actuator.file={make_net()}")
    assert gains(unknown, "kp") is None


def test_a_fixed_command_is_a_range_of_one_value() -> None:
    command = parse_task(compose("train", ["command=forward"])).command
    assert command_ranges(command) == {"lin_vel_x": (0.5, 0.5), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (0.0, 0.0)}


# ---------------------------------------------------------------------- tampering


def refused(data: bytes) -> str:
    with pytest.raises(BundleError) as caught:
        loads(data, "bad.zip")
    message = str(caught.value)
    assert message.startswith("bad.zip: ")
    return message.removeprefix("bad.zip: ")


def test_what_was_packed_is_read_back(data: bytes, members: dict[str, bytes]) -> None:
    assert pack(members) == data
    assert loads(data, "x").sizes == {name: len(content) for name, content in members.items()}


@pytest.mark.parametrize("name", ["manifest.json", *MEMBERS])
@pytest.mark.parametrize("place", [0.0, 0.5, 1.0], ids=["first byte", "middle", "last byte"])
def test_a_changed_byte_is_found_in_its_member(name: str, place: float, data: bytes) -> None:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        info = archive.getinfo(name)
    start = info.header_offset + 30 + len(name)
    changed = bytearray(data)
    changed[start + round(place * (info.file_size - 1))] ^= 0x20
    assert refused(bytes(changed)).startswith(f"{name}: damaged (")


@pytest.mark.parametrize("name", MEMBERS)
def test_a_member_that_is_not_the_one_that_was_hashed_is_named(
    name: str, manifest: bytes, members: dict[str, bytes]
) -> None:
    changed = stored({"manifest.json": manifest, **{**members, name: members[name] + b" "}})
    assert refused(changed).startswith(f"{name}: its SHA-256 is {seal(members[name] + b' ')}, that of manifest.json")


@pytest.mark.parametrize("name", ["manifest.json", *MEMBERS])
def test_a_missing_member_is_named(name: str, manifest: bytes, members: dict[str, bytes]) -> None:
    left = {n: content for n, content in {"manifest.json": manifest, **members}.items() if n != name}
    assert refused(stored(left)) == f"{name}: missing"


def test_members_that_do_not_belong_there_are_named(data: bytes, members: dict[str, bytes]) -> None:
    assert refused(pack({**members, "run.sh": b"x"})) == "run.sh: unexpected member"
    turned = {name: members[name] for name in reversed(MEMBERS)}
    assert refused(pack(turned)).startswith("members in the order manifest.json, trace.npz")
    twice = io.BytesIO(data)
    with zipfile.ZipFile(twice, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("policy.onnx", b"another")
    assert refused(twice.getvalue()) == "policy.onnx: duplicate"


def test_another_form_of_the_same_archive_is_refused(data: bytes) -> None:
    again = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(again, "w", zipfile.ZIP_DEFLATED) as other:
        for name in archive.namelist():
            other.writestr(name, archive.read(name))
    assert refused(again.getvalue()).startswith("manifest.json: compressed")
    for changed in (b"#!/bin/sh\n" + data, data + b"\n", data[:-100], data[:-10], data[:1000], b"", bytes(1000)):
        assert refused(changed).startswith("not a bundle, or damaged (")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: b"{", "invalid JSON"),
        (lambda m: as_json([]), "must be a mapping"),
        (lambda m: as_json({**m, "note": "x"}), "must have format and sha256"),
        (lambda m: as_json({**m, "format": 2}), "format 2, this version reads 1"),
        (lambda m: as_json({**m, "sha256": {}}), "must give the SHA-256 of metadata.json"),
        (lambda m: as_json({**m, "sha256": 5}), "must give the SHA-256 of metadata.json"),
    ],
)
def test_a_changed_manifest_is_refused(
    change: Callable[[Any], bytes], message: str, manifest: bytes, members: dict[str, bytes]
) -> None:
    changed = change(json.loads(manifest))
    assert refused(stored({"manifest.json": changed, **members})).startswith(f"manifest.json: {message}")


def reweighted(model: bytes, by: float) -> bytes:
    changed = onnx.load_from_string(model)
    for tensor in changed.graph.initializer:
        if tensor.name == "head.bias":
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor) + np.float32(by), tensor.name))
    return bytes(changed.SerializeToString())


def test_another_policy_is_refused_by_the_replay(members: dict[str, bytes]) -> None:
    """An offset of 5e-5 in the action is one of 1.5e-5 rad in the target, and no more is needed."""
    for by in (5e-5, -1.0, np.nan):
        message = refused(pack({**members, "policy.onnx": reweighted(members["policy.onnx"], by)}))
        assert message.startswith("trace.npz: joint_target[")
        assert message.endswith("in the trace; they may differ by 1e-05")
    loads(pack({**members, "policy.onnx": reweighted(members["policy.onnx"], 2e-6)}), "within tolerance")


def test_a_graph_that_is_none_or_another_is_refused(members: dict[str, bytes]) -> None:
    for content in (b"nonsense", b""):
        said = refused(pack({**members, "policy.onnx": content}))
        assert said.startswith("policy.onnx: not a graph that onnxruntime")
    for what, name in (("input", "joint_pos"), ("output", "action")):
        model = onnx.load_from_string(members["policy.onnx"])
        for value in getattr(model.graph, what):
            value.name = "odd" if value.name == name else value.name
        for node in model.graph.node:
            for names in (node.input, node.output):
                names[:] = ["odd" if n == name else n for n in names]
        changed = bytes(model.SerializeToString())
        assert refused(pack({**members, "policy.onnx": changed})).startswith(f"policy.onnx: its {what}s are ")


@pytest.mark.parametrize("name", ["joint_target", "observation", "action"])
def test_a_trace_of_other_outputs_is_refused(name: str, good: Bundle, members: dict[str, bytes]) -> None:
    trace = {key: values.copy() for key, values in good.trace.items()}
    trace[f"output.{name}"][7, 3] += 3e-5
    message = refused(pack({**members, "trace.npz": bundle._npz(trace)}))
    at = f"{good.trace['time'][7]:.2f}"
    if name == "observation":
        assert message.startswith(f"trace.npz: observation[3] at {at} s is ")
    else:  # found sooner: the action does not mean the target
        assert message.startswith(("metadata.json: nominal_stance and action_scale", f"trace.npz: {name}[3] at {at} s"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("input.imu_gyro"), "arrays missing or too many: input.imu_gyro"),
        (lambda t: t.update({"input.x": t["time"]}), "arrays missing or too many: input.x"),
        (lambda t: t.update({"time": t["time"].astype(np.float32)}), "time: float32 of shape"),
        (lambda t: t.update({"input.command": t["input.command"][:-1]}), "input.command: float32 of shape"),
        (lambda t: t.update({k: v[:0] for k, v in t.items()}), "time: float64 of shape (0,)"),
        (lambda t: t["input.command"].__setitem__((0, 0), np.nan), "input.command: holds values that are not finite"),
    ],
    ids=["missing", "too many", "another type", "another length", "empty", "NaN"],
)
def test_a_damaged_trace_is_refused(
    change: Callable[[Any], Any], message: str, good: Bundle, members: dict[str, bytes]
) -> None:
    trace = {key: values.copy() for key, values in good.trace.items()}
    change(trace)
    assert refused(pack({**members, "trace.npz": bundle._npz(trace)})).startswith(f"trace.npz: {message}")


def test_a_trace_is_never_unpickled(good: Bundle, members: dict[str, bytes]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **{**good.trace, "time": np.array([print], dtype=object)})  # type: ignore[arg-type]
    assert "allow_pickle=False" in refused(pack({**members, "trace.npz": buffer.getvalue()}))
    assert refused(pack({**members, "trace.npz": b"x"})).startswith("trace.npz: not NumPy's arrays")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kp": [20.0]}, "kp: 1 values for 12 joints"),
        ({"joints": "FR_hip"}, "joints: must be a list"),
        ({"action_scale": 0.25}, "nominal_stance and action_scale are not those of the trace"),
        ({"action_scale": "0.3"}, "action_scale = '0.3': must be a finite number"),
        ({"action_scale": True}, "action_scale = True: must be a finite number"),
        ({"action_clip": 1e-4}, "action_clip is not that of the trace"),
        ({"action_max_step": 1e-4}, "action_max_step is not that of the trace"),
        ({"action_max_step": 0}, "action_max_step: must be greater than 0"),
        ({"nominal_stance": [0.0] * 12}, "nominal_stance and action_scale are not those of the trace"),
        ({"policy_dt": 0}, "policy_dt: must be greater than 0"),
        ({"observation": []}, "outputs: their sizes are"),
        ({"joint_limits": [[1.0]] * 12}, "joint_limits.0: must be a list of 2"),
        ({"inputs": [{"name": "joint_pos"}]}, "inputs.0.size: missing"),
        ({"trained": None}, "trained.: must be a mapping"),
        ({"odd": 1}, "odd: unknown key"),
        ({"kp": [20.0] * 11 + [-5.0]}, "kp.11 = -5: must be 0 to 1023, as the gain of RL_calf"),
        ({"kp": [1e9] + [20.0] * 11}, "kp.0 = 1e+09: must be 0 to 1023, as the gain of FR_hip"),
        (
            {"torque_limit": [0.0] * 12},
            "torque_limit.0 = 0: must be greater than 0 and at most 100, as the limit of FR",
        ),
        ({"torque_limit": [1e12] * 12}, "torque_limit.0 = 1e+12: must be greater than 0 and at most 100, as the limit"),
        ({"velocity_limit": [1e3] * 12}, "velocity_limit.0 = 1000: must be greater than 0 and at most 100, as the"),
        (
            {"joint_limits": [[-1e3, 1e3]] * 12},
            "joint_limits.0: the stops of FR_hip are more than a turn from its zero",
        ),
        ({"joint_limits": [[1.0, -1.0]] * 12}, "joint_limits.0: the lower stop of FR_hip, 1, is not below -1"),
        ({"joints": ["FR_hip"] * 12}, "joints: FR_hip duplicate"),
        ({"command_ranges": {"lin_vel_q": [-1.0, 1.0]}}, "command_ranges.lin_vel_q: unknown axis; those of a command"),
        ({"command_ranges": {"lin_vel_x": [1.0, -1.0]}}, "command_ranges.lin_vel_x: the lowest, 1, is above the"),
        ({"robot": ...}, "robot: missing"),
    ],
    ids=str,
)
def test_wrong_metadata_are_refused_by_key(change: dict[str, Any], message: str, members: dict[str, bytes]) -> None:
    content = {**json.loads(members["metadata.json"]), **change}
    content = {name: value for name, value in content.items() if value is not ...}
    assert refused(pack({**members, "metadata.json": as_json(content)})).startswith(f"metadata.json: {message}")


@pytest.mark.parametrize("name", ["metadata.json", "config.json", "versions.json"])
def test_what_is_no_json_is_refused(name: str, members: dict[str, bytes]) -> None:
    assert refused(pack({**members, name: b"{"})).startswith(f"{name}: invalid JSON")
    assert refused(pack({**members, name: b"[" * 100_000})).startswith(f"{name}: invalid JSON")
    assert f"{name}: " in refused(pack({**members, name: b"[]"}))


# ---------------------------------------------------------------------- the policy as a function


@pytest.mark.parametrize(
    ("reading", "message"),
    [
        (None, "joint_pos: missing"),
        (np.zeros((1, 12)), "joint_pos: float64 of shape"),
        (np.zeros(12, np.float32), "joint_pos: float32 of shape"),
        (np.zeros((1, 3), np.float32), r"joint_pos: float32 of shape \(1, 3\); must be float32 \(rows, 12\)"),
    ],
)
def test_a_wrong_reading_is_named(reading: np.ndarray | None, message: str, good: Bundle) -> None:
    given: dict[str, Any] = {port.name: np.zeros((1, port.size), np.float32) for port in good.policy.inputs}
    given["joint_pos"] = reading
    with pytest.raises(ValueError, match=message):
        good.policy(given)


def test_the_runtime_does_on_the_traces_readings_what_the_environment_did(good: Bundle) -> None:
    """Controller, policy and safety in a row, from a state's arrival to the command that is sent."""
    trace = good.trace
    apart = np.flatnonzero(np.diff(trace["time"]) > 0.021)  # where an episode ended
    rows = int(apart[0]) + 1 if len(apart) else len(trace["time"])
    assert rows > 5
    measured = ("joint_pos", "joint_vel", "imu_quat", "imu_gyro")
    states = [
        low_state(float(trace["time"][k]), **{name: trace[f"input.{name}"][k] for name in measured})
        for k in range(rows)
    ]
    observed: list[Any] = []
    link = FakeLink(lambda k: [states[k]])
    sent = link.sent
    commands = lambda t: trace["input.command"][len(sent)]  # noqa: E731
    estimates = trace["input.base_lin_vel_b"]
    estimator: Any = SimpleNamespace(update=lambda state: None, ahead=lambda age: estimates[len(sent)])
    safety = Safety(robot.JOINTS, robot.JOINT_POS_LIMITS, np.array(good.metadata.torque_limit))
    gains: dict[str, Any] = {"kp": np.array(good.metadata.kp), "kd": np.array(good.metadata.kd)}
    about: dict[str, Any] = {"stages": Stages(stand_up=0.0), "on_cycle": observed.append, **gains}
    runtime = Controller(good, link, commands, estimator, safety, **about)
    for state in states:
        assert runtime.cycle(state.t)
    assert safety.fault is None
    assert not safety.clamped.any()
    np.testing.assert_allclose([c.observation for c in observed], trace["output.observation"][:rows], rtol=0, atol=1e-5)
    np.testing.assert_allclose([c.joint_target for c in sent], trace["output.joint_target"][:rows], rtol=0, atol=1e-5)
    assert all((c.kp == good.metadata.kp).all() and (c.kd == good.metadata.kd).all() for c in sent)


def test_loading_a_bundle_loads_neither_torch_nor_an_engine_nor_hydra(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "b.zip").write_bytes(data)
    code = (
        "import sys, json, go1exp.deploy.runtime.controller, go1exp.deploy.runtime.loop, go1exp.deploy.runtime.safety; "
        "from go1exp.deploy.runtime.bundle import load; found = load('b.zip'); "
        "print(json.dumps([found.seal, sorted({name.split('.')[0] for name in sys.modules})]))"
    )
    done = run_alone(tmp_path, code=code, PYTHONWARNINGS="error")
    assert done.returncode == 0, done.stderr
    sealed, modules = json.loads(done.stdout)
    assert sealed == seal(data)
    heavy = {"torch", "stable_baselines3", "gymnasium", "mujoco", "hydra", "omegaconf", "pydantic", "scipy", "onnx"}
    assert {"numpy", "onnxruntime"} <= set(modules)
    assert not heavy & set(modules)


# ---------------------------------------------------------------------- the verbs


def verb(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["go1exp", *arguments])
    return cli.main()


def test_export_writes_a_bundle_and_check_says_what_is_in_it(
    run: Path,
    members: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("go1exp.deploy.export.build.to_onnx", lambda module: members["policy.onnx"])  # 3 s less
    assert verb(monkeypatch, "export", f"run={run}", "seconds=0.5", "out=there/walk.zip", "checkpoint=000002.pt") == 0
    message = capsys.readouterr().out
    assert [p.name for p in (tmp_path / "there").iterdir()] == ["walk.zip"]
    sealed = seal((tmp_path / "there/walk.zip").read_bytes())
    assert f"SHA-256 {sealed}" in message
    assert message.splitlines()[-1] == "now: go1exp export check there/walk.zip"

    assert verb(monkeypatch, "export", "check", "there/walk.zip") == 0
    message = capsys.readouterr().out
    for part in (sealed, "imu_quat", "projected_gravity", "FR_hip", "policy 50 Hz", "trace.npz", "lin_vel_x -2 to 3"):
        assert part in message
    assert message.splitlines()[-1].startswith("good: every hash matches, ")
    assert max(map(len, message.splitlines())) <= 120

    whole = (tmp_path / "there/walk.zip").read_bytes()
    (tmp_path / "bad.zip").write_bytes(whole.replace(b'"ppo": {', b'"PPO": {'))
    assert verb(monkeypatch, "export", "check", "bad.zip") == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("go1exp export check: bad.zip: config.json: damaged (")
    assert verb(monkeypatch, "export", "check", "nowhere.zip") == 2
    assert capsys.readouterr().err == "go1exp export check: No such file or directory: nowhere.zip\n"


def test_a_bundle_lies_in_its_run_folder_unless_told_otherwise(
    run: Path, data: bytes, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("go1exp.deploy.export.build.build", lambda *_, **__: data)
    assert verb(monkeypatch, "export", f"run={run}") == 0
    assert (run / "bundle.zip").read_bytes() == data
    (run / "bundle.zip").unlink()
    assert f"written to {run / 'bundle.zip'}" in capsys.readouterr().out


def test_a_run_without_a_checkpoint_is_refused_and_leaves_nothing(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.yaml").write_bytes((run / "config.yaml").read_bytes())
    assert verb(monkeypatch, "export", f"run={tmp_path}") == 2
    assert "no checkpoint to load" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["config.yaml"]


def test_another_network_than_its_environments_is_refused(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Were torch's exporter wrong, the build itself would say so."""

    def off(module: DeployedPolicy) -> bytes:
        bias = cast(nn.Linear, module.head).bias.data
        bias += 0.01
        try:
            return to_onnx(module)
        finally:
            bias -= 0.01

    monkeypatch.setattr("go1exp.deploy.export.build.to_onnx", off)
    with pytest.raises(BundleError, match=r"trace\.npz: joint_target\["):
        build(run, seconds=0.2)
