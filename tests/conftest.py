"""What the tests share."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time

from go1exp.cli import ONE_BLAS_THREAD

os.environ.setdefault(*ONE_BLAS_THREAD)  # before NumPy is imported; tests run side by side

from collections.abc import Callable, Generator
from copy import deepcopy
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.extend.testing.actuators import go1_actuators
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.actuator_net import ActuatorNet, NetInfo, Provenance, group_names
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig, parse_task
from tests.selection import changed_since, chosen
from tests.small_run import made_once, plain, trained

torch.set_num_threads(1)

CHANGED = pytest.StashKey[frozenset[str] | None]()
SPENT = pytest.StashKey[float]()
SPENT_ALL = "the time for slow tests is spent"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the choice of slow tests: tests/selection.py."""
    text = "slow tests: all, none, or those about files that changed since a commit (default: all)"
    parser.addoption("--slow", default="all", metavar="WHICH", help=text)
    text = "skip the slow tests that are left when this process has spent so long on slow tests (default: no limit)"
    parser.addoption("--slow-seconds", default=float("inf"), type=float, metavar="S", help=text)


def pytest_configure(config: pytest.Config) -> None:
    """Ask git once."""
    # Started by nohup, this process ignores SIGHUP, and so would every process that a test starts.
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    slow = str(config.getoption("--slow"))
    config.stash[SPENT] = 0.0
    config.stash[CHANGED] = None if slow in ("all", "none") else changed_since(slow, config.rootpath)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Say which slow tests ran where that depends on something."""
    slow, changed = config.getoption("--slow"), config.stash[CHANGED]
    if slow not in ("all", "none"):
        about = "all, as git cannot tell what changed" if changed is None else f"about the {len(changed)} files changed"
        terminalreporter.write_line(f"slow tests: {about} since {slow}")
    left = [report for report in terminalreporter.stats.get("skipped", []) if SPENT_ALL in str(report.longrepr)]
    if left:
        terminalreporter.write_line(f"slow tests: {len(left)} of them skipped, {SPENT_ALL}; make test-all runs them")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Count the time of slow tests."""
    begin = time.monotonic()
    result = yield
    if item.get_closest_marker("slow"):
        item.config.stash[SPENT] += time.monotonic() - begin
    return result


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a slow test where their time is spent."""
    if item.get_closest_marker("slow") and item.config.stash[SPENT] >= item.config.getoption("--slow-seconds"):
        pytest.skip(SPENT_ALL)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the slow tests that were not chosen."""
    slow, changed = str(config.getoption("--slow")), config.stash[CHANGED]
    kept: list[pytest.Item] = []
    dropped: list[pytest.Item] = []
    for item in items:
        mark = item.get_closest_marker("slow")
        itself = item.path.relative_to(config.rootpath).as_posix()
        keep = mark is None or chosen(slow, (*mark.args, itself), changed)
        (kept if keep else dropped).append(item)
    if dropped:
        items[:] = kept
        config.hook.pytest_deselected(items=dropped)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leave what was imported out of the garbage collector's rounds: a tenth of the suite's time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@cache
def composed(overrides: tuple[str, ...], folder: str) -> dict[str, Any]:
    """Compose once what many tests begin with; paths among the overrides begin at ``folder``."""
    return compose("train", overrides)


@pytest.fixture(scope="session")
def make_task() -> Callable[..., TaskConfig]:
    """Parse the environment's configuration from command-line overrides."""
    return lambda *overrides: parse_task(deepcopy(composed(plain(*overrides), os.getcwd())))


@pytest.fixture
def make_core(make_task: Callable[..., TaskConfig]) -> Callable[..., Go1Core]:
    """Build a batched environment from overrides; keyword arguments go to ``Go1Core``."""

    def make(*overrides: str, num_envs: int = 4, **kwargs: Any) -> Go1Core:
        return Go1Core(make_task("backend.threads=1", *overrides), num_envs, **kwargs)

    return make


@pytest.fixture
def start_core(make_core: Callable[..., Go1Core]) -> Callable[..., Go1Core]:
    """Build as ``make_core`` does, and begin the first episodes."""

    def start(*overrides: str, **kwargs: Any) -> Go1Core:
        core = make_core(*overrides, **kwargs)
        core.reset()
        return core

    return start


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Path of a bundle of two tiny iterations: its policy hardly moves, so that a robot stands."""
    from go1exp.deploy.export.build import build

    def make(path: Path) -> None:
        run = trained(tmp_path_factory.mktemp("walk") / "run", "actuator.kp=35", "actuator.kd=0.7")
        path.write_bytes(build(run, seconds=0.2))

    return str(made_once(tmp_path_factory, "walk.zip", make))


@pytest.fixture
def drives() -> Callable[..., ActuatorSetup]:
    """Describe the drives of n Go1 robots at 2 ms; keyword arguments change that."""
    return go1_actuators


def random_net(
    seed: int = 0, bias: float = 0.1, skip: float = 0.0, torque: float = 10.0, **changes: Any
) -> ActuatorNet:
    """An actuator net of the Go1 that nobody fitted, of the size of ``torque`` N m; ``changes`` to what it says."""
    about = Provenance({}, (), (), (), 0.0, seed, "{}", {})
    usual: dict[str, Any] = {
        "robot": "go1",
        "joints": robot.JOINTS,
        "share": "kind",
        "inputs": ("position_error", "velocity"),
        "history": 3,
        "period": 0.002,
        "hidden": (8, 6, 7),
        "target": "tau_est",
        "kp": None,
        "kd": None,
        "provenance": about,
    }
    said = {**usual, **changes}
    info = NetInfo(groups=group_names(said["joints"], said["share"]), **said)
    rng, k, f = np.random.default_rng(seed), len(info.groups), info.features
    widths = (f, *info.hidden, 1)
    layers = list(pairwise(widths))
    return ActuatorNet(
        info,
        weights=tuple(rng.normal(0.0, 2.0 / np.sqrt(a), (k, a, b)) for a, b in layers),
        biases=tuple(bias * rng.normal(size=(k, b)) for _, b in layers),
        skip=skip * rng.normal(size=(k, f)),
        input_mean=bias * rng.normal(size=(k, f)),
        input_std=rng.uniform(0.2, 2.0, (k, f)),
        output_mean=bias * rng.normal(size=k),
        output_std=rng.uniform(0.5, 1.0, k) * torque,
        input_low=np.full((k, len(info.inputs)), -1.0),
        input_high=np.full((k, len(info.inputs)), 1.0),
    )


@pytest.fixture(scope="session")
def make_net(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Write a random actuator net; keyword arguments as ``random_net``'s."""

    def make(**settings: Any) -> Path:
        path = tmp_path_factory.mktemp("net") / "net.npz"
        random_net(**settings).save(path)
        return path

    return make


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder of its own, as MuJoCo writes its warnings to a file where it runs."""
    monkeypatch.chdir(tmp_path)
