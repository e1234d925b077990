"""Bad input of every verb ends in one clean line and a status; paths may hold any letters, and hints can be copied."""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pyarrow.parquet
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from go1exp.base.wording import NOT_FOR_TRAINING
from go1exp.cli.hydra_main import choices_from_files
from go1exp.cli.places import remove_empty
from go1exp.cli.verbs import command, protected
from go1exp.config.choices import config_folder
from go1exp.config.compose import compose, compose_checked
from go1exp.config.schema.registry import ConfigError
from go1exp.gap.data.cutting import cut
from go1exp.gap.result import GapSettings
from go1exp.logs import recording
from go1exp.logs.recording import Recording, RecordingError
from go1exp.robot import JOINTS
from tests.command import refuse
from tests.made import meta

Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Types a command line in a folder of its own, in this process; gives the status and what was complained of."""
    monkeypatch.chdir(tmp_path)

    def type_in(*words: str) -> tuple[int, str]:
        done = refuse(tmp_path, *words)
        return done.returncode, done.stderr

    return type_in


def made(folder: Path, episode: str, rows: int, kp: float = 20.0) -> Path:
    """A recording of a suspended Go1 at 500 Hz."""
    about = meta(kp=(kp,) * len(JOINTS), kd=(0.5,) * len(JOINTS), episode=episode)
    t = np.arange(rows) / 500.0
    phases = {"q": 0.0, "qd": 1.6, "q_target": 0.4, "tau_est": 0.9}  # rad: a column may not repeat another
    wave = {f"{name}_{joint}": 0.1 * np.sin(9.0 * t + phase) for name, phase in phases.items() for joint in JOINTS}
    folder.mkdir(parents=True, exist_ok=True)
    recording.write(folder / f"{episode}.parquet", Recording(about, {"t": t, **wave}))
    return folder


def test_a_file_in_place_of_recordings_an_answer_or_options_is_called_one(run: Run, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("<xml>no key</xml>")
    status, err = run("gap", "logs=notes.txt")
    assert status == 2
    assert err.startswith("go1exp gap: notes.txt: not a whole Parquet file (")
    assert err.endswith("; a log of another format becomes a recording by go1exp record import\n")
    said = "notes.txt: is a file; out must be the folder of an answer, with verdict.json"
    assert run("gap", "report", "out=notes.txt") == (2, f"go1exp gap: {said}\n")
    (tmp_path / "verdict.json").write_text("{}")
    said = "verdict.json: not a result of go1exp gap (has no 'verdict'); run go1exp gap explain again"
    assert run("gap", "report", "out=.") == (2, f"go1exp gap: {said}\n")
    status, err = run("record", "import", "csv", "notes.txt", "options=notes.txt")
    assert (status, err.startswith("go1exp record import: options=notes.txt: must be a mapping")) == (2, True), err
    (tmp_path / "log.csv").write_text("t,q,qt\n" + "".join(f"{k / 100},0.1,0.2\n" for k in range(9)))
    options = "options={robot: arm, columns: {t: t, q_hip: q, q_target_hip: qt}}"
    status, err = run("record", "import", "csv", "log.csv", options, "out=notes.txt")
    assert (status, err) == (2, "go1exp record import: out = 'notes.txt': cannot be written to (File exists)\n")
    whole = (made(tmp_path / "whole", "a", 200) / "a.parquet").read_bytes()
    (tmp_path / "cut.parquet").write_bytes(whole[:-100])
    _, err = run("gap", "logs=cut.parquet")
    assert "not a whole Parquet file" in err
    assert "record import" not in err  # it was a recording


@pytest.mark.parametrize(
    ("rows", "settings", "said"),
    [
        (1000, {"window_s": 0.001}, "search.window_s = 0.001: a window must have two steps of the recordings, 0.004 s"),
        (1000, {"stride_s": 1e3}, "fits into these recordings with one in 1000 s (search.stride_s); record longer"),
        (45, {"window_s": 0.01}, "the longest recording has 45 rows; 53 are needed to tell the noise"),
    ],
)
def test_windows_that_do_not_fit_are_told_by_what_is_in_the_way(
    rows: int, settings: dict[str, float], said: str, tmp_path: Path
) -> None:
    log = recording.read(made(tmp_path, "a", rows) / "a.parquet")
    with pytest.raises(RecordingError, match=re.escape(said)):
        cut([log], GapSettings(**settings))  # type: ignore[arg-type]


LEADS_BACK = "an alias leads back to itself, or there are more than 100,000 values"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\xff\xfea: 1", "not UTF-8 (byte 0)"),
        (b"", "is empty; without any, use effect=none"),
        (b"# nothing but a remark\n", "is empty; without any, use effect=none"),
        (b"coulomb:\n  bound: [0.1\n  x: 2\n", "no YAML (line 3: expected ',' or ']', but got ':')"),
        (b"- coulomb\n", "must be a mapping, as the files of conf/effect are"),
        (b"5\n", "must be a mapping"),
        (b"a: " + b"{a: " * 3000 + b"1" + b"}" * 3000, "nests too deeply"),
        (b"coulomb: &a\n  bound: *a\n", LEADS_BACK),
        (b"a0: &a0 [1]\n" + b"".join(b"a%d: &a%d [*a%d,*a%d]\n" % (k + 1, k + 1, k, k) for k in range(40)), LEADS_BACK),
    ],
)
def test_an_effect_file_that_is_none_is_refused_by_name_and_line(
    content: bytes, said: str, run: Run, tmp_path: Path
) -> None:
    (tmp_path / "e.yaml").write_bytes(content)
    assert run("train", "effect=e.yaml") == (2, f"go1exp train: effect=e.yaml: {said}\n")
    assert [p.name for p in tmp_path.iterdir()] == ["e.yaml"]


def test_an_empty_model_is_not_told_to_be_none(run: Run, tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").touch()
    assert run("gap", "model=arm.yaml") == (2, "go1exp gap: model=arm.yaml: is empty; it must describe one\n")


def test_every_wrong_file_is_named_at_once(run: Run) -> None:
    status, text = run("train", "effect=[a.yaml,payload]", "reward=b.yaml")
    assert (status, text.splitlines()[1:]) == (2, ["  effect=a.yaml: no such file", "  reward=b.yaml: no such file"])


def test_a_file_that_says_none_is_none(tmp_path: Path, run: Run) -> None:
    (tmp_path / "mine.yaml").write_text((config_folder() / "effect/none.yaml").read_text())
    assert compose("train", choices_from_files(["effect=mine.yaml"], "train"))["effect"] == {}


def test_training_warns_of_a_file_that_is_not_for_it(tmp_path: Path, run: Run) -> None:
    (tmp_path / "compensating.yaml").write_text(f"# Makes up. {NOT_FOR_TRAINING}\ncoulomb:\n  bound: 0.1\n")
    with pytest.warns(UserWarning, match=r"effect=compensating\.yaml: not for training"):
        composed = compose("train", choices_from_files(["effect=compensating.yaml"], "train"))
    assert composed["effect"] == {"coulomb": {"bound": 0.1}}
    choices_from_files(["effect=compensating.yaml"], "record")  # may have it


def test_a_file_is_taken_though_a_shipped_choice_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``model=so101.yaml`` in a folder of one's own is that file, not the model of that name in conf/."""
    monkeypatch.chdir(tmp_path)
    mine = (config_folder() / "model/so101.yaml").read_text().replace("mjcf: ", "mjcf: elsewhere/")
    (tmp_path / "so101.yaml").write_text(mine)
    shipped = compose("gap", ["logs=x", "model=so101"])["model"]
    chosen = compose("gap", choices_from_files(["logs=x", "model=so101.yaml"], "gap"))["model"]
    assert chosen["mjcf"] == str(tmp_path / "elsewhere" / shipped["mjcf"])
    assert {**chosen, "mjcf": ""} == {**shipped, "mjcf": ""}


