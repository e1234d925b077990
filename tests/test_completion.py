"""Tab completion: what each word can become, without anything heavy, without a word on the terminal."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

import go1exp.logs.excitations
import go1exp.logs.importers
import go1exp.logs.record.motions  # noqa: F401  (registers every importer and excitation)
from go1exp.base.paths import data_root
from go1exp.cli import EVERY, SUBVERBS, VERBS, completion
from go1exp.cli.app import app_of
from go1exp.cli.completion import STAGES, WORDS, _importers, _listed, completions, serve
from go1exp.cli.gap import GapVerb
from go1exp.config.choices import config_folder, groups_in
from go1exp.config.schema import registry
from go1exp.sim.task import PPOConfig

PROGRAM = "import sys; from go1exp.cli import main; sys.exit(main())"

POLICIES = ("clock", "paper", "robust", "robust_history", "rough")
"""Shipped ones."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's folder with runs, recordings, an effect of their own and groups of their own."""
    for run in ("flat", "rough one"):
        (tmp_path / "runs" / run / "checkpoints").mkdir(parents=True)
        (tmp_path / "runs" / run / "config.yaml").touch()
    (tmp_path / "runs/flat/checkpoints/000400.pt").touch()
    logs = ("net.npz", "walk.zip", "logs/walk.parquet", "gap/effect.yaml")
    for file in (*logs, "mine/reward/short.yaml", "mine/weather/wind.yaml"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text("a: 1\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("", set(VERBS)),
        ("tr", {"train"}),
        ("trian rand=ta", set()),
        ("record au", {"audit"}),
        ("export ch", {"check", "checkpoint="}),
        ("export check fi", {"file="}),
        ("export check w", {"walk.zip"}),
        ("export check n", set()),
        ("record audit ou", {"out="}),
        ("record import opt", {"options="}),
        ("record import go2", {"go2_in_air"}),
        ("gap lo", {"localise", "logs=", "loop"}),
        ("compare pa", {"paper"}),
        ("compare paper pa", {"paper"}),
        ("list re", {"reward"}),
        ("list group=rew", {"group=reward"}),
        ("list --config-dir mine we", {"weather"}),
        ("train rand=ta", {"rand=table1"}),
        ("train rew", {"reward=", "reward."}),
        ("train rand=table1 ppo.iterat", {"ppo.iterations="}),
        ("train terrain=rough terrain.ro", {"terrain.rows="}),
        ("train ~reward.gai", {"~reward.gait"}),
        ("train experiment=abl", {"experiment=ablation/"}),
        ("train experiment=ablation/no_ga", {"experiment=ablation/no_gait", "experiment=ablation/no_gait_shaping"}),
        ("train -m experiment=ablation/no_gait,ablation/no_noi", {"experiment=ablation/no_gait,ablation/no_noise"}),
        ("train 'effect=[coulomb,visc", {"effect=[coulomb,viscous"}),
        ("train effect=[coulomb,cou", set()),
        ("train effect=gap/", {"effect=gap/effect.yaml"}),
        ("train --config-dir mine reward=sh", {"reward=short"}),
        ("train --config-dir mine +wea", {"+weather="}),
        ("train --config-dir mi", {"mine/"}),
        ("train --help rew", {"reward"}),
        ("train resume=runs/f", {"resume=runs/flat"}),
        ("train start_from=", {f"start_from={f}" for f in (*POLICIES, "runs/")}),
        ("train hydra/launcher=", {f"hydra/launcher={f}" for f in ("basic", "joblib", "ray", "slurm", "slurm_gpu")}),
        ("train hydra/l", {"hydra/launcher="}),
        ("train study=", {"study=ablations", "study=walking_cpu"}),
        ("train --he", {"--help"}),
        ("eval run=", {"run=runs/"}),
        ("eval run=lo", set()),
        ("eval run=runs/flat/", set()),
        ("report r", {"runs/"}),
        ("report folders=[runs/flat,", {"folders=[runs/flat,runs/"}),
        ("compare runs/f", {"runs/flat"}),
        ("train logger.dir=w", {"logger.dir=walk.zip"}),
        ("eval run=runs/", {"run=runs/flat", "run=runs/rough one"}),
        ("eval run=runs/flat checkpoint=0", {"checkpoint=000400.pt"}),
        ("eval policy=", {f"policy={name}" for name in POLICIES}),
        ("eval noise=", {"noise=true", "noise=false"}),
        ("eval epis", {"episodes="}),
        ("eval rob", set()),
        ("deploy walk.zip rob", {"robot="}),
        ("deploy walk.zip robot=", {"robot=sim", "robot=go1"}),
        ("deploy w", {"walk.zip"}),
        ("gap logs=logs/", {"logs=logs/walk.parquet"}),
        ("record seco", {"seconds="}),
        ("record effect=cou", {"effect=coulomb"}),
        ("fit-actuator epo", {"epochs=", "epoch_rows="}),
        ("record --cfg j", {"job"}),
    ],
)
def test_tab_completes(line: str, offered: set[str], folder: Path) -> None:
    answer = completions(f"go1exp {line}")
    assert len(answer) == len({*answer})
    assert {*answer} == offered


