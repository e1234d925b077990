"""A run that was stopped and continued in another process is the run that was never stopped, to the last bit."""

from __future__ import annotations

import csv
import fcntl
import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch

from go1exp.base.paths import data_root
from go1exp.train import checkpoint, metrics, run_folder, trainer
from tests.command import COMMAND_LINE, refuse
from tests.command import run as cli
from tests.small_run import small, train

SMALL = (
    *small(num_envs=8, steps=8, epochs=2),
    "checkpoint.every=2",
    "checkpoint.keep=2",
    # within six iterations, 0.96 s, everything that can happen happens
    "sim.episode_s=0.4",
    "command.hold_time=[0.1,0.3]",
    "event.push.interval=[0.1,0.3]",
)
FLAT = (*SMALL, "rand=table1", "ppo=cpu", "ppo.schedule=adaptive")
ROUGH = (
    *SMALL,
    "ppo=paper",
    "terrain=rough",
    "curriculum=terrain_level",
    "terrain.rows=3",
    "terrain.cols=4",
    "terrain.tile_size=4",
    "terrain.border=2",
    "terrain.platform=1.5",
    "curriculum.terrain_level.start_level_max=2",
)
SIX = "ppo.iterations=6"

SIGNALLED = """
import os, signal, sys
from go1exp.cli import main
from go1exp.train.metrics import CsvWriter
write = CsvWriter.write
def signalled(self, values, excluded, step=0):
    write(self, values, excluded, step)
    if values["iteration"] == {iteration}:
        os.kill(os.getpid(), signal.{name})
CsvWriter.write = signalled
sys.exit(main())
"""


def rows(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.read_text().splitlines()))


def iterations(file: Path) -> list[int]:
    return [int(row["iteration"]) for row in rows(file)]


def differences(one: Any, other: Any, path: str = "") -> list[str]:
    """The places at which two states of plain data and tensors are not the same bits."""
    if type(one) is not type(other):
        return [f"{path}: {type(one)} and {type(other)}"]
    if isinstance(one, dict):
        if set(one) != set(other):
            return [f"{path}: {set(one) ^ set(other)} on one side only"]
        return [d for key in one for d in differences(one[key], other[key], f"{path}.{key}")]
    if isinstance(one, list | tuple):
        if len(one) != len(other):
            return [f"{path}: {len(one)} and {len(other)} items"]
        return [d for k, pair in enumerate(zip(one, other, strict=True)) for d in differences(*pair, f"{path}[{k}]")]
    if isinstance(one, torch.Tensor):
        same = (
            one.dtype == other.dtype and one.shape == other.shape and one.numpy().tobytes() == other.numpy().tobytes()
        )
    else:
        same = repr(one) == repr(other)
    return [] if same else [path]


def assert_the_same_run(run: Path, reference: Path) -> None:
    one, other = (checkpoint.read(folder / "checkpoints/000006.pt") for folder in (run, reference))
    assert {"policy", "optimizer", "env", "rng", "last_obs"} <= set(one)
    assert differences(one, other) == []
    assert (run / "metrics.csv").read_bytes() == (reference / "metrics.csv").read_bytes()
    assert iterations(run / "timing.csv") == [1, 2, 3, 4, 5, 6]


class Again(Exception):
    """What the usual handler of these tests raises."""


@pytest.fixture
def usual_handler() -> Iterator[Callable[[int, FrameType | None], None]]:
    """A handler for both signals that would end the test instead of pytest."""

    def raise_again(number: int, frame: FrameType | None) -> None:
        raise Again

    before = {s: signal.signal(s, raise_again) for s in (signal.SIGINT, signal.SIGTERM)}
    yield raise_again
    for s, handler in before.items():
        signal.signal(s, handler)


def signal_after(monkeypatch: pytest.MonkeyPatch, iteration: int, *numbers: int) -> None:
    """Send this process signals when the row of ``iteration`` is written."""
    write = metrics.CsvWriter.write

    def signalled(self: metrics.CsvWriter, values: dict[str, Any], excluded: Any, step: int = 0) -> None:
        write(self, values, excluded, step)
        if values["iteration"] == iteration:
            for number in numbers:
                os.kill(os.getpid(), number)

    monkeypatch.setattr(metrics.CsvWriter, "write", signalled)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("resume")


@pytest.fixture(scope="module")
def flat(folder: Path) -> Path:
    """Six iterations without a stop."""
    train(folder / "flat", [*FLAT, SIX])
    return folder / "flat"


