"""What the tests share."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time

from go1exp.cli import ONE_BLAS_THREAD

os.environ.setdefault(*ONE_BLAS_THREAD)  # before NumPy is imported; tests run side by side

from collections.abc import Generator

import pytest

from tests.selection import changed_since, chosen

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
    """Ask git once, and load what tests share where tests run: a process that hands them out needs no torch."""
    if hasattr(config, "workerinput") or config.getoption("dist", "no") == "no":
        config.pluginmanager.import_plugin("tests.fixtures")
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
