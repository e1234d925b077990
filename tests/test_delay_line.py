"""The delay line against NumPy's interpolation over the whole past."""

from __future__ import annotations

import numpy as np
import torch

from go1exp.base.tensors.memory import DelayLine

DT, LONGEST = 0.002, 0.02


def line(num_envs: int, joints: int) -> DelayLine:
    return DelayLine(num_envs, joints, LONGEST, DT, torch.float64, torch.device("cpu"))


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
