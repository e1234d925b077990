"""Several GPUs of one host that share a training: each has a share of the robots and of every minibatch.

What is random belongs to a robot (``base/tensors/randomness.py``), or is drawn identically by all, each of which keeps
its own part. The rollouts are joined after they are collected, so that a minibatch is drawn from all of them, and
gradients are averaged before they are clipped. So a training is that of one GPU with all robots, up to the order of
sums, and its checkpoints are too.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from stable_baselines3.common.distributions import DiagGaussianDistribution
from torch import Tensor, nn

from go1exp.base.errors import Expected
from go1exp.train import run_state

T = TypeVar("T")

PATIENCE = 180.0
"""Time after which a member that waits for the others gives up, s; kernels are compiled in the first iteration."""

SUMMED = ("contact/impossible",)
"""Metrics that add up over the members; of others it is the mean of the members that have one."""

LARGEST = ("contact/largest_force",)
"""Metrics of which the largest counts."""


@dataclass(frozen=True)
class Group:
    """The members of a training, seen by one of them. Alone, nothing is exchanged.

    Attributes:
        rank: number of this member; the first one, 0, writes all files.
        size: how many there are.
    """

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the member that logs and saves."""
        return self.rank == 0

    def rows(self, total: int) -> slice:
        """Return which of ``total`` rows, of robots or of a minibatch, are this member's."""
        share = total // self.size
        return slice(self.rank * share, (self.rank + 1) * share)

    def average(self, values: Tensor) -> None:
        """Replace ``values`` by its mean over the members."""
        if self.size > 1:
            dist.all_reduce(values)
            values.div_(self.size)

    def join(self, local: Tensor, out: Tensor) -> None:
        """Write the rollouts (T, n, ...) of all members into ``out`` (T, N, ...), robots in their order."""
        pieces = local.new_empty(self.size, *local.shape)
        dist.all_gather(list(pieces.unbind(0)), local)
        out.view(len(local), self.size, *local.shape[1:]).copy_(pieces.transpose(0, 1))

    def share_weights(self, module: nn.Module) -> None:
        """Give all members the first one's parameters."""
        if self.size > 1:
            for parameter in module.parameters():
                dist.broadcast(parameter.data, 0)

    def meet(self) -> None:
        """Wait until the devices of all members have done everything so far.

        An exchange on a GPU waits for the other's, which may not come while that one still compiles or records.
        """
        if self.size > 1:
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            dist.barrier(group=_by_host())

    def agreed(self, value: T) -> T:
        """Return the first member's ``value``, plain data."""
        if self.size == 1:
            return value
        held = [value]
        dist.broadcast_object_list(held, 0, group=_by_host())
        return held[0]

    def metrics(self, local: dict[str, float]) -> dict[str, float]:
        """Return the metrics of all robots from those of each member's."""
        if self.size == 1:
            return local
        each = self._of_all(local)
        return {key: _together(key, [m[key] for m in each]) for key in local}

    def whole(self, state: Any, robots: int) -> Any:
        """Return the state of all robots, in the first member; in the others what it returns has no meaning.

        Args:
            state: of this member's robots: dictionaries, lists, plain data and tensors. A dimension as long as there
                are robots is theirs (the first, behind the time in a delay line); without one, a tensor is the same
                for all members.
            robots: how many this member has.
        """
        if self.size == 1:
            return state
        return joined(self._of_all(_mapped(state, Tensor.cpu)), robots)

    def part(self, state: Any, robots: int) -> Any:
        """Return this member's part of what ``whole`` returned; ``robots`` are this member's."""
        if self.size == 1:
            return state
        total = robots * self.size
        rows = self.rows(total)

        def share(values: Tensor) -> Tensor:
            return values.narrow(values.shape.index(total), rows.start, robots) if total in values.shape else values

        return _mapped(state, share)

    def _of_all(self, local: T) -> list[T]:
        each = [local] * self.size
        dist.all_gather_object(each, local, group=_by_host())
        return each


