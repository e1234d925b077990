"""Every file of conf/ works, ablations take away what they are named after, and the paper's numbers are the paper's."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import go1exp.evaluate.protocol.kinds
import go1exp.logs.importers
import go1exp.logs.record.motions  # noqa: F401  (registers every importer and excitation)
from go1exp import cli
from go1exp.base.paths import data_root
from go1exp.cli import EVERY, helptext
from go1exp.cli.app import app_of, begin
from go1exp.cli.app import parse as parse_settings
from go1exp.cli.gap import with_logs
from go1exp.cli.hydra_main import choices_from_files
from go1exp.cli.record import RIG
from go1exp.cli.record import _motions as motions
from go1exp.cli.subjects import ROBOT_GROUPS
from go1exp.config.compose import compose
from go1exp.config.hydra_adapter import hydra_for
from go1exp.config.schema import plugins, registry
from go1exp.config.schema.registry import Term
from go1exp.evaluate.protocol.base import chosen
from go1exp.gap.robots.description import parse_model
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TrainConfig, parse_parts, parse_train
from go1exp.train import preflight
from go1exp.train.trainer import trained_task
from tests.test_extending import files as files_of_extending
from tests.test_own_robot import files as files_of_own_robot

CONF = data_root() / "conf"
DOCS = Path(__file__).parents[1] / "docs"


def groups() -> list[str]:
    defaults = OmegaConf.to_container(OmegaConf.load(CONF / "train.yaml"))["defaults"]  # type: ignore[call-overload,index]
    return [str(group).removeprefix("optional ") for item in defaults if isinstance(item, dict) for group in item]


def choices() -> list[str]:
    found = []
    for group in groups():
        folder = CONF / ("randomization" if group == "rand" else group)
        names = [file.relative_to(folder).with_suffix("").as_posix() for file in sorted(folder.rglob("*.yaml"))]
        found += [f"{group}={name}" for name in names]
    return found


DEPARTURES_OF_THE_STUDY = (
    *("no_raised_weight", "no_close_kernels", "no_diagonal_load", "no_touchdown_speed", "no_widening", "no_latency"),
    "no_mirrored_samples",
)
"""Ablations of departures from the paper."""

OTHERS = {"none", "no_curriculum", "no_phases", "no_schedule", *DEPARTURES_OF_THE_STUDY}
ABLATIONS = [
    name for c in choices() if c.startswith("experiment=ablation/") and (name := c.split("/")[1]) not in OTHERS
]
NEEDS = {
    **{key: ["terrain=rough"] for key in ("curriculum=terrain_level", "curriculum=hard_start")},
    "estimator=decoder": ["critic=privileged"],
}


ELSEWHERE = ("experiment=ablation/", "experiment=minute_part/", "effect=")
"""Choices with tests of their own: below, and in tests/contracts/test_effects.py."""


@pytest.mark.parametrize("choice", [c for c in choices() if not c.startswith(ELSEWHERE)])
def test_every_file_composes_and_parses(choice: str, make_net: Callable[..., Path]) -> None:
    needs = [f"actuator.file={make_net()}"] if choice == "actuator=net" else NEEDS.get(choice, [])
    parse_train(compose("train", [choice, *needs]))


def test_every_group_has_a_folder_and_a_choice() -> None:
    assert {c.split("=")[0] for c in choices()} == {g for g in groups() if not g.startswith("override ")}


# ---------------------------------------------------------------------- overlays

REWARD_GROUPS = {
    "no_gait_shaping": ["feet_air_time", "gait", "air_time_variance", "foot_clearance"],
    "no_smoothness": ["action_smoothness", "joint_acceleration", "joint_velocity"],
    "no_effort": ["joint_torque", "foot_force"],
    "no_posture": ["base_motion", "base_orientation", "joint_deviation"],
    "no_contact": ["foot_slip", "foot_force", "thigh_contact", "calf_contact"],
    "no_limits": ["joint_position_limit", "joint_velocity_limit"],
}


def printed(table: str) -> dict[str, list[str]]:
    """Return the rows of one of the paper's tables: the cells behind a term's name, with ASCII signs."""
    section = (DOCS / "paper.md").read_text().replace("−", "-").split(f"## Table {table}: ")[1].split("\n\n|")[1]
    rows = [line.strip("| ").split(" | ") for line in section.split("\n\n")[0].splitlines()]
    return {match[1]: cells for name, *cells in rows if (match := re.search(r"\(`(\w+)`\)", name))}


def interval(cell: str) -> tuple[float, float]:
    """Return the two numbers of a cell such as ``Add (-0.5, 0.5)``."""
    low, high = re.findall(r"-?[\d.]+", cell)
    return float(low), float(high)


TABLE_1 = {term: interval(cells[0]) for term, cells in printed("I").items() if cells[0] != "text only"}
TABLE_2 = {term: (int(cells[0]), float(cells[-1])) for term, cells in printed("II").items()}
TABLE_3 = {term: float(cells[0]) for term, cells in printed("III").items()}
"""Term -> range; size and injected noise; weight."""


def flat(node: Any, path: str = "") -> dict[str, Any]:
    """Leaves of nested mappings by dotted path; an empty mapping has none."""
    if not isinstance(node, Mapping):
        return {path: node}
    return {k: v for key, child in node.items() for k, v in flat(child, f"{path}.{key}".strip(".")).items()}


def laid_over(base: Mapping[str, Any], experiment: str) -> dict[str, Any]:
    """Return the configuration ``base`` with the values of an experiment's own file, and of nothing else."""
    content = OmegaConf.to_container(OmegaConf.load(CONF / f"experiment/{experiment}.yaml"))
    changes = flat(content)
    return {k: v for k, v in base.items() if not k.startswith(tuple(f"{c}." for c in changes))} | changes


