"""Policies of other frameworks: a shipped network in their conventions acts as it does; a wrong contract is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import nn

from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.export.contract import alternatives, at_rest, build_foreign, drive
from go1exp.deploy.export.foreign import ORDERS, PRESETS, Front, Spec, config_of, spec_of
from go1exp.deploy.export.foreign_graph import Network
from go1exp.deploy.export.graph import ExportError
from go1exp.deploy.runtime.bundle import load
from go1exp.train import run_folder
from go1exp.train.policy import load_network
from tests.lockstep import play

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")

ABOUT = ("go1exp/deploy/export/", "go1exp/cli/export.py", "go1exp/config/schema/", "conf/export_import.yaml")

PLACES = {"base_linear_velocity": 0, "base_angular_velocity": 3, "projected_gravity": 6, "velocity_command": 9}
PLACES |= {"joint_position": 12, "joint_velocity": 24, "previous_action": 36}


class InTheirs(nn.Module):
    """The shipped network, as another framework would have trained it: its order, scales and units of action."""

    def __init__(self, spec: Spec) -> None:
        super().__init__()
        run = data_root() / "assets/policies/paper"
        config = run_folder.read_parsed(run)
        policy, _ = load_network(run, config, None)
        self.net = nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)
        front = Front(spec, config_of(spec)[1])
        inverse = [spec.names.index(name) for name in robot.JOINTS]
        order, gain = [], []
        start = 0
        columns = {}
        for term, law in zip(front._terms, front._laws, strict=True):
            size = len(law[0])
            sign = torch.as_tensor(spec.joints("joint_sign"), dtype=torch.float32) if size == 12 else 1.0
            columns[term.entry.name] = (start, inverse if size == 12 else [0, 1, 2], sign / law[3])
            start += size
        for name in PLACES:
            at, index, factor = columns[name]
            order += [at + k for k in index]
            gain += [float(factor[k]) for k in index]
        self.order, self.gain = order, torch.tensor(gain)
        self.joints = [robot.JOINTS.index(name) for name in spec.names]
        self.sign = torch.as_tensor(spec.joints("joint_sign"), dtype=torch.float32)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.net(obs[:, self.order] * self.gain)[:, self.joints] * self.sign


def contract(tmp_path: Path, preset: str) -> str:
    """A file: the preset's observation and order, with pose, gains and scale of the shipped policy."""
    stance = ", ".join(f"{n}: {v}" for n, v in zip(robot.JOINTS, robot.NOMINAL_STANCE, strict=True))
    file = tmp_path / f"{preset}.yaml"
    file.write_text(
        f"preset: {preset}\ndefault_pose: {{{stance}}}\nkp: 20.0\nkd: 0.5\naction_scale: 0.2\n"
        "command_ranges: {lin_vel_x: [-2, 3]}\n"
    )
    return str(file)


def exported(module: nn.Module, file: Path, size: int = 48) -> Path:
    torch.jit.trace(module.eval(), torch.zeros(2, size)).save(str(file))
    return file


@pytest.mark.slow(*ABOUT)
@pytest.mark.parametrize("preset", PRESETS)
def test_a_network_in_their_convention_acts_as_the_original_and_is_deployed(preset: str, tmp_path: Path) -> None:
    spec, _ = spec_of(contract(tmp_path, preset), {})
    theirs = InTheirs(spec)
    front = Front(spec, config_of(spec)[1])
    data, lines = build_foreign(exported(theirs, tmp_path / "policy.pt"), contract(tmp_path, preset))
    assert "mismatch" not in lines[-1]
    file = tmp_path / "walk.zip"
    file.write_bytes(data)
    rng = np.random.default_rng(0)
    given = {p.name: torch.tensor(rng.normal(size=(50, p.size)), dtype=torch.float32) for p in front.inputs}
    given["imu_quat"] = nn.functional.normalize(given["imu_quat"])
    ours, _ = spec_of(contract(tmp_path, "isaaclab"), {})
    plain = Front(type(ours)(**{**ours.__dict__, "joint_order": "sdk"}), config_of(ours)[1])
    wanted = theirs.net(plain(*[given[p.name] for p in plain.inputs])[0]).detach()
    made = load(file).policy
    got = made({name: values.numpy() for name, values in given.items()})
    np.testing.assert_allclose(got["action"], wanted, rtol=0, atol=1e-4)
    np.testing.assert_allclose(got["joint_target"], robot.NOMINAL_STANCE + 0.2 * wanted.numpy(), rtol=0, atol=1e-4)
    done = play(str(file), tmp_path / "walk", about={"truth": True})
    assert done.status == 0
    x, y, yaw = done.account["velocity"]["mean"]
    assert (x, y, yaw) == (pytest.approx(0.4, abs=0.05), pytest.approx(0, abs=0.05), pytest.approx(0, abs=0.1))


