"""Every leaf of every file in conf/ does something: no number there is only decoration.

One leaf at a time gets another valid value, and something observable has to come out differently: a state, a reward,
an observation, a weight of the network, a file, what an outside library is told. What a program observably does is
its *trace*; a trace never holds a copy of the configuration, which would make every key look alive.

Leaves are found in the files and other values by trial against the schemas, so a new key needs nothing here unless
it has no effect within a few robots and steps; ``EXEMPT`` has those that cannot be shown, and why.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
import socket
import sys
import types
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, redirect_stdout, suppress
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from fnmatch import fnmatchcase
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pyarrow.parquet as parquet
import pytest
import torch
import yaml
from mujoco.batch import Batch
from omegaconf import OmegaConf
from omegaconf.basecontainer import get_yaml_loader

from go1exp.base.paths import data_root
from go1exp.cli.app import app_of
from go1exp.cli.app import parse as parsed
from go1exp.cli.record import RIG
from go1exp.config import compose as composing
from go1exp.config.schema import registry
from go1exp.config.schema.registry import ConfigError, Expected, Range
from go1exp.config.schema.training import CheckpointConfig, LoggerConfig, PPOConfig
from go1exp.deploy.export import graph
from go1exp.deploy.export.build import build
from go1exp.deploy.export.graph import DeployedPolicy
from go1exp.deploy.runtime import go1_wire
from go1exp.deploy.runtime.bundle import loads
from go1exp.deploy.runtime.walk import STATUS
from go1exp.mdp.types import Snapshot
from go1exp.robot.messages import LowCmd
from go1exp.sim.env.core import Go1Core
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.task import MANY_TERMS, ONE_TERM, TrainConfig, parse_parts, parse_train
from go1exp.train import metrics, policy, run_folder, trainer
from tests.lockstep import lockstep

pytestmark = pytest.mark.filterwarnings("ignore:The `render_mode` attribute is not defined")

CONF = data_root() / "conf"

Trace = Generator[tuple[str, Any], None, None]
"""What can be observed, in order, each with a name; lazy, so that a comparison stops at the first difference.

