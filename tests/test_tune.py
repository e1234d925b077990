"""``go1exp tune``, and the sweep of Weights & Biases: searches that call ``go1exp train``."""

from __future__ import annotations

import importlib.util
import json
import shlex
from pathlib import Path

import pytest
import yaml

from go1exp import data_root
from go1exp.compose import compose
from go1exp.config import parse_train
from tests.command import run as cli
from tests.small_run import SMALL

SPACE = 'space=["ppo.learning_rate=tag(log,interval(1e-4,3e-3))","ppo.gamma=choice(0.97,0.99)"]'


def test_the_agent_of_weights_and_biases_gets_a_command_that_composes() -> None:
    from wandb.sdk.launch.sweeps.utils import create_sweep_command, create_sweep_command_args

    sweep = yaml.safe_load((data_root() / "docs/wandb_sweep.yaml").read_text())
    given = {"ppo.learning_rate": {"value": 0.0007}, "ppo.minibatches": {"value": 8}}
    words: list[str] = []
    values = {**create_sweep_command_args({"args": given}), "program": [sweep["program"]]}
    for word in create_sweep_command(sweep["command"]):  # as wandb's agent puts them together
        words += values[word[2:-1]] if word.startswith("${") else [word]
    assert words[:2] == ["go1exp", "train"]
    container = compose("train", words[2:])
    config = parse_train(container)
    assert (config.ppo.learning_rate, config.ppo.minibatches) == (0.0007, 8)
    assert container["logger"]["wandb"]
    assert {*sweep["parameters"]} == {*given}


@pytest.mark.slow("go1exp/sweep/", "go1exp/cli/tune.py", "conf/tune.yaml")
def test_a_search_finds_its_best_trial_and_goes_on(tmp_path: Path) -> None:
    if importlib.util.find_spec("optuna") is None:
        pytest.skip("no optuna: pip install 'go1exp[tune]'")
    settings = ",".join(json.dumps(word) for word in (*SMALL, "ppo.iterations=4"))
    line = (SPACE, f"overrides=[{settings}]", "workers=2", "metric=train/kl", "direction=minimize", "out=search")
    first = cli(tmp_path, "tune", *line, "trials=2")
    assert first.returncode == 0, first.stderr
    again = cli(tmp_path, "tune", *line, "trials=3")
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("trial ") == 2  # the third one, and the best
    jobs = json.loads((tmp_path / "search/sweep.json").read_text())["jobs"]
    assert [(job["run_folder"], job["state"]) for job in jobs] == [(f"trial-{n:04}", "done") for n in range(3)]
    best = json.loads((tmp_path / "search/best.json").read_text())
    (now,) = [row for row in again.stdout.splitlines() if row.startswith("now: ")]
    config = parse_train(compose("train", shlex.split(now)[3:]))
    assert config.ppo.learning_rate == best["overrides"]["ppo.learning_rate"]
    other = cli(tmp_path, "tune", 'space=["ppo.epochs=range(1,3)"]', "out=search")
    assert (other.returncode, other.stderr.count("\n")) == (1, 1)
    assert "holds a search for" in other.stderr
    nobody = cli(tmp_path, "tune", SPACE, "storage=sqlite:////nowhere/at/all.db", "out=elsewhere")
    assert (nobody.returncode, nobody.stderr.count("\n")) == (1, 1)
    assert "cannot be used" in nobody.stderr
