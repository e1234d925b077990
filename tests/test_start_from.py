"""A new run that begins with the weights of another."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from go1exp.cli.places import shipped_policies
from go1exp.cli.train import APP
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError, Expected
from go1exp.sim.task import parse_train
from go1exp.train import checkpoint, policy, run_folder, trainer
from go1exp.train.policy import load_run
from tests.small_run import small

SMALL = small(iterations=1, hidden="[16]")

Train = Callable[..., Any]


def train_here(run: Path, *overrides: str, source: Path | None = None) -> Any:
    container = compose("train", [*SMALL, *overrides, *([f"start_from={source}"] if source else [])])
    config = parse_train(container)
    run_folder.write(run, container)
    return trainer.train(config, container, run, policy.read_weights(config, source) if source else None)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("start") / "first"
    train_here(run)
    return run


def test_the_weights_are_the_others_and_all_else_is_new(
    first: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: dict[str, Any] = {}
    begin = policy.begin_with

    def spied(ppo: Any, *arguments: Any) -> None:
        fresh = [p.clone() for p in ppo.policy.state_dict().values()]
        begin(ppo, *arguments)
        begun.update(policy={k: v.clone() for k, v in ppo.policy.state_dict().items()}, fresh=fresh)
        begun.update(iteration=ppo.iteration, moments=dict(ppo.policy.optimizer.state))

    monkeypatch.setattr(trainer, "begin_with", spied)
    run = tmp_path / "second"
    ppo = train_here(run, "reward.gait.weight=20", "ppo.learning_rate=0.0001", source=first)
    old = checkpoint.read(first / "checkpoints/000001.pt")["policy"]
    assert begun["policy"].keys() == old.keys()
    assert all(torch.equal(begun["policy"][k], old[k]) for k in old)
    assert any(not torch.equal(a, b) for a, b in zip(begun["fresh"], old.values(), strict=True))
    assert begun["iteration"] == 0
    assert begun["moments"] == {}
    assert ppo.iteration == 1
    assert ppo.num_timesteps == 16

    told = json.loads((run / "start.json").read_text())
    file = first / "checkpoints" / told.pop("checkpoint")
    assert told.pop("sha256") == hashlib.sha256(file.read_bytes()).hexdigest()
    assert told == {"run": str(first), "iteration": 1, "num_timesteps": 16}


def test_a_shipped_policy_is_the_origin_by_its_name() -> None:
    config = parse_train(compose("train", ["experiment=rough_climb", "start_from=rough"]))
    assert policy.read_weights(config, shipped_policies()["rough"]).about["run"] == "rough"


def test_steps_are_counted_from_the_first_of_the_runs(first: Path, tmp_path: Path) -> None:
    second, third = tmp_path / "second", tmp_path / "third"
    train_here(second, source=first)
    train_here(third, source=second)
    assert json.loads((third / "start.json").read_text())["num_timesteps"] == 2 * 16
    assert [load_run(run)[2]["num_timesteps"] for run in (first, second, third)] == [16, 2 * 16, 3 * 16]


def test_a_run_that_has_a_checkpoint_goes_on_from_that(first: Path, tmp_path: Path) -> None:
    run = tmp_path / "second"
    train_here(run, source=first)
    (run / "start.json").unlink()
    train_here(run, "ppo.iterations=2", source=first)
    assert [int(p.stem) for p in checkpoint.checkpoints(run)] == [1, 2]
    assert not (run / "start.json").exists()


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("~observation.projected_gravity", "observation is .* here and .*'projected_gravity.* there"),
        (
            "+observation.joint_velocity.history=3",
            r"joint_velocity \(12 x 3 steps\).* here and .*joint_velocity \(12\)",
        ),
        ("ppo.hidden=[16,16]", r"ppo.hidden is \[16, 16\] here and \[16\] there"),
        ("ppo.activation=relu", "ppo.activation is relu here and elu there"),
    ],
)
def test_weights_of_another_function_are_refused(first: Path, override: str, said: str) -> None:
    config = parse_train(compose("train", [*SMALL, override]))
    with pytest.raises(ConfigError, match=said):
        policy.read_weights(config, first)


def test_an_estimator_of_another_size_is_refused_and_another_weight_of_its_loss_is_not(tmp_path: Path) -> None:
    estimating = ("critic=privileged", "estimator=decoder", "estimator.latent=4", "estimator.hidden=[8]")
    train_here(tmp_path / "first", *estimating)
    for overrides, said in (
        ((*estimating, "estimator.latent=5"), "estimator.latent is 5 here and 4 there$"),
        ((*estimating, "estimator.hidden=[9]"), r"estimator.hidden is \[9\] here and \[8\] there$"),
        (("critic=privileged",), "estimator.latent is 0 here and 4 there$"),
    ):
        with pytest.raises(ConfigError, match=f"policy of this run: {said}"):
            policy.read_weights(parse_train(compose("train", [*SMALL, *overrides])), tmp_path / "first")
    train_here(tmp_path / "second", *estimating, "estimator.weight=0.5", source=tmp_path / "first")


def test_from_the_command_line(
    first: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    big = [*(o for o in SMALL if "hidden" not in o), "ppo=paper", *SMALL[:4]]
    assert APP.run([*big, "start_from=paper", "hydra.run.dir=tuned"]) == 0
    assert json.loads((tmp_path / "tuned/start.json").read_text())["num_timesteps"] > 1e8
    assert "starting from" in capsys.readouterr().out
    assert parse_train(run_folder.read_config(tmp_path / "tuned")).process.start_from == "paper"

    assert APP.run(["resume=tuned", "ppo.iterations=2"]) == 0
    for wanted, told in ((2, "tuned has 2 iterations already; now"), (1, "already, more than the 1 asked for; now")):
        assert APP.run(["resume=tuned", f"ppo.iterations={wanted}"]) == 0
        assert told in capsys.readouterr().out

    run = tmp_path / "paper"  # a run folder goes before a shipped policy of its name
    train_here(run, "ppo.hidden=[512,256,128]")
    assert APP.run([*big, "start_from=paper", "hydra.run.dir=of_the_folder"]) == 0
    assert json.loads((tmp_path / "of_the_folder/start.json").read_text())["num_timesteps"] == 16

    for wrong, said in (
        (
            "nowhere",
            "start_from = 'nowhere': no run folder (it has no config.yaml) and no shipped policy "
            f"(there are: {', '.join(sorted(shipped_policies()))})",
        ),
        (str(first), "ppo.hidden is [512, 256, 128] here"),
    ):
        with pytest.raises((ConfigError, Expected), match=re.escape(said)):
            APP.run([*big, f"start_from={wrong}", "hydra.run.dir=refused"])
        assert not (tmp_path / "refused/config.yaml").exists()