Two traces are run in turns: while one waits, it has changed nothing that the other could see.
"""

EXEMPT = {
    "*.yaml:hydra": "Hydra's own settings",
    "*.yaml:plugins": "tests/test_plugins.py shows what it does",
    "backend/cpu.yaml:backend.name": "the other engine is an extra: tests/contracts/test_backends.py",
    "engine/mujoco.yaml:engine": "backend/cpu.yaml has the same keys; tests/test_physx.py shows the other engine",
    "engine/physx.yaml:engine": "needs an extra: tests/test_physx.py shows what each key does",
    "backend/warp.yaml:backend": "needs a GPU and an extra: tests/contracts/test_backends.py",
    "controller/mpc.yaml:controller": "tests/test_controller.py shows what each key does",
    "controller/policy.yaml:controller": "the name of the choice",
    "experiment/ablation/*.yaml:schedule": "ramps that are taken away with their rows, or wait for another one",
    "experiment/rough.yaml:reward.foot_clock.excess": "of feet higher than asked, which come later: test_rewards",
    "experiment/rough_climb.yaml:ppo.matmul_precision": "of a GPU: test_device_training",
    "experiment/rough_climb.yaml:reward.foot_clock": "of feet before a step, which come later: test_rewards",
    "reward/paper_literal.yaml:reward.air_time_variance.weight": "as printed, the term is zero for every gait",
    "launcher/*.yaml:launcher": "needs several cores, or a cluster: tests/test_sweeps.py, test_slurm.py",
    "study/*.yaml:study": "jobs of a sweep: tests/test_configs.py",
    "schedule/*.yaml:schedule": "ramps over millions of steps: tests/test_schedule.py shows each key",
    "actuator/net_simulated.yaml:actuator.period": "actuator/net.yaml has the same key",
    "train.yaml:sweep": "tests/test_sweeps.py shows what it does",
    "logger/wandb.yaml:logger.wandb.tags": "tests/test_logging.py reads them back",
    "protocol/*.yaml:protocol": "tests/test_protocols.py shows that each key is read",
    "model/go1.yaml:model": "the Go1 is that of the group robot; test_gap_tolerances.py shows what its tolerances do",
    **{
        f"model/{name}.yaml:model": "a robot that is not simulated here; test_gap_machines.py shows what its keys do"
        for name in ("go2", "xl330_pendulum", "ak80_double_pendulum_a", "ak80_double_pendulum_c", "so101")
    },
    **{
        f"{verb}.yaml:{key}": reason
        for verb, keys, reason in (
            ("tune", "space overrides trials workers metric direction average warmup", "test_tune"),
            ("tune", "prune storage seed out", "test_tune"),
            ("deploy", "motion gains", "of a suspended robot: test_played"),
            ("deploy", "address check", "of robot=go1: test_go1_walk"),
            ("deploy", "feet", "of sensors that count: test_go1_walk"),
            ("report", "folders baseline curves figures correction paired unfinished eval evaluation", "test_report"),
            ("report", "points wandb project folder", "test_report"),
            ("train", "eval video stop", "test_asynchronous"),
            ("play", "host port log", "test_viewer_keys"),
            ("play", "bundle", "in place of run, as of eval: test_viewer_keys"),
            ("sim", "viewer host port", "of its page: test_viewer_keys"),
            ("gap", "search.phase", "of robots that walk: test_gap_swings"),
            ("gap", "host port", "of the stage view: test_viewer_keys"),
            ("gap_next", "logs out design", "test_gap_next"),
            ("export_import", "network spec out force", "test_foreign"),
            ("gap_loop", "effect excitation gains seconds seeds repeats support hang physics_dt seed", "record.yaml"),
            ("gap_loop", "rounds sensors search design out", "gap.yaml, gap_next.yaml, test_gap_loop"),
            ("compare", "subjects same_robot seed physics_dt folder", "test_protocol_commands"),
            ("eval", "bundle folder", "not of the grid: test_protocol_commands"),
        )
        for key in keys.split()
    },
}
"""Leaf, or mapping of leaves, that need not be shown to act (``*`` as in file names), and the reason or test."""

NEEDS = {
    **{
        f"experiment/{name}": ["schedule=none"]  # which sets these rows
        for name in (
            *("ablation/no_action_smoothness", "ablation/no_smoothness", "minute_part/no_smoothness"),
            *("ablation/no_raised_weight", "ablation/no_diagonal_load", "ablation/no_touchdown_speed"),
        )
    },
    "reward/paper": ["schedule=none"],  # which sets three of its weights
    "curriculum/terrain_level": ["terrain=rough"],
    "curriculum/hard_start": ["terrain=rough"],
    "critic/terrain": ["terrain=rough"],
    **{f"estimator/{name}": ["critic=privileged"] for name in ("none", "decoder")},
    "experiment/clock": [  # it changes what these say
        *("observation=clock", "reward=clock", "ppo=warp", "command=widening", "actuator=delay"),
        "observation.gait_clock.rate=3.1",  # neither the file's nor the experiment's, which the rewards take over
    ],
    "experiment/minute": ["reward=clock"],
    "actuator/delay": ["schedule=none"],  # which begins without latency
    "command/widening": ["schedule=none"],  # which begins without slow commands
    **{f"contact/{name}": ["schedule=none"] for name in ("elliptic", "soft", "stiff")},  # it begins on soft ground
    "experiment/ablation/no_latency": ["actuator=delay"],
    **{f"experiment/{part}/no_mirrored_samples": ["ppo=small_cpu"] for part in ("ablation", "minute_part")},
    "experiment/minute_part/no_near_kernels": ["experiment=minute"],
    "experiment/study": ["backend=cpu", "ppo=warp"],
    "experiment/robust": ["experiment=clock", "backend=cpu"],
    "experiment/robust_history": ["experiment=robust", "backend=cpu"],
    "experiment/rough": ["experiment=robust_history", "terrain=steps", "observation=proprioception", "backend=cpu"],
    "experiment/rough_climb": [
        "experiment=rough",
        "backend=cpu",
        "terrain.obstacles_proportion=0.6",
        "terrain.boxes_proportion=0.0",
    ],
}
"""Choices that other choices must go with."""


def given(text: str) -> dict[str, Any]:
    """Keys and values of words such as ``ppo.steps=6``."""
    return {key: yaml.safe_load(value) for key, _, value in (word.partition("=") for word in text.split())}


SMALL: dict[str, dict[str, Any]] = {
    "train": given("""
        sim.physics_dt=0.005 sim.episode_s=0.4 backend.threads=1 torch_threads=1 logger.tensorboard=false
        terrain.rows=3 terrain.cols=10 terrain.tile_size=4.0 terrain.border=2.0
        curriculum.terrain_level.start_level_max=1 checkpoint.every=1
        ppo.num_envs=8 ppo.iterations=4 ppo.steps=6 ppo.epochs=2 ppo.minibatches=4 ppo.learning_rate=0.005
        ppo.learning_rate_range=[0.003,0.01] ppo.hidden=[8,7,6]
    """),
    "eval": given("""
        grid.x=[0.5,1.0] grid.y=[0.5] grid.yaw=[1.0] grid.cross=false
        episodes=2 seconds=0.2 settle_s=0.1 noise=true randomize=true push=true train_ground=true
    """),
    "play": given("seconds=0.4 noise=true randomize=true push=true train_ground=true viewer=clip"),
    "record": given("excitation=[gait] seconds=0.2 physics_dt=0.002 episodes=2"),
    "record_audit": {},
    "record_import": {},
    "fit-actuator": given(
        "hidden=[6,5,4] epochs=4 batch=64 learning_rate=0.2 patience=1 epoch_rows=400 plots=false",
    ),
    "gap": given("""
        search.window_s=0.1 search.burn_s=0.02 search.stride_s=0.15 search.physics_dt=0.002 search.max_terms=1
        search.shortlist=1 search.iterations=1 search.bootstraps=0 search.overlays=1 search.threads=1
    """),
    "export": given("seconds=0.1"),
    "export_check": {},
    "deploy": given("seconds=0.04 stand_up=0.06 hand_over=0.04 lie_down=0.04 brake=0.06 patience=0.1 keep=0.2"),
    "sim": given("noise=1.0"),
    "list": {},
    "bench": given("num_envs=4 rounds=1 seconds=0.1 threads=1"),
}
"""Values that the traces use instead of those in conf/: fewer and shorter, or switched on so that others can act."""

OTHER: dict[str, Any] = {
    **given("""
        train:backend.threads=2 train:torch_threads=2 train:device=cuda train:start_from=paper
        train:actuator.period=resample eval:physics_dt=0.0025 eval:measures=[stride_rate]
        play:out=other.gif play:physics_dt=0.0025 play:tile=[2,1] record:excitation=[steps]
        record_import:source=so101_arm record_import:drop=impossible
        fit-actuator:gains=[20.0,0.5] fit-actuator:inputs=[position_error] fit-actuator:period=0.004
        fit-actuator:smoothing=0.02
        gap:stage=localise gap:search.min_share=1.0 gap:search.adequate=1.0e+6 gap:search.material=1.0e+6 gap:accept=1.0
        gap:search.confirm_fraction=0.5 gap:search.certified=0.0 gap:search.max_rows=64
        deploy:rate=100.0 deploy:lie_down=0.0 sim:address=127.0.0.1:18007 sim:tile=[1,1] sim:seconds=1.0
        list:group=reward bench:overrides=[sim.physics_dt=0.004]
    """),
    "gap:search.alpha": 1e-5,  # no p-value is a tenfold of that
    "train:logger.wandb": {"project": "p", "mode": "offline", "group": None, "entity": None},
    **{key: {"coulomb": {"bound": 0.4}} for key in ("train:effect", "record:effect", "sim:effect")},
    "record_import:options": {"rate_hz": 100.0},
    "record_import:columns": {"q_hip": "jpos1"},
}
"""Other values of leaves where ``other_values`` could not guess one."""

MADE: dict[str, Callable[[Walk], Path]] = {
    "train:resume": lambda walk: walk.trained("resumed"),
    "train:actuator.file": lambda walk: walk.net(1),
    **dict.fromkeys(("record:run", "eval:run", "play:run", "export:run"), lambda walk: walk.trained("other", "seed=5")),
    **dict.fromkeys(
        ("eval:checkpoint", "play:checkpoint", "export:checkpoint"),
        lambda walk: walk.trained("run") / "checkpoints/000003.pt",
    ),
    **dict.fromkeys(("export_check:file", "deploy:bundle"), lambda walk: walk.exported("other", "seed=5")),
    "record_audit:files": lambda walk: walk.recorded("lossy", {"sensors.dropped": 0.3}),
    "record_import:path": lambda walk: walk.logs(1),
    "fit-actuator:recordings": lambda walk: walk.recorded("noisy", {**FIVE, "sensors.qd.noise": 0.3}),
    "gap:logs": lambda walk: walk.recorded("stiff", {**HELD, "effect": {"viscous": {"damping": 0.6}}}),
}
"""The same where the value is a file or folder."""


FIVE: dict[str, Any] = {"seeds": [0, 1, 2, 3, 4], "physics_dt": 0.002}
"""What a fit needs to be made of: episodes enough to train with, to stop by and to report on."""

HELD: dict[str, Any] = {
    "excitation": ["chirp"],
    "effect": {"coulomb": {"bound": 0.5}, "viscous": {"damping": 0.3}},
    "seeds": [0, 1, 2, 3],
    "seconds": 0.7,
}
"""A robot with two effects that the model lacks, in enough episodes to keep some for the last check."""


# ---------------------------------------------------------------------- the leaves


@dataclass(frozen=True)
class Leaf:
    """One value in one file: ``key`` is its path in the composed configuration."""

    file: str
    key: str
    value: Any

    @property
    def name(self) -> str:
        return f"{self.file}.yaml:{self.key}"

    @property
    def program(self) -> str:
        return self.file if "/" not in self.file else "train"

    @property
    def overlay(self) -> bool:
        """Part of an experiment, which changes keys that other files have."""
        return self.file.startswith("experiment/")

    @property
    def term(self) -> str:
        """Path of the term that the leaf is a parameter of."""
        return ".".join(self.key.split(".")[:2])

    @property
    def choice(self) -> list[str]:
        """Overrides that bring the file into the configuration."""
        group, _, choice = self.file.partition("/")
        group = group.replace("randomization", "rand")
        chosen = [f"{group}={choice}"] if choice and not self.overlay else []
        return [*chosen, *NEEDS.get(self.file, [])]


def flat(node: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Leaves of nested mappings; a term without parameters, ``{}``, is one."""
    if isinstance(node, Mapping) and node:
        for key, value in node.items():
            yield from flat(value, f"{path}.{key}".strip("."))
    else:
        yield path, node


