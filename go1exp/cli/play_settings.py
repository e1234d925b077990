"""The settings of ``go1exp play``, checked as strictly as those of the other verbs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from go1exp.config.schema.registry import Duration, FolderName, Speed
from go1exp.config.schema.settings import settings

Port = Annotated[int, Field(ge=0, le=65535)]


@settings
class PlaySettings:
    """``conf/play.yaml``.

    Attributes:
        controller: what moves the robot: policy, the one of run or policy, or mpc.
        run: run folder to watch; or give policy.
        policy: name of a policy that comes with the package, such as paper, in place of run.
        bundle: file of go1exp export, in place of run: its policy as the robot's computer runs it.
        log: recording to show in the browser, in place of a robot that walks.
        checkpoint: file of the run; null takes the newest.
        velocity: commanded velocity, x m/s, y m/s, yaw rad/s; arrow keys change it in the live viewer and the browser.
        seconds: length of the clip, s.
        viewer: clip, live (a window), web (a page for the browser), or auto, which is live where there is a display.
        host: interface on which viewer=web listens; 127.0.0.1 is this machine alone.
        port: on which it listens; 0 takes the first free one from 8080 on.
        fps: frames per second of the clip.
        noise: add the observation noise of training.
        randomize: randomise the robot as in training; false takes the nominal robot.
        push: push the robot as in training.
        train_ground: use the ground of training; false is flat.
        physics_dt: another physics step, s, such as 0.002 for a policy trained with coarser steps; null keeps that of
            training.
        seed: seed of everything random.
        out: clip (.mp4, .gif); null writes play.mp4 in the run folder. A picture, .png, goes beside it.
    """

    controller: Any = None
    run: FolderName | None
    policy: str | None
    bundle: str | None
    log: str | None
    checkpoint: str | None
    velocity: tuple[Speed, Speed, Speed]
    seconds: Duration
    viewer: Literal["auto", "clip", "live", "web"]
    host: str
    port: Port
    fps: Annotated[int, Field(ge=1, le=50)]
    noise: bool
    randomize: bool
    push: bool
    train_ground: bool
    physics_dt: Annotated[float, Field(gt=0, le=0.02)] | None
    seed: Annotated[int, Field(ge=0)]
    out: str | None