def test_two_files_whose_paths_differ_by_a_sign_are_two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a-b.yaml").write_text("coulomb: {bound: 0.1}\n")
    (tmp_path / "a_b.yaml").write_text("coulomb: {bound: 0.2}\n")
    both = [compose("train", choices_from_files([f"effect={name}.yaml"], "train")) for name in ("a-b", "a_b")]
    assert [c["effect"]["coulomb"]["bound"] for c in both] == [0.1, 0.2]


def test_a_users_own_choices_are_among_those_that_are_known(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine/reward").mkdir(parents=True)
    (tmp_path / "mine/reward/lively.yaml").write_text("gait: {weight: 1.0}\n")
    said = "go1exp train: reward=livly: unknown choice of reward 'livly'; did you mean 'lively'?\n"
    assert run("train", "--config-dir", "mine", "reward=livly") == (2, said)


@pytest.mark.parametrize("folder", ["rand", "randomization"])
def test_randomisations_of_ones_own_lie_in_either_folder(folder: str, tmp_path: Path) -> None:
    (tmp_path / folder).mkdir()
    (tmp_path / folder / "calm.yaml").write_text("link_mass: {range: [0.9, 1.1]}\n")
    assert list(compose("train", ["rand=calm"], [tmp_path])["rand"]) == ["link_mass"]


def test_gap_leaves_out_recordings_that_are_too_short(run: Run, tmp_path: Path) -> None:
    made(tmp_path / "logs", "three", rows=3)
    for stage in ("all", "check", "replay"):
        assert run("gap", stage, "logs=logs") == (14, "go1exp gap: none of these recordings can be compared\n")


def test_of_several_sets_of_gains_a_fit_takes_the_one_that_is_chosen_or_says_which_there_are(
    run: Run, tmp_path: Path
) -> None:
    for kp in (20.0, 35.0):
        for k in range(4):
            made(tmp_path / "logs", f"kp{kp:g}_{k}", rows=60, kp=kp)
    status, text = run("fit-actuator", "recordings=logs", "out=nets/mine")
    assert status == 1
    assert "kp 20, kd 0.5 (4), kp 35, kd 0.5 (4); choose one, as gains=[20,0.5]" in text
    said = "go1exp fit-actuator: gains = [35,1]: no recording was made with these; there are [20,0.5], [35,0.5]\n"
    assert run("fit-actuator", "recordings=logs", "gains=[35,1]", "out=nets/mine") == (2, said)
    assert not (tmp_path / "nets").exists()
    small = ("hidden=[4]", "epochs=1", "half_net=false", "plots=false", "share=all")
    status, text = run("fit-actuator", "recordings=logs", "gains=[35,0.5]", "out=nets/mine", *small)
    assert status == 0, text
    from go1exp.sim.actuator.actuator_net import load

    assert load(tmp_path / "nets/mine/net.npz").info.kp == (35.0,) * len(JOINTS)


def test_only_empty_folders_are_taken_away(tmp_path: Path) -> None:
    (tmp_path / "a/b/c").mkdir(parents=True)
    (tmp_path / "a/kept").touch()
    remove_empty(tmp_path / "a/b/c")
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["kept"]


# ---------------------------------------------------------------------- paths

NAMES = (
    *("a b", "a=b", "it's", "a#b", "é", "(x)", "1_000", "2026", "$x"),
    *("a{b", "a&b", "a;b", "a!b", "a\\", "x(1)/y", "~/x"),
)


@pytest.mark.parametrize("name", NAMES)
def test_hydra_takes_a_path_as_it_is(name: str) -> None:
    for key in ("run", "out", "actuator.file", "+logs", "options", "columns", "folder", "motion", "feet", "plugins"):
        assert OverridesParser.create().parse_override(protected(f"{key}={name}")).value() == name


MEANT = (
    *("run=null", "run=a,b", "run='a b'", "files=[a,b]", "out=${x}", "seed=1 2"),
    *("run=glob(*)", "options={a: 1}", "command=gentle"),
)


@pytest.mark.parametrize("text", MEANT)
def test_what_is_meant_for_hydra_stays(text: str) -> None:
    assert protected(text) == text


def test_a_file_of_commands_may_be_called_anything() -> None:
    assert OverridesParser.create().parse_override(protected("command=lä/a b.csv")).value() == "lä/a b.csv"


@pytest.mark.parametrize("name", NAMES)
def test_a_hint_can_be_copied(name: str) -> None:
    program, verb, key_value = shlex.split(command("eval", settings={"run": Path("runs") / name}))
    assert (program, verb) == ("go1exp", "eval")
    assert OverridesParser.create().parse_override(protected(key_value)).value() == str(Path("runs") / name)
    assert command("eval", settings={"run": "runs/a b"}) == "go1exp eval run='runs/a b'"


def test_a_run_folder_may_be_called_anything(run: Run, tmp_path: Path) -> None:
    status, text = run("eval", "run=runs/my walk = é")
    assert (status, text.split("run = ")[1].split(":")[0]) == (2, "'runs/my walk = é'")


@pytest.mark.parametrize("given", ["effect={}", "effect=[{},payload]", "+effect={}"])
def test_an_effect_file_may_be_called_anything(given: str, tmp_path: Path) -> None:
    file = tmp_path / "é = it.yaml"
    file.write_text("coulomb: {bound: 0.3}\n")
    chosen = choices_from_files([given.format(file).replace("+", "")], "train")
    assert compose("train", chosen)["effect"]["coulomb"] == {"bound": 0.3}


def test_a_package_that_is_missing_is_named_once(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "optuna" else found(name, *rest)
    )
    said = "go1exp tune: needs the package optuna: pip install 'go1exp[tune]'\n"
    assert run("tune", 'space=["ppo.gamma=interval(0.9,0.95)"]') == (2, said)


@pytest.mark.parametrize("name", ["1", "1e5", "nan", "null", "true"])
def test_a_file_whose_name_is_a_value_to_hydra_is_taken(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(f"{name}.yaml").write_text("coulomb: {bound: 0.3}\n")
    for given in (f"effect={name}.yaml", f"effect=[{name}.yaml,payload]"):
        assert compose("train", choices_from_files([given], "train"))["effect"]["coulomb"] == {"bound": 0.3}


# ---------------------------------------------------------------------- Python


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (
            "observation.joint_position.history=5",
            "no such key 'observation.joint_position.history'; did you mean 'observation.joint_position.noise' or "
            "'observation.joint_position' or 'observation.joint_velocity'? A parameter of a term that its file leaves "
            "out takes a plus: '+observation.joint_position.history=5'",
        ),
        ("reward.foot_slip.wieght=-1", "no such key 'reward.foot_slip.wieght'; did you mean 'reward.foot_slip.weight'"),
        ("+seed=3", "+seed=3: 'seed' exists already; leave out the plus: 'seed=3'"),
        ("+reward.gait.weight=3", "'reward.gait.weight' exists already; leave out the plus: 'reward.gait.weight=3'"),
        ("terrain=hilly", "terrain=hilly: unknown choice of terrain 'hilly'; known: flat, rough, steps"),
    ],
)
def test_the_environment_refuses_overrides_in_the_words_of_the_command_line(override: str, said: str) -> None:
    import go1exp.sim.gym  # noqa: F401  (registers the environment)

    with pytest.raises(ConfigError, match=re.escape(said)):
        gymnasium.make("Go1-v0", overrides=[override])
    with pytest.raises(ConfigError, match=re.escape(said)):
        compose_checked("train", [override])


@pytest.mark.parametrize("given", ["effect=[coulomb,payload,coulomb]", "effect=[a.yaml, a.yaml]"])
def test_a_choice_that_is_there_twice_is_refused(given: str) -> None:
    with pytest.raises(ConfigError, match=r"(coulomb|a\.yaml) is chosen twice"):
        choices_from_files([given], "train")
    assert choices_from_files(["effect=[coulomb,payload]", "ppo.hidden=[64,64]"], "train")


def test_a_wrong_value_that_is_long_is_not_printed_whole(tmp_path: Path) -> None:
    file = tmp_path / "long.parquet"
    table = pyarrow.table({"t": [0.0]}).replace_schema_metadata({"go1exp": "x" * 50_000})
    pyarrow.parquet.write_table(table, file)
    with pytest.raises(RecordingError, match="metadata") as wrong:
        recording.read(file)
    assert len(str(wrong.value)) < 1000