class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """OmegaConf's numbers, read by libyaml: every worker of pytest reads all files before its first test."""

    yaml_implicit_resolvers = get_yaml_loader().yaml_implicit_resolvers


def read(file: str, conf: Path = CONF) -> dict[str, Any]:
    """What a file holds, without the choices that it makes."""
    content = yaml.load((conf / f"{file}.yaml").read_text(), Loader) or {}
    assert isinstance(content, dict)
    content.pop("defaults", None)
    return {str(key): value for key, value in content.items()}


def read_leaves(conf: Path = CONF) -> list[Leaf]:
    found = []
    for file in sorted(conf.rglob("*.yaml")):
        name = file.relative_to(conf).with_suffix("").as_posix()
        content = read(name, conf)
        group = name.split("/")[0].replace("randomization", "rand") if "/" in name else ""
        prefix = "" if group == "experiment" else group
        found += [Leaf(name, key, value) for key, value in flat(content, prefix) if content]
    return found


def covers(entry: str, name: str) -> bool:
    return fnmatchcase(name, entry) or fnmatchcase(name, f"{entry}.*")


def exemption(name: str) -> str | None:
    """The entry of ``EXEMPT`` that covers a leaf."""
    return next((e for e in EXEMPT if covers(e, name)), None)


def stale(exempt: Iterable[str], names: Iterable[str]) -> list[str]:
    """Exemptions that no leaf needs any more."""
    names = list(names)
    return [e for e in exempt if not any(covers(e, n) for n in names)]


LEAVES = read_leaves()
WALKED = [leaf for leaf in LEAVES if not exemption(leaf.name)]


# ---------------------------------------------------------------------- other values


def get(container: Mapping[str, Any], key: str) -> Any:
    for part in key.split("."):
        container = container[part]
    return container


def has(container: Mapping[str, Any], key: str) -> bool:
    try:
        get(container, key)
    except KeyError:
        return False
    return True


ABSENT = object()


