"""Training of one network: least squares, then Adam on the residual, stopped by the validation episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from go1exp.base.tensors.threads import one_thread
from go1exp.gap.actuator_net.dataset import Rows
from go1exp.gap.actuator_net.settings import FitError, FitSettings

OnEpoch = Callable[[int, int, float, float], None]
"""``on_epoch(done, total, train, validation)``: epochs, and root mean square errors in N m."""

RIDGE = 1e-3
"""Penalty of the linear map in units of the variance of the normalised inputs (chosen: taps 2 ms apart are nearly
equal; without a penalty their weights become large and opposite, and amplify noise of a command)."""


@dataclass(frozen=True, eq=False)
class Trained:
    """One trained network: the arrays of ``ActuatorNet`` without the leading axis K."""

    weights: tuple[np.ndarray, ...]  # layer by layer (in, out)
    biases: tuple[np.ndarray, ...]  # layer by layer (out,)
    skip: np.ndarray  # linear map (F,); zeros without one
    input_mean: np.ndarray  # (F,)
    input_std: np.ndarray  # (F,)
    output_mean: float  # N m
    output_std: float  # N m
    curve: np.ndarray  # (epochs done, 2) root mean square errors of training and validation, N m
    best: int  # epoch (from 0) whose weights these are


def train(
    rows: Rows, validation: Rows, settings: FitSettings, hidden: tuple[int, ...], on_epoch: OnEpoch | None = None
) -> Trained:
    """Train one network of the widths ``hidden``, alike for one seed; FitError without rows to train or validate on."""
    for part, name in ((rows, "training"), (validation, "validation")):
        if len(part) == 0:
            raise FitError(f"no rows for {name}: its episodes are shorter than the history, or their actuators are off")
    mean, std = rows.x.mean(axis=0), rows.x.std(axis=0)
    std = np.where(std > 0, std, 1.0)  # an input that never changes must not be divided by zero
    output_mean = float(rows.y.mean())
    z = (rows.x - mean) / std
    skip = ridge(z, rows.y - output_mean) if settings.skip else np.zeros(rows.x.shape[1])
    left = rows.y - output_mean - z @ skip
    output_std = float(left.std()) or 1.0
    left_validation = validation.y - output_mean - (validation.x - mean) / std @ skip
    with one_thread():  # more threads are slower for such small matrices, and change the order of sums
        net, curve, best = _descend(
            torch.tensor(z, dtype=torch.float32),
            torch.tensor(left / output_std, dtype=torch.float32),
            torch.tensor((validation.x - mean) / std, dtype=torch.float32),
            torch.tensor(left_validation / output_std, dtype=torch.float32),
            settings,
            hidden,
            output_std,
            on_epoch,
        )
    layers = [layer for layer in net if isinstance(layer, torch.nn.Linear)]
    return Trained(
        tuple(layer.weight.detach().double().numpy().T.copy() for layer in layers),
        tuple(layer.bias.detach().double().numpy().copy() for layer in layers),
        skip / output_std,
        mean,
        std,
        output_mean,
        output_std,
        np.array(curve),
        best,
    )


def ridge(z: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return least-squares weights (F,) of normalised inputs z (R, F), with the penalty ``RIDGE``."""
    gram = z.T @ z / len(z) + RIDGE * np.eye(z.shape[1])
    return np.asarray(np.linalg.solve(gram, z.T @ y / len(z)))


def _descend(
    x: Tensor,
    y: Tensor,
    x_validation: Tensor,
    y_validation: Tensor,
    settings: FitSettings,
    hidden: tuple[int, ...],
    unit: float,
    on_epoch: OnEpoch | None,
) -> tuple[torch.nn.Sequential, list[tuple[float, float]], int]:
    """Return the net of the best validation error, the curve of errors in N m, and the epoch of the best."""
    draws = torch.Generator().manual_seed(settings.seed)
    net = _build(x.shape[1], hidden, draws)
    rows = min(len(x), settings.epoch_rows)
    batch = min(settings.batch, rows)
    steps = rows // batch
    # fused: one kernel for all parameters; the networks are so small that calls cost more than arithmetic
    adam = torch.optim.Adam(net.parameters(), lr=settings.learning_rate, fused=True)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(adam, T_max=settings.epochs * steps)
    best, best_error, kept = 0, float("inf"), {}
    curve = []
    for epoch in range(settings.epochs):
        total = torch.zeros(())
        # whole minibatches only; another random part of the rows in every epoch
        pick = torch.randperm(len(x), generator=draws)[: steps * batch]
        for x_batch, y_batch in zip(x[pick].split(batch), y[pick].split(batch), strict=True):
            loss = mse_loss(net(x_batch)[:, 0], y_batch)
            adam.zero_grad(set_to_none=True)
            loss.backward()
            adam.step()
            decay.step()
            total += loss.detach()
        with torch.no_grad():
            error = unit * float(mse_loss(net(x_validation)[:, 0], y_validation)) ** 0.5
        curve.append((unit * float(total / steps) ** 0.5, error))
        if on_epoch:
            on_epoch(epoch + 1, settings.epochs, *curve[-1])
        if error < best_error:
            best, best_error = epoch, error
            kept = {name: value.clone() for name, value in net.state_dict().items()}
        elif epoch - best >= settings.patience:
            break
    if not kept:
        raise FitError("the training diverged: no epoch gave a finite validation error; lower learning_rate")
    net.load_state_dict(kept)
    return net, curve, best


def _build(features: int, hidden: tuple[int, ...], draws: torch.Generator) -> torch.nn.Sequential:
    """Layers with PyTorch's usual initial weights, uniform in +-1/sqrt(inputs), drawn from ``draws``."""
    layers: list[torch.nn.Module] = []
    widths = (features, *hidden, 1)
    for wide, narrow in pairwise(widths):
        # Without this PyTorch draws the weights from its global generator, which others use too.
        layer = torch.nn.utils.skip_init(torch.nn.Linear, wide, narrow)
        with torch.no_grad():
            for values in (layer.weight, layer.bias):
                values.uniform_(-(wide**-0.5), wide**-0.5, generator=draws)
        layers += [layer, torch.nn.Softsign()]
    return torch.nn.Sequential(*layers[:-1])