@pytest.fixture(scope="module")
def killed(folder: Path) -> Path:
    """The same, ended by SIGKILL between the row of iteration 5 and the next checkpoint."""
    run = folder / "killed"
    done = cli(folder, "train", *FLAT, SIX, f"hydra.run.dir={run}", code=SIGNALLED.format(iteration=5, name="SIGKILL"))
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert iterations(run / "metrics.csv") == [1, 2, 3, 4, 5]
    assert [p.name for p in checkpoint.checkpoints(run)] == ["000002.pt", "000004.pt"]
    return run


@pytest.fixture
def killed_copy(killed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(killed, tmp_path / "run"))


# ---------------------------------------------------------------------- the reference is worth comparing with


def test_in_the_reference_everything_random_happens(flat: Path) -> None:
    found = rows(flat / "metrics.csv")
    assert [int(r["iteration"]) for r in found] == [1, 2, 3, 4, 5, 6]
    assert len({r["train/learning_rate"] for r in found}) > 2  # the rate adapts
    assert len({r["rollout/return"] for r in found}) > 3  # episodes end
    state = checkpoint.read(flat / "checkpoints/000006.pt")
    counters = {name: int(c) for name, c in state["env"]["random"].items() if name != "seed"}
    assert min(counters[name] for name in ("command", "event.push", "noise", "rand.foot_friction")) > 0
    fields = state["env"]["backend"]["fields"]
    drawn = [field for name, field in fields.items() if name != "geom_solref"]  # which the schedule sets, for all alike
    assert all(len(field.flatten(1).unique(dim=0)) == 8 for field in drawn)  # no robot like another


def test_only_the_newest_checkpoints_stay(flat: Path) -> None:
    assert [p.name for p in sorted((flat / "checkpoints").iterdir())] == ["000004.pt", "000006.pt"]


# ---------------------------------------------------------------------- ways of stopping


def test_a_run_stopped_by_ctrl_c_goes_on_with_resume(flat: Path, folder: Path) -> None:
    run = folder / "interrupted"
    interrupt = SIGNALLED.format(iteration=3, name="SIGINT")
    stopped = cli(folder, "train", *FLAT, "ppo.iterations=50", f"hydra.run.dir={run}", code=interrupt)
    assert stopped.returncode == 130, stopped.stderr
    assert f"train resume={run}" in stopped.stdout
    assert "Traceback" not in stopped.stderr
    assert iterations(run / "metrics.csv") == [1, 2, 3]
    assert checkpoint.checkpoints(run)[-1].name == "000003.pt"

    resumed = cli(folder, "train", f"resume={run}", SIX)
    assert resumed.returncode == 0, resumed.stderr
    assert "000003.pt" in resumed.stdout
    assert_the_same_run(run, flat)
    assert run_folder.read_config(run) == run_folder.read_config(flat)
    assert not (folder / "runs").exists() or not any((folder / "runs").iterdir())


def test_a_run_killed_between_checkpoints_goes_on_when_the_same_command_is_given_again(
    flat: Path, folder: Path, killed_copy: Path
) -> None:
    again = cli(folder, "train", *FLAT, SIX, f"hydra.run.dir={killed_copy}")
    assert again.returncode == 0, again.stderr
    assert "000004.pt" in again.stdout
    assert_the_same_run(killed_copy, flat)


@pytest.mark.slow(
    "go1exp/train/",
    "go1exp/base/signals.py",
    "go1exp/cli/",
    "go1exp/base/tensors/",
    "go1exp/sim/terrain.py",
    "go1exp/sim/env/",
)
def test_a_run_on_rough_ground_stopped_by_sigterm_goes_on_with_resume(
    folder: Path, monkeypatch: pytest.MonkeyPatch, usual_handler: Callable[[int, FrameType | None], None]
) -> None:
    reference, run = folder / "rough", folder / "terminated"
    train(reference, [*ROUGH, SIX])
    levels = {row["curriculum/terrain_level"] for row in rows(reference / "metrics.csv")}
    assert len(levels) > 1  # the curriculum moves

    signal_after(monkeypatch, 3, signal.SIGTERM)
    with pytest.raises(trainer.Stopped):
        train(run, [*ROUGH, SIX])
    assert signal.getsignal(signal.SIGTERM) is usual_handler
    assert iterations(run / "metrics.csv") == [1, 2, 3]

    resumed = cli(folder, "train", f"resume={run}")
    assert resumed.returncode == 0, resumed.stderr
    assert_the_same_run(run, reference)


