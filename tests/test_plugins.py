"""Terms of the user: files and packages that are loaded, refused in a line, kept by a run folder and there again."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch
from omegaconf import OmegaConf

from go1exp.cli import main
from go1exp.config.compose import compose
from go1exp.config.schema import plugins, registry
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.export.graph import ExportError, required_inputs
from go1exp.deploy.sim_robot.__main__ import bundle_task
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import parse_task, parse_train
from go1exp.train import checkpoint, policy, run_folder, trainer
from go1exp.train.policy import load_run
from tests.small_run import SMALL

LAZY = '''
from go1exp.extend import Positive, Snapshot, reward

@reward("lazy")
def lazy(s: Snapshot, *, scale: Positive = 2.0):
    """Square of the action."""
    return scale * s.action.square().sum(-1)
'''

REMEMBERING = '''
from go1exp.extend import Memory, Positive, Snapshot, TermSetup, observation, reward, termination

class Average(Memory):
    memory = ("mean", "calls")

    def __init__(self, setup, *, time: Positive = 0.1):
        self._share = min(setup.dt / time, 1.0)
        self.mean, self.calls = setup.zeros(), setup.zeros()

    def reset(self, mask):
        self.mean.masked_fill_(mask, 0.0)
        self.calls.masked_fill_(mask, 0.0)

    def take(self, s):
        self.mean += self._share * (s.joint_vel.square().sum(-1) - self.mean)
        self.calls += 1

@reward("slow_power")
class SlowPower(Average):
    """Mean over a time."""

    def __call__(self, s):
        self.take(s)
        return self.mean

@termination("wild")
class Wild(Average):
    """Fast for a time."""

    def __call__(self, s):
        self.take(s)
        return self.mean > 1e9

@observation("memory_of_speed", size=2)
class MemoryOfSpeed(Average):
    """What was."""

    def advance(self, s):
        self.take(s)

    def __call__(self, s):
        import torch
        return torch.stack([self.mean, self.calls], -1)
'''

ALL_THREE = (
    "+reward.slow_power.weight=-0.001",
    "+termination.wild={}",
    "+observation.memory_of_speed={}",
    "sim.episode_s=0.1",
    "backend.threads=1",
)


@pytest.fixture(autouse=True)
def nothing_left(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Work in an empty folder and leave the registry as it was."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(plugins.VARIABLE, raising=False)
    yield
    monkeypatch.delenv(plugins.VARIABLE, raising=False)
    plugins.begin([])


def go1exp(*arguments: str) -> int:
    before, sys.argv = sys.argv, ["go1exp", *arguments]
    try:
        return main()
    finally:
        sys.argv = before


def write(name: str, text: str) -> str:
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return name


def refusal(*names: str) -> str:
    with pytest.raises(ConfigError) as error:
        plugins.use(names)
    assert len(error.value.problems) == 1, error.value.problems
    return error.value.problems[0]


# ---------------------------------------------------------------------- loading


def test_a_file_of_terms_is_there_for_the_configuration_that_names_it_and_for_no_other() -> None:
    write("my_terms.py", LAZY)
    for named in ("[my_terms.py]", "my_terms.py"):  # one needs no list
        task = parse_task(compose("train", [f"plugins={named}", "+reward.lazy.weight=-1"]))
        assert task.reward[-1].entry.name == "lazy"
    with pytest.raises(ConfigError, match=r"reward\.lazy: unknown reward term 'lazy'"):
        parse_task(compose("train", ["+reward.lazy.weight=-1"]))


def test_a_file_named_twice_is_loaded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    write("my_terms.py", LAZY + "\nimport sys\nsys.loaded = getattr(sys, 'loaded', 0) + 1\n")
    monkeypatch.setattr(sys, "loaded", 0, raising=False)
    monkeypatch.setenv(plugins.VARIABLE, "my_terms.py")
    for _ in range(2):
        plugins.use(["my_terms.py", "./my_terms.py", str(Path("my_terms.py").resolve())])
    assert sys.loaded == 1  # type: ignore[attr-defined]
    assert not Path("__pycache__").exists()


def test_a_file_that_has_changed_is_loaded_anew() -> None:
    write("my_terms.py", LAZY)
    plugins.use(["my_terms.py"])
    write("my_terms.py", LAZY.replace("2.0", "3.0"))
    plugins.use(["my_terms.py"])
    assert registry.members("reward")["lazy"].parameters["scale"].default == 3.0


def test_plugins_of_a_session_stay_in_force_until_the_next_command() -> None:
    write("my_terms.py", LAZY)
    (plugin,) = plugins.load("my_terms.py")
    assert [(e.group, e.name) for e in plugin.entries] == [("reward", "lazy")]
    parse_task(compose("train", ["+reward.lazy.weight=-1"]))
    plugins.begin()
    with pytest.raises(ConfigError):
        parse_task(compose("train", ["+reward.lazy.weight=-1"]))


def test_a_package_is_imported_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    write("lab_terms/__init__.py", "from lab_terms import rewards\n")
    write("lab_terms/rewards.py", LAZY.replace("lazy", "lab_lazy"))
    monkeypatch.syspath_prepend(str(Path.cwd()))
    for _ in range(2):
        (plugin,) = plugins.use(["lab_terms"])
        assert [e.name for e in plugin.entries] == ["lab_lazy"]
        plugins.use([])
        assert "lab_lazy" not in registry.members("reward")


def test_an_installed_package_is_searched_when_a_term_is_wanted_that_nobody_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write("lab_entry.py", LAZY.replace("lazy", "offered"))
    monkeypatch.syspath_prepend(str(Path.cwd()))
    point = importlib.metadata.EntryPoint("lab", "lab_entry", plugins.GROUP)
    asked = []

    def entry_points(*, group: str) -> list[Any]:
        asked.append(group)
        return [point]

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    monkeypatch.setattr(plugins, "_installed", None)
    try:
        parse_task(compose("train"))
        assert asked == []
        task = parse_task(compose("train", ["+reward.offered.weight=-1"]))
        assert asked == [plugins.GROUP]
        assert plugins.origin(task.reward[-1].entry) == "lab_entry"
        assert plugins.origin(task.reward[0].entry) is None
    finally:
        for plugin in plugins.installed():
            for entry in plugin.entries:
                registry.remove(entry)
        plugins._loaded.pop("lab_entry", None)


def test_gymnasium_takes_plugins_among_its_overrides() -> None:
    write("my_terms.py", LAZY)
    overrides = ["plugins=[my_terms.py]", "+reward.lazy.weight=-1", "backend.threads=1"]
    env = gymnasium.make("go1exp.sim.gym:Go1-v0", overrides=overrides)
    env.reset(seed=0)
    *_, info = env.step(env.action_space.sample() * 0.01)
    assert info["reward_terms"]["lazy"] < 0.0
    env.close()


def test_the_users_own_yaml_groups_may_use_their_terms(capsys: pytest.CaptureFixture[str]) -> None:
    write("my_terms.py", LAZY)
    write("mine/reward/calm.yaml", "defaults: [paper]\nlazy: {weight: -1.0, scale: 3.0}\n")
    write(
        "mine/experiment/calm.yaml",
        "# @package _global_\ndefaults:\n  - override /reward: calm\nplugins: [my_terms.py]\n",
    )
    overrides = [*SMALL, "experiment=calm", "hydra.run.dir=run", "ppo.iterations=1"]
    assert go1exp("train", "--config-dir", "mine", *overrides) == 0, capsys.readouterr().err
    config = OmegaConf.load("run/config.yaml")
    assert config.reward.lazy == {"weight": -1.0, "scale": 3.0}
    assert Path("run/plugins/my_terms.py").read_text() == LAZY


# ---------------------------------------------------------------------- refusals


def test_a_name_that_exists_already_is_refused_naming_both_places() -> None:
    line = LAZY.splitlines().index('@reward("lazy")') + 1
    write("my_terms.py", LAZY.replace("lazy", "gait"))
    text = refusal("my_terms.py")
    assert text.startswith("plugins: reward term 'gait' of ")
    assert f"my_terms.py:{line} exists already, in " in text
    assert "mdp/rewards.py:" in text
    write("a.py", LAZY)
    write("b.py", LAZY + "\n# another file\n")
    text = refusal("a.py", "b.py")
    assert f"b.py:{line} exists already" in text
    assert f"a.py:{line};" in text


def test_two_configurations_of_one_process_may_have_different_terms_of_one_name() -> None:
    """As the jobs of a sweep, or two run folders that are compared."""
    write("a.py", LAZY)
    write("b.py", LAZY.replace("2.0", "3.0"))
    for _ in range(2):
        for name, default in (("a.py", 2.0), ("b.py", 3.0)):
            plugins.use([name])
            assert registry.members("reward")["lazy"].parameters["scale"].default == default


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("\n\nx = 1 / 0\n", 3, "ZeroDivisionError: division by zero"),
        ("\nfrom go1exp.extend import reward\n\nreward('a'\n", 4, "SyntaxError: '(' was never closed"),
        ("import no_such_thing\n", 1, "ModuleNotFoundError: No module named 'no_such_thing'"),
        ("def f():\n    raise ValueError('one\\ntwo')\nf()\n", 2, "ValueError: one"),
        ("raise SystemExit\n", 1, "SystemExit: without a message"),
    ],
)
def test_a_file_that_fails_is_one_line_with_file_line_and_error(text: str, line: int, what: str) -> None:
    write("my_terms.py", LAZY + text)
    offset = len(LAZY.splitlines())
    expected = f"plugins: {Path('my_terms.py').resolve()}:{offset + line}: {what}"
    assert refusal("my_terms.py") == expected
    assert "lazy" not in registry.members("reward")
    assert refusal("my_terms.py") == expected


def test_a_file_that_is_no_text_is_named() -> None:
    write("my_terms.py", "\0")
    assert refusal("my_terms.py").startswith(f"plugins: {Path('my_terms.py').resolve()}: SyntaxError: source code")


def test_what_is_not_there_or_registers_nothing_is_refused() -> None:
    assert refusal("nowhere.py") == "plugins: nowhere.py: no such file"
    assert refusal("no_such_package") == "plugins: no_such_package: no such package is installed"
    write("my_terms.py", "x = 1\n")
    assert refusal("my_terms") == "plugins: my_terms: no such package; did you mean my_terms.py?"
    assert refusal("my_terms.py").startswith("plugins: my_terms.py: registers no term; decorate one, such as @reward")
    write("folder/a.py", LAZY)
    assert "is a folder" in refusal("./folder")
    with pytest.raises(ConfigError, match=r"plugins = 3: must be a list of files and packages"):
        parse_train(compose("train", ["plugins=3"]))


def test_the_command_line_refuses_in_a_line_and_leaves_no_folder(capsys: pytest.CaptureFixture[str]) -> None:
    write("my_terms.py", "x = 1 / 0\n")
    for verb in ("train", "list", "eval", "record", "bench", "gap", "export", "play", "fit-actuator"):
        assert go1exp(verb, "plugins=[my_terms.py]") == 2, verb
        error = capsys.readouterr().err
        assert (
            error == f"go1exp {verb}: plugins: {Path('my_terms.py').resolve()}:1: ZeroDivisionError: division by zero\n"
        )
    assert [path.name for path in Path.cwd().rglob("*.*")] == ["my_terms.py"]


def test_list_shows_a_term_and_its_plugin(capsys: pytest.CaptureFixture[str]) -> None:
    write("my_terms.py", LAZY)
    assert go1exp("list", "reward", "plugins=[my_terms.py]") == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split() == ["lazy", "Square", "of", "the", "action.", "[my_terms.py]"] for line in lines)
    assert not any("[" in line.split("  ")[-1] for line in lines if line.strip().startswith("gait "))


# ---------------------------------------------------------------------- terms that remember


def remembering(num_envs: int = 3, **options: Any) -> Go1Core:
    write("memory.py", REMEMBERING)
    return Go1Core(parse_task(compose("train", ["plugins=[memory.py]", *ALL_THREE])), num_envs, seed=3, **options)


def test_terms_that_remember_are_called_once_a_step_and_forget_where_an_episode_begins() -> None:
    core = remembering()
    first = core.reset().clone()
    assert not first[:, -2:].any()
    parts = core.terms.parts()
    assert list(parts) == ["reward.gait", "reward.slow_power", "termination.wild", "observation.memory_of_speed"]
    core.terms.frames.noise.zero_()
    for step in range(1, 8):
        result = core.step(torch.full((3, 12), 0.5 * (-1) ** step))
        final, observed = result.final_observation[:, -1], result.observation[:, -1]
        assert final.tolist() == [float(1 + (step - 1) % 5)] * 3  # an episode has five steps
        assert observed.tolist() == [float(step % 5)] * 3
        for name in set(parts) - {"reward.gait"}:  # which counts nothing
            assert parts[name].calls.tolist() == observed.tolist()


def test_an_observation_that_remembers_cannot_be_exported_and_that_is_said() -> None:
    core = remembering()
    with pytest.raises(ExportError, match=r"observation\.memory_of_speed: has a memory"):
        required_inputs(core.task.observation)


# ---------------------------------------------------------------------- run folders


def train(run: Path, *overrides: str, iterations: int = 2) -> Any:
    container = compose("train", [*SMALL, *overrides, f"ppo.iterations={iterations}"])
    config = parse_train(run_folder.with_kept_plugins(run, container))
    run_folder.write(run, container)
    return trainer.train(config, container, run)


MINE = ("plugins=[my_terms.py]", "+reward.lazy.weight=-1", "+reward.slow_power.weight=-0.001")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with terms of its own, whose file is no longer where it was."""
    folder = tmp_path_factory.mktemp("own")
    before = Path.cwd()
    os.chdir(folder)
    try:
        write("my_terms.py", LAZY + REMEMBERING)
        train(folder / "run", *MINE)
        Path("my_terms.py").unlink()
    finally:
        os.chdir(before)
    return folder / "run"