@cache
def default() -> dict[str, Any]:
    return flat(compose("train"))


def ablated(name: str, base: Mapping[str, Any]) -> dict[str, Any]:
    """What the configuration ``base`` is without what the ablation's name says."""
    if name in ("no_push", "no_rand"):
        gone = {"no_push": "event.", "no_rand": "rand."}[name]
        return {k: v for k, v in base.items() if not k.startswith(gone)}
    if name == "no_noise":
        return {k: 0.0 if k.endswith(".noise") and k != "eval.noise" else v for k, v in base.items()}
    if name.startswith("no_rand_"):
        return laid_over(base, f"ablation/{name}")
    terms = REWARD_GROUPS.get(name, [name.removeprefix("no_")])
    return {**base, **{f"reward.{term}.weight": 0.0 for term in terms}}


@pytest.mark.slow("conf/", "go1exp/sim/task.py", "go1exp/config/schema/", "go1exp/config/compose.py")
@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_changes_what_it_says_and_nothing_else(name: str) -> None:
    container = compose("train", [f"experiment=ablation/{name}"])
    parse_train(container)
    changed = flat(container)
    assert without_ramp(changed) == without_ramp(ablated(name, default()))
    assert changed != default()
    assert (changed.get("schedule.smooth", "kept") is None) == (name in ("no_action_smoothness", "no_smoothness"))


def without_ramp(values: dict[str, Any]) -> dict[str, Any]:
    """Without the ramp that would set the weight of action_smoothness."""
    return {key: value for key, value in values.items() if not key.startswith("schedule.smooth")}


def test_every_row_of_the_tables_has_its_ablation() -> None:
    singles = [f"no_{term}" for term in TABLE_3] + [f"no_rand_{term}" for term in TABLE_1]
    assert set(singles) | set(REWARD_GROUPS) | {"no_noise", "no_push", "no_rand"} == set(ABLATIONS)


def test_ablations_work_on_other_choices_too() -> None:
    other = ["reward=paper_literal", "rand=text"]
    expected = flat(compose("train", other))
    names = [name for name in ABLATIONS if name != "no_rand"]
    for name in names:
        expected = ablated(name, expected)
    every = ",".join(f"ablation/{name}" for name in names)
    container = compose("train", [*other, f"experiment=[{every}]"])
    parse_train(container)
    assert flat(container) == expected | {"schedule.smooth": None}  # a ramp that no other reward has