@pytest.mark.parametrize("numbers", [(signal.SIGINT,) * 2, (signal.SIGTERM,) * 4, (signal.SIGTERM, signal.SIGINT)])
def test_a_second_signal_is_heard_and_costs_no_checkpoint(
    numbers: tuple[signal.Signals, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    usual_handler: Callable[[int, FrameType | None], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    signal_after(monkeypatch, 3, *numbers)
    with pytest.raises(trainer.Stopped):
        train(tmp_path / "run", [*FLAT, SIX])
    assert checkpoint.checkpoints(tmp_path / "run")[-1].name == "000003.pt"
    assert signal.getsignal(signal.SIGINT) is usual_handler
    words = capsys.readouterr().err
    assert words.count("stopping after this iteration, with a checkpoint") == 1
    assert words.count("heard;") == (1 if numbers.count(signal.SIGINT) == 2 else 0)


def test_a_third_ctrl_c_ends_the_run_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, usual_handler: Callable[[int, FrameType | None], None]
) -> None:
    signal_after(monkeypatch, 3, signal.SIGINT, signal.SIGINT, signal.SIGINT)
    with pytest.raises(Again):
        train(tmp_path / "run", [*FLAT, SIX])
    assert [p.name for p in checkpoint.checkpoints(tmp_path / "run")] == ["000002.pt"]
    assert signal.getsignal(signal.SIGINT) is usual_handler


def test_a_signal_in_the_last_iteration_leaves_a_finished_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, usual_handler: Callable[[int, FrameType | None], None]
) -> None:
    signal_after(monkeypatch, 2, signal.SIGTERM)
    with pytest.raises(trainer.Stopped) as caught:
        train(tmp_path / "run", [*FLAT, "ppo.iterations=2"])
    assert caught.value.finished


@pytest.mark.slow("go1exp/train/", "go1exp/base/signals.py", "go1exp/cli/", "go1exp/base/tensors/")
def test_the_end_of_the_terminal_costs_no_checkpoint(tmp_path: Path) -> None:
    """The kernel sends SIGHUP, and what is printed from then on fails."""
    master, slave = pty.openpty()
    run = tmp_path / "run"
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND_LINE, "train", *FLAT, "ppo.iterations=100000", f"hydra.run.dir={run}"],
        env={**os.environ, "PYTHONPATH": str(data_root())},
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(slave, termios.TIOCSCTTY, 0),
    )
    os.close(slave)
    text = b""
    while b"steps/s" not in text:  # the first iteration is done
        text += os.read(master, 4096)
    os.close(master)
    assert process.wait(timeout=300) == 130
    assert iterations(run / "metrics.csv")[-1] == int(checkpoint.checkpoints(run)[-1].stem)
    assert json.loads((run / "state.json").read_text())["state"] == "stopped"