def put(container: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy with another value, or without the key where that is ABSENT; what is beside it is shared."""
    *parents, last = key.split(".")
    changed = node = dict(container)
    for part in parents:
        node[part] = dict(node[part])
        node = node[part]
    if value is ABSENT:
        del node[last]
    else:
        node[last] = value
    return changed


@lru_cache(64)
def _resolved(container: str) -> str:
    return json.dumps(OmegaConf.to_container(OmegaConf.create(json.loads(container)), resolve=True))


def resolved(container: dict[str, Any]) -> dict[str, Any]:
    """A copy without interpolations. OmegaConf gets those and what they read; the whole would take it 30 ms."""
    whole = json.dumps(container)
    texts = {key: text for key, text in flat(container, "") if isinstance(text, str) and "${" in text}
    assert whole.count("${") == sum(text.count("${") for text in texts.values())
    read = {name for text in texts.values() for name in re.findall(r"\$\{(?:oc\.select:)?(\w+)", text)}
    part = {"texts": list(texts.values()), **{name: container[name] for name in sorted(read) if name in container}}
    values = json.loads(_resolved(json.dumps(part)))["texts"]
    plain: dict[str, Any] = json.loads(whole)
    for key, value in zip(texts, values, strict=True):
        parent, _, last = key.rpartition(".")
        (get(plain, parent) if parent else plain)[last] = value
    return plain


def parse(program: str, container: dict[str, Any]) -> Any:
    """What the program makes of its configuration; ConfigError if that is not valid."""
    if program == "train":
        return parse_train(container)
    if program == "record":
        _, problems = parse_parts(container, RIG)
        if problems:
            raise ConfigError(problems)
    kind = settings_of(program)
    return parsed(kind, {f.name: container[f.name] for f in fields(kind) if f.name in container})


def settings_of(program: str) -> Any:
    """The class of a verb's settings that are no group's."""
    return app_of(program).settings


def complaints(program: str, container: dict[str, Any]) -> list[str]:
    try:
        parse(program, resolved(container))
    except ConfigError as error:
        return error.problems
    return []


def other_values(value: Any) -> list[Any]:
    """Guesses at other valid values of a leaf, the most telling first."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value + 2, 2 * value, value - 1, 4 * value]
    if isinstance(value, float):
        if value == 0.0:
            return [0.1, 0.01, -0.1, 1.0]
        return [*(f * value for f in (0.5, 1.5)), value + 0.1, value - 0.1, *(f * value for f in (10.0, 0.1, 0.01))]
    if value is None:
        return [0.1, 1, "other"]
    return []


def other_lists(name: str, value: list[Any]) -> Iterator[tuple[str, list[list[Any]]]]:
    """Name of each number in a list, which may hold lists, and the lists with another number there."""
    for k, v in enumerate(value):
        here = f"{name}[{k}]"
        for inner, others in other_lists(here, v) if isinstance(v, list) else [(here, other_values(v))]:
            yield inner, [[*value[:k], other, *value[k + 1 :]] for other in others]


def with_other_term(container: dict[str, Any], key: str) -> Iterator[dict[str, Any]]:
    """Configurations in which ``term`` names another term, with its own defaults for parameters."""
    group, path = key.split(".")[0], key.rpartition(".")[0]
    now, slots = get(container, path), MANY_TERMS.get(group)
    kept = {k: v for k, v in now.items() if slots and k in slots.model_fields}
    for name in registry.members(group):
        if name != now["term"]:
            yield put(container, path, {"term": name, **kept})


def variants(program: str, container: dict[str, Any], key: str, walk: Walk) -> dict[str, list[dict[str, Any]]]:
    """Changed configurations by what is changed: the leaf, or one element of it. One of each must make a difference."""
    value = get(resolved(container), key)
    if (path := f"{program}:{key}") in {**OTHER, **MADE}:
        other = OTHER[path] if path in OTHER else str(MADE[path](walk))
        return {key: [put(container, key, [other] if key == "files" else other)]}
    if key == "policy":  # in place of a run
        return {key: [put(put(container, "run", None), key, "paper")]}
    if value == {}:
        return {key: [put(container, key, ABSENT)]}
    if key.endswith(".term") and key.split(".")[0] in (*MANY_TERMS, *ONE_TERM):
        return {key: list(with_other_term(container, key))}
    if isinstance(value, list):
        return {name: [put(container, key, v) for v in changed] for name, changed in other_lists(key, value)}
    if isinstance(value, str):  # the schema's complaint lists what may stand there
        allowed = [m for line in complaints(program, put(container, key, "?")) for m in re.findall(r"'(\w+)'", line)]
        return {key: [put(container, key, v) for v in [*allowed, f"{value}_other"] if v != value]}
    return {key: [put(container, key, v) for v in other_values(value)]}


# ---------------------------------------------------------------------- comparison


def same(a: Any, b: Any) -> bool:
    """Equal; numbers up to rounding, so that a term that is zero but for rounding does not count as acting."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, torch.Tensor | np.ndarray | float) and isinstance(b, torch.Tensor | np.ndarray | float):
        x, y = np.asarray(a), np.asarray(b)
        return x.shape == y.shape and bool(np.allclose(x, y, rtol=1e-6, atol=1e-7, equal_nan=True))
    return bool(a == b)


class Kept:
    """What a trace has shown, kept for the next comparison; it goes on only as far as somebody looks.

    Most keys show within the first steps, and then the training and the walks that follow need not be run at all.
    """

    def __init__(self, trace: Trace) -> None:
        self._trace, self._seen = trace, list[tuple[str, Any]]()

    def __iter__(self) -> Iterator[tuple[str, Any]]:
        for k in itertools.count():
            if k == len(self._seen):
                try:
                    self._seen.append(next(self._trace))
                except StopIteration:
                    return
            yield self._seen[k]


def difference(base: Iterable[tuple[str, Any]], other: Iterable[tuple[str, Any]]) -> str | None:
    """Name of the first thing that is not the same, or None."""
    for (name, a), found in itertools.zip_longest(base, other, fillvalue=("end", None)):
        if name != found[0] or not same(a, found[1]):
            return name
    return None


class Walk:
    """Composes, traces and compares; keeps what several leaves need."""

    def __init__(self, scratch: Path, make_net: Callable[..., Path]) -> None:
        self._scratch, self._make_net = scratch, make_net
        self._count = itertools.count()
        self._bases: dict[str, Kept] = {}
        self._runs: dict[str, Path] = {}
        self._nets: dict[int, Path] = {}

    def folder(self) -> Path:
        folder = self._scratch / str(next(self._count))
        folder.mkdir()
        return folder

    def trained(self, name: str, *overrides: str) -> Path:
        """A finished run on rough ground that makes big movements, whose pushes are frequent."""
        if name not in self._runs:
            container = resolved(small("train", compose("train", ("terrain=rough", *overrides))))
            container["terrain"]["platform"] = 0.2
            container["event"]["push"]["interval"] = [0.04, 0.06]
            container["action"]["scale"] = 20.0
            run = self._scratch / name
            run_folder.write(run, container)
            trainer.train(parse_train(container), container, run)
            self._runs[name] = run
        return self._runs[name]

    def net(self, seed: int) -> Path:
        """An actuator net for every second physics step."""
        if seed not in self._nets:
            self._nets[seed] = self._make_net(seed=seed, period=2 * SMALL["train"]["sim.physics_dt"])
        return self._nets[seed]

    def recorded(self, name: str, changes: Mapping[str, Any]) -> Path:
        """A folder of recordings of the simulated robot."""
        if name not in self._runs:
            folder = self._scratch / name
            container = small("record", compose("record", ("backend.threads=1", f"out={folder}")))
            for key, value in changes.items():
                container = put(container, key, value)
            list(record_trace(resolved(container), self))
            self._runs[name] = folder
        return self._runs[name]

    def exported(self, name: str, *overrides: str) -> Path:
        """The bundle of a finished run."""
        file = self._scratch / f"{name}.zip"
        if not file.exists():
            file.write_bytes(build(self.trained(name, *overrides), seconds=0.1))
        return file

    def logs(self, seed: int) -> Path:
        """A folder with a log of each of two other robots."""
        folder, rng = self._scratch / f"logs{seed}", np.random.default_rng(seed)
        if not folder.exists():
            folder.mkdir()
            names = [name.format(i) for i in range(12) for name in ("jpos{}", "jvel{}", "jpos{}_des")]
            rows = np.column_stack([np.tile([20.0, 0.5], (9, 1)), rng.normal(size=(9, 36))])
            np.savetxt(folder / "go2.csv", rows, delimiter=",", header=",".join(["kp", "kd", *names]), comments="")
            moved: dict[str, Any] = {key: rng.normal(size=(9, 2)) for key in ("pos", "vel", "cmd_pos")}
            np.savez(folder / "arm.npz", t=np.arange(9) / 50.0, joint_names=["Base", "Jaw"], **moved)
        return folder

    def needs(self, leaf: Leaf) -> list[str]:
        """Overrides without which the program of a leaf does nothing, or nothing that the leaf could change."""
        if leaf.program in ("eval", "play", "export"):
            return [f"run={self.trained('run')}"]
        if leaf.program == "record":
            needed = leaf.key in ("run", "policy", "episodes")
            walk = ["excitation=[policy]", f"run={self.trained('run')}"] if needed else []
            stand = ["support=ground"] if leaf.key == "sensors.truth" else []  # a held trunk does not move
            return ["backend.threads=1", *walk, *stand]
        if leaf.program == "record_audit":
            folders = [
                self.recorded("whole", {}),
                *([self.recorded("second", {"seed": 5})] if leaf.key == "tables" else []),
            ]
            return [f"files=[{','.join(map(str, folders))}]"]  # the table of a single one is always printed
        if leaf.program == "record_import" and leaf.key == "columns":
            table = ["source=csv", f"path={self.logs(0)}", "options={robot: go2, rate_hz: 100.0}"]
            return [*table, "columns={q_hip: jpos0}"]
        if leaf.program == "record_import" and leaf.key == "drop":
            spiked = self._scratch / "spiked.csv"
            moved = np.column_stack([np.arange(200) / 100.0, np.sin(np.arange(200) / 20.0)])
            moved[100, 1] += 1.0
            np.savetxt(spiked, moved, delimiter=",", header="t,q", comments="")
            return ["source=csv", f"path={spiked}", "options={robot: arm}", "columns={t: t, q_elbow: q}"]
        if leaf.program == "record_import":
            return ["source=go2_in_air", f"path={self.logs(0)}"]
        if leaf.program == "fit-actuator" and leaf.key == "gains":
            two = {**FIVE, "gains": [[20.0, 0.5], [30.0, 0.5]]}
            return [f"recordings={self.recorded('two gains', two)}", "inputs=[velocity]"]
        if leaf.program == "fit-actuator":
            return [f"recordings={self.recorded('five', FIVE)}"]
        if leaf.program == "export_check":
            return [f"file={self.exported('run')}"]
        if leaf.program == "deploy":
            swings = ["command=sinusoid"] if leaf.key.startswith("sinusoid.") else []
            return [f"bundle={self.exported('run')}", *swings]
        if leaf.program == "sim":
            return ["terrain=rough"] if leaf.key == "tile" else []
        if leaf.program == "gap":
            return [f"logs={self.recorded('held', HELD)}"]
        return []

    def setup(self, leaf: Leaf) -> dict[str, Any]:
        """The configuration, interpolations unresolved, in which a leaf is tried."""
        needs = self.needs(leaf)
        if leaf.file == "actuator/net":  # its period is not the simulation's, so that it matters what is done then
            needs = [f"actuator.file={self.net(0)}", "actuator.period=hold", "ppo.coarse_physics=1"]
        container = small(leaf.program, compose(leaf.program, (*leaf.choice, *needs)))
        return put(container, "excitation", ["policy"]) if "excitation=[policy]" in needs else container

    def trace(self, program: str, container: dict[str, Any], key: str) -> Trace:
        how = verb_trace if key in THE_VERBS else TRACES[program]
        return how(resolved(container), self)

    def base(self, program: str, container: dict[str, Any], key: str) -> Kept:
        identity = f"{program} {key in THE_VERBS} {json.dumps(container, sort_keys=True)}"
        if identity not in self._bases:
            self._bases[identity] = Kept(self.trace(program, container, key))
        return self._bases[identity]

    def effect(self, program: str, before: dict[str, Any], after: dict[str, Any], key: str) -> str | None:
        with closing(self.trace(program, after, key)) as other:
            return difference(self.base(program, before, key), other)

    def dead(self, leaf: Leaf) -> list[str]:
        """The leaf, or the elements of it, that make no difference."""
        before = self.setup(leaf)
        if leaf.overlay and not has(before, leaf.key):  # of a term that the experiment adds
            before = put(before, leaf.term, get(read(leaf.file), leaf.term))
        elif leaf.overlay and leaf.key not in SMALL["train"]:  # what an experiment sets is itself the other value
            return self.idle("train", before, leaf.key, {leaf.key: [put(before, leaf.key, leaf.value)]})
        return self.idle(leaf.program, before, leaf.key, variants(leaf.program, before, leaf.key, self))

    def idle(
        self, program: str, before: dict[str, Any], key: str, changes: dict[str, list[dict[str, Any]]]
    ) -> list[str]:
        """The changes by name none of whose valid configurations makes a difference."""
        assert changes, f"{key}: no way to vary it; OTHER needs a value"
        found = []
        for name, changed in changes.items():
            valid = (c for c in changed if not complaints(program, c))
            if not any(self.effect(program, before, c, key) for c in valid):
                found.append(name)
        return found


@cache
def _compose(program: str, overrides: tuple[str, ...]) -> str:
    return json.dumps(composing.compose(program, overrides, resolve=False))


def compose(program: str, overrides: tuple[str, ...] = ()) -> dict[str, Any]:
    """Compose without resolving interpolations, so that a change goes where they lead."""
    container: dict[str, Any] = json.loads(_compose(program, overrides))
    return container


def small(program: str, container: dict[str, Any]) -> dict[str, Any]:
    for key, value in SMALL[program].items():
        try:
            container = put(container, key, value)
        except KeyError:  # of a choice that is not made here
            assert key.startswith("curriculum."), f"SMALL: no such key {key}"
    return container


# ---------------------------------------------------------------------- traces


def provoked(core: Go1Core, steps: int = 12) -> Trace:
    """Throw the robots about, so that whatever can happen to one happens to some, and look at everything.

    Every other robot is put into a random state: at any height and tilt, joints anywhere and fast, feet long in the
    air or on the ground, told to stand, commands and pushes running out. The others go on from where they are.
    """
    rng = np.random.default_rng(0)
    yield "first observation", core.reset().clone()
    yield from everything(core)
    n = core.num_envs
    for step in range(steps):
        here = torch.arange(n) % 2 == step % 2
        qpos, qvel = core.backend.qpos.clone(), core.backend.qvel.clone()
        qpos[:, 2] = core.spawn[:, 2] + torch.tensor(rng.uniform(0.1, 0.4, n))
        tilt = rng.normal(size=(n, 3)) * rng.choice([0.1, 0.5, 1.0], (n, 1))
        quat = np.concatenate([np.ones((n, 1)), tilt], 1)
        qpos[:, 3:7] = torch.tensor(quat / np.linalg.norm(quat, axis=1, keepdims=True))
        low, high = np.tile([[-0.863, 0.863], [-0.686, 4.501], [-2.818, -0.888]], (4, 1)).T
        qpos[:, 7:] = torch.tensor(rng.uniform(low, high, (n, 12)))
        qvel[:, :6] = torch.tensor(rng.uniform(-1, 1, (n, 6)) * rng.choice([0.3, 2.0], (n, 1)))
        qvel[:, 6:] = torch.tensor(rng.uniform(-40, 40, (n, 12)))
        core.backend.reset(here, qpos, qvel)
        for name in ("air", "contact", "last_air", "last_contact"):
            getattr(core.feet, name)[here] = torch.tensor(rng.uniform(0, 1, (n, 4)), dtype=torch.float32)[here]
        core.command.value[here & (torch.arange(n) % 4 < 2)] = 0.0
        for part in (core.command, *core.events.values()):
            if hasattr(part, "time_left"):
                part.time_left[here] = 0.0
        size = rng.choice([0.3, 3.0, 300.0], (n, 1))
        result = core.step(torch.tensor(rng.normal(size=(n, 12)) * size, dtype=torch.float32))
        for field in fields(result):
            yield f"step {step}: {field.name}", getattr(result, field.name).clone()
        if step % 4 == 3:
            yield from everything(core)


def everything(core: Go1Core) -> Trace:
    for part, state in core.state_dict().items():
        if part != "random":  # holds the seed as it was given
            yield part, state


def train_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """Build learner and environment, provoke the environment; then a short training run."""
    config = parse_train(container)
    with stand_ins() as (asked, _):
        # Without this the other device is refused: a test of its own.
        with pytest.MonkeyPatch.context() as pretend:
            pretend.setattr(torch.cuda, "is_available", lambda: True)
            ppo = trainer.build(config)
        threads = torch.get_num_threads()
    core = ppo.get_env().core  # type: ignore[union-attr]
    yield "first weights", {name: weight.clone() for name, weight in ppo.policy.state_dict().items()}
    yield "threads of torch", threads
    yield "threads of MuJoCo", core.backend._batch.nthread
    yield "device", asked[0]
    yield "ground", {"heights": core.terrain.heights, "origins": core.terrain.tile_origins}
    yield from provoked(core)
    yield from trained(config, container, walk.folder())


def trained(config: TrainConfig, container: dict[str, Any], run: Path) -> Trace:
    """What a training run leaves."""
    with stand_ins() as (_, told):
        ppo = trainer.train(config, container, run)
    yield "weights", dict(ppo.policy.state_dict())
    yield "learning rate", ppo.policy.optimizer.param_groups[0]["lr"]
    yield "steps", ppo.num_timesteps
    yield "files", sorted(str(p.relative_to(run)) for p in run.rglob("*") if "tfevents" not in p.name)
    if (run / "metrics.csv").exists():
        with (run / "metrics.csv").open(newline="") as file:
            yield "metrics", [{k: float(v) if v else None for k, v in row.items()} for row in csv.DictReader(file)]
    yield "Weights & Biases", told


@contextmanager
def stand_ins() -> Iterator[tuple[list[str], list[Any]]]:
    """For a GPU and for Weights & Biases; yield which devices were asked for, and what was reported."""
    asked: list[str] = []  # a machine without a GPU has no other device to go to
    told: list[Any] = []

    def get_device(device: Any) -> torch.device:
        asked.append(str(device))
        return torch.device("cpu")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stable_baselines3.common.base_class.get_device", get_device)
        patch.setitem(sys.modules, "wandb", wandb_stub(told))
        patch.setattr(metrics, "_bundle", lambda run: None)  # tests/test_logging.py has what packs it
        torch.set_num_threads(1)
        try:
            yield asked, told
        finally:
            torch.set_num_threads(1)


def wandb_stub(told: list[Any]) -> types.ModuleType:
    """A module that writes down what it is told, but for the copy of the configuration and the identity of the run."""

    def init(**arguments: Any) -> Any:
        told.append({k: v for k, v in arguments.items() if k not in ("config", "id", "dir", "settings")})
        run = {
            "id": "stub",
            "dir": arguments["dir"],
            "log_artifact": lambda artifact: told.append(artifact.files),
            "finish": lambda: None,
        }
        return types.SimpleNamespace(log=lambda values, step: told.append(sorted(values)), **run)

    def artifact(name: str, type: str) -> Any:
        files: list[str] = []
        return types.SimpleNamespace(files=files, add_file=lambda path, name: files.append(name))

    module = types.ModuleType("wandb")
    module.init, module.Settings, module.Artifact = init, dict, artifact  # type: ignore[attr-defined]
    return module


THE_VERBS = ("resume", "start_from")
"""Settings that act before the training, in the verb."""


def verb_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """Run the verb itself, with stubs for the training: in which folder it would train, with whose weights."""
    from go1exp.cli.train import APP

    folders: list[list[str | None]] = []
    chosen = [f"{key}={json.dumps(container[key])}" for key in THE_VERBS if container[key]]

    def noted(config: TrainConfig, container: dict[str, Any], run: Path, first: policy.Weights | None) -> None:
        folders.append([run.name, first.about["run"] if first else None])

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()):
        patch.setattr(sys, "argv", sys.argv)
        patch.setenv("HYDRA_FULL_ERROR", "0")  # the verb changes both
        patch.setattr(trainer, "train", noted)
        fitting = ["ppo=paper"] if container["start_from"] else []  # the network of policy=paper
        assert APP.run([*fitting, f"hydra.run.dir={walk.folder() / 'new'}", *chosen]) == 0
    yield "folder", folders


def outcome(
    program: str, container: dict[str, Any], walk: Walk, statuses: tuple[int, ...] = (0,)
) -> tuple[str, dict[str, bytes]]:
    """Run a verb without its Hydra application; return what it printed, and the files it wrote by path."""
    said, here = io.StringIO(), walk.folder()
    places = [here, *(Path(run) for run in [container.get("run")] if run)]
    before = {p for place in places for p in place.rglob("*")}
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said):
        patch.chdir(here)
        status = app_of(program).task(container) or 0
    assert status in statuses
    files = {p: place for place in places for p in place.rglob("*") if p not in before and p.is_file()}
    written = {p.relative_to(place).as_posix(): p.read_bytes() for p, place in files.items()}
    for file in files:
        file.unlink()
    return said.getvalue(), written


def eval_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """The report without the settings that it repeats, and where it lies."""
    _, files = outcome("eval", container, walk)
    yield "files", sorted(files)
    for name, content in files.items():
        if name.endswith(".parquet"):  # rows of what the report has
            continue
        report = json.loads(content)
        yield "report", {k: report.get(k) for k in ("commands", "rmse", "falls", "episodes", "delay_margin")}


def play_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """The frames of the film, or that the live viewer was opened; a stub draws the state as numbers."""
    from go1exp.evaluate import video

    seen: list[Any] = []

    class Camera:
        def __init__(self, core: Go1Core, width: int, height: int) -> None:
            self.stage = types.SimpleNamespace(core=core)

        def frame(self, env: int) -> Any:
            seen.append(self.stage.core.backend.qpos[env].clone())
            return np.zeros((64, 64, 3), np.uint8)

        def close(self) -> None:
            pass

    def write_mp4(path: Path, frames: Any, fps: float) -> None:
        path.write_text(f"{len(list(frames))} frames at {fps}")

    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DISPLAY", raising=False)
        patch.delenv("WAYLAND_DISPLAY", raising=False)
        patch.setattr(video, "Camera", Camera)
        patch.setattr(video, "write_mp4", write_mp4)
        patch.setattr(video, "write_strip", lambda path, frames: path.write_text("strip"))
        patch.setattr(video, "live", lambda core, policy: seen.append("live"))
        _, files = outcome("play", container, walk)
    yield "frames", seen
    yield "files", files


def record_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """Where the recordings lie and what their channels hold; their names and metadata repeat the settings."""
    from go1exp.logs.record import simulate

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "SETTLE_S", 0.02)
        _, files = outcome("record", container, walk)
    yield from recorded(files)


def recorded(files: Mapping[str, bytes]) -> Trace:
    yield "folders", [Path(name).parent.as_posix() for name in files]
    for content in files.values():
        columns = parquet.read_table(io.BytesIO(content)).to_pydict()
        yield "channels", {name: np.asarray(column, dtype=float) for name, column in columns.items()}


def audit_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """What is said of the recordings, without their names, and where it is written."""
    from go1exp.base.errors import AUDIT as STATUSES

    said, files = outcome("record_audit", container, walk, tuple(STATUSES.values()))
    yield "findings", [line for line in said.splitlines() if ".parquet" not in line and "written to" not in line]
    yield "files", sorted(files)


def import_trace(container: dict[str, Any], walk: Walk) -> Trace:
    yield from recorded(outcome("record_import", container, walk)[1])


def fit_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """Errors in the report, the net's numbers, and for how long it was trained; not what the net says of itself."""
    from go1exp.cli import fit_actuator
    from go1exp.gap.actuator_net import fitting
    from go1exp.sim.actuator.actuator_net import load

    def plot(result: fitting.FitResult, folder: Path) -> list[Path]:
        (folder / "picture.png").touch()
        return [folder / "picture.png"]

    epochs: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, "plot", plot)
        patch.setattr(fit_actuator, "spinner", lambda total, what: lambda done, total: epochs.append(done))
        _, files = outcome("fit-actuator", container, walk)
    yield "files", sorted(files)
    found = {Path(name).name: content for name, content in files.items()}
    report = json.loads(found["report.json"])
    yield "report", {k: report[k] for k in ("cells", "episodes", "missing", "thresholds")}
    file = walk.folder() / "net.npz"
    file.write_bytes(found["net.npz"])
    yield "net", load(file).arrays()
    yield "epochs", epochs


