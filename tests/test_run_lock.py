"""Two trainings never write into one run folder, and no dead one keeps a folder to itself."""

from __future__ import annotations

import errno
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from go1exp.config.compose import compose
from go1exp.train import run_folder, run_state
from tests.command import environment
from tests.command import run as cli
from tests.small_run import SMALL

HOLD = """
import sys
from pathlib import Path
from go1exp.train import run_state
run = Path(sys.argv[1])
with run_state.locked(run):
    run_state.write(run, "running")
    print("locked", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds ``tmp_path/run``, where a run has begun."""
    run_folder.write(tmp_path / "run", compose("train", SMALL))
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "run")],
        env=environment(),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.communicate()


@pytest.mark.parametrize(
    "again",
    ["hydra.run.dir={run}", pytest.param("resume={run}", marks=pytest.mark.slow("go1exp/train/", "go1exp/cli/"))],
)
def test_a_second_training_in_a_folder_is_refused_in_one_line(
    again: str, holder: subprocess.Popen[str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    settings = SMALL if again.startswith("hydra") else ()
    before = {p: p.read_bytes() for p in run.iterdir() if p.is_file()}
    done = cli(tmp_path, "train", *settings, again.format(run=run))
    assert done.returncode == 1, done.stderr
    who = rf"process {holder.pid} on {re.escape(socket.gethostname())} since \d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d"
    assert re.fullmatch(rf"go1exp train: {re.escape(str(run))}: in use by {who}; .*\n", done.stderr), done.stderr
    assert {p: p.read_bytes() for p in run.iterdir() if p.is_file()} == before
    assert run_state.read(run).state == "running"


def test_a_killed_training_leaves_the_folder_free_and_is_known_to_be_dead(
    holder: subprocess.Popen[str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    (run / "checkpoints").mkdir()
    (run / "checkpoints/000003.pt.1a2b3c4d.partial").write_bytes(b"half")
    assert run_state.in_use(run)
    holder.kill()
    holder.wait()
    assert run_state.read(run) == run_state.RunState("failed", "was killed")
    with run_state.locked(run):
        assert list((run / "checkpoints").iterdir()) == []
    assert not run_state.in_use(run)


def test_where_the_file_system_knows_no_locks_a_file_with_a_heartbeat_guards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(descriptor: int) -> bool:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("filelock._unix.lock_fd_nonblocking", no_locks)

    def second() -> None:
        with run_state.locked(tmp_path):
            raise AssertionError("two at a time")

    with (
        pytest.warns(UserWarning, match="its file system has no locks"),
        run_state.locked(tmp_path),
        pytest.raises(run_state.RunInUse, match=f"process {os.getpid()} on "),
    ):
        second()
    with pytest.warns(UserWarning, match="no locks"), run_state.locked(tmp_path):
        pass