def enter(rank: int, size: int, meeting: Path, backend: str = "nccl") -> Group:
    """Join the group of ``size`` members that meet by the file ``meeting``, which must not exist before.

    Args:
        rank: number of this member.
        size: how many there are.
        meeting: on this host; no port is opened to other hosts for it.
        backend: ``nccl``, or ``gloo`` between processors (for tests).
    """
    patience = timedelta(seconds=PATIENCE)
    device = torch.device("cuda", torch.cuda.current_device()) if backend == "nccl" else None
    dist.init_process_group(
        # With a device NCCL's links are made now, and not in the first exchange.
        *(backend, f"file://{meeting}"),
        rank=rank,
        world_size=size,
        timeout=patience,
        device_id=device,
    )
    global _HOST_GROUP  # as torch's own groups, it belongs to the process
    _HOST_GROUP = dist.new_group(backend="gloo", timeout=patience)
    group = Group(rank, size)
    group.average(torch.zeros(1, device=device))
    group.meet()
    return group


def leave() -> None:
    """Leave the group that ``enter`` joined, if it did."""
    if dist.is_initialized():
        dist.destroy_process_group()


_HOST_GROUP: dist.ProcessGroup | None = None


def _by_host() -> dist.ProcessGroup | None:
    """Return the group that exchanges plain data through the host's memory."""
    return _HOST_GROUP


def _together(key: str, values: Sequence[float]) -> float:
    if key in LARGEST:
        return max(values)
    known = [v for v in values if not math.isnan(v)]
    return sum(known) / (1 if key in SUMMED else len(known)) if known else math.nan


def _mapped(state: Any, change: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(state, Tensor):
        return change(state)
    if isinstance(state, Mapping):
        return {key: _mapped(value, change) for key, value in state.items()}
    if isinstance(state, list | tuple):
        return [_mapped(value, change) for value in state]
    return state


def joined(each: Sequence[Any], robots: int) -> Any:
    """Join the states of members that have ``robots`` robots each."""
    first = each[0]
    if isinstance(first, Tensor):
        return torch.cat(list(each), first.shape.index(robots)) if robots in first.shape else first
    if isinstance(first, Mapping):
        return {key: joined([state[key] for state in each], robots) for key in first}
    if isinstance(first, list):
        return [joined([state[k] for state in each], robots) for k in range(len(first))]
    return first


class SharedNoise(DiagGaussianDistribution):
    """SB3's Gaussian, whose samples for a member's robots are those that one GPU would draw for them among all."""

    def __init__(self, action_dim: int, group: Group) -> None:
        """Keep the group."""
        super().__init__(action_dim)
        self._group = group

    def sample(self) -> Tensor:
        """Return the samples (n, A) of this member's robots."""
        spread = self.distribution
        total = torch.zeros(len(spread.mean) * self._group.size, *spread.mean.shape[1:], device=spread.mean.device)
        noise = torch.normal(total, 1.0)[self._group.rows(len(total))]
        return spread.mean + spread.stddev * noise


Work = Callable[[dict[str, object], Path, Group], object]
"""What a member does: with the configuration as plain data, the run folder and its group."""

ENDED_EARLY = "a process of another GPU ended early"

LEAVING = 30.0
"""Time that the others are given to end by themselves, s."""


class MemberEnded(Expected):
    """A process of another GPU failed; it has said why."""


@contextmanager
def together(size: int, work: Work, container: dict[str, object], run: Path, backend: str = "nccl") -> Iterator[Group]:
    """Start ``size`` - 1 other processes that do ``work``, and be the first member of their group.

    Should one of them fail, this process ends at once where it would wait for it for ever.

    Args:
        size: members, one for each GPU; 1 starts nothing.
        work: an importable function.
        container: the configuration as plain data.
        run: the run folder.
        backend: as of ``enter``.

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
            yield enter(0, size, meeting, backend)
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
            leave()


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
    rank: int, size: int, meeting: Path, backend: str, work: Work, container: dict[str, object], run: Path
) -> None:
    """Do ``work`` as member ``rank``; the first member handles signals for all."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        work(container, run, enter(rank, size, meeting, backend))
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