def gap_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """What was found, written and proved, without provenance, and the batches of robots that were run.

    Two effects are all that the library has here, and one of them all that the nominal model may vary: the search is
    the whole one, but a replay has ten variants and not sixty.
    """
    from go1exp.base.errors import DOES_NOT_HOLD, EXIT_CODES
    from go1exp.gap.robots import go1
    from go1exp.gap.search import tolerances

    built: set[tuple[int, int]] = set()

    def backend(model: Any, blocks: Any, num: int, threads: int) -> Any:
        built.add((num, threads))
        return MujocoCpu(model, blocks, num, threads)

    few = put(container, "search.effects", ["coulomb", "viscous"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tolerances, "nominal", lambda robot: ("viscous",))
        patch.setattr(go1, "MujocoCpu", backend)
        _, files = outcome("gap", few, walk, (*EXIT_CODES.values(), DOES_NOT_HOLD))
    yield "files", sorted(files)
    yield "batches", sorted(built)
    for name, content in sorted(files.items()):
        if name.endswith("/verdict.json"):
            found = json.loads(content)
            yield "answer", {k: v for k, v in found.items() if k not in ("provenance", "seconds")}
        if name.endswith("/applied.json"):
            proof = json.loads(content)
            yield "proof", {k: v for k, v in proof.items() if k not in ("physics_dt", "files")}
        if name.endswith(".yaml"):
            yield name, OmegaConf.to_container(OmegaConf.create(content.decode()))


def export_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """The policy, what it is said to be, and its trace; not the configuration that goes with them."""
    _, files = outcome("export", container, walk)
    yield "files", sorted(files)
    for content in files.values():
        found = loads(content, "bundle")
        yield "checkpoint", found.metadata.trained.sha256
        yield "trace", found.trace


def check_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """What is said of the policy, without the file's name."""
    said, _ = outcome("export_check", container, walk)
    yield "said", [re.sub(r"\S+\.zip", "", line) for line in said.splitlines()]


def deploy_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """Walks at a time of their own, with a robot that speaks, one that falls silent, and one that never speaks.

    What its drives were told, cycle by cycle, and what was logged, but for the account, which repeats settings.
    """
    for silent_from in (np.inf, 0.08, 0.0):
        refused, files = "", dict[str, bytes]()
        with lockstep(lambda state, begin=silent_from: state if state.clock < begin else None) as world:  # type: ignore[misc]
            try:
                _, files = outcome("deploy", container, walk, (0, *STATUS.values()))
            except Expected as error:
                refused = str(error)
        if refused:
            yield "refused", refused
            return
        yield "clock", world.spins
        yield "folders", sorted({Path(name).parent.as_posix() for name in files})
        for name, content in sorted(files.items()):
            if name.endswith(".npz"):
                cycles = dict(np.load(io.BytesIO(content)))
                yield "cycles", {name: values for name, values in cycles.items() if name != "phases"}
            if name.endswith(".parquet"):
                yield from recorded({name: content})


def sim_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """What a client that moves a leg hears, and where the robot truly is, tick by tick."""
    from go1exp.deploy.sim_robot import alone

    seen: list[Any] = []

    def lived(server: Any, going: Any, say: Any, seconds: float | None) -> None:
        seen.append([server.address, seconds])
        far = go1_wire.pack_command(LowCmd(np.tile([0.1, 1.2, -1.8], 4), np.full(12, 20.0), np.full(12, 0.5)))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.setblocking(False)
            for k in range(60):
                client.sendto(go1_wire.IDLE if k < 5 else far, server.address)
                server.tick()
                with suppress(BlockingIOError):
                    while True:
                        seen.append([k, client.recv(2000)])
        seen.insert(1, np.array(server.truth))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(alone, "serve", lived)
        outcome("sim", container, walk)
    yield from (("lived", part) for part in seen)


def list_trace(container: dict[str, Any], walk: Walk) -> Trace:
    yield "output", outcome("list", container, walk)[0]


def bench_trace(container: dict[str, Any], walk: Walk) -> Trace:
    """What is built and for how long it runs, by a clock of its own and without other processes."""
    from go1exp.evaluate.bench import env
    from go1exp.sim.physics import mujoco_cpu

    built: list[Any] = []
    ticks = itertools.count()

    def batch(model: Any, *arguments: Any, **options: Any) -> Any:
        made = Batch(model, *arguments, **options)
        built.append([made.nsim, made.nthread, model.opt.timestep])
        return made

    def memory(overrides: list[str]) -> float:
        built.append(overrides)
        return 0.0

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(env, "time", types.SimpleNamespace(perf_counter=lambda: 0.04 * next(ticks)))
        patch.setattr(mujoco_cpu, "Batch", batch)
        patch.setattr(env, "Batch", batch)
        patch.setattr(env, "subproc_subject", lambda task: (lambda: 1, lambda: None))
        patch.setattr(env, "memory_per_env_kb", memory)
        said, files = outcome("bench", container, walk)
    yield "built", built
    yield "time", next(ticks)
    yield "figures", re.findall(r"^ *[\d,.]+  .*", said, re.MULTILINE)
    yield "files", files


TRACES: dict[str, Callable[[dict[str, Any], Walk], Trace]] = {
    "train": train_trace,
    "eval": eval_trace,
    "play": play_trace,
    "record": record_trace,
    "record_audit": audit_trace,
    "record_import": import_trace,
    "fit-actuator": fit_trace,
    "gap": gap_trace,
    "export": export_trace,
    "export_check": check_trace,
    "deploy": deploy_trace,
    "sim": sim_trace,
    "list": list_trace,
    "bench": bench_trace,
}
"""Program (a file at the root of conf/) -> its trace."""


# ---------------------------------------------------------------------- the tests


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory, make_net: Callable[..., Path]) -> Iterator[Walk]:
    """What the leaves share. A policy is exported once: torch takes 3 s, whatever the rest of the bundle is."""
    kept: dict[str, bytes] = {}

    def to_onnx(module: DeployedPolicy) -> bytes:
        weights = {name: value.tolist() for name, value in module.state_dict().items()}
        identity = repr((weights, [(t.key, t.entry.name, t.parameters) for t in module._terms], module._action))
        if identity not in kept:
            kept[identity] = graph.to_onnx(module)
        return kept[identity]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("go1exp.deploy.export.build.to_onnx", to_onnx)
        yield Walk(tmp_path_factory.mktemp("keys"), make_net)


