"""The delay line against NumPy's interpolation over the whole past."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from go1exp.base.tensors.memory import DelayLine

DT, LONGEST = 0.002, 0.02


def line(num_envs: int, joints: int) -> DelayLine:
    return DelayLine(num_envs, joints, LONGEST, DT, torch.float64, torch.device("cpu"))


def test_it_is_the_signal_of_a_while_ago_for_each_environment_and_joint() -> None:
    rng = np.random.default_rng(0)
    signal = rng.normal(size=(60, 3, 4))
    delay = np.concatenate([rng.uniform(0.0, LONGEST, (2, 4)), [[0.0, DT, LONGEST, 0.5 * DT]]])
    made = line(3, 4)
    times = np.arange(60) * DT
    for k in range(60):
        got = made.advance(torch.as_tensor(signal[k]), torch.as_tensor(delay)).numpy()
        for i in range(3):
            for j in range(4):  # before the first sample, the first
                expected = np.interp(times[k] - delay[i, j], times[: k + 1], signal[: k + 1, i, j])
                assert got[i, j] == pytest.approx(expected, abs=1e-12), (k, i, j)


def test_no_delay_is_the_sample_itself_bit_for_bit() -> None:
    made, zero = line(2, 3), torch.zeros(2, 3, dtype=torch.float64)
    for k in range(30):
        sample = torch.as_tensor(np.random.default_rng(k).normal(size=(2, 3)))
        assert torch.equal(made.advance(sample, zero), sample)


def test_a_reset_forgets_the_past_of_its_rows_only_and_the_state_can_be_saved() -> None:
    rng = np.random.default_rng(1)
    signal = torch.as_tensor(rng.normal(size=(40, 2, 1)))
    delay = torch.full((2, 1), 0.007, dtype=torch.float64)
    made, kept = line(2, 1), line(2, 1)
    for k in range(20):
        made.advance(signal[k], delay)
        kept.advance(signal[k], delay)
    made.reset(torch.tensor([True, False]))
    got, old = made.advance(signal[20], delay), kept.advance(signal[20], delay)
    assert got[0] == signal[20, 0]
    assert got[1] == old[1]
    copy = line(2, 1)
    copy.load_state_dict(made.state_dict())
    for k in range(21, 40):
        assert torch.equal(made.advance(signal[k], delay), copy.advance(signal[k], delay))
    assert made.advance(signal[0], delay)[0] != signal[0, 0]


def test_a_state_of_an_older_version_goes_on_where_it_was() -> None:
    """Its ring had 12 places for 10 samples and the two about them, where the newest now has a power of two."""
    rng = np.random.default_rng(2)
    signal = torch.as_tensor(rng.normal(size=(60, 2, 3)))
    delay = torch.as_tensor(rng.uniform(0.0, LONGEST, (2, 3)))
    made, copy, places = line(2, 3), line(2, 3), 12
    for k in range(30):
        made.advance(signal[k], delay)
    older = made.state_dict()
    older["_past"] = torch.stack([signal[29 - (29 - k) % places] for k in range(places)])
    older["_newest"] = torch.tensor([29 % places])
    older["_age"] = older["_age"].long()
    copy.load_state_dict(older)
    for k in range(30, 60):
        assert torch.equal(made.advance(signal[k], delay), copy.advance(signal[k], delay)), k


def test_what_was_no_number_before_a_reset_does_not_come_back() -> None:
    made, delay = line(1, 2), torch.zeros(1, 2, dtype=torch.float64)
    for _ in range(20):
        made.advance(torch.full((1, 2), torch.nan, dtype=torch.float64), delay)
    made.reset(torch.tensor([True]))
    sample = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    assert torch.equal(made.advance(sample, delay), sample)
    assert torch.equal(made.advance(sample, delay + LONGEST), sample)
