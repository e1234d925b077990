"""What goes wrong stops training with a message that says what, and never costs what was saved before."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from go1exp.config.schema import registry
from go1exp.mdp.types import Snapshot, StepResult
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.faults import NumericalFault
from go1exp.sim.task import TrainConfig
from go1exp.train import checkpoint, run_folder, trainer
from go1exp.train.group import Group
from go1exp.train.metrics import CsvWriter
from go1exp.train.ppo import AdaptivePPO
from tests.command import run as cli
from tests.small_run import small, train

SMALL = small(
    *("ppo=paper", "checkpoint.every=1", "sim.spread_starts=false"), num_envs=8, steps=8, epochs=2, iterations=4
)
FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="/dev/full, a disk without space, is Linux's")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT where it stands
    return tmp_path / "run"


def break_step(monkeypatch: pytest.MonkeyPatch, number: int, damage: Callable[[Go1Core], None]) -> None:
    """Damage the environment before its step ``number`` (the first is 1)."""
    step, done = Go1Core.step, [0]

    def broken(self: Go1Core, action: Tensor) -> StepResult:
        done[0] += 1
        if done[0] == number:
            damage(self)
        return step(self, action)

    monkeypatch.setattr(Go1Core, "step", broken)


def assert_saved_up_to(run: Path, iteration: int) -> None:
    """The newest checkpoint is that of ``iteration``, whole and finite, and nothing half done lies about."""
    state, path = checkpoint.load_latest(run)
    assert (state["iteration"], path.name) == (iteration, f"{iteration:06d}.pt")
    assert all(torch.isfinite(weight).all() for weight in state["policy"].values())
    assert torch.isfinite(state["env"]["backend"]["state"]["qpos"]).all()
    lines = (run / "metrics.csv").read_text().splitlines()
    assert [int(line.split(",")[0]) for line in lines[1:]] == list(range(1, iteration + 1))


def assert_dumped(run: Path, fault: NumericalFault) -> dict[str, np.ndarray]:
    """The notes beside the run tell the same as the exception; return the arrays."""
    notes = json.loads((run / "fault.json").read_text())
    assert notes == {"quantity": fault.quantity, "message": str(fault)}
    with np.load(run / "fault.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


# ---------------------------------------------------------------------- numbers that are not finite


@pytest.mark.parametrize(
    ("where", "column", "value", "quantities"),
    [
        ("qpos", 0, math.nan, {"qpos"}),
        ("qpos", 7, math.nan, {"qpos", "torque"}),
        ("qvel", 3, math.inf, {"qvel", "qpos"}),
    ],
)
def test_broken_physics_stop_training_with_the_quantity_and_the_robot(
    where: str, column: int, value: float, quantities: set[str], run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damage(core: Go1Core) -> None:
        getattr(core.backend, where)[2, column] = value

    break_step(monkeypatch, 2 * 8 + 4, damage)
    with pytest.raises(NumericalFault, match="is not finite in environment 2 at step 20") as caught:
        train(run, SMALL)
    assert caught.value.quantity in quantities
    assert str(caught.value).startswith(caught.value.quantity)
    arrays = assert_dumped(run, caught.value)
    assert not np.isfinite(arrays[caught.value.quantity]).all()
    assert {"action", "qpos", "qvel", "observation", "reward.foot_slip"} <= set(arrays)
    assert np.isfinite(arrays["action"]).all()
    assert (arrays["qpos"].shape, arrays["action"].shape) == ((19,), (12,))
    assert_saved_up_to(run, 2)


@pytest.fixture
def odd_reward() -> Iterator[str]:
    """A reward that is NaN in environment 5, and infinite in 6, once their episodes have lasted 0.4 s."""

    @registry.reward("odd")
    def odd(s: Snapshot) -> Tensor:
        late = s.episode_time > 0.399
        values = torch.zeros(len(late))
        values[5], values[6] = math.nan, math.inf
        return torch.where(late, values, torch.zeros(len(late)))

    yield "+reward.odd_one={term: odd, weight: 1.0}"
    del registry._REGISTRY["reward"]["odd"]


def test_a_reward_that_is_not_finite_is_named_by_its_key(odd_reward: str, run: Path) -> None:
    with pytest.raises(NumericalFault) as caught:
        train(run, [*SMALL, odd_reward, "termination=none"])
    assert str(caught.value) == "reward.odd_one is not finite in environment 5 at step 20"
    arrays = assert_dumped(run, caught.value)
    assert [name for name, array in arrays.items() if not np.isfinite(array).all()] == ["reward.odd_one"]
    assert_saved_up_to(run, 2)


def break_gradient(monkeypatch: pytest.MonkeyPatch, name: str, value: float, number: int) -> None:
    """Make one element of a parameter's gradient ``value`` in backward pass ``number``."""
    build = trainer.build

    def broken(config: TrainConfig, group: Group) -> AdaptivePPO:
        ppo, passes = build(config, group), [0]

        def damage(gradient: Tensor) -> Tensor:
            passes[0] += 1
            if passes[0] != number:
                return gradient
            gradient = gradient.clone()
            gradient.view(-1)[0] = value
            return gradient

        dict(ppo.policy.named_parameters())[name].register_hook(damage)
        return ppo

    monkeypatch.setattr(trainer, "build", broken)


