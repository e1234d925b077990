"""What a CUDA graph cannot hold is seen without a GPU: data from the host, and waiting for a value."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig

UNFIT = {
    "aten.lift_fresh.default": "a tensor made of numbers of the host, such as an index that is a list",
    "aten._local_scalar_dense.default": "a value that the host waits for",
    "aten.nonzero.default": "a shape that depends on data",
}


class Watch(TorchDispatchMode):
    """Notes the operations that are unfit; an index by a mask is one of them."""

    def __init__(self) -> None:
        super().__init__()
        self.unfit: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Note, and compute as ever."""
        indices = args[1] if "aten.index" in str(func) and isinstance(args[1], list | tuple) else ()
        masks = [i for i in indices if i is not None and i.dtype == torch.bool]
        number = str(func) == "aten.lift_fresh.default" and args[0].dim() == 0  # goes along as an argument
        if masks or (str(func) in UNFIT and not number):
            self.unfit.append(UNFIT.get(str(func), "an index that is a mask"))
        return func(*args, **(kwargs or {}))


@contextmanager
def without_engine(core: Go1Core) -> Iterator[None]:
    """The engine of the CPU may look at what it likes; the step around it may not."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("step", "reset", "derive_constants"):
            patch.setattr(core.backend, name, lambda *args: None)
        for name in ("ids", "compiled"):  # MuJoCo Warp's are kept
            patch.setattr(core.backend, name, cache(getattr(core.backend, name)))
        patch.setattr(core, "_restarts", core._restart)
        yield


ROUGH = ("terrain=rough", "terrain.cols=2", "terrain.border=2.0", "curriculum=terrain_level")


CHANGING = (
    *("actuator.command", "contact.time_constant", "command.slow_fraction"),
    *("reward.gait.weight", "reward.gait.full_cycle"),
)


@pytest.mark.parametrize(
    "choices",
    [
        (*ROUGH, "+observation.height_scan={}", "+reward.ahead={term: foot_clock_ahead, weight: 1.0}"),
        ("experiment=clock", "backend=cpu"),
        ("reward=paper_literal",),
    ],
)
def test_a_step_holds_nothing_that_a_graph_cannot(choices: tuple[str, ...], start_core: Callable[..., Go1Core]) -> None:
    core = start_core(*choices)
    with without_engine(core):
        core.step_by_call(torch.zeros(4, 12))  # constants are made once
        with Watch() as watch:
            core.step_by_call(torch.zeros(4, 12))
    assert watch.unfit == []


def test_a_step_whose_settings_change_holds_nothing_that_a_graph_cannot(make_task: Callable[..., TaskConfig]) -> None:
    core = Go1Core(
        make_task("reward=paper", "actuator=delay", "command=widening", "backend.threads=1"), 4, changing=CHANGING
    )
    for path in CHANGING:
        core.change(path, (0.0, 0.01) if path == "actuator.command" else 0.01)
    core.reset()
    with without_engine(core):
        core.step_by_call(torch.zeros(4, 12))  # constants are made once
        with Watch() as watch:
            core.step_by_call(torch.zeros(4, 12))
    assert watch.unfit == []


def test_what_is_unfit_is_seen() -> None:
    x = torch.zeros(3, 4)
    for work in (lambda: x[:, [1, 2]], lambda: float(x.sum()), lambda: x[x > 0], lambda: torch.tensor([1.0])):
        with Watch() as watch:
            work()
        assert len(watch.unfit) == 1
    with Watch() as watch:
        torch.where(x[:, 1:3] > 0.0, x[:, :2], 1.0).sum()
    assert watch.unfit == []