GRAVITY = (
    "observation: [lin_vel, ang_vel, {term: projected_gravity, %s}, velocity_commands, joint_pos, joint_vel, actions]"
)
JOINT_VELOCITY = (
    "observation: [lin_vel, ang_vel, projected_gravity, velocity_commands, joint_pos, {term: joint_vel, scale: 0.05}, "
    "actions]"
)


@pytest.mark.slow(*ABOUT)
@pytest.mark.parametrize(
    ("line", "likely"),
    [
        ("joint_order: sdk", "joint_order=joint_major"),
        ("joint_sign: -1.0", "joint_sign reversed"),
        ("action_scale: 0.4", "action_scale x 0.5"),
        ("preset: legged_gym", "order of preset isaaclab"),
        (GRAVITY % "scale: -1.0", "gravity frame: sign"),
        (GRAVITY % "quaternion: inverse", "gravity frame: quaternion=wxyz"),
        (GRAVITY % "quaternion: xyzw", "quaternion order: quaternion=wxyz"),
        (JOINT_VELOCITY, "joint_velocity scale=1"),
        ("kp: 60.0", "gains: kp x 1/3"),
        ("kp: 40.0", "gains: kp x 1/2"),
        ("kp: 10.0", "gains: kp x 2"),
        ("kd: 2.0", "gains: kd x 1/3"),
    ],
)
def test_a_wrong_contract_is_named(line: str, likely: str, tmp_path: Path) -> None:
    spec, _ = spec_of(contract(tmp_path, "isaaclab"), {})
    file = exported(InTheirs(spec), tmp_path / "policy.pt")
    wrong = tmp_path / "wrong.yaml"
    key = line.partition(":")[0]
    stated = Path(contract(tmp_path, "isaaclab")).read_text().splitlines()
    wrong.write_text("\n".join([one for one in stated if one.partition(":")[0] != key] + [line, ""]))
    with pytest.raises(ExportError, match=f"likely mismatch.*{likely}"):
        build_foreign(file, str(wrong))


RIGHT_HIPS = "joint_sign: {FR_hip: -1, RR_hip: -1, FL: 1, RL: 1, thigh: 1, calf: 1}\n"


@pytest.mark.slow(*ABOUT)
def test_joints_of_one_side_that_are_reversed_are_named(tmp_path: Path) -> None:
    stated = Path(contract(tmp_path, "isaaclab"))
    turned = tmp_path / "turned.yaml"
    turned.write_text(stated.read_text().replace("FR_hip: -0.1", "FR_hip: 0.1").replace("RR_hip: -0.1", "RR_hip: 0.1"))
    turned.write_text(turned.read_text() + RIGHT_HIPS)
    file = exported(InTheirs(spec_of(str(turned), {})[0]), tmp_path / "policy.pt")
    with pytest.raises(ExportError, match=r"likely mismatch.*stands with: sign: joint_sign reversed \(right hip\)"):
        build_foreign(file, str(stated))
    assert "mismatch" not in build_foreign(file, str(turned))[1][-1]