def test_a_run_folder_keeps_the_file_and_its_hash(trained: Path) -> None:
    (record,) = json.loads((trained / "meta.json").read_text())["plugins"]
    copy = trained / "plugins/my_terms.py"
    assert copy.read_text() == LAZY + REMEMBERING
    assert record == {
        "name": "my_terms.py",
        "file": "plugins/my_terms.py",
        "sha256": plugins.sha256(copy),
        "terms": ["reward.lazy", "reward.slow_power"],
    }
    assert not list(trained.rglob("__pycache__"))


def test_a_run_is_read_with_its_copy_even_where_another_file_has_that_name(
    trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("my_terms.py", LAZY.replace("2.0", "7.0"))
    monkeypatch.setenv(plugins.VARIABLE, "my_terms.py")
    config, _, _ = load_run(trained)
    assert {t.key: t.parameters.get("scale") for t in config.task.reward}["lazy"] == 2.0
    assert parse_task(compose("train", ["+reward.lazy.weight=-1"])).reward[-1].parameters["scale"] == 7.0


def test_eval_export_and_the_simulated_robot_get_along_with_the_terms_of_a_run(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = ["episodes=1", "seconds=0.1", "settle_s=0.0", "out=eval.json"]
    assert go1exp("eval", f"run={trained}", *short) == 0, capsys.readouterr().err
    assert go1exp("export", f"run={trained}", "seconds=0.1", "out=bundle.zip") == 0, capsys.readouterr().err
    plugins.begin([])
    assert bundle_task("bundle.zip", {}).actuator.entry.name == "pd"


def test_a_resumed_run_has_its_own_terms_and_continues_bit_for_bit(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    halves, through = tmp_path / "halves", tmp_path / "through"
    shutil.copytree(trained, halves)
    written = (halves / "config.yaml").read_text()
    assert go1exp("train", f"resume={halves}", "ppo.iterations=4") == 0, capsys.readouterr().err
    assert OmegaConf.load(halves / "config.yaml").plugins == ["my_terms.py"] == OmegaConf.create(written).plugins
    (record,) = json.loads((halves / "meta.json").read_text())["plugins"]
    assert record["name"] == "my_terms.py"
    write("my_terms.py", LAZY + REMEMBERING)
    train(through, *MINE, iterations=4)
    a, b = (checkpoint.load_latest(run)[0] for run in (halves, through))
    assert set(a["env"]) == set(b["env"]) >= {"reward.slow_power"}
    for name, value in a["env"]["reward.slow_power"].items():
        assert torch.equal(value, b["env"]["reward.slow_power"][name]), name
    assert all(torch.equal(v, b["policy"][k]) for k, v in a["policy"].items())


def test_a_new_run_starts_from_one_with_other_terms_of_the_same_name(trained: Path) -> None:
    write("my_terms.py", LAZY.replace("2.0", "7.0"))
    config = parse_train(compose("train", [*SMALL, "plugins=[my_terms.py]", "+reward.lazy.weight=-1"]))
    policy.read_weights(config, trained)
    assert registry.members("reward")["lazy"].parameters["scale"].default == 7.0


def test_a_run_folder_takes_no_second_run_whose_plugin_has_changed(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "copy"
    shutil.copytree(trained, run)
    write("my_terms.py", LAZY + REMEMBERING + "\n# changed\n")
    assert go1exp("train", *SMALL, *MINE, "ppo.iterations=2", f"hydra.run.dir={run}") == 2
    assert "other settings of plugins (my_terms.py has changed)" in capsys.readouterr().err


def test_what_a_run_folder_lacks_is_said_in_a_line(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "copy"
    shutil.copytree(trained, run)
    copy = run / "plugins/my_terms.py"
    copy.write_text(LAZY)
    assert go1exp("eval", f"run={run}") == 2
    assert f"{copy}: is not the file that the run was trained with" in capsys.readouterr().err
    copy.unlink()
    for arguments in (["eval", f"run={run}"], ["export", f"run={run}"], ["train", f"resume={run}"]):
        assert go1exp(*arguments) == 2
        error = capsys.readouterr().err
        assert f"{copy}: missing; the run was trained with this plugin (it has reward.lazy, reward.slow_power)" in error
        assert len(error.splitlines()) == 1


def test_a_package_is_noted_with_its_version_and_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    write("lab_kept/__init__.py", LAZY.replace("lazy", "kept") + "__version__ = '1.2'\n")
    monkeypatch.syspath_prepend(str(Path.cwd()))
    container = compose("train", [*SMALL, "plugins=[lab_kept]", "+reward.kept.weight=-1"])
    run_folder.write(Path("run"), container)
    (record,) = json.loads(Path("run/meta.json").read_text())["plugins"]
    assert record == {"name": "lab_kept", "version": "1.2", "commit": None, "terms": ["reward.kept"]}
    parse_train(run_folder.read_config(Path("run")))
    monkeypatch.setattr(sys.modules["lab_kept"], "__version__", "1.3")
    with pytest.warns(UserWarning, match=r"run: was trained with lab_kept 1\.2, here it is 1\.3"):
        run_folder.read_config(Path("run"))
    shutil.rmtree("lab_kept")
    plugins.begin([])
    del sys.modules["lab_kept"]
    with pytest.raises(ConfigError, match=r"run: was trained with package lab_kept 1\.2 .*not installed"):
        run_folder.read_config(Path("run"))


def test_terms_that_came_from_the_environment_variable_are_kept_if_they_are_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write("my_terms.py", LAZY)
    write("others.py", LAZY.replace("lazy", "lazier"))
    monkeypatch.setenv(plugins.VARIABLE, os.pathsep.join(["my_terms.py", "others.py"]))
    run_folder.write(Path("run"), compose("train", ["+reward.lazy.weight=-1"]))
    assert [p.name for p in Path("run/plugins").iterdir()] == ["my_terms.py"]
    monkeypatch.delenv(plugins.VARIABLE)
    assert parse_train(run_folder.read_config(Path("run"))).task.reward[-1].key == "lazy"


def test_two_files_of_one_name_are_both_kept() -> None:
    write("a/terms.py", LAZY)
    write("b/terms.py", LAZY.replace("lazy", "lazier"))
    container = compose(
        "train", ["plugins=[a/terms.py,b/terms.py]", "+reward.lazy.weight=-1", "+reward.lazier.weight=-1"]
    )
    run_folder.write(Path("run"), container)
    assert len(list(Path("run/plugins").iterdir())) == 2
    assert len(parse_train(run_folder.read_config(Path("run"))).task.reward) == len(container["reward"])


WRITES = {
    "s.joint_pos.clamp_(-9.0, 9.0)": "joint_pos of the Snapshot",  # even where it changes no value
    "s.command.numpy()[:, 1] = 7.0": "command of the Snapshot",
    "s.joint_vel.data[:] = 7.0": "joint_vel of the Snapshot",
}


def first_step(*overrides: str, **groups: Any) -> None:
    container = compose("train", ["plugins=[my_terms.py]", *overrides, "backend.threads=1"])
    core = Go1Core(parse_task(container | groups), 2)
    core.reset()
    core.step(torch.zeros(2, 12))


@pytest.mark.parametrize("line", WRITES)
@pytest.mark.parametrize("group", ["reward", "termination", "observation"])
def test_a_term_that_writes_into_the_snapshot_is_named_with_its_plugin_at_the_first_step(group: str, line: str) -> None:
    shaped = {"reward": "[:, 0]", "termination": "[:, 0] > 9", "observation": ""}[group]
    size = ", size=12" if group == "observation" else ""
    write(
        "my_terms.py",
        f'from go1exp.extend import {group}\n\n\n@{group}("marks"{size})\ndef marks(s):\n'
        f'    """Writes."""\n    {line}\n    return s.joint_pos{shaped}\n',
    )
    with pytest.raises(ConfigError, match=rf"^{group}\.marks \(my_terms\.py\): writes into {WRITES[line]}"):
        first_step("+reward.marks.weight=1" if group == "reward" else f"+{group}.marks={{}}")


ADVANCES = """
from go1exp.extend import Memory, command, curriculum, event, observation


@observation("marks", size=12)
class Marks(Memory):
    \"""Writes while it advances.\"""

    def __init__(self, setup):
        pass

    def reset(self, mask):
        pass

    def advance(self, s):
        s.joint_pos[:, 0] = 0.0

    def __call__(self, s):
        return s.joint_pos.clone()


@command("marks")
class Held(Memory):
    \"""Writes into what begins anew.\"""

    def __init__(self, stream):
        self.value = stream.uniform(3)

    def advance(self, dt, restart):
        restart |= True


@event("marks")
class Pushes(Held):
    \"""Writes into what begins anew.\"""

    def advance(self, state, dt, restart):
        restart.fill_(False)


@curriculum("marks")
class Levels:
    \"""Writes into the levels of all robots.\"""

    def __call__(self, level, distance, commanded_distance, tile_size, max_level, random_level):
        return level.add_(1)
"""


@pytest.mark.parametrize(
    ("overrides", "groups", "named"),
    [
        (["+observation.marks={}"], {}, r"observation\.marks .*: writes into joint_pos of the Snapshot"),
        ([], {"command": {"term": "marks"}}, r"command\S* .*: writes into restart"),
        (["+event.marks={}"], {}, r"event\.marks .*: writes into restart"),
        (["terrain=rough"], {"curriculum": {"marks": {}}}, r"curriculum\.marks .*: writes into level"),
    ],
)
def test_what_a_plugin_is_given_to_read_is_not_written_into(
    overrides: list[str], groups: dict[str, Any], named: str
) -> None:
    write("my_terms.py", ADVANCES)
    with pytest.raises(ConfigError, match=f"^{named}; clone what is to change"):
        first_step(*overrides, **groups)