VERB = ("go1exp/cli/", "go1exp/sim/task.py", "go1exp/config/schema/")
RUN = (*VERB, "go1exp/train/")
SLOW = {
    "gap": ("conf/gap.yaml", "go1exp/gap/", "go1exp/sim/effects/", *VERB),
    "record_audit": ("conf/record_audit.yaml", "go1exp/logs/audit/", *VERB),
    "export": ("conf/export.yaml", "go1exp/deploy/export/", *VERB),
    "export_check": ("conf/export_check.yaml", "go1exp/deploy/export/", *VERB),
    "deploy": ("conf/deploy.yaml", "go1exp/deploy/", "go1exp/deploy/sim_robot/", *VERB),
    "sim": ("conf/sim.yaml", "go1exp/deploy/sim_robot/", *VERB),
    "fit-actuator": ("conf/fit-actuator.yaml", "go1exp/gap/actuator_net/", *VERB),
    "eval": ("conf/eval.yaml", "go1exp/evaluate/", *VERB),
    "play": ("conf/play.yaml", "go1exp/evaluate/", *VERB),
    "bench": ("conf/bench.yaml", "go1exp/evaluate/bench/", *VERB),
    "ppo": ("conf/ppo/", *RUN),
    "logger": ("conf/logger/", *RUN),
    "experiment": ("conf/experiment/", *RUN),
    "effect": ("conf/effect/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py"),
}
"""Programs, and groups of train, of which a trace takes long, and what they are made of. ``make test`` asks of their
keys only that each is read, in one trace for all of a program; ``make test-all`` that each acts. The terms of the MDP,
drives, randomisation and ground act in both (``REPEATED``); that each parameter of an effect moves a robot is also the
contract of effects (tests/contracts/test_effects.py)."""