def test_an_ablation_works_on_the_papers_setting() -> None:
    base = flat(compose("train", ["experiment=paper"]))
    for name in ("no_gait", "no_push", "no_rand"):
        expected = ablated(name, base)
        assert flat(compose("train", [f"experiment=[paper,ablation/{name}]"])) == expected
        assert flat(compose("train", ["experiment=paper", f"+experiment/ablation={name}"])) == expected


def test_a_part_of_a_study_changes_what_its_file_says_and_nothing_else() -> None:
    """Each value that the part names is in force, whatever the experiment sets."""
    swept = OmegaConf.load(CONF / "study/walking_cpu.yaml").hydra.sweeper.params["+experiment/minute_part"]
    parts = {file.stem for file in (CONF / "experiment/minute_part").glob("*.yaml")}
    assert parts == set(swept.split(","))
    studies = {"minute": ("minute_part", parts), "study": ("ablation", {"none", *DEPARTURES_OF_THE_STUDY})}
    for study, (folder, names) in studies.items():
        base = flat(compose("train", [f"experiment={study}"]))
        for name in names:
            container = compose("train", [f"experiment={study}", f"+experiment/{folder}={name}"])
            parse_train(container)
            assert flat(container) == laid_over(base, f"{folder}/{name}"), name
            assert (flat(container) == base) == (name == "none"), name


def test_without_phases_or_a_schedule() -> None:
    literal = flat(compose("train", ["reward=paper_literal"]))
    task = compose("train", ["experiment=study", "+experiment/ablation=no_phases"])
    parse_train(task)
    seconds = {k: v for k, v in flat(task).items() if k.startswith("reward.gait_in_seconds.")}
    assert seconds.pop("reward.gait_in_seconds.term") == "gait"
    assert seconds == {k.replace(".gait.", ".gait_in_seconds."): v for k, v in literal.items() if ".gait." in k}
    assert flat(task)["reward.gait.weight"] == 0.0
    bare = compose("train", ["experiment=study", "+experiment/ablation=no_schedule"])
    parse_train(bare)
    assert not bare["schedule"]


def test_a_curriculum_is_taken_away() -> None:
    base = flat(compose("train", ["experiment=paper"]))
    without = flat(compose("train", ["experiment=[paper,ablation/no_curriculum]"]))
    assert without == {k: v for k, v in base.items() if not k.startswith("curriculum.")} != base
    for name in ("rough", "rough_climb"):
        assert not compose("train", [f"experiment={name}", "curriculum=none"])["curriculum"]


def test_the_study_has_24_parts_by_three_seeds() -> None:
    params = OmegaConf.to_container(OmegaConf.load(CONF / "study/ablations.yaml").hydra.sweeper.params)
    assert isinstance(params, dict)
    assert params["seed"] == "0,1,2"
    names = {name.strip() for name in params["+experiment/ablation"].split(",")}
    assert len(names) == 24
    assert {*REWARD_GROUPS, *OTHERS - {"no_curriculum"}, "no_rand", "no_push", "no_noise"} < names
    for name in names:  # a ramp may wait for a reward that the variant takes away
        preflight.check(parse_train(compose("train", [f"+experiment/ablation={name}"])))


def test_the_command_line_beats_an_experiment() -> None:
    values = flat(compose("train", ["experiment=ablation/no_gait", "reward.gait.weight=2.0"]))
    assert values["reward.gait.weight"] == 2.0
    assert compose("train", ["experiment=ablation/no_push", "event=push"])["event"]
    assert compose("train", ["experiment=paper", "ppo=cpu"])["ppo"] == compose("train")["ppo"]


def test_a_training_takes_its_own_physics_step_and_an_evaluation_that_of_the_task() -> None:
    def steps(*overrides: str) -> tuple[float, float]:
        config = parse_train(compose("train", list(overrides)))
        return trained_task(config).sim.physics_dt, config.task.sim.physics_dt

    assert steps() == (0.004, 0.002)
    assert steps("ppo.coarse_physics=1") == steps("ppo=warp") == (0.002, 0.002)
    assert steps("experiment=minute") == (0.01, 0.01)
    assert steps("sim.policy_dt=0.01") == (pytest.approx(0.01 / 3), 0.002)
    assert steps("sim.physics_dt=0.001") == (0.002, 0.001)
    assert steps("actuator=net_simulated", "actuator.period=exact") == (0.002, 0.002)  # a history of its own spacing


