"""``hydra/launcher=ray`` on a real cluster of two nodes, one of which is killed during the sweep."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from go1exp.train.sweep.index import read
from tests import ray_cluster
from tests.command import environment, run_alone
from tests.small_run import SMALL

pytestmark = pytest.mark.slow("go1exp/train/sweep/", "go1exp/cli/", "conf/launcher/", "tests/ray_cluster.py")

LONGER = (*SMALL, "ppo.iterations=150", "checkpoint.every=5")


NO_RAY = "no ray: pip install 'go1exp[ray]'" if importlib.util.find_spec("ray") is None else ""


@pytest.fixture
def _network_of_its_own() -> None:
    lacking = NO_RAY
    if not lacking and (os.getuid() != 0 or not shutil.which("unshare") or not shutil.which("ip")):
        lacking = "a network of its own needs root, unshare and ip"
    if lacking and os.environ.get("GO1EXP_TEST_RAY"):
        pytest.fail(lacking)
    elif lacking:
        pytest.skip(lacking)


@pytest.mark.usefixtures("_network_of_its_own")
def test_a_node_that_dies_during_a_sweep_costs_nothing_but_time(tmp_path: Path) -> None:
    train = [sys.executable, "-m", "go1exp", "train", "-m", "seed=1,2,3", *LONGER, "hydra.sweep.dir=sweep"]
    launcher = ["hydra/launcher=ray", f"hydra.launcher.address=127.0.0.1:{ray_cluster.PORT}"]
    cluster = [sys.executable, ray_cluster.__file__, str(tmp_path), *train, *launcher]
    with (tmp_path / "output.txt").open("w") as output:
        process = subprocess.Popen(
            ["unshare", "-n", *cluster], cwd=tmp_path, env=environment(), stdout=output, stderr=subprocess.STDOUT
        )
    try:
        limit = time.monotonic() + 400
        begun = tmp_path / "sweep/seed-1"
        while not any((begun / "checkpoints").glob("*.pt")):
            assert time.monotonic() < limit, (tmp_path / "output.txt").read_text()
            assert process.poll() is None, (tmp_path / "output.txt").read_text()
            time.sleep(0.2)
        holder = json.loads((begun / ".holder.json").read_text())["pid"]
        ray_cluster.end(node_of(holder, [int(p) for p in (tmp_path / "nodes.txt").read_text().split()]))
        assert process.wait(timeout=600) == 0, (tmp_path / "output.txt").read_text()
    finally:
        if process.poll() is None:
            process.kill()
    assert [job.state for job in read(tmp_path / "sweep").jobs] == ["done"] * 3
    assert "continuing from" in (begun / "job.log").read_text()

    alone = run_alone(tmp_path, "train", *LONGER, "seed=1", "hydra.run.dir=alone")
    assert alone.returncode == 0, alone.stderr
    assert (begun / "metrics.csv").read_bytes() == (tmp_path / "alone/metrics.csv").read_bytes()


def node_of(process: int, nodes: list[int]) -> int:
    """Return the session of the node that a process descends from: jobs have sessions of their own."""
    while process > 1:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        if int(fields[3]) in nodes:
            return int(fields[3])
        process = int(fields[1])
    raise AssertionError("no node's")


@pytest.fixture(autouse=True)
def _ray() -> None:
    if NO_RAY and os.environ.get("GO1EXP_TEST_RAY"):
        pytest.fail(NO_RAY)
    elif NO_RAY:
        pytest.skip(NO_RAY)


def test_a_private_cluster_starts_runs_the_sweep_and_is_gone_afterwards(tmp_path: Path) -> None:
    line = (
        "train",
        "-m",
        "seed=1,2",
        *SMALL,
        "hydra/launcher=ray",
        "hydra.launcher.address=null",
        "hydra.sweep.dir=sweep",
    )
    done = run_alone(tmp_path, *line, RAY_AUTH_MODE="disabled", RAY_TMPDIR=(place := tempfile.mkdtemp(prefix="r")))
    try:
        assert done.returncode == 0, done.stdout + done.stderr
        assert [job.state for job in read(tmp_path / "sweep").jobs] == ["done"] * 2
        alone = run_alone(tmp_path, "train", *SMALL, "seed=2", "hydra.run.dir=alone")
        assert alone.returncode == 0, alone.stderr
        assert (tmp_path / "sweep/seed-2/metrics.csv").read_bytes() == (tmp_path / "alone/metrics.csv").read_bytes()
        assert of_sessions_in(place) == []
    finally:
        shutil.rmtree(place, ignore_errors=True)


def of_sessions_in(place: str) -> list[str]:
    """Return the commands of processes that keep their files in that folder."""
    words = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace"))
    return [line for line in words if place in line]


def test_a_cluster_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    done = run_alone(
        tmp_path, "train", "-m", "seed=1,2", *SMALL, "hydra/launcher=ray", "hydra.launcher.address=127.0.0.1:9"
    )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert "ray: no cluster at '127.0.0.1:9'" in done.stderr
    assert list(tmp_path.iterdir()) == []
