"""The command line: refusals that say what is meant, before anything is loaded; help, completion, and every verb."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from go1exp.base.paths import data_root
from go1exp.cli import EVERY, ONE_BLAS_THREAD, SUBVERBS, VERBS, _by_name, main
from go1exp.cli.app import begin
from go1exp.cli.helptext import leaves
from go1exp.cli.hydra_main import choices_from_files
from go1exp.cli.play import APP as PLAY
from go1exp.cli.verbs import parted
from go1exp.config.compose import compose
from go1exp.config.schema import registry
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.env.camera import RenderingUnavailable, choose_gl
from go1exp.train import run_folder
from tests.command import WITH_MODULES, refuse, run_alone
from tests.command import run as cli
from tests.small_run import small, trained

SMALL = small("ppo=paper")
HEAVY = {"mujoco", "stable_baselines3", "gymnasium", "torch.nn", "wandb", "tensorboard", "matplotlib", "scipy.stats"}


def assert_refused(tmp_path: Path, arguments: list[str], *said: str) -> None:
    """Status 2, one message with everything of ``said``, nothing left behind."""
    here = tmp_path / "here"
    here.mkdir()
    done = refuse(here, *arguments)
    first, *others = done.stderr.splitlines()
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert re.match(r"go1exp( [\w-]+){0,2}: ", first)
    assert all(line.startswith("  ") for line in others), done.stderr
    assert not [text for text in said if text not in done.stderr], done.stderr
    assert done.stdout == ""
    assert [p for p in here.rglob("*") if p != here / "runs"] == []


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two tiny iterations."""
    return trained(tmp_path_factory.mktemp("cli") / "run", "ppo=paper")