def test_the_default_is_the_papers_task_on_flat_ground() -> None:
    """But for the learner, shorter episodes, commands that grow to the paper's, latency and a hard floor."""
    paper = flat(compose("train", ["experiment=paper_flat"]))
    widening = default()
    for key in ("lin_vel_x", "lin_vel_y", "ang_vel_z", "hold_time"):
        assert widening[f"command.{key}"] == paper[f"command.{key}"]

    def others(values: dict[str, Any]) -> dict[str, Any]:
        return {
            k: v
            for k, v in values.items()
            if not k.startswith(("ppo.", "command.", "actuator.", "contact.", "sim.episode_s"))
        }

    assert others(paper) == others(widening)
    assert [widening[f"actuator.drive.{key}"] for key in ("term", "kp", "kd")] == ["pd", 20.0, 0.5]


def test_an_ablated_reward_is_not_computed(make_core: Callable[..., Go1Core]) -> None:
    metrics = make_core("experiment=ablation/no_limits", num_envs=1).drain_metrics(1)
    assert "reward/gait" in metrics
    assert not [key for key in metrics if key.endswith("_limit")]


@pytest.mark.parametrize("term", TABLE_1)
def test_a_neutral_range_equals_the_term_removed(term: str, make_core: Callable[..., Go1Core]) -> None:
    def rollout(*overrides: str) -> torch.Tensor:
        core = make_core("sim.episode_s=0.1", "actuator=pd", "contact=soft", *overrides, num_envs=2)
        seen = [core.reset(), core.backend.qpos.clone()]
        generator = torch.Generator().manual_seed(0)
        for _ in range(12):
            result = core.step(torch.randn(2, 12, generator=generator))
            seen += [result.observation.clone(), core.backend.qpos.clone()]
        return torch.cat(seen, dim=1)

    neutral = rollout(f"experiment=ablation/no_rand_{term}")
    torch.testing.assert_close(neutral, rollout(f"~rand.{term}"), rtol=0, atol=0)
    assert not torch.equal(neutral, rollout())


# ---------------------------------------------------------------------- the paper


@cache
def parsed(*overrides: str) -> TrainConfig:
    return parse_train(compose("train", overrides))


@pytest.fixture
def paper() -> TrainConfig:
    return parsed("experiment=paper")


def by_key(terms: tuple[Term, ...]) -> dict[str, Term]:
    return {term.key: term for term in terms}


def test_table_3_has_the_printed_rows_in_order_and_weights() -> None:
    terms = parsed("reward=paper_literal").task.reward
    assert [(term.key, term.slots["weight"]) for term in terms] == list(TABLE_3.items())


DEPARTURES = {"linear_velocity_error": 15.0}
"""Rows of Table III that have another weight in ``reward=paper``."""

ADDED = {"close_linear_velocity": 5.0, "close_angular_velocity": 10.0, "diagonal_load": 5.0, "touchdown_speed": -7.0}
"""Rows of ``reward=paper`` that are not in Table III."""


def test_the_reading_that_walks_departs_from_table_3_where_it_says_so() -> None:
    weights = {term.key: term.slots["weight"] for term in parsed("reward=paper").task.reward}
    assert [key for key in weights if key not in ADDED] == list(TABLE_3)
    assert weights == {**TABLE_3, **DEPARTURES, **ADDED}
    text = (data_root() / "conf/reward/paper.yaml").read_text(encoding="utf-8")
    lines = {line.split(":")[0]: line for line in text.splitlines() if line[:1].isalpha()}
    assert [key for key in (*DEPARTURES, *ADDED) if "#" not in lines[key]] == []


def test_table_3_has_the_printed_constants(paper: TrainConfig) -> None:
    terms, literal = by_key(paper.task.reward), by_key(parsed("reward=paper_literal").task.reward)
    assert terms["feet_air_time"].parameters["mode_time"] == 0.175
    assert literal["feet_air_time"].parameters["threshold"] == 0.175
    for choice in (terms, literal):
        assert choice["linear_velocity_error"].parameters["scale"] == 1.0
        assert choice["angular_velocity_error"].parameters["scale"] == 2.0
        assert choice["foot_clearance"].parameters["target_height"] == 0.08