@pytest.mark.slow(*ABOUT)
@pytest.mark.parametrize("layout", ["term", "frame"])
def test_frames_in_another_order_are_named(layout: str, tmp_path: Path) -> None:
    theirs = InTheirs(spec_of(contract(tmp_path, "isaaclab"), {})[0])
    newest = list(range(96, 144))  # of three frames, the oldest first
    if layout == "term":
        newest = [k for start in (0, 9, 18, 27) for k in range(start + 6, start + 9)]
        newest += [k for start in (36, 72, 108) for k in range(start + 24, start + 36)]

    class Newest(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = theirs

        def forward(self, obs: torch.Tensor) -> torch.Tensor:
            return self.net(obs[:, newest])

    wrong = Path(contract(tmp_path, "isaaclab"))
    wrong.write_text(f"{wrong.read_text()}history: 3\nhistory_order: newest_first\nhistory_layout: frame\n")
    with pytest.raises(ExportError, match=f"mismatch.*history_order=oldest_first, history_layout={layout}"):
        build_foreign(exported(Newest(), tmp_path / "policy.pt", 144), str(wrong))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_other_contract_differs_from_the_stated_one(preset: str, tmp_path: Path) -> None:
    file = tmp_path / "spec.yaml"
    file.write_text(f"preset: {preset}\nhistory: 3\n")
    spec = spec_of(str(file), {})[0]
    others = dict(alternatives(spec))
    assert not {f"terms, scales and joint order of preset {preset}", f"joint order: joint_order={spec.joint_order}"} & {
        *others
    }
    assert "default pose: that of preset mjlab" in others or preset == "mjlab"
    assert len([name for name in others if name.startswith("history: ")]) == 3
    right = others["sign: joint_sign reversed (right hip)"]
    assert dict(zip(right.names, right.joints("joint_sign"), strict=True))["FR_hip"] == -1
    for name, other in others.items():  # a reversed joint of a robot keeps its default pose
        if name.startswith("sign: joint_sign"):
            poses = [one.joints("joint_sign") * one.joints("default_pose") for one in (spec, other)]
            np.testing.assert_array_equal(*poses)


@pytest.mark.slow(*ABOUT)
@pytest.mark.parametrize("preset", PRESETS)
def test_of_a_policy_that_does_nothing_no_mismatch_is_named(preset: str, tmp_path: Path) -> None:
    still = nn.Linear(48, 12)
    nn.init.zeros_(still.weight)
    nn.init.zeros_(still.bias)
    _, lines = build_foreign(exported(still, tmp_path / "policy.pt"), preset)
    assert "stands 2 s" in lines[-1]
    assert "mismatch" not in lines[-1]
    assert any(line.startswith("note: not checked") and "others" in line for line in lines)


@pytest.mark.slow(*ABOUT)
def test_a_policy_of_mjlab_stated_as_one_of_isaaclab_is_named(tmp_path: Path) -> None:
    spec, _ = spec_of(contract(tmp_path, "mjlab"), {})
    file = exported(InTheirs(spec), tmp_path / "policy.pt")
    with pytest.raises(ExportError, match=r"likely mismatch.*order of preset mjlab"):
        build_foreign(file, contract(tmp_path, "isaaclab"))


def network(file: Path, size: int, kinds: tuple[int, int], shapes: tuple[list[int], list[int]]) -> Path:
    """Write a graph without any effect, whose input and output have these types of numbers and shapes."""
    helper = onnx.helper
    weights = onnx.numpy_helper.from_array(np.zeros((size, 12), np.float32), "W")
    nodes = [
        helper.make_node("Cast", ["obs"], ["x"], to=1),
        helper.make_node("MatMul", ["x", "W"], ["y"]),
        helper.make_node("Cast", ["y"], ["actions"], to=kinds[1]),
    ]
    ports = [helper.make_tensor_value_info(*p) for p in zip(("obs", "actions"), kinds, shapes, strict=True)]
    graph = helper.make_graph(nodes, "p", ports[:1], ports[1:], [weights])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), file)
    return file


def test_metadata_of_the_file_and_sizes(tmp_path: Path) -> None:
    props = {
        "joint_names": ",".join(f"{n}_joint" for n in ORDERS["leg_major"]),
        "observation_names": "base_ang_vel,joint_pos,actions",
        "joint_stiffness": ",".join(str(k) for k in range(12)),
        "action_scale": "0.3",
    }
    spec, notes = spec_of("mjlab", props)
    assert spec.names == ORDERS["leg_major"]
    assert [o.term for o in spec.observation] == ["base_ang_vel", "joint_pos", "actions"]
    assert spec.joints("kp").tolist() == list(range(12))
    assert "joint_order" in notes[0]
    made = network(tmp_path / "p.onnx", 45, (1, 1), ([1, 45], [1, 12]))
    with pytest.raises(ConfigError, match=r"48 numbers .*the network takes 45"):
        build_foreign(made, "legged_gym")
    assert {name.partition(":")[0] for name, _ in alternatives(spec_of("isaaclab", {})[0])} >= {"joint order", "sign"}


@pytest.mark.parametrize(
    ("kinds", "shapes", "named"),
    [
        ((10, 1), ([1, 48], [1, 12]), "input obs is float16, 2-D; must be float32, 2-D"),
        ((1, 11), ([1, 48], [1, 12]), "output actions is double, 2-D; must be"),
        ((1, 1), ([48], [12]), "input obs is float, 1-D; must be"),
    ],
)
def test_numbers_of_a_network_that_the_runtime_does_not_feed_are_named(
    kinds: tuple[int, int], shapes: tuple[list[int], list[int]], named: str, tmp_path: Path
) -> None:
    file = network(tmp_path / "p.onnx", 48, kinds, shapes)
    with pytest.raises(ExportError, match=named):
        build_foreign(file, "isaaclab")