@pytest.mark.parametrize("value", [math.nan, math.inf], ids=["nan", "inf"])
@pytest.mark.parametrize("name", ["log_std", "mlp_extractor.value_net.0.weight", "action_net.bias"])
def test_a_gradient_that_is_not_finite_is_named_by_its_parameter_before_it_does_harm(
    name: str, value: float, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    break_gradient(monkeypatch, name, value, 2 * 4 + 3)  # four gradient steps an iteration
    with pytest.raises(NumericalFault, match="in iteration 3") as caught:
        train(run, SMALL)
    assert_dumped(run, caught.value)
    assert_saved_up_to(run, 2)
    named = caught.value.quantity
    assert named.startswith("gradient")
    assert named.endswith(f"policy.{name}") or "policy." not in named  # SB3's clipping spreads a NaN: blame no other


def test_on_the_command_line_a_fault_is_a_message_and_a_status(run: Path) -> None:
    code = """
import sys
from go1exp.cli import main
from go1exp.sim.env.core import Go1Core
snapshot = Go1Core.snapshot
def broken(self):
    s = snapshot(self)
    if int(self.steps[3]) == 12:
        s.joint_torque[3, 5] = float("nan")
    return s
Go1Core.snapshot = broken
sys.exit(main())
"""
    done = cli(Path.cwd(), "train", *SMALL, f"hydra.run.dir={run}", code=code)
    assert done.returncode == 1
    assert re.search(r"^go1exp train: \S*torque is not finite in environment 3 at step 12$", done.stderr, re.MULTILINE)
    assert "Traceback" not in done.stderr
    assert (run / "fault.npz").exists()
    assert_saved_up_to(run, 1)


# ---------------------------------------------------------------------- disks


@pytest.mark.parametrize("name", ["run", "run/below"])
def test_a_file_in_the_place_of_the_run_folder_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / "run").write_text("mine")
    with pytest.raises(OSError, match="run folder cannot be written") as caught:
        run_folder.write(tmp_path / name, {"seed": 0})
    assert str(tmp_path / name) in str(caught.value)
    assert (tmp_path / "run").read_text() == "mine"


def test_a_save_that_fails_half_way_costs_nothing_and_can_be_made_up_for(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(tmp_path / "reference", SMALL)
    save = torch.save

    def half(state: dict[str, object], file: object) -> None:
        if state["iteration"] == 3:
            file.write(b"PK half a checkpoint")  # type: ignore[attr-defined]
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(state, file)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", half)
        with pytest.raises(OSError, match="No space left on device"):
            train(run, SMALL)
    assert checkpoint.load_latest(run)[1].name == "000002.pt"
    train(run, SMALL)
    assert_saved_up_to(run, 4)
    assert not list((run / "checkpoints").glob("*.partial"))
    assert (run / "metrics.csv").read_bytes() == (tmp_path / "reference/metrics.csv").read_bytes()


def test_a_disk_that_fills_up_within_a_checkpoint_is_named_as_the_cause(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then the error that arrives is one of torch's zip writer about positions in the file."""
    save = torch.save

    class NearlyFull(io.BytesIO):
        def write(self, content: Any) -> int:
            if self.tell() + len(content) > 5000:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return super().write(content)

    monkeypatch.setattr(torch, "save", lambda state, file: save(state, NearlyFull()))
    with pytest.raises(OSError, match="No space left on device") as caught:
        train(run, SMALL)
    assert caught.value.errno == errno.ENOSPC
    assert str(run / "checkpoints") in str(caught.value)
    assert not checkpoint.checkpoints(run)


def row(iteration: int) -> dict[str, float]:
    return {"iteration": iteration, "train/loss": 0.5, "time/steps_per_s": 10.0}


@needs_full
def test_a_full_disk_is_reported_with_the_metrics_file(tmp_path: Path) -> None:
    writer = CsvWriter(tmp_path, 0)
    writer.write(row(1), {}, 1)
    (tmp_path / "metrics.csv").unlink()
    (tmp_path / "metrics.csv").symlink_to(FULL)
    with pytest.raises(OSError, match="No space left on device") as caught:
        writer.write(row(2), {}, 2)
    assert str(tmp_path / "metrics.csv") in str(caught.value)


@pytest.mark.parametrize("name", ["metrics.csv", "checkpoints"])
def test_something_else_in_the_place_of_a_file_of_the_run_is_named(name: str, run: Path) -> None:
    run.mkdir()
    if name == "checkpoints":
        (run / name).write_text("mine")
    else:
        (run / name).mkdir()
    with pytest.raises(OSError, match=re.escape(name)):
        train(run, SMALL)