def test_a_run_killed_before_its_first_checkpoint_begins_anew_without_a_row_twice(flat: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(flat, run, ignore=lambda *_: ["checkpoints"])
    train(run, [*FLAT, SIX])
    assert_the_same_run(run, flat)


def test_a_finished_run_is_extended_as_if_it_had_been_meant_to_be_longer(flat: Path, tmp_path: Path) -> None:
    train(tmp_path / "run", [*FLAT, "ppo.iterations=3"])
    train(tmp_path / "run", [*FLAT, SIX])
    assert_the_same_run(tmp_path / "run", flat)


# ---------------------------------------------------------------------- damaged checkpoints


def test_a_changed_bit_of_a_tensor_is_damage(killed_copy: Path) -> None:
    newest = killed_copy / "checkpoints/000004.pt"
    changed = bytearray(newest.read_bytes())
    weight = checkpoint.read(newest)["policy"]["mlp_extractor.policy_net.0.weight"].numpy().tobytes()
    changed[changed.index(weight) + 100] ^= 1
    newest.write_bytes(changed)
    with pytest.raises(checkpoint.DamagedCheckpoint, match=r"000004\.pt: damaged"):
        checkpoint.read(newest)


@pytest.mark.parametrize("damage", ["truncated", "empty", "overwritten"])
def test_a_damaged_checkpoint_is_passed_over_with_a_warning(damage: str, flat: Path, killed_copy: Path) -> None:
    newest = killed_copy / "checkpoints/000004.pt"
    whole = newest.read_bytes()
    newest.write_bytes({"truncated": whole[: len(whole) // 2], "empty": b"", "overwritten": b"x" * len(whole)}[damage])
    (killed_copy / "checkpoints/000005.pt.1a2b3c4d.partial").write_bytes(whole)
    with pytest.warns(UserWarning, match=r"000004\.pt: damaged checkpoint .*; skipped") as caught:
        state, path = checkpoint.load_latest(killed_copy)
    (warning,) = caught
    assert "\n" not in str(warning.message)
    assert "weights_only" not in str(warning.message)  # torch's advice to run what the file may hold
    assert path.name == "000002.pt"
    assert state["iteration"] == 2
    if damage == "truncated":
        with pytest.warns(UserWarning, match=r"000004\.pt: damaged"):
            train(killed_copy, [*FLAT, SIX])
        assert_the_same_run(killed_copy, flat)


def test_a_checkpoint_whose_weights_are_not_finite_is_passed_over(killed_copy: Path) -> None:
    newest = killed_copy / "checkpoints/000004.pt"
    state = checkpoint.read(newest)
    state["policy"]["log_std"][0] = torch.nan
    torch.save(state, newest)
    with pytest.warns(UserWarning, match=r"000004\.pt: .*not finite: log_std\); skipped"):
        assert checkpoint.load_latest(killed_copy)[1].name == "000002.pt"


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("config.yaml", "reward: [", "no YAML (line 1"),
        ("config.yaml", "", "is not the configuration of a run"),
        ("config.yaml", "- 1", "is not the configuration of a run"),
        ("config.yaml", "seed: 1\n", "sim: required"),
        *(("meta.json", text, "damaged; it must be") for text in ("{", "[]", '{"plugins": 3}', '{"plugins": [{}]}')),
    ],
)
def test_a_run_with_a_damaged_file_is_refused_with_its_name(
    file: str, text: str, said: str, killed_copy: Path, tmp_path: Path
) -> None:
    (killed_copy / file).write_text(text)
    before = contents(killed_copy)
    for words in (("train", f"resume={killed_copy}"), ("eval", f"run={killed_copy}")):
        done = refuse(tmp_path, *words)
        assert done.returncode == 2, done.stderr
        assert "Traceback" not in done.stderr
        assert f"{killed_copy}/{file}: {said}" in done.stderr
    assert contents(killed_copy) == before


def test_with_no_whole_checkpoint_left_nothing_is_trained_over(killed_copy: Path) -> None:
    for file in checkpoint.checkpoints(killed_copy):
        file.write_bytes(b"")
    before = (killed_copy / "metrics.csv").read_bytes()
    none_whole = rf"{killed_copy}: none of its 2 checkpoints can be read"
    with pytest.warns(UserWarning, match="damaged"), pytest.raises(checkpoint.DamagedCheckpoint, match=none_whole):
        train(killed_copy, [*FLAT, SIX])
    assert (killed_copy / "metrics.csv").read_bytes() == before


def test_a_run_without_a_checkpoint_begins_anew_and_says_so(killed_copy: Path, tmp_path: Path) -> None:
    for file in checkpoint.checkpoints(killed_copy):
        file.unlink()
    done = cli(tmp_path, "train", f"resume={killed_copy}", "ppo.iterations=1")
    assert done.returncode == 0, done.stderr
    assert f"{killed_copy}: no checkpoint; training begins anew" in done.stdout


# ---------------------------------------------------------------------- what a resumed run may change


def contents(run: Path) -> dict[str, bytes]:
    return {str(p.relative_to(run)): p.read_bytes() for p in sorted(run.rglob("*")) if p.is_file()}


def test_resume_refuses_changed_settings_and_touches_nothing(killed_copy: Path, tmp_path: Path) -> None:
    before = contents(killed_copy)
    done = refuse(
        tmp_path, "train", f"resume={killed_copy}", "ppo.iterations=9", "seed=3", "ppo.gamma=0.9", "rand=none"
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    for override in ("seed=3", "ppo.gamma=0.9", "rand=none"):
        assert f"{override}: a resumed run keeps its configuration" in done.stderr
    assert "ppo.iterations=9:" not in done.stderr
    assert contents(killed_copy) == before
    assert not list(tmp_path.glob("runs/*"))


def test_the_same_folder_with_other_settings_is_refused_too(killed_copy: Path, tmp_path: Path) -> None:
    """It would go on from the old checkpoint, and config.yaml would no longer say what was run."""
    before = contents(killed_copy)
    done = refuse(tmp_path, "train", *FLAT, SIX, "ppo.gamma=0.9", f"hydra.run.dir={killed_copy}")
    assert done.returncode == 2, done.stdout
    assert "ppo.gamma" in done.stderr
    other = refuse(tmp_path, "train", "experiment=rough", "backend=cpu", f"hydra.run.dir={killed_copy}")
    assert re.search(r" and \d+ more; use another folder$", other.stderr.strip())
    assert len(other.stderr) < 600
    kept = {name: data for name, data in contents(killed_copy).items() if not name.startswith(".hydra")}
    assert kept == {name: data for name, data in before.items() if not name.startswith(".hydra")}
