from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby, pairwise

import numpy as np
import pytest
import torch

from go1exp.mdp.feet import FootTimers

DT = 0.002
SUBSTEPS = 10


def random_contacts(seed: int, steps: int, n: int) -> np.ndarray:
    """Contact flags (steps, n, 4): phases of random length, some of a single step."""
    rng = np.random.default_rng(seed)
    flags = np.zeros((steps, n, 4), dtype=bool)
    for env in range(n):
        for foot in range(4):
            state, k = rng.random() < 0.5, 0
            while k < steps:
                length = int(rng.choice([1, 2, int(rng.integers(1, 15)), int(rng.integers(10, 120))]))
                flags[k : k + length, env, foot] = state
                state, k = not state, k + length
    return flags


def runs(flags: Iterable[bool]) -> list[tuple[bool, int]]:
    """Lengths of the phases so far: (touching, steps)."""
    return [(bool(value), len(list(group))) for value, group in groupby(flags)]


def last_completed(phases: list[tuple[bool, int]], touching: bool) -> float:
    """Duration of the last phase of a kind that has ended; it ends with the first step of the next one."""
    ended = [length for value, length in phases[:-1] if value == touching]
    return (ended[-1] + 1) * DT if ended else 0.0


def expected(flags: np.ndarray, substep: int) -> dict[str, float]:
    """All timers of one foot, from its history up to now; ``substep`` counts those of the running policy step."""
    phases = runs(flags)
    touching, length = phases[-1]
    recent = flags[len(flags) - substep - 1 : len(flags)] if len(flags) > substep else flags
    return {
        "air": 0.0 if touching else length * DT,
        "contact": length * DT if touching else 0.0,
        "last_air": last_completed(phases, touching=False),
        "last_contact": last_completed(phases, touching=True),
        "touchdown": any(not before and after for before, after in pairwise(recent)),
    }


def run_through(timers: FootTimers, flags: np.ndarray) -> None:
    for k, row in enumerate(flags):
        if k % SUBSTEPS == 0:
            timers.begin_step()
        timers.update(torch.as_tensor(row))


@pytest.mark.parametrize("seed", range(3))
def test_timers_agree_with_a_count_of_the_whole_history(seed: int) -> None:
    n = 5
    flags = random_contacts(seed, 400, n)
    timers = FootTimers(n, DT, torch.device("cpu"))
    for k in range(len(flags)):
        if k % SUBSTEPS == 0:
            timers.begin_step()
        timers.update(torch.as_tensor(flags[k]))
        if k % 7 and k % SUBSTEPS:
            continue  # every seventh step and every policy step will do
        for env in range(n):
            for foot in range(4):
                want = expected(flags[: k + 1, env, foot], k % SUBSTEPS + 1)
                got = {name: getattr(timers, name)[env, foot].item() for name in want}
                assert got == pytest.approx(want, abs=1e-6), (k, env, foot)


def test_a_hop_by_hand() -> None:
    """On the ground for 3 steps, in the air for 5, on the ground for 2, then off again."""
    timers = FootTimers(1, 0.1, torch.device("cpu"))
    history = []
    for touching in [1, 1, 1, 0, 0, 0, 0, 0, 1, 1, 0]:
        timers.begin_step()
        timers.update(torch.full((1, 4), bool(touching)))
        history.append([getattr(timers, name)[0, 0].item() for name in FootTimers.memory])
    by_hand = [  # air, contact, last air, last contact, touchdown
        [0.0, 0.1, 0.0, 0.0, 0],
        [0.0, 0.2, 0.0, 0.0, 0],
        [0.0, 0.3, 0.0, 0.0, 0],
        [0.1, 0.0, 0.0, 0.4, 0],
        [0.2, 0.0, 0.0, 0.4, 0],
        [0.3, 0.0, 0.0, 0.4, 0],
        [0.4, 0.0, 0.0, 0.4, 0],
        [0.5, 0.0, 0.0, 0.4, 0],
        [0.0, 0.1, 0.6, 0.4, 1],
        [0.0, 0.2, 0.6, 0.4, 0],
        [0.1, 0.0, 0.6, 0.3, 0],
    ]
    np.testing.assert_allclose(history, by_hand, atol=1e-6)


def test_a_touchdown_is_remembered_for_the_rest_of_the_policy_step() -> None:
    timers = FootTimers(1, DT, torch.device("cpu"))
    timers.begin_step()
    seen = []
    for touching in [False, True, False, False]:
        timers.update(torch.full((1, 4), touching))
        seen.append(timers.touchdown.all().item())
    assert seen == [False, True, True, True]
    timers.begin_step()
    assert not timers.touchdown.any()


def test_a_reset_zeroes_its_rows_and_they_go_on_as_new() -> None:
    flags = random_contacts(9, 200, 4)
    reset, plain, new = (FootTimers(4, DT, torch.device("cpu")) for _ in range(3))
    run_through(reset, flags[:100])
    run_through(plain, flags[:100])
    mask = torch.tensor([True, False, False, True])
    reset.reset(mask)
    for name in FootTimers.memory:
        assert not getattr(reset, name)[mask].any()
    for timers in (reset, plain, new):
        run_through(timers, flags[100:])
    for name in FootTimers.memory:
        after = getattr(reset, name)
        assert torch.equal(after[mask], getattr(new, name)[mask]), name
        assert torch.equal(after[~mask], getattr(plain, name)[~mask]), name


def test_timers_continue_from_their_saved_state() -> None:
    flags = random_contacts(3, 200, 4)
    first, second = FootTimers(4, DT, torch.device("cpu")), FootTimers(4, DT, torch.device("cpu"))
    run_through(first, flags[:105])
    second.load_state_dict(first.state_dict())
    for row in torch.as_tensor(flags[105:]):
        first.update(row)
        second.update(row)
    for name in FootTimers.memory:
        assert torch.equal(getattr(first, name), getattr(second, name))