def repeated(leaves: Iterable[Leaf]) -> set[str]:
    """Names of the leaves that another choice of the group has too, of the same term, but for the first of each."""
    leaves = list(leaves)
    names = {(leaf.file, leaf.key): leaf.value for leaf in leaves if leaf.key.endswith("term")}
    first: dict[tuple[Any, ...], str] = {}
    for leaf in leaves:
        parts = leaf.key.split(".")
        terms = [names.get((leaf.file, ".".join([*parts[:n], "term"]))) for n in range(1, len(parts))]
        first.setdefault((leaf.program, leaf.key, leaf.value if parts[-1] == "term" else None, *terms), leaf.name)
    return {leaf.name for leaf in leaves} - set(first.values())


REPEATED = repeated(leaf for leaf in WALKED if not leaf.overlay)
"""``make test`` tries a key of a term in one choice, ``make test-all`` in each: ``reward.gait.weight`` has four."""


def marks(leaf: Leaf) -> list[pytest.MarkDecorator]:
    """Whether a leaf is for ``make test-all``, and what its trace is made of."""
    start = leaf.file.split("/")[0]
    if start in SLOW:
        return [pytest.mark.slow(*SLOW[start])]
    return [pytest.mark.slow(f"conf/{leaf.file}.yaml", "go1exp/mdp/")] if leaf.name in REPEATED else []