def test_the_literal_table_uses_every_literal_term() -> None:
    used = {term.entry.name for term in parsed("reward=paper_literal").task.reward}
    assert {name for name in registry.members("reward") if name.endswith("_literal")} == used - set(TABLE_3)


def test_table_1_has_the_printed_ranges(paper: TrainConfig) -> None:
    terms = by_key(paper.task.rand)
    assert {key: term.parameters["range"] for key, term in terms.items()} == TABLE_1
    assert terms["foot_friction"].parameters["operation"] == "set"
    assert terms["joint_positions"].parameters["operation"] == "scale"


def test_table_2_has_the_printed_sizes_and_noise_in_order(paper: TrainConfig) -> None:
    rows = [(t.key, (t.entry.traits["size"], t.slots["noise"])) for t in paper.task.observation]
    assert rows == list(TABLE_2.items())
    assert sum(size for size, _ in TABLE_2.values()) == 48
    assert (len(TABLE_1), len(TABLE_3)) == (8, 19)


def test_section_2_commands_pushes_terrain_and_actions(paper: TrainConfig) -> None:
    task = paper.task
    velocities = {"lin_vel_x": (-2.0, 3.0), "lin_vel_y": (-1.5, 1.5), "ang_vel_z": (-1.5, 1.5)}
    fractions = {"standing_fraction": 0.1, "zero_fraction": 0.0, "slow_fraction": 0.0, "hard_share": 1.0}
    assert task.command.parameters == {**velocities, "hold_time": (0.3, 10.0), **fractions}
    (push,) = task.event
    assert (push.key, push.parameters) == ("push", {"interval": (10.0, 15.0), "velocity": (-1.0, 1.0)})
    assert task.terrain.kind == "tiles"
    assert min(task.terrain.boxes_proportion, task.terrain.bumps_proportion, task.terrain.ramps_proportion) > 0
    assert [term.key for term in task.curriculum] == ["terrain_level"]
    assert task.action.scale == 0.2
    assert (task.actuator.parameters["kp"], task.actuator.parameters["kd"]) == (20.0, 0.5)


def test_section_3_network_ppo_and_time_steps(paper: TrainConfig) -> None:
    ppo, sim = paper.ppo, paper.task.sim
    assert (ppo.num_envs, ppo.iterations) == (4096, 5000)
    assert (ppo.hidden, ppo.activation) == ((512, 256, 128), "elu")
    assert (ppo.schedule, ppo.learning_rate, ppo.desired_kl) == ("adaptive", 0.001, 0.01)
    assert (ppo.entropy, ppo.gamma, ppo.gae_lambda) == (0.0025, 0.99, 0.95)
    assert (sim.physics_dt, sim.policy_dt) == (0.002, 0.02)


def test_what_the_paper_leaves_out_is_isaac_labs(paper: TrainConfig) -> None:
    ppo = paper.ppo
    assert (ppo.steps, ppo.epochs, ppo.minibatches) == (24, 5, 4)
    assert (ppo.clip_range, ppo.value_coef, ppo.max_grad_norm, ppo.init_std) == (0.2, 0.5, 1.0, 1.0)
    assert ppo.learning_rate_range == (1e-5, 1e-2)
    assert paper.task.sim.episode_s == 20.0


def test_defaults_in_the_code_are_the_papers(paper: TrainConfig) -> None:
    """So that a term added by hand, as ``+reward.trot={weight: 10.0}``, is the paper's term."""
    task = paper.task
    terms = [*task.reward, *task.rand, *task.event, *task.termination, *task.curriculum, task.command, task.actuator]
    for term in terms:
        if term.key in {**ADDED, **DEPARTURES} or term.key != term.entry.name:
            continue
        for name, parameter in term.entry.parameters.items():
            assert parameter.default == term.parameters[name], f"{term.entry.name}.{name}"


# ---------------------------------------------------------------------- examples in the documentation


PAGES = [DOCS.parent / "README.md", *sorted(DOCS.glob("*.md"))]


def fences(language: str) -> list[str]:
    """Fenced blocks of that language in all pages."""
    text = "\n".join(page.read_text() for page in PAGES)
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [content for name, content in blocks if name == language]


