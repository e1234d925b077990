"""The processes of a training on several GPUs: one for each, of which the first is the one that was started."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from go1exp.base.errors import Expected
from go1exp.train import group, run_state
from go1exp.train.group import Group

Work = Callable[[dict[str, Any], Path, Group], Any]
"""What a member does: with the configuration as plain data, the run folder and its group."""

ENDED_EARLY = "a process of another GPU ended early"

LEAVING = 30.0
"""Time that the others are given to end by themselves, s."""


class MemberEnded(Expected):
    """A process of another GPU failed; it has said why."""


@contextmanager
def together(size: int, work: Work, container: dict[str, Any], run: Path, backend: str = "nccl") -> Iterator[Group]:
    """Start ``size`` - 1 other processes that do ``work``, and be the first member of their group.

    Should one of them fail, this process ends at once where it would wait for it for ever.

    Args:
        size: members, one for each GPU; 1 starts nothing.
        work: an importable function.
        container: the configuration as plain data.
        run: the run folder.
        backend: as of ``group.enter``.

    Raises:
        MemberEnded: if one of them failed and an exchange noticed it.
    """
    if size == 1:
        yield Group()
        return
    with tempfile.TemporaryDirectory() as folder:
        meeting = Path(folder) / "meeting"
        spawn = multiprocessing.get_context("spawn")
        arguments = (size, meeting, backend, work, container, run)
        others = [spawn.Process(target=_member, args=(rank, *arguments), daemon=True) for rank in range(1, size)]
        _start(others)
        done = threading.Event()
        threading.Thread(target=_watch, args=(others, done, run), daemon=True).start()
        try:
            yield group.enter(0, size, meeting, backend)
            done.set()
            for other in others:
                other.join(LEAVING)
        except Expected:
            raise
        except RuntimeError as error:  # of an exchange, where the others' end is seen at once
            for other in others:
                other.join(1.0)
            if any(other.exitcode for other in others):
                raise MemberEnded(ENDED_EARLY) from error
            raise
        finally:
            done.set()
            for other in others:
                other.kill()
            group.leave()


def _start(others: Sequence[BaseProcess]) -> None:
    """Start the processes, each of which sees one GPU, the next one of those that this one sees."""
    name = "CUDA_VISIBLE_DEVICES"
    before = os.environ.get(name)
    visible = before.split(",") if before else [str(k) for k in range(len(others) + 1)]
    try:
        for other, device in zip(others, visible[1:], strict=False):
            os.environ[name] = device
            other.start()
    finally:
        if before is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = before


def _member(
    rank: int, size: int, meeting: Path, backend: str, work: Work, container: dict[str, Any], run: Path
) -> None:
    """Do ``work`` as member ``rank``; the first member hears the signals and tells the others."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        work(container, run, group.enter(rank, size, meeting, backend))
    except Exception as error:
        print(f"GPU {rank} of {size}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        os._exit(1)
    os._exit(0)  # without waiting for threads of CUDA and NCCL


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


def _watch(others: list[BaseProcess], done: threading.Event, run: Path) -> None:
    """End this process when one of the others has failed."""
    connection.wait([other.sentinel for other in others])
    if not done.wait(1.0) and any(other.exitcode for other in others):
        run_state.note_failure(run, ENDED_EARLY)
        print(f"{ENDED_EARLY}; what was saved is in {run}, go on with: go1exp train resume={run}", file=sys.stderr)
        for other in others:
            other.kill()
        os._exit(1)