def test_tab_offers_words_and_settings_after_a_verb_that_has_both() -> None:
    assert {*SUBVERBS["record"], "seconds=", "effect="} <= {*completions("go1exp record ")}


def test_words_that_are_offered_are_words_that_exist() -> None:
    """They are written down, so that nothing need be imported to know them."""
    assert {*STAGES, "all"} == {*get_args(get_type_hints(GapVerb)["stage"])}
    assert {*_importers()} == registry.members("importer").keys()
    assert {*_listed([config_folder()])} == {*registry.groups(), *groups_in(config_folder())}
    hints = [
        get_type_hints(kind, include_extras=False)
        for kind in (*filter(None, (app_of(verb).settings for verb in EVERY)), PPOConfig)
    ]
    for key in ("viewer", "trunk_velocity", "suite", "what", "support", "share", "target", "schedule", "robot"):
        assert {*WORDS[key]} in [{*get_args(hint[key])} for hint in hints if key in hint], key


def test_a_folder_with_too_many_entries_to_look_at_is_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("large", "small"):
        (tmp_path / name).mkdir()
    for k in range(5):
        (tmp_path / "large" / str(k)).touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(completion, "MANY", 4)
    assert completions("go1exp eval run=") == ["run=large/"]


def process(words: list[str], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(data_root()), **environment}
    return subprocess.run(words, cwd=folder, env=env, capture_output=True, text=True, timeout=60)


def query(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    code = "import sys\nfrom go1exp.cli import main\nmain()\nprint(*sys.modules, file=sys.stderr)"
    return process([sys.executable, "-c", code, "-sc", "query=bash"], folder, COMP_LINE=line)


def test_a_key_press_imports_nothing_heavy(tmp_path: Path) -> None:
    done = query("go1exp train terrain=rough ppo.iterat", tmp_path)
    assert done.stdout == "ppo.iterations=\n"
    assert not {"hydra", "omegaconf", "torch", "numpy", "pydantic", "mujoco"} & {*done.stderr.split()}


@pytest.mark.parametrize(
    "line", ["go1exp train effect=[", "go1exp train 'a \"b", "go1exp eval run=/root/x/", "go1exp train \\"]
)
def test_a_line_half_typed_prints_nothing_but_completions(line: str, tmp_path: Path) -> None:
    done = query(line, tmp_path)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    assert all("=" in word for word in done.stdout.split())


@pytest.mark.parametrize(
    ("line", "breaks", "offered"),
    [
        ("go1exp train rand=ta", " =:", ["table1"]),
        ("go1exp train rand=ta", " ", ["rand=table1"]),
        ("go1exp train 'rand=ta", " =:", ["rand=table1"]),
        ("go1exp eval run='runs/ro", " =:", ["runs/rough one"]),
        ("go1exp eval run=runs/ro", " =:", [r"runs/rough\ one"]),
        (r"go1exp eval run=runs/rough\ o", " =:", [r"runs/rough\ one"]),
    ],
)
def test_tab_completes_in_a_real_bash(line: str, breaks: str, offered: list[str], folder: Path) -> None:
    program = folder / "bin/go1exp"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\nexec '{sys.executable}' -c '{PROGRAM}' \"$@\"\n")
    program.chmod(0o755)
    script = """
eval "$(go1exp -sc install=bash)"
COMP_LINE=$1; COMP_POINT=${#COMP_LINE}; COMP_WORDBREAKS=$2
$(complete -p go1exp | sed 's/.*-F \\([^ ]*\\).*/\\1/')
printf '%s\\n' "${COMPREPLY[@]}"
"""
    path = f"{program.parent}:{os.environ['PATH']}"
    done = process(["bash", "-c", script, "bash", line, breaks], folder, PATH=path)
    assert (done.stdout.splitlines(), done.stderr) == (offered, "")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
@pytest.mark.parametrize("action", ["install", "uninstall"])
def test_completion_is_installed_and_taken_away(action: str, shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert serve(f"{action}={shell}") == 0
    script = capsys.readouterr().out
    assert "go1exp" in script
    assert "default" not in script  # no shell adds files of its own where there is nothing to offer