# ---------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        # a misspelt key
        ("train ppo.iteratons=7", ("ppo.iteratons=7", "did you mean 'ppo.iterations'")),
        ("train reward.gait.weigth=-1", ("reward.gait.weigth=-1", "did you mean 'reward.gait.weight'")),
        ("train ~reward.gat", ("reward.gat", "did you mean 'reward.gait'")),
        ("eval run=x second=3", ("second=3", "did you mean 'seconds'")),
        # a new one
        ("train +sead=3", ("sead: unknown key", "did you mean 'seed'", "3")),
        ("train +ppo.gama=3", ("ppo.gama: unknown key", "did you mean 'gamma'", "3")),
        ("train +reward.gait.weigth=3", ("reward.gait.weigth: unknown key", "did you mean 'weight'", "3")),
        ("play run=x +grid.x=[1]", ("grid: unknown key", "{'x': [1]}")),
        ("play policy=paper viewer=wbe", ("viewer = 'wbe'", "'auto', 'clip', 'live' or 'web'")),
        ("play policy=paper viewer=web port=70000", ("port = 70000", "65535")),
        ("play policy=paper viewer=web host=127.0.0.1:80", ("host = '127.0.0.1:80'", "port=")),
        ("play policy=paper bundle=x.zip", ("bundle = 'x.zip' and policy = 'paper': only one of them",)),
        ("play bundle=nowhere.zip viewer=web", ("bundle = 'nowhere.zip': there is no such file",)),
        ("play log=x.parquet policy=paper", ("log = 'x.parquet' and policy = 'paper': only one of them",)),
        ("play log=x.parquet viewer=clip", ("viewer = 'clip'", "viewer=web alone")),
        ("play policy=paper terrain=rough train_ground=true", ("train_ground = True and terrain",)),
        ("gap view host=", ("host = ''", "127.0.0.1")),
        # a folder that a variable of the shell was to name
        ("train resume=", ("resume = ''",)),
        ("train sweep=", ("sweep = ''",)),
        ("train start_from=", ("start_from = ''",)),
        # a group by its folder's name, a choice left out, what Hydra cannot read
        ("train randomization=table1", ("no such key 'randomization'; did you mean 'rand=table1'?",)),
        ("train launcher=joblib", ("did you mean 'hydra/launcher=joblib'?",)),
        ("train rand=", ("rand=: a group takes the name of one of its files: none, table1, text",)),
        ("train logger.wandb.notes=a(b", ("logger.wandb.notes=a(b: cannot be read as key=value",)),
        # a launcher without a sweep
        ("train hydra/launcher=joblib", ("needs -m: go1exp train -m hydra/launcher=joblib",)),
        # a misspelt term
        ("train +reward.foot_slp={weight:1}", ("reward.foot_slp: unknown reward term", "did you mean 'foot_slip'")),
        ("train actuator.term=dp", ("actuator", "unknown actuator term 'dp'", "did you mean 'pd'")),
        # a wrong type
        ("train ppo.iterations=many", ("ppo.iterations = 'many'", "integer")),
        ("train ppo.hidden=[64,x]", ("ppo.hidden.1 = 'x'", "integer")),
        # one problem: pydantic counts the items that are left, and would call the list too short as well
        ("train ppo.hidden=[0]", ("train: ppo.hidden.0 = 0: input should be greater than or equal to 1\n",)),
        ("train ppo.hidden=[]", ("ppo.hidden = []: ", " at least 1 item")),
        ("train reward.gait=5", ("reward.gait = 5", "mapping")),
        ("eval run=x grid.x=3", ("grid.x = 3", "array")),
        # out of range
        ("train ppo.gamma=1.5", ("ppo.gamma = 1.5", "less than or equal to 1")),
        ("train torch_threads=100000", ("torch_threads = 100000", "less than or equal to 1024")),
        ("train event.push.interval=[3,1]", ("event.push.interval = [3, 1]", "low must not exceed high")),
        ("eval run=x measures=[stride_rat]", ("measures.stride_rat", "did you mean 'stride_rate'")),
        ("eval run=x measures=all", ("measures = 'all'", "[stride_rate]")),
        ("eval run=x grid.x=[0.5,1e30]", ("grid.x.1 = 1e+30: must be from -100 to 100 (m/s or rad/s)",)),
        ("play policy=paper velocity=[0,0,-1e30]", ("velocity.2 = -1e+30: must be from -100 to 100",)),
        ("train command.lin_vel_x=[0,1e30]", ("command.lin_vel_x.1 = 1e+30: must be from -100 to 100",)),
        ("train command=forward command.ang_vel_z=1e30", ("command.ang_vel_z = 1e+30: must be from -100 to 100",)),
        ("train event.push.velocity=[-1,1e300]", ("event.push.velocity.1 = 1e+300: must be from -100 to 100",)),
        ("train rand.body_velocity.range=[-1e300,1]", ("rand.body_velocity.range.0 = -1e+300: must be from -100",)),
        ("eval run=x episodes=0", ("episodes = 0", "greater than or equal to 1")),
        ("eval run=x settle_s=30", ("settle_s = 30.0", "seconds = 20.0")),
        ("report x evaluation.seconds=1", ("report: evaluation.settle_s = 2.0: must be",)),
        ("bench suite=fast", ("suite = 'fast'", "'env', 'train'", "'deploy'")),
        # a misspelt choice
        ("train rand=tabel1", ("rand=tabel1", "did you mean 'table1'?")),
        ("train experiment=ablation/no_gat", ("experiment=ablation/no_gat", "did you mean 'ablation/no_gait'")),
        ("list group=rewrd", ("'rewrd'", "did you mean 'reward'?")),
        ("train logger=null", ("logger=null",)),
        ("train terrain=5", ("terrain=5",)),
        # recordings and fits
        ("record excitation=[chrip]", ("excitation.chrip", "did you mean 'chirp'?")),
        ("record excitation=[{chirp:{bnd:[1,2]}}]", ("excitation.chirp.bnd", "did you mean 'band'?")),
        ("record excitation=chirp", ("excitation = 'chirp'", "must be a list")),
        ("record excitation=[policy]", ("run: required",)),
        ("record excitation=[mpc] controller=policy", ("controller.name = 'policy'", "needs controller=mpc")),
        ("record excitation=[mpc] support=suspended", ("support = 'suspended'", "walks on the ground")),
        ("eval controller=mpc controller.height=1.0", ("controller.height = 1.0", "less than or equal to 0.4")),
        ("eval controller=mpc checkpoint=000400.pt", ("checkpoint = '000400.pt'", "controller=mpc has none")),
        ("deploy walk.zip controller=mpc rate=50", ("rate = 50", "runs at 500 Hz")),
        ("deploy walk.zip controller=mpc robot=go1", ("controller=mpc: is for robot=sim",)),
        ("record gains=[] physics_dt=0.0015", ("2 problems", "gains = []", "physics_dt = 0.0015", "multiple")),
        ("record effect=[coulomb,stribek]", ("effect=stribek", "did you mean 'stribeck'")),
        ("record seconds=1e9", ("seconds = 1e+09: with 3 recordings it takes at least", "GB are free", "s at most")),
        ("record seconds=1e308", ("seconds = 1e+308: with", "at least inf GB")),
        ("deploy a.zip motion=chirp seconds=1e9 sim.start=suspended", ("seconds = 1e+09: the motion takes at least",)),
        ("record +sensors.q.bias=1", ("sensors.q.bias: unknown key",)),
        ("record audit", ("go1exp record audit: files: required",)),
        ("record audit a b +depth=3", ("depth: unknown key",)),
        ("record import", ("go1exp record import: ", "source: required", "path: required")),
        ("record import go2_in_air", ("path: required",)),
        ("record import go2_in_aire x", ("unknown importer 'go2_in_aire'", "did you mean 'go2_in_air'?")),
        ("record import go2_in_air x options={rate:3}", ("rate: unknown key", "rate_hz")),
        ("fit-actuator", ("recordings: required",)),
        ("fit-actuator recordings=x epoch=3", ("epoch=3", "did you mean 'epochs'")),
        ("fit-actuator recordings=x history=0 share=leg", ("history = 0", "share = 'leg'", "'all', 'kind' or 'none'")),
        ("gap", ("logs: required",)),
        ("gap logs=[5]", ("logs.0 = 5", "valid string")),
        ("gap logs=x stage=fit search.alpha=2", ("2 problems", "stage = 'fit'", "'localise'", "search.alpha = 2")),
        ("gap logs=x +search.int=3", ("search.int: unknown key",)),
        ("export", ("run: required",)),
        ("export run=nowhere secnds=2", ("secnds=2", "did you mean 'seconds'")),
        ("export run=nowhere seconds=0", ("seconds = 0", "greater than 0")),
        ("export check", ("go1exp export check: file: required",)),
        ("export check a.zip +deep=1", ("deep: unknown key",)),
        ("deploy", ("bundle: required", "go1exp deploy runs/NAME/bundle.zip")),
        ("deploy a.zip robot=dog rate=1", ("2 problems", "robot = 'dog'", "'sim' or 'go1'", "rate = 1")),
        ("sim protocol=exact", ("no such key 'protocol'",)),
        ("deploy a.zip command=[]", ("3 problems\n", *(f"command.{k}: required, but not given" for k in range(3)))),
        # a command may be a word, too; of what is a list, only its items are spoken of
        ("deploy a.zip command=[1,0]", ("deploy: command.2: required, but not given\n",)),
        ("deploy a.zip command=[1,b,0]", ("deploy: command.1 = 'b': input should be a valid number\n",)),
        ("deploy a.zip command=[0,0,0,0]", ("deploy: command = [0, 0, 0, 0]: tuple should have at most 3 items",)),
        ("deploy a.zip command=3", ("deploy: command = 3: input should be a valid array or a valid string\n",)),
        ("deploy a.zip sim.los=0.1", ("sim.los=0.1", "did you mean 'sim.loss'")),
        ("deploy a.zip robot=go1 effect=payload", ("effect: the real robot has its own",)),
        ("list efects", ("'efects'", "did you mean 'effect'")),
        # recordings, paths, options, sweeps
        ("train word", ("word: not a setting, which is key=value; see go1exp train --help",)),
        ("train -m seed=1,2 ppo.gama=2", ("ppo.gama=2: no such key 'ppo.gama'; did you mean 'ppo.gamma'",)),
        ("train hydra.run.dir=x reward.foot_slp.weight=2", ("reward.foot_slp.weight=2: no such key",)),
        ("train rand.foot_friction.range.low=1", ("no such key 'rand.foot_friction.range.low'; did you mean",)),
        ("train rand.foot_friction.range.5=1", ("no such key 'rand.foot_friction.range.5'; did you mean",)),
        ("train reward.foot_slip={wieght:1}", ("no such key 'reward.foot_slip.wieght'; did you mean",)),
        ("train -m +seed=1", ("+seed=1: 'seed' exists already; leave out the plus: 'seed=1'",)),
        ("train -m --cfg job seed=1,2", ("-m and --cfg cannot be used together: --cfg and --info show",)),
        ("eval --foo", ("--foo: unknown option; see go1exp eval --help",)),
        ("list reward rand", ("rand: not a setting, which is key=value; see go1exp list --help",)),
        ("train --config-dir nowhere reward=x", ("no such folder",)),
        ("train schedule=papr", ("schedule=papr: unknown choice of schedule 'papr'; did you mean 'paper'?",)),
        ("eval reward=paper", ("reward=paper: no such key 'reward'; reward is a group of train; see --help",)),
        ("eval policy=papr", ("policy: unknown shipped policy 'papr'; did you mean 'paper'?",)),
        ("eval run=.", ("run = '.': not a run folder (it has no config.yaml)",)),
        ("play policy=paper out=x.xyz", ("out = 'x.xyz': a clip is .mp4 or .gif",)),
        ("play policy=paper out=.", ("out = '.': is a folder; name the file, such as out=play.mp4",)),
        ("gap report", ("gap/verdict.json: no such file; run go1exp gap explain first",)),
        ("gap logs=.", (".: no *.parquet in it",)),
        ("export check .", ("Is a directory: .",)),
        ("deploy x.zip feet=f.json", ("feet = f.json: calibrates sensors that report counts; those of robot=sim",)),
        ("deploy walk.zip robot=sm", ("robot = 'sm': input should be 'sim' or 'go1'",)),
        ("train reward=qqq", ("reward=qqq: unknown choice of reward 'qqq'; known: clock, paper, paper_literal, spot",)),
        ("gap prove", ("stage: unknown stage 'prove'; known: all, ",)),
        ("gap logs=[]", ("logs = []: a folder of recordings is needed, such as logs=recordings",)),
        ("gap logs=", ("logs = '': a folder of recordings is needed, such as logs=recordings",)),
        ("gap logs=[a,'']", ("logs = ['a', '']: a folder of recordings is needed, such as logs=recordings",)),
        ("gap next logs=", ("logs = '': a folder of recordings is needed, such as logs=recordings",)),
        ("gap logs=x out=", ("out = '': ",)),
        ("gap logs=x accept=-1", ("accept = -1: must be from 0 to 1 rad; with a unit such as 2mrad",)),
        ("gap logs=x accept=-2mrad", ("accept = '-2mrad': must be from 0 to 1 rad; with a unit such as 2mrad",)),
        ("gap logs=x accept=2", ("accept = 2: must be from 0 to 1 rad; with a unit such as 2mrad",)),
        ("gap logs=x accept=..mrad", ("accept = '..mrad': must be a number of rad, or one with rad, mrad, deg",)),
        ("gap logs=x +search.effects=[coulmb]", ("search.effects: unknown effect 'coulmb'; did you mean 'coulomb'?",)),
        ("gap logs=x search.physics_dt=1e-9", ("search.physics_dt = 1e-09: input should be greater than or equal to",)),
        ("gap replay logs=x train_dt=1e-9", ("train_dt = 1e-09: input should be greater than or equal to",)),
        ("gap loop +search.effects=[coulmb]", ("search.effects: unknown effect 'coulmb'; did you mean 'coulomb'?",)),
        ("gap loop gains=[]", ("gains = []: at least one is needed",)),
        ("gap loop seeds=[]", ("seeds = []: at least one is needed",)),
        ("gap loop seconds=0.1", ("seconds = 0.1: shorter than a window, search.burn_s + search.window_s = 0.37 s",)),
        ("record import go2_in_air x out=", ("out = '': ",)),
        ("train =", ("=: not a setting, which is key=value",)),
        ("train seed=${oc.env:NO_SUCH_VARIABLE}", ("seed: Environment variable 'NO_SUCH_VARIABLE' not found",)),
        ("train device=mars", ("device = 'mars': must be auto, cpu, cuda, or one of several as cuda:1",)),
        ("train ppo.hidden=[100000000]", ("ppo.hidden = [100000000]: with ppo.",)),
        ("eval policy=paper effect.coulomb.bound=0.2", ("no file of effect is chosen, as effect=coulomb does",)),
        ("record excitation=[nope]", ("excitation.nope: unknown excitation term 'nope'; known: chirp",)),
        ("compare paper @100hz", ("subjects: '@100hz': names no policy before @",)),
        ("sim address=nonsense", ("address=nonsense: must be HOST:PORT",)),
        ("sim address=8.8.8.8:8007", ("address = 8.8.8.8:8007: ",)),
        ("deploy nowhere.zip", ("No such file or directory: nowhere.zip",)),
        ("gap logs=nowhere", ("nowhere: no such file",)),
        ("train --help nope", ("no group or key 'nope'",)),
        ("-sc install=cmd", ("-sc install=cmd: install, uninstall or query",)),
        # what is not there
        ("record audit nowhere.parquet", ("go1exp record audit: nowhere.parquet: no such file\n",)),
        ("record audit .", ("go1exp record audit: .: no *.parquet in it\n",)),
        ("record import go2_in_air nowhere", ("go1exp record import: nowhere: no such file or folder\n",)),
        ("fit-actuator recordings=nowhere", ("go1exp fit-actuator: nowhere: no such file\n",)),
        *((f"{verb}=nowhere", ("nowhere", "not a run folder")) for verb in ("eval run", "play run", "export run")),
        ("train resume=nowhere", ("nowhere", "not a run folder")),
        ("train resume=nowhere terrain.stair_rise=[0,1]", ("stair_rise=[0,1]: a resumed run keeps its configuration",)),
        ("train resume=nowhere curriculum.terrain_level.start_level_max=3", ("a resumed run keeps its configuration",)),
        ("train resume=nowhere checkpoint.evry=3", ("did you mean 'checkpoint.every'",)),
        ("eval policy=rough terrain=steps", ("a group of gap loop, play, record, sim, train; train_ground=true or",)),
        # others
        (
            "fit-actuator recordings=nowhere inputs=[speed]",
            ("inputs.0 = 'speed'", "should be 'position_error', 'velocity'"),
        ),
        ("fit-actuator recordings=nowhere holdout=[a] validation=[a,b]", ("validation: a cannot be held out too\n",)),
        ("eval policy=paper grid.cross=true grid.x=[]", ("grid: with cross=true every axis needs at least one value",)),
        ("train seed=4294967296", ("seed = 4294967296", "4294967295")),
        ("train reward=[1]", ("reward=[1]: a group takes the name of one of its files, such as reward=paper",)),
        ("trian seed=1", ("unknown verb 'trian'", "did you mean 'train'?")),
        ("eval", ("run: required",)),
        ("play seconds=3", ("run: required",)),
        ("train ppo.gamma=1.5 sim.policy_dt=0.003", ("problems", "ppo.gamma = 1.5", "sim.policy_dt = 0.003")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_wrong_setting_is_refused_at_once_in_words(arguments: str, said: tuple[str, ...], tmp_path: Path) -> None:
    assert_refused(tmp_path, arguments.split(), *said)


def test_a_key_that_the_chosen_group_does_not_have_is_not_proposed_for_itself(tmp_path: Path) -> None:
    arguments = ["train", "rand=none", "rand.foot_friction.range=[0,1]"]
    assert_refused(tmp_path, arguments, "rand.foot_friction.range=[0,1]: no such key")
    done = refuse(tmp_path, *arguments)
    assert "did you mean 'rand.foot_friction" not in done.stderr


FILES = {
    "mine.yaml": "coulomb: {bound: 0.3}",
    "bad.yaml": "coulomb: [0.1",
    "list.yaml": "- coulomb",
    "typo.yaml": "coulmb: {}",
}


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        ("nowhere.yaml", "effect={folder}/nowhere.yaml: no such file"),
        ("[payload,{folder}/nowhere.yaml]", "effect={folder}/nowhere.yaml: no such file"),
        ("bad.yaml", "effect={folder}/bad.yaml: no YAML"),
        ("list.yaml", "effect={folder}/list.yaml: must be a mapping"),
        ("[{folder}/mine.yaml,{folder}/list.yaml]", "effect={folder}/list.yaml: must be a mapping"),
        ("typo.yaml", "effect.coulmb: unknown effect term 'coulmb'; did you mean 'coulomb'?"),
        ("[{folder}/mine.yaml,payloat]", "effect=payloat: unknown choice of effect 'payloat'; did you mean 'payload'?"),
    ],
)
@pytest.mark.parametrize("verb", ["train", "record"])
def test_an_effect_from_a_file_that_is_none_is_refused(verb: str, choice: str, said: str, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    for name, content in FILES.items():
        (folder / name).write_text(content)
    choice = choice if choice.startswith("[") else f"{{folder}}/{choice}"
    assert_refused(tmp_path, [verb, f"effect={choice.format(folder=folder)}"], said.format(folder=folder))


def test_effects_come_from_files_by_any_path_and_from_names(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/mine.yaml").write_text(FILES["mine.yaml"])
    (tmp_path / "other.yaml").write_text("payload: {mass: 2.0}")
    for given, expected in {
        "effect=sub/mine.yaml": {"coulomb": {"bound": 0.3}},
        f"effect={tmp_path}/other.yaml": {"payload": {"mass": 2.0}},
        "effect=[sub/mine.yaml,other.yaml]": {"coulomb": {"bound": 0.3}, "payload": {"mass": 2.0}},
        "effect=[viscous,./other.yaml]": {**compose("train", ["effect=viscous"])["effect"], "payload": {"mass": 2.0}},
    }.items():
        done = refuse(tmp_path, "train", "--cfg", "job", given)
        assert done.returncode == 0, done.stderr
        assert OmegaConf.create(done.stdout).effect == expected, given


def test_groups_take_files_of_the_user(tmp_path: Path) -> None:
    groups = {"rand": "table1", "command": "paper", "reward": "paper", "schedule": "paper", "event": "push"}
    groups |= {"termination": "fall", "terrain": "flat", "contact": "stiff", "ppo": "paper", "observation": "paper"}
    for group, name in groups.items():
        folder = data_root() / "conf" / ("randomization" if group == "rand" else group)
        shutil.copy(folder / f"{name}.yaml", tmp_path / f"my_{group}.yaml")
    done = refuse(tmp_path, "train", "--cfg", "job", *(f"{group}=my_{group}.yaml" for group in groups))
    assert done.returncode == 0, done.stderr
    ours = compose("train", [f"{group}={name}" for group, name in groups.items()])
    composed = OmegaConf.create(done.stdout)
    assert all(OmegaConf.select(composed, group) == ours[group] for group in groups)


def test_a_file_can_be_added_where_a_verb_has_no_choice_of_the_group(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(FILES["mine.yaml"])
    assert "effect" not in compose("gap", [])
    for given in (f"+effect={file}", f"+effect=[{file}]"):
        assert compose("gap", choices_from_files([given], "gap"))["effect"] == {"coulomb": {"bound": 0.3}}
    assert_refused(
        tmp_path, ["gap", f"+effect={tmp_path}/nowhere.yaml"], f"effect={tmp_path}/nowhere.yaml: no such file"
    )


def test_a_traceback_is_there_for_who_asks_for_it(tmp_path: Path) -> None:
    done = cli(tmp_path, "train", "ppo.gamma=1.5", HYDRA_FULL_ERROR="1")
    assert done.returncode not in (0, 2)
    assert "Traceback" in done.stderr
    assert "ConfigError" in done.stderr


# ---------------------------------------------------------------------- help


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"], ["help"]])
def test_the_general_help_names_every_verb_and_loads_nothing(arguments: list[str], tmp_path: Path) -> None:
    done = run_alone(tmp_path, *arguments, code=WITH_MODULES, MODULES=str(tmp_path / "modules.json"))
    assert done.returncode == 0
    for verb, text in VERBS.items():
        assert re.search(rf"^  {verb} +{re.escape(text)}$", done.stdout, re.MULTILINE)
    loaded = set(json.loads((tmp_path / "modules.json").read_text()))
    assert not (HEAVY | {"hydra", "numpy", "pydantic", "scipy", "torch"}) & loaded


EXAMPLES = [
    line.strip()
    for verb in EVERY
    for line in (data_root() / f"conf/{verb}.yaml").read_text().split("Examples:")[-1].splitlines()
    if line.strip().startswith("go1exp ")
]


@pytest.mark.parametrize("example", dict.fromkeys(EXAMPLES))
def test_the_examples_of_the_help_are_commands_that_exist(
    example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for file in map(Path, re.findall(r"=([\w/]+\.yaml)", example)):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("coulomb: {bound: 0.3}")
    _, verb, *overrides = shlex.split(re.split(r" {3,}", example)[0])
    assert verb in VERBS
    if overrides and overrides[0] in SUBVERBS.get(verb, ()):
        verb, overrides = f"{verb}_{overrides[0]}", overrides[1:]
    if "-m" in overrides:
        overrides = [override.split(",")[0] for override in overrides if override != "-m"]
    compose(verb, choices_from_files(_by_name(verb, overrides), verb))


@pytest.mark.parametrize(
    ("verb", "given", "named"),
    [
        ("list", ["effects"], ["group='effects'"]),
        ("list", ["what=terms", "effects"], ["what=terms", "group='effects'"]),
        ("record_audit", ["a.parquet", "b.parquet", "out=x"], ["out=x", "files=['a.parquet','b.parquet']"]),
        ("record_audit", ["files=[a]", "--cfg", "job"], ["--cfg", "job", "files=[a]"]),
        ("record_import", ["go2_in_air", "logs/it's.csv"], ["source='go2_in_air'", r"path='logs/it\'s.csv'"]),
        ("export_check", ["walk.zip"], ["file='walk.zip'"]),
        ("export", ["run=x", "walk.zip"], ["run=x", "walk.zip"]),
        ("deploy", ["walk.zip", "robot=sim", "command=[1,0,0]"], ["robot=sim", "command=[1,0,0]", "bundle='walk.zip'"]),
        ("deploy", ["robots=sim", "sim.loss=0"], ["robots=sim", "sim.loss=0"]),
        ("record_import", ["go2_in_air", "a", "b"], ["source='go2_in_air'", "path='a'", "b"]),
        ("train", ["reward=paper", "word"], ["reward=paper", "word"]),
        ("record", [], []),
    ],
)
def test_words_by_position_become_settings(verb: str, given: list[str], named: list[str]) -> None:
    assert _by_name(verb, given) == named


def test_a_path_by_position_may_hold_anything(tmp_path: Path) -> None:
    folder = tmp_path / "it's [a] {folder}, $x"
    done = refuse(tmp_path, "record", "audit", str(folder), "second one")
    said = f"go1exp record audit: {folder}: no such file\nsecond one: no such file\n"
    assert (done.returncode, done.stderr) == (2, said)


def test_the_value_of_an_option_is_no_setting(tmp_path: Path) -> None:
    done = refuse(tmp_path, "record", "import", "--cfg", "job", "go2_in_air", "logs", "options={rate_hz: 100.0}")
    assert done.returncode == 0, done.stderr
    expected: dict[str, Any] = {
        "source": "go2_in_air",
        "path": "logs",
        "columns": None,
        "options": {"rate_hz": 100.0},
        "drop": None,
        "out": "recordings",
        "plugins": [],
    }
    assert OmegaConf.create(done.stdout) == expected


@pytest.mark.parametrize("verb", [verb for verb in EVERY if verb != "train"])
def test_every_setting_of_a_verb_can_be_given_on_the_command_line(verb: str) -> None:
    """A folder of conf/ with the name of a key would make Hydra take the key for a choice of files."""
    given = {key: "x" if value == "???" else value for key, value in leaves(compose(verb)).items() if value != {}}
    words = [f"{key}={json.dumps(value)}" for key, value in given.items()]
    try:
        assert {key: value for key, value in leaves(compose(verb, words)).items() if value != {}} == given
    except (HydraException, ValueError):
        assert [word for word in words if not accepted(verb, word)] == []
        raise


def accepted(verb: str, word: str) -> bool:
    try:
        compose(verb, [word])
    except (HydraException, ValueError):
        return False
    return True


def test_cfg_job_prints_the_configuration_and_runs_nothing(tmp_path: Path) -> None:
    done = refuse(tmp_path, "train", "--cfg", "job", "rand=none", "ppo.iterations=7")
    assert done.returncode == 0, done.stderr
    printed = OmegaConf.create(done.stdout)
    assert printed == compose("train", ["rand=none", "ppo.iterations=7"])
    assert printed.ppo.iterations == 7
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("given", [None, "3"])
def test_blas_has_one_thread_unless_the_user_says_otherwise(given: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set before NumPy is imported, which the general help shows not to be."""
    variable, one = ONE_BLAS_THREAD
    monkeypatch.setenv(variable, given or "")
    if given is None:
        monkeypatch.delenv(variable)
    monkeypatch.setattr(sys, "argv", ["go1exp", "--version"])
    assert main() == 0
    assert os.environ[variable] == (given or one)


# ---------------------------------------------------------------------- verbs


def test_list_prints_every_registered_term_with_its_first_line_and_every_choice(tmp_path: Path) -> None:
    done = refuse(tmp_path, "list")
    assert done.returncode == 0, done.stderr
    sections: dict[str, list[str]] = {}
    for line in done.stdout.splitlines():
        if line and not line.startswith(" "):
            sections[line] = []
        elif line:
            sections[line and list(sections)[-1]].append(line)
    for group in registry.groups():
        for name, entry in registry.members(group).items():
            assert entry.doc
            assert [line for line in sections[group] if line.split() == [name, *entry.doc.split()]], (group, name)
    assert any(line.startswith("  rand=table1 ") for line in sections["rand"])
    assert any(line.startswith("  experiment=ablation/no_gait ") for line in sections["experiment"])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("words", "first"), [("list", "actuator"), ("gap --help", "go1exp gap: compare recordings")])
def test_a_reader_may_leave(words: str, first: str, tmp_path: Path) -> None:
    """``go1exp list | head -1``: no complaint, and the status of a closed pipe."""
    script = f"set -o pipefail; PYTHONUNBUFFERED=1 {sys.executable} -m go1exp {words} | head -n 1"
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.stdout.startswith(first)
    assert done.stderr == ""
    assert done.returncode in (0, 141)  # 0 where everything fitted into the pipe before the reader left


@pytest.mark.parametrize("word", ["effect", "effects", "group=effect"])
def test_list_takes_a_group_by_position_in_singular_and_plural(word: str, tmp_path: Path) -> None:
    done = refuse(tmp_path, "list", word)
    assert done.returncode == 0, done.stderr
    first, *lines = done.stdout.splitlines()
    assert first == "effect"
    assert [line for line in lines if line and not line.startswith(" ")] == []
    named = {line.split()[0] for line in lines if line}
    assert {"coulomb", "effect=coulomb"} <= named


def test_a_recording_is_made_imported_audited_and_refused(tmp_path: Path) -> None:
    quick = ("seconds=1.0", "physics_dt=0.002", "backend.threads=1", "excitation=[gait]", "out=logs")
    done = cli(tmp_path, "record", *quick)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "recording ...\n"
    assert done.stdout.startswith("1 recording, 1 s, in logs\n")
    (file,) = (tmp_path / "logs").iterdir()
    done = cli(tmp_path, "record", "audit", f"logs/{file.name}", "out=audit/found.json")
    (name,) = found = json.loads((tmp_path / "audit/found.json").read_text())
    assert name == f"logs/{file.name}"
    assert done.returncode == {"ok": 0, "suspect": 3, "bad": 4}[found[name]["verdict"]], done.stderr
    assert done.stdout.splitlines()[0] == name
    columns = [f"{q}{i}{end}" for i in range(12) for q, end in (("jpos", ""), ("jvel", ""), ("jpos", "_des"))]
    rows = "\n".join(",".join(["20", "0.5", *["0.1"] * len(columns)]) for _ in range(9))
    (tmp_path / "go2.csv").write_text(f"kp,kd,{','.join(columns)}\n{rows}\n")
    done = cli(tmp_path, "record", "import", "go2_in_air", "go2.csv", "out=theirs")
    assert done.returncode == 0, done.stderr
    assert [p.name for p in (tmp_path / "theirs").iterdir()] == ["go2.parquet"]
    again = cli(tmp_path, "record", "import", "go2_in_air", "go2.csv", "options={rate_hz: 4.0}", "out=slow")
    assert again.stdout.startswith("1 recording, 2 s, in slow\n"), again.stderr
    assert done.stdout.startswith("1 recording, ")
    assert "note: " in done.stdout
    file.write_bytes(file.read_bytes()[:1000])
    done = cli(tmp_path, "record", "audit", "logs")
    assert done.returncode == 2
    assert re.fullmatch(r"go1exp record audit: logs/\S+\.parquet: .*\n", done.stderr), done.stderr


def test_a_sweep_writes_one_run_folder_for_each_job(tmp_path: Path) -> None:
    done = cli(tmp_path, "train", "-m", "seed=3,5", *SMALL, f"hydra.sweep.dir={tmp_path / 'sweep'}")
    assert done.returncode == 0, done.stderr
    runs = sorted(p.parent for p in (tmp_path / "sweep").glob("*/config.yaml"))
    assert [run_folder.read_config(r)["seed"] for r in runs] == [3, 5]
    for run in runs:
        assert (run / "checkpoints/000002.pt").exists()
        assert json.loads((run / "meta.json").read_text())["seed"] == run_folder.read_config(run)["seed"]
    tables = [(run / "metrics.csv").read_text() for run in runs]
    assert [len(t.splitlines()) for t in tables] == [3, 3]
    assert tables[0] != tables[1]
    assert [p.name for p in tmp_path.iterdir()] == ["sweep"]


GRID = ("grid.x=[0.5]", "grid.y=[]", "grid.yaw=[]", "episodes=2", "seconds=0.4", "settle_s=0.1")


def test_eval_prints_a_table_and_writes_the_same_as_json(run: Path, tmp_path: Path) -> None:
    done = cli(tmp_path, "eval", f"run={run}", *GRID, "out=sub/report.json", "checkpoint=checkpoints/000002.pt")
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("evaluating ...\n")  # progress, if it takes long
    report: dict[str, Any] = json.loads((tmp_path / "sub/report.json").read_text())
    assert set(report) >= {"policy", "commands", "rmse", "falls", "episodes", "settings"}
    assert report["policy"]["iteration"] == 2
    assert report["policy"]["file"].endswith("checkpoints/000002.pt")
    assert report["policy"]["num_timesteps"] == 2 * 4 * 4
    assert [c["command"] for c in report["commands"]] == [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]
    for command in report["commands"]:
        tracking = {"command", "mean", "rmse", "falls", "episodes", "mean_time_s"}
        assert set(command) == {*tracking, "distinct_falls", "measures"}
        assert set(command["rmse"]) == set(command["mean"]) == {"x", "y", "yaw"}
        assert command["episodes"] == 2
    assert report["episodes"] == 4
    assert report["settings"]["seconds"] == 0.4
    header, *lines = done.stdout.splitlines()
    assert "command" in header
    assert "RMSE" in header
    mean = report["commands"][1]["mean"]
    assert "+0.50, +0.00, +0.00" in lines[1]
    assert f"{mean['x']:+.2f}, {mean['y']:+.2f}, {mean['yaw']:+.2f}" in lines[1]
    assert "sub/report.json" in done.stdout
    assert [p.name for p in tmp_path.iterdir()] == ["sub"]


def test_a_measure_of_a_users_own_is_printed(run: Path, tmp_path: Path) -> None:
    text = (
        "import numpy as np\nfrom go1exp.extend import Trace, measure\n\n"
        "@measure('three', unit='rad')\ndef three(trace: Trace):\n"
        "    '''Three.'''\n    return np.full(trace.counts.shape[1], 3.0)\n"
    )
    (tmp_path / "mine.py").write_text(text)
    done = cli(tmp_path, "eval", f"run={run}", *GRID, "plugins=[mine.py]", "measures=[three]", "out=report.json")
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    place = lines.index(["command", "three", "rad", "n"])
    assert lines[place + 1] == ["+0.0", "+0.0", "+0.0", "3", "1"]
    assert "gait" not in done.stdout.split("acceptance criteria")[0]


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (("eval", "out=file/x.json"), "out = 'file/x.json': its folder"),
        (("eval", "protocol=sinusoid", "folder=file/x"), "folder = 'file/x':"),
        (("play", "viewer=clip", "out=file/x.mp4"), "out = 'file/x.mp4': its folder"),
        (("compare", "protocol=sinusoid", "folder=file/x"), "folder = 'file/x':"),
    ],
)
def test_a_place_for_results_that_cannot_be_written_to_is_refused_before_the_work(
    words: tuple[str, ...], key: str, run: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    subject = "subjects=[paper,clock]" if words[0] == "compare" else f"run={run}"
    done = refuse(tmp_path, words[0], subject, *words[1:])
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.splitlines()[-1].startswith(f"go1exp {words[0]}: {key} cannot be written to (")


def test_a_policy_period_that_physics_cannot_keep_is_refused(run: Path, tmp_path: Path) -> None:
    """2.5 physics steps would become 2, and every time and speed in the report would be of another clock."""
    done = refuse(tmp_path, "eval", f"run={run}", *GRID, "out=report.json", "policy_dt=0.005")
    assert done.returncode == 2, done.stdout
    assert "policy_dt = 0.005" in done.stderr


def test_play_writes_a_clip_and_a_picture(run: Path, tmp_path: Path) -> None:
    try:
        choose_gl()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    done = cli(tmp_path, "play", f"run={run}", "seconds=0.4", "fps=10", "viewer=clip", "out=clip.mp4")
    assert done.returncode == 0, done.stderr
    frames = iio.imread(tmp_path / "clip.mp4")
    assert 4 <= len(frames) <= 5
    assert iio.imread(tmp_path / "clip.png").std() > 1.0
    assert {p.name for p in tmp_path.iterdir()} == {"clip.mp4", "clip.png"}


def test_a_clip_that_cannot_be_written_names_the_package_and_a_format_that_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    settings = compose("play", ["policy=clock", "viewer=clip", f"out={tmp_path / 'clip.mp4'}"])
    with pytest.raises(ConfigError, match=r"an \.mp4 needs .* 'go1exp\[video\]', or name a GIF: out=.*clip\.gif"):
        PLAY.task(begin("play", settings))


def test_a_folder_that_looks_like_a_setting_is_one_if_its_name_can_be_no_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("sp ace=x", "runs/seed=1", "seed=1"):
        Path(name).mkdir(parents=True)
    given = ["sp ace=x", "runs/seed=1", "./seed=1", "seed=1", "reward=paper", "hydra/launcher=joblib", "no such=x"]
    assert parted(given) == ([], ["seed=1", "reward=paper", "hydra/launcher=joblib", "no such=x"], given[:3])
