"""Settings of a fit, checked before anything is read."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass

from go1exp.config.schema.registry import STRICT, Expected, Positive
from go1exp.sim.actuator.actuator_net import Count, InputName, Name, Share, Target

Part = Annotated[float, Field(gt=0, lt=1)]


class FitError(Expected):
    """Recordings that cannot be used for the requested fit."""


@checked_dataclass(frozen=True, config=STRICT)
class FitSettings:
    """How to fit. Wrong types, names or ranges raise pydantic's ``ValidationError``.

    The network's form is the paper's (three layers of 64, softsign). ``skip`` adds a linear map, least squares in the
    same inputs, so that the layers learn only what it leaves: on held-out open-loop episodes of an AK80 actuator 0.040
    instead of 0.050 N m after as many epochs (``benchmarks/actuator_net_ak80.py --all``). False: the paper's alone.

    Attributes:
        inputs: inputs of the net, each with ``history`` taps; ``tau_cmd`` for actuators that are commanded a torque.
        history: taps of each input (Walk These Ways: 3).
        period: time between taps, s; None takes the recordings' nominal sampling period.
        hidden: widths of the hidden layers.
        skip: whether a linear map is added to them.
        share: ``all``, one net for all joints (the paper's way), ``kind``, one each for hip, thigh and calf, or
            ``none``, one per joint.
        target: ``tau_est``, what the actuator reports, or ``joint_torque``, by inverse dynamics (``go1exp
            fit-actuator``: of a suspended Go1).
        smoothing: window over which the inputs' angle and speed are smoothed first, s; None takes them as measured.
        epochs: passes over the training rows, at most; the learning rate falls to zero over them (cosine).
        batch: rows per step.
        learning_rate: step size of Adam at the start.
        patience: epochs without a better validation error before the training stops.
        epoch_rows: rows of one pass; where there are more, each pass draws that many afresh.
        holdout: held-out episodes, used for the report only, by name or as a share of all.
        validation: episodes that decide when to stop, by name or as a share of all.
        half_net: whether to train a net of half the width too, as a reference.
        seed: seed of split, initial weights and minibatches.
    """

    inputs: Annotated[tuple[InputName, ...], Field(min_length=1)] = ("position_error", "velocity")
    history: Count = 3
    period: Positive | None = None
    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (64, 64, 64)
    skip: bool = True
    share: Share = "all"
    target: Target = "tau_est"
    smoothing: Positive | None = None
    epochs: Count = 60
    batch: Count = 256
    learning_rate: Positive = 5e-3
    patience: Count = 15
    epoch_rows: Count = 100_000
    holdout: Part | tuple[Name, ...] = 0.2
    validation: Part | tuple[Name, ...] = 0.2
    half_net: bool = True
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _consistent(self) -> FitSettings:
        wrong = []
        if len(set(self.inputs)) != len(self.inputs):
            wrong.append(f"inputs: each only once, not {', '.join(self.inputs)}")
        for key in ("holdout", "validation"):
            if getattr(self, key) == ():
                wrong.append(f"{key}: name at least one episode, or give a part such as 0.2")
        if isinstance(self.holdout, tuple) and isinstance(self.validation, tuple):
            both = sorted(set(self.holdout) & set(self.validation))
            if both:
                wrong.append(f"validation: {', '.join(both)} cannot be held out too")
        parts = [part for part in (self.holdout, self.validation) if isinstance(part, float)]
        if sum(parts) >= 1:
            wrong.append(f"holdout: {self.holdout} and validation {self.validation} leave nothing to train on")
        if wrong:
            raise ValueError("\n".join(wrong))
        return self
