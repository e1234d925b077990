"""How the simulated robot is set up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from go1exp.config.schema.registry import STRICT, Duration, Fraction, NonNegative
from go1exp.config.schema.settings import settings


@dataclass(frozen=True)
class SimConfig:
    """Setup of the simulated robot.

    Attributes:
        start: standing in the nominal stance, lying on its belly, or hung up so that no foot reaches the ground.
        noise: noise of its sensors, as a multiple of the paper's Table II.
        delay: delay of datagrams, each way, s.
        jitter: largest further delay, drawn for each datagram from 0 to this, s; so one may overtake another.
        loss: share of the datagrams that are lost, each way.
        feet: what the foot sensors say in the robot's own packets, newton, or raw counts with zeros and scales of their
            own (by seed), as the robot's.
        seed: seed of noise, loss and random effects.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    start: Literal["standing", "lying", "suspended"] = "standing"
    noise: NonNegative = 1.0
    delay: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    jitter: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    loss: Annotated[Fraction, Field(lt=1)] = 0.0
    feet: Literal["newton", "raw"] = "newton"
    seed: Annotated[int, Field(ge=0)] = 0


@settings
class SimSettings(SimConfig):
    """``conf/sim.yaml`` without the groups.

    Attributes:
        address: HOST:PORT to listen at; another host than 127.0.0.1 opens it to the network, to anybody in it.
        tile: row and column of the tile of terrain=rough on which it begins; rows grow harder.
        seconds: how long it lives, s; null until Ctrl-C.
        viewer: web shows it in the browser, with the timing of whoever drives it; null prints lines alone.
        host: interface on which viewer=web serves its page; another one than 127.0.0.1 opens it to the network.
        port: of that page; 0 takes the first free one from 8080 on.
    """

    address: str = "127.0.0.1:8007"
    tile: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (0, 0)
    seconds: Duration | None = None
    viewer: Literal["web"] | None = None
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 0
