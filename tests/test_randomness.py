from __future__ import annotations

import io
import math

import numpy as np
import pytest
import torch
from scipy import stats

from go1exp.base.tensors.randomness import EnvRandom


def test_an_environment_draws_the_same_in_any_batch_bit_for_bit() -> None:
    batch = EnvRandom(seed=11, num_envs=9)
    draws = [batch.stream("a").uniform(3), batch.stream("a").normal(2, 2), batch.stream("b").integers(7, 4)]
    for i in range(9):
        alone = EnvRandom(seed=11, num_envs=1, first_env=i)
        again = [alone.stream("a").uniform(3), alone.stream("a").normal(2, 2), alone.stream("b").integers(7, 4)]
        for together, single in zip(draws, again, strict=True):
            assert torch.equal(together[i : i + 1], single)
    half = EnvRandom(seed=11, num_envs=4, first_env=5)
    assert torch.equal(half.stream("a").uniform(3), draws[0][5:])


def test_the_same_seed_gives_the_same_numbers_and_another_seed_others() -> None:
    first, second = EnvRandom(3, 100), EnvRandom(3, 100)
    assert torch.equal(first.stream("x").uniform(10), second.stream("x").uniform(10))
    seen = torch.cat([EnvRandom(seed, 100).stream("x").uniform(10).flatten() for seed in (*range(20), 2**40, -1)])
    # 22000 draws of 2^24 values: chance makes some 14 of them equal, repeated sequences would make thousands.
    assert len(seen.unique()) > 21900


def test_shapes_are_robots_first() -> None:
    stream = EnvRandom(0, 5).stream("x")
    assert stream.uniform().shape == (5,)
    assert stream.uniform(3).shape == (5, 3)
    assert stream.uniform(2, 4).shape == (5, 2, 4)
    assert stream.normal(2, 4).shape == (5, 2, 4)
    assert stream.normal().shape == (5,)
    assert stream.integers(6, 2).shape == (5, 2)
    assert stream.uniform(3).dtype == stream.normal(3).dtype == torch.float32
    assert stream.integers(6).dtype == torch.int64


def test_drawing_in_pieces_is_drawing_at_once() -> None:
    whole, pieces = EnvRandom(0, 4).stream("x"), EnvRandom(0, 4).stream("x")
    expected = whole.uniform(6)
    got = torch.cat([pieces.uniform(1), pieces.uniform(2), pieces.uniform(3)], dim=1)
    assert torch.equal(got, expected)


def test_another_consumer_does_not_shift_a_stream() -> None:
    quiet, busy = EnvRandom(5, 4), EnvRandom(5, 4)
    expected = [quiet.stream("mine").uniform(3) for _ in range(3)]
    for step in expected:
        busy.stream("new").uniform(17)
        assert torch.equal(busy.stream("mine").uniform(3), step)
        busy.stream("newer").normal(2)


@pytest.mark.parametrize("seed", [0, 1, 123456789])
def test_uniform_numbers_are_uniform_across_robots_and_along_a_stream(seed: int) -> None:
    across = EnvRandom(seed, 20_000).stream("x").uniform(1).flatten()
    along = EnvRandom(seed, 1).stream("x").uniform(20_000).flatten()
    for draws in (across, along):
        assert draws.min() >= 0.0
        assert draws.max() < 1.0
        assert stats.kstest(draws.double().numpy(), "uniform").pvalue > 1e-3


def test_uniform_bounds_may_differ_by_element_and_by_robot() -> None:
    low, high = torch.tensor([0.0, -5.0, 2.0]), torch.tensor([1.0, -4.0, 2.0])
    draws = EnvRandom(0, 3000).stream("x").uniform(3, low=low, high=high)
    assert (draws >= low).all()
    assert (draws <= high).all()
    assert (draws[:, 2] == 2.0).all()
    for column, start in [(0, 0.0), (1, -5.0)]:
        assert stats.kstest(draws[:, column].double().numpy(), "uniform", args=(start, 1.0)).pvalue > 1e-3
    per_robot = torch.arange(3000.0).unsqueeze(1)
    draws = EnvRandom(0, 3000).stream("x").uniform(2, low=per_robot, high=per_robot + 0.5)
    assert (draws.floor() == per_robot).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_normal_numbers_are_standard_normal_and_uncorrelated(seed: int) -> None:
    draws = EnvRandom(seed, 10_000).stream("x").normal(3).double().numpy()
    assert np.isfinite(draws).all()
    for column in draws.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
    assert np.abs(np.corrcoef(draws.T) - np.eye(3)).max() < 0.05
    along = EnvRandom(seed, 1).stream("x").normal(10_000).flatten().double().numpy()
    assert stats.kstest(along, "norm").pvalue > 1e-3


@pytest.mark.parametrize("high", [1, 2, 7, 100])
def test_integers_cover_their_range_evenly(high: int) -> None:
    draws = EnvRandom(0, 10_000).stream("x").integers(high, 1).flatten()
    counts = np.bincount(draws.numpy(), minlength=high)
    assert len(counts) == high
    assert stats.chisquare(counts).pvalue > 1e-3 if high > 1 else counts[0] == 10_000


def correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(np.corrcoef(a.flatten().double().numpy(), b.flatten().double().numpy())[0, 1])


def test_streams_robots_seeds_and_successive_draws_are_uncorrelated() -> None:
    n = 20_000
    limit = 5.0 / math.sqrt(n)  # five standard deviations
    random = EnvRandom(0, n)
    a, b = random.stream("a").uniform(2), random.stream("b").uniform(2)
    other_seed = EnvRandom(1, n).stream("a").uniform(2)
    pairs = {
        "streams": (a, b),
        "seeds": (a, other_seed),
        "successive draws": (a[:, 0], a[:, 1]),
        "neighbours": (a[:-1], a[1:]),
        "neighbours, one draw later": (a[:-1, 1], a[1:, 0]),
        "two robots in time": tuple(EnvRandom(0, 2).stream("a").uniform(n)),
        "a robot with itself one draw later": (lambda x: (x[:-1], x[1:]))(EnvRandom(0, 1).stream("a").uniform(n)[0]),
    }
    for name, (x, y) in pairs.items():
        assert abs(correlation(x, y)) < limit, name


def test_the_state_restores_every_stream_and_forgets_those_that_came_later() -> None:
    random = EnvRandom(4, 3)
    random.stream("a").uniform(5)
    random.stream("b").normal(2)
    file = io.BytesIO()
    torch.save(random.state_dict(), file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    expected = [random.stream(name).uniform(4) for name in ("a", "b", "c")]
    random.stream("a").uniform(100)

    elsewhere = EnvRandom(99, 3)
    elsewhere.stream("c").uniform(1)
    elsewhere.stream("a").uniform(1)
    for resumed in (random, elsewhere):
        resumed.load_state_dict(state)
        assert resumed.seed == 4
        for name, draw in zip(("a", "b", "c"), expected, strict=True):
            assert torch.equal(resumed.stream(name).uniform(4), draw), name


def test_reseeding_is_starting_anew_through_the_same_stream_object() -> None:
    random = EnvRandom(1, 3)
    stream = random.stream("a")
    stream.uniform(7)
    random.reseed(2)
    fresh = EnvRandom(2, 3)
    assert random.stream("a") is stream
    assert torch.equal(stream.uniform(7), fresh.stream("a").uniform(7))
    assert torch.equal(random.stream("late").uniform(7), fresh.stream("late").uniform(7))