def test_gains_that_the_motors_do_not_take_are_refused_before_a_simulation(tmp_path: Path) -> None:
    file = tmp_path / "spec.yaml"
    file.write_text("preset: isaaclab\nkp: [20.0, 5000.0, 20.0]\n")
    with pytest.raises(ExportError, match=r"kp\.1 = 5000: must be 0 to 1023, as the gain of FR_thigh"):
        build_foreign(exported(nn.Linear(48, 12), tmp_path / "policy.pt"), str(file))


def test_a_script_that_returns_more_than_actions_is_named(tmp_path: Path) -> None:
    class Two(nn.Module):
        def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return obs[:, :12], obs

    with pytest.raises(ExportError, match=r"policy\.pt: returns a tuple; one tensor of 12 actions is needed"):
        build_foreign(exported(Two(), tmp_path / "policy.pt"), "isaaclab")


def test_first_targets_are_compared_with_the_own_pose_and_limit_of_each_joint(tmp_path: Path) -> None:
    file = tmp_path / "spec.yaml"
    file.write_text("preset: isaaclab\ndefault_pose: {hip: 0.0, thigh: 0.7, calf: -1.4}\nkp: [100.0, 20.0, 20.0]\n")
    spec, _ = spec_of(str(file), {})
    target = np.tile([0.0, 0.7, -1.4], 4)
    assert at_rest(spec, target)[0].endswith(" 0% of its limit")
    target[robot.JOINTS.index("FL_hip")] += 0.2
    target[robot.JOINTS.index("RR_calf")] -= 1.0
    said = at_rest(spec, target)
    assert said == [
        "first target: RR_calf -1.00 rad from its default pose; largest torque: FL_hip +20.0 N m, 84% of its limit"
    ]
    target[robot.JOINTS.index("FL_hip")] += 0.1
    assert at_rest(spec, target)[1:] == ["warning: first targets with torques beyond the limit: FL_hip"]
    target[robot.JOINTS.index("RL_thigh")] = -0.7
    assert at_rest(spec, target)[2:] == ["warning: first targets beyond the stops: RL_thigh"]


def given(tmp_path: Path, joint_vel: str, *lines: str) -> Spec:
    terms = f"observation: [ang_vel, projected_gravity, commands, joint_pos, {{term: joint_vel, {joint_vel}}}, actions]"
    file = tmp_path / "spec.yaml"
    file.write_text("\n".join(["preset: isaaclab", terms, *lines, ""]))
    return spec_of(str(file), {})[0]


def front_of(tmp_path: Path, joint_vel: str) -> Front:
    spec = given(tmp_path, joint_vel)
    return Front(spec, config_of(spec)[1])


@pytest.mark.parametrize(
    ("clip", "low", "high"),
    [("5", -5.0, 5.0), ("[null, 5]", -8.0, 5.0), ("[-2, null]", -2.0, 8.0), ("[-2, 5]", -2.0, 5.0)],
)
def test_a_term_is_clipped_on_one_side_or_both_and_scaled_by_hip_thigh_and_calf(
    clip: str, low: float, high: float, tmp_path: Path
) -> None:
    front = front_of(tmp_path, f"clip: {clip}, scale: [1, 2, 3]")
    readings = {port.name: torch.zeros(2, port.size) for port in front.inputs}
    readings["imu_quat"][:, 0] = 1.0
    readings["joint_vel"][:] = torch.tensor([[-8.0], [8.0]])
    start = 3 + 3 + 3 + 12
    seen = front(*[readings[port.name] for port in front.inputs])[1][:, start : start + 12]
    torch.testing.assert_close(seen, torch.tensor([[low], [high]]) * torch.tensor([1.0, 2.0, 3.0]).repeat_interleave(4))


@pytest.mark.parametrize(
    ("setting", "named"),
    [("clip: [5, 1]", "clip"), ("clip: [5]", "clip"), ("scale: [1, 2]", "joint_vel.scale: 2 values")],
)
def test_a_clip_or_scale_of_a_term_that_cannot_be_is_refused_by_name(setting: str, named: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=rf"observation.*{named}"):
        front_of(tmp_path, setting)


@pytest.mark.parametrize(("decimation", "period"), [(4, 0.02), (2, 0.01)])
def test_an_imported_policy_is_tried_at_its_own_period(decimation: int, period: float, tmp_path: Path) -> None:
    still = exported(nn.Linear(45, 12), tmp_path / "policy.pt", 45)
    spec = given(tmp_path, "scale: 1", "physics_dt: 0.005", f"decimation: {decimation}")
    _, trace, _ = drive(config_of(spec)[1], [spec], Network(still, 45))
    np.testing.assert_allclose(np.diff(trace["time"]), period)
