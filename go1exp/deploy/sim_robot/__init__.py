"""A simulated Go1 that runs in real time as a process of its own; the runtime talks to it as to a real robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from go1exp.base.wording import Start
from go1exp.config.schema.registry import CountOrZero, Duration, Fraction, NonNegative, Strict
from go1exp.config.schema.settings import settings


@dataclass(frozen=True)
class SimConfig(Strict):
    """Setup of the simulated robot.

    Attributes:
        start: standing in the nominal stance, lying on its belly, crouched, sitting, or suspended above the ground.
        noise: noise of its sensors, relative to the paper's Table II.
        delay: delay of packets, each way, s.
        jitter: largest additional delay, drawn for each packet from 0 to this, s; so one may overtake another.
        loss: share of the packets that are lost, each way.
        feet: unit of the foot sensors, newton, or raw: counts with zeros and scales drawn by seed, as on a robot.
        seed: seed of noise, loss and random effects.
    """

    start: Start = "standing"
    noise: NonNegative = 1.0
    delay: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    jitter: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    loss: Annotated[Fraction, Field(lt=1)] = 0.0
    feet: Literal["newton", "raw"] = "newton"
    seed: CountOrZero = 0


@settings
class SimSettings(SimConfig):
    """``conf/sim.yaml`` without the groups.

    Attributes:
        address: HOST:PORT to listen at; another host than 127.0.0.1 opens it to every computer in the network.
        tile: row and column of its initial tile of terrain=rough; difficulty grows with the row.
        seconds: how long it runs, s; null until Ctrl-C.
        viewer: web shows it in the browser, with the timing of its client; null prints lines alone.
        host: interface on which viewer=web serves its page; another one than 127.0.0.1 opens it to the network.
        port: of that page; 0 takes the first free one from 8080 on.
    """

    address: str = "127.0.0.1:8007"
    tile: tuple[CountOrZero, CountOrZero] = (0, 0)
    seconds: Duration | None = None
    viewer: Literal["web"] | None = None
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 0
