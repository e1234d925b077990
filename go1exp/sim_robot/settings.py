"""How the simulated robot is set up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from go1exp.schema.registry import STRICT, Fraction, NonNegative


@dataclass(frozen=True)
class SimConfig:
    """How the simulated robot is set up.

    Attributes:
        start: standing in the nominal stance, lying on its belly, or hung up so that no foot reaches the ground.
        noise: noise of its sensors, as a multiple of the paper's Table II.
        delay: delay of datagrams, each way, s.
        loss: share of the datagrams that are lost, each way.
        seed: seed of noise, loss and random effects.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    start: Literal["standing", "lying", "hung"] = "standing"
    noise: NonNegative = 1.0
    delay: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    loss: Annotated[Fraction, Field(lt=1)] = 0.0
    seed: Annotated[int, Field(ge=0)] = 0