COMMANDS = [
    line
    for block in fences("bash") + fences("")
    for line in block.splitlines()
    if re.match(r"go1exp [\w-]+( |$)", line) and " --" not in line
]
VERBS: dict[str, Any] = {verb: app_of(verb).settings for verb in EVERY if verb != "train"}
COMPLAINTS = [block for block in fences("console") if block.startswith("$ go1exp train ")]


def jobs(overrides: list[str]) -> list[list[str]]:
    """The overrides of each job of a multirun."""
    runs: list[list[str]] = [[]]
    with hydra_for("train"):
        parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
        for override in parser.parse_overrides(overrides):
            if override.is_sweep_override():
                ways = [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]
            else:
                ways = [override.input_line or ""]
            runs = [[*run, way] for run in runs for way in ways]
    return runs


def parse(verb: str, container: dict[str, Any]) -> None:
    """Raise if the verb would refuse its settings."""
    container = with_logs(begin(verb, container))
    if verb == "train":
        parse_train(container)
        return
    own = {f.name for f in fields(VERBS[verb])}
    checked: Any = parse_settings(VERBS[verb], {k: v for k, v in container.items() if k in own})
    others = container.keys() - own
    assert others <= {*RIG, *ROBOT_GROUPS, "engine", "excitation", "model", "protocol"}
    problems = parse_parts(container, tuple(others - {"excitation", "model", "protocol"}))[1]
    if "protocol" in others:
        chosen(container["protocol"])
    if "model" in others:
        parse_model(container["model"])
    if "excitation" in others:
        motions(container["excitation"])
    if verb == "record_import":
        assert checked.source in registry.members("importer")
    if verb == "list":
        helptext.APP.task(container)
    assert problems == []


@pytest.fixture
def beside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_net: Callable[..., Path]
) -> Iterator[Callable[[str], None]]:
    """Puts the files that a command names into the folder that it is typed in."""
    monkeypatch.chdir(tmp_path)

    def lay(command: str) -> None:
        for name in re.findall(r"[\w/]+\.(?:npz|yaml)", command):
            file = tmp_path / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(make_net().read_bytes() if file.suffix == ".npz" else b"coulomb: {bound: 0.3}")
        for name, text in {**files_of_extending(), **files_of_own_robot()}.items():
            if name in command:
                (tmp_path / name).write_text(text)

    yield lay
    plugins.begin([])


def test_the_pages_show_every_verb() -> None:
    shown = {" ".join(command.split()[1:3]) for command in COMMANDS}
    words = [*cli.VERBS, *(f"{verb} {sub}" for verb, subs in cli.SUBVERBS.items() for sub in subs)]
    missing = [word for word in words if not any(f"{s} ".startswith(f"{word} ") for s in shown)]
    assert missing == []


COMPOSED = (
    "README.md",
    "docs/",
    "conf/",
    "go1exp/cli/",
    "go1exp/config/compose.py",
    "go1exp/sim/task.py",
    "go1exp/config/schema/",
)


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(c, marks=[] if c in (data_root() / "README.md").read_text() else [pytest.mark.slow(*COMPOSED)])
        for c in dict.fromkeys(COMMANDS)
    ],
)
def test_commands_in_the_documentation_compose_and_parse(command: str, beside: Callable[[str], None]) -> None:
    beside(command)
    verb, *overrides = shlex.split(command, comments=True)[1:]
    if overrides[:1] and overrides[0] in cli.SUBVERBS.get(verb, ()):
        verb, overrides = f"{verb}_{overrides[0]}", overrides[1:]
    runs = [choices_from_files(cli._by_name(verb, overrides), verb)]
    if overrides[:1] == ["-m"]:
        runs = jobs(overrides[1:])
        assert len(runs) > 1 or runs[0][0].startswith("study=")  # values in the file
    for run in (runs[0], runs[-1]):
        parse(verb, compose(verb, run))


@pytest.mark.parametrize("block", COMPLAINTS)
def test_complaints_in_the_documentation_are_true(
    block: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    typed, *message = block.splitlines()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", shlex.split(typed)[1:])
    assert cli.main() == 2
    assert capsys.readouterr().err.splitlines() == message
