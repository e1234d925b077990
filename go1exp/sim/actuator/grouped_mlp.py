"""Small networks, each applied to many columns, fast enough to be part of a physics step.

An actuator's net is tiny and is evaluated for every joint of every robot at every physics step, so what counts is how
often the numbers pass through memory. Columns are samples and rows are units, so that every row is one long vector;
buffers and the calls on them are made once; the columns are worked through in blocks that stay in the processor's
cache; biases are a further column of the weights, against a row of ones, which spares a pass over the block.

No column depends on the others. That holds to the bit where the matrix library adds up the products of a column in one
order however many columns there are. MKL does when each of its threads gets at least 12 columns and when there is more
than one output; fewer columns are added up in another order. ``padded_rows`` keeps clear of that. Tried with MKL 2024.2
on an AMD processor with AVX2, on its compatible and AVX2 code paths and on 1 to 3 threads, for layers of up to 96
units: one of 128 is added up otherwise on the compatible path with two threads. Other libraries may differ in the last
bits (docs/trust.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 2048
"""Columns that a CPU thread works on at a time: 64 rows of them are 0.5 MB. Measured best of 512 to 12288."""

OUTPUTS = 4
"""Rows of the last layer, of which the first is the output: with one, the library takes another road."""

FEWEST = 2
"""Columns of a net, at least."""

LANES = 16
"""Float32 numbers in the widest vector register. Columns come in multiples of it for each thread of the library."""

Layer = tuple[np.ndarray, np.ndarray]
"""Weights (inputs, outputs) and biases (outputs,)."""

Piece = tuple[int, int, int]
"""Columns of one net in a block: net, start, stop."""


def padded_rows(rows: int, counts: Sequence[int], device: torch.device) -> int:
    """Return how many rows to allocate for ``rows`` robots, so that no robot's bits depend on how many there are.

    Args:
        rows: robots, N.
        counts: joints of a robot that each net serves; a net's columns are its joints times the rows.
        device: of the buffers.
    """
    threads = torch.get_num_threads() if device.type == "cpu" else 1
    step = max(LANES // math.gcd(LANES, count) for count in counts)
    least = -(-LANES * threads // min(counts))
    return step * -(-max(rows, least) // step)


class GroupedMLP:
    """Networks of one shape, with softsign between their layers, each with a run of columns of its own.

    Attributes:
        inputs: (F, C) float32, written by the caller.
    """

    def __init__(
        self, nets: Sequence[Sequence[Layer]], skips: Sequence[np.ndarray], columns: Sequence[int], device: torch.device
    ) -> None:
        """Prepare buffers and calls.

        Args:
            nets: K lists of layers, first to last; the last has one output.
            skips: K linear maps (F,) whose outcome is added to the networks'.
            columns: of each network, at least ``FEWEST``; C is their sum.
            device: of the buffers.
        """
        if min(columns) < FEWEST:
            raise ValueError(f"columns: at least {FEWEST} for each net")
        total = sum(columns)
        block = min(total, BLOCK * torch.get_num_threads()) if device.type == "cpu" else total

        def ones(rows: int, width: int) -> Tensor:
            return torch.ones(rows, width, dtype=torch.float32, device=device)

        weights = [[_augmented(*layer, device) for layer in net] for net in nets]
        linear = [_augmented(skip[:, None], np.zeros(1), device) for skip in skips]
        widest = max(len(w) for net in weights for w in net)
        # The row of ones is the first, so that layers of different widths leave it alone.
        self._x, self._out = ones(weights[0][0].shape[1], total), ones(OUTPUTS, total)
        self.inputs = self._x[1:].zero_()
        work, spare = [ones(1 + widest, block), ones(1 + widest, block)], ones(widest, block)
        self._calls: list[tuple[Callable[..., Tensor], tuple[Tensor | float, ...], Tensor]] = []
        for pieces in _blocks(columns, block):
            self._add_layers(pieces, weights, work, spare)
            if any(skip.any() for skip in skips):
                for net, start, stop in pieces:
                    out = self._out[:, start:stop]
                    self._calls.append((torch.addmm, (out, linear[net], self._x[:, start:stop]), out))

    def _add_layers(self, pieces: list[Piece], weights: list[list[Tensor]], work: list[Tensor], spare: Tensor) -> None:
        first, width = pieces[0][1], pieces[-1][2] - pieces[0][1]
        source, depth = self._x[:, first : first + width], len(weights[0])
        for k in range(depth):
            units = len(weights[0][k])
            if k < depth - 1:
                buffer = work[k % 2][: 1 + units, :width]
                target = buffer[1:]
            else:
                target = buffer = self._out[:, first : first + width]
            for net, start, stop in pieces:
                columns = slice(start - first, stop - first)
                self._calls.append((torch.mm, (weights[net][k], source[:, columns]), target[:, columns]))
            if k < depth - 1:  # softsign: h / (1 + |h|)
                size = spare[:units, :width]
                self._calls += [(torch.abs, (target,), size), (torch.add, (size, 1.0), size)]
                self._calls.append((torch.div, (target, size), target))
            source = buffer

    def __call__(self) -> Tensor:
        """Return the outputs (C,) for ``inputs``; the next call overwrites them."""
        for function, given, out in self._calls:
            function(*given, out=out)
        return self._out[0]


def _augmented(weight: np.ndarray, bias: np.ndarray, device: torch.device) -> Tensor:
    """Return (outputs, 1 + inputs): the biases, then the weights; a single output gets rows of zeros below it."""
    full = np.column_stack([bias, weight.T])
    if len(full) == 1:
        full = np.concatenate([full, np.zeros((OUTPUTS - 1, full.shape[1]))])
    return torch.as_tensor(full, dtype=torch.float32, device=device).contiguous()


def _blocks(columns: Sequence[int], block: int) -> list[list[Piece]]:
    """Divide the columns of all nets into blocks.

    No piece of a net is wider than a block. A net is cut at multiples of ``LANES`` into pieces of nearly equal width.
    """
    blocks: list[list[Piece]] = []
    offset = 0
    for net, count in enumerate(columns):
        parts, lanes = -(-count // block), -(-count // LANES)
        cuts = [offset + min(count, LANES * (lanes * i // parts)) for i in range(parts + 1)]
        for start, stop in pairwise(cuts):
            if not blocks or stop - blocks[-1][0][1] > block:
                blocks.append([])
            blocks[-1].append((net, start, stop))
        offset += count
    return blocks