READ: dict[str, list[type]] = {
    **{program: [settings_of(program)] for program in SMALL if program in SLOW},
    "ppo/paper": [PPOConfig, LoggerConfig, CheckpointConfig],
}
"""A file of a program or group -> the dataclasses of its settings."""


@pytest.mark.parametrize("leaf", [pytest.param(leaf, id=leaf.name, marks=marks(leaf)) for leaf in WALKED])
def test_every_key_acts(leaf: Leaf, walk: Walk) -> None:
    assert not (dead := walk.dead(leaf)), f"{leaf.file}.yaml: nothing changes with {', '.join(dead)}"


def unread(kinds: Iterable[type], work: Callable[[], object]) -> list[str]:
    """Fields of dataclasses that nothing reads while ``work`` is done; checks and copies of them do not count."""
    read: set[tuple[type, str]] = set()

    def noted(self: Any, name: str) -> Any:
        reader = sys._getframe(1)
        if reader.f_globals.get("__name__") != "dataclasses" and reader.f_code.co_name != "__post_init__":
            read.add((type(self), name))
        return object.__getattribute__(self, name)

    with pytest.MonkeyPatch.context() as patch:
        for kind in kinds:
            patch.setattr(kind, "__getattribute__", noted)
        work()
    return [
        f"{kind.__name__}.{field.name}" for kind in kinds for field in fields(kind) if (kind, field.name) not in read
    ]


@pytest.mark.parametrize("file", READ)
def test_every_key_of_a_slow_program_is_read(file: str, walk: Walk) -> None:
    leaf = Leaf(file, "", None)
    parts = [t for kind in READ[file] for t in get_type_hints(kind).values() if is_dataclass(t)]
    kinds = list(dict.fromkeys([*READ[file], *(part for part in parts if isinstance(part, type))]))
    container = walk.setup(leaf)
    assert unread(kinds, lambda: list(walk.trace(leaf.program, container, ""))) == []


def test_a_field_that_is_only_checked_and_copied_is_unread() -> None:
    @dataclass(frozen=True)
    class Two:
        used: int = 1
        unused: int = 2

        def __post_init__(self) -> None:
            assert self.unused

    assert unread([Two], lambda: asdict(replace(Two(), used=3)) and Two().used) == ["Two.unused"]


def test_a_repeated_key_is_one_of_the_same_term_in_another_choice() -> None:
    files = ("reward/a", {"gait": {"weight": 1.0}}), ("reward/b", {"gait": {"weight": 2.0, "term": "gait_clock"}})
    leaves = [Leaf(name, key, value) for name, content in files for key, value in flat(content, "reward")]
    assert repeated(leaves) == set()
    assert repeated([*leaves, Leaf("reward/c", "reward.gait.weight", 3.0)]) == {"reward/c.yaml:reward.gait.weight"}
    tried = [leaf for leaf in WALKED if leaf.name not in REPEATED]
    assert {leaf.key for leaf in WALKED} == {leaf.key for leaf in tried}


def test_exemptions_are_needed() -> None:
    assert not stale(EXEMPT, (leaf.name for leaf in LEAVES))


def test_the_tables_hold_no_keys_that_are_gone() -> None:
    known = {f"{leaf.program}:{leaf.key}" for leaf in LEAVES}
    mentioned = {f"{program}:{key}" for program, values in SMALL.items() for key in values} | {*OTHER, *MADE}
    assert not stale(mentioned, known)


# ---------------------------------------------------------------------- the test of the test


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(
            p, marks=[pytest.mark.slow(*SLOW[p])] if p in ("gap", "export", "export_check", "deploy", "sim") else []
        )
        for p in TRACES
    ],
)
def test_a_trace_repeats(program: str, walk: Walk) -> None:
    container = walk.setup(Leaf(program, "", None))
    assert list(walk.base(program, container, ""))
    assert difference(walk.base(program, container, ""), walk.trace(program, container, "")) is None


@pytest.mark.slow("go1exp/config/schema/", "go1exp/sim/task.py")
def test_dead_keys_are_found(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    def ghost(s: Snapshot, *, used: float = 1.0, unused: float = 1.0, half: Range = (0.0, 1.0)) -> torch.Tensor:
        return used * half[1] * s.joint_vel.square().sum(-1)

    monkeypatch.setitem(registry._REGISTRY["reward"], "ghost", registry.Entry("reward", "ghost", ghost))
    before = walk.setup(Leaf("train", "", None))
    before["reward"] = {"ghost": {"weight": 1.0, "used": 1.0, "unused": 1.0, "half": [0.0, 1.0]}}
    before["schedule"] = {}  # whose rows are those of reward=paper
    for key, dead in {"weight": [], "used": [], "unused": ["unused"], "half": ["half[0]"]}.items():
        path = f"reward.ghost.{key}"
        found = walk.idle("train", before, path, variants("train", before, path, walk))
        assert found == [f"reward.ghost.{name}" for name in dead]


def test_new_keys_are_found_and_old_exemptions_too(tmp_path: Path) -> None:
    (tmp_path / "reward").mkdir()
    (tmp_path / "train.yaml").write_text("defaults: [{reward: some}]\nsim: {new: 1.0}\nhydra: {job: {name: x}}\n")
    (tmp_path / "reward/some.yaml").write_text("gait: {weight: 1.0, list: [1, 2]}\nempty: {}\n")
    (tmp_path / "reward/none.yaml").write_text("{}\n")
    names = [leaf.name for leaf in read_leaves(tmp_path)]
    of_reward = [f"reward/some.yaml:reward.{key}" for key in ("gait.weight", "gait.list", "empty")]
    assert names == [*of_reward, "train.yaml:sim.new", "train.yaml:hydra.job.name"]
    assert [name for name in names if exemption(name)] == ["train.yaml:hydra.job.name"]
    old = "train.yaml:sim.old"
    assert stale(["train.yaml:hydra", old, "reward/some.yaml:reward.gait"], names) == [old]


ALIKE: list[tuple[Any, Any]] = [(1.0, 1.0 + 1e-8), (float("nan"),) * 2, (torch.zeros(3),) * 2, ({"x": [1.0]},) * 2]
OTHER_THAN: list[tuple[Any, Any]] = [
    *((1.0, 1.001), (torch.zeros(3), torch.zeros(4)), ({"x": [1.0]}, {"x": [2.0]}), ({"x": 1}, {"y": 1})),
    *(([1.0], [1.0, 1.0]), (None, 1.0), ("a", "b")),
]


def test_what_is_compared_is_alike_up_to_rounding_and_a_trace_that_ends_early_is_different() -> None:
    assert [same(a, b) for a, b in ALIKE + OTHER_THAN] == [True] * len(ALIKE) + [False] * len(OTHER_THAN)
    assert difference([("x", 1)], [("x", 1)]) is None
    assert difference([("x", 1), ("y", 2)], [("x", 1)]) == "y"
    assert difference([("x", 1)], [("x", 1), ("y", 2)]) == "end"
