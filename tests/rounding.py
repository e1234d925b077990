"""How far a robot of a batch may be from the same robot alone where a matrix product is between them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch

from go1exp.sim.actuator.actuator_net import load
from go1exp.sim.actuator.grouped_mlp import LANES

UNIT = 2.0**-24
"""Largest relative error of one float32 operation."""


@cache
def one_order(outputs: int, terms: int) -> bool:
    """Return whether this matrix library sums each column of a product alike at every width that nets use."""
    made = torch.Generator().manual_seed(0)
    weight, columns = torch.randn(outputs, terms, generator=made), torch.randn(terms, 8192, generator=made)
    whole, least = torch.mm(weight, columns), LANES * torch.get_num_threads()
    widths = [*range(least, least + 20 * LANES, LANES), 1024, 2048, 4096 - LANES]
    return all(torch.equal(torch.mm(weight, columns[:, :width]), whole[:, :width]) for width in widths)


def alone_and_in_a_batch(file: Path, largest_input: float) -> float:
    """Return the largest difference, N m, between a robot alone and in a batch that drives with the net in ``file``.

    0 where the library sums in one order. Else what float32 allows: two orders of summing K products differ by at most
    2 K UNIT times the sum of their sizes (Higham, Accuracy and Stability of Numerical Algorithms, 2002, section 3.1);
    a layer passes the differences of its inputs on, multiplied by the sizes of its weights; softsign enlarges none.

    Args:
        file: an actuator net.
        largest_input: of any angle error, rad, angle, rad, or speed, rad/s, that the net is given.
    """
    weights, biases, skip = load(file).folded
    if all(one_order(max(w.shape[2], 4), w.shape[1] + 1) for w in (*weights, skip)):
        return 0.0
    worst = 0.0
    for net in range(len(skip)):
        size = np.full(weights[0].shape[1], largest_input)
        straight = 2 * (len(size) + 1) * UNIT * float(np.abs(skip[net, :, 0]) @ size)
        error = np.zeros_like(size)
        for w, b in zip(weights, biases, strict=True):
            total = np.abs(w[net]).T @ size + np.abs(b[net])
            error = np.abs(w[net]).T @ error + 2 * (len(size) + 4) * UNIT * total  # 3 more for softsign
            size = np.minimum(total, 1.0)
        worst = max(worst, straight + float(error.max()))
    return worst
