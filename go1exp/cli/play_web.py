"""``go1exp sim``, and ``go1exp play`` in the browser (``viewer=web``, ``log=FILE``): what there is, and the window."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from go1exp.base.errors import Expected
from go1exp.cli.app import App, announce, parse_with_groups
from go1exp.cli.places import shipped_policies
from go1exp.cli.subjects import Named, agent, word
from go1exp.config.choices import choice_files, config_folder, load
from go1exp.config.schema import settings as schema
from go1exp.config.schema.physics import PhysicsStep
from go1exp.config.schema.registry import ConfigError, CountOrZero, Duration, FolderName, Speed
from go1exp.config.schema.settings import subset
from go1exp.deploy.sim_robot import SimConfig, SimSettings

if TYPE_CHECKING:
    from go1exp.config.schema.physics import BackendConfig
    from go1exp.deploy.sim_robot.machine import Body
    from go1exp.evaluate.agents import Agent
    from go1exp.evaluate.viewer.requests import Ground
    from go1exp.gap.robots.protocol import Robot
    from go1exp.robot.config import RobotConfig
    from go1exp.sim.terrain import TerrainConfig

Port = Annotated[int, Field(ge=0, le=65535)]


@schema.settings
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
        tile: row and column of its first tile of graded ground, counted from 0; difficulty grows with the row. null: in
            the middle, and not flat.
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
    tile: tuple[CountOrZero, CountOrZero] | None
    physics_dt: PhysicsStep | None
    seed: Annotated[int, Field(ge=0)]
    out: str | None


RUNS, MOST_RUNS = Path("runs"), 12
"""Where runs are looked for, and how many of the newest are offered."""

GIVEN = "given"  # name of a ground that is none of ``conf/terrain``


def address(host: str, port: int) -> tuple[str, int]:
    """Return where to listen; raise ConfigError if the host is none."""
    if not host or any(c.isspace() for c in host) or (":" in host and host.count(":") == 1):
        raise ConfigError([f"host = {host!r}: is the address of an interface, such as 127.0.0.1; see also port={port}"])
    return host, port


def require_studio() -> None:
    """Raise Expected if MuJoCo's web viewer is not installed, before anything is built."""
    try:
        server = importlib.util.find_spec("mujoco.studio.web.web_server")
    except ImportError:
        server = None
    if server is None:
        raise Expected(
            "viewer=web needs MuJoCo Studio, which comes with the package mujoco and not with mujoco-core alone: "
            "pip install 'mujoco>=4'"
        )


def first_tile(ground: TerrainConfig, wanted: tuple[int, int] | None) -> tuple[int, int, str] | None:
    """Return row, column and kind of the tile to begin on, None on a plane; raise ConfigError if there is no such."""
    from go1exp.sim.terrain import column_types

    if ground.kind == "flat":
        if wanted is None:
            return None
        raise ConfigError([f"tile = {list(wanted)}: needs graded ground; use terrain=rough, or train_ground=true"])
    kinds = column_types(ground)
    if wanted is None:
        uneven = [column for column, kind in enumerate(kinds) if kind != "flat"] or [0]
        wanted = (ground.rows - 1) // 2, uneven[len(uneven) // 2]
    row, column = wanted
    if row >= ground.rows or column >= ground.cols:
        has = f"the ground has {ground.rows} rows and {ground.cols} columns, counted from 0"
        raise ConfigError([f"tile = {list(wanted)}: {has}"])
    return row, column, kinds[column]


def walk(
    subject: Named,
    other: dict[str, object],
    ground: TerrainConfig | None,
    engine: BackendConfig,
    settings: PlaySettings,
    where: tuple[str, int],
) -> None:
    """Show a robot that ``subject`` drives first, until Ctrl-C; without a ``ground`` on that of the settings."""
    require_studio()
    from go1exp.base.tensors.threads import one_thread

    with one_thread():
        from go1exp.evaluate.viewer import web
        from go1exp.evaluate.viewer.drive_window import DriveWindow
        from go1exp.evaluate.viewer.page_server import Gamepad
        from go1exp.evaluate.viewer.requests import Setup, catalogue
        from go1exp.evaluate.viewer.session import Robots, Session
        from go1exp.evaluate.viewer.walk import WalkShow
        from go1exp.sim.terrain import TerrainConfig

        first = agent(subject, other)
        wanted = ground or (first.task.terrain if settings.train_ground else TerrainConfig())
        begin = first_tile(wanted, settings.tile)
        name, grounds = _grounds(wanted)
        effects, sizes = catalogue(first.task.effect, settings.randomize)
        setup = Setup(
            ground=name,
            level=begin[0] if begin else 0.0,
            tile=begin[2] if begin else None,
            sizes=sizes,
            noise=settings.noise,
            physics_dt=settings.physics_dt,
            randomize=settings.randomize,
            push=settings.push,
            engine=engine,
            seed=settings.seed,
        )
        robots = Robots(_agents(subject, first, other), grounds, effects)
        session = Session(robots, subject.label, setup, settings.velocity)
        title, pad = f"go1exp: {subject.label}", Gamepad()
        web.run(WalkShow(session), [DriveWindow(pad)], title=title, host=where[0], port=where[1], pad=pad)
    print(f"\nclosed after {session.time:.0f} s of walking, {session.falls} falls")


def _agents(subject: Named, first: Agent, other: dict[str, object]) -> dict[str, Callable[[], Agent]]:
    """Return what could drive this robot, loaded on request: shipped policies, newest runs, the MPC."""

    def loader(name: str) -> Callable[[], Agent]:
        return lambda: agent(word(name, "play"), other, robot_of=first.task)

    runs = sorted((p.parent for p in RUNS.glob("*/config.yaml")), key=lambda p: -p.stat().st_mtime)
    walked = [run for run in runs if (run / "checkpoints").is_dir()][:MOST_RUNS]
    names = [*shipped_policies(), *(str(run) for run in walked if run != subject.run)]
    if importlib.util.find_spec("daqp") is not None:
        names.append("mpc")
    return {subject.label: lambda: first} | {name: loader(name) for name in names if name != subject.label}


def _grounds(wanted: TerrainConfig | None) -> tuple[str, dict[str, Ground]]:
    """Return the name of the ground that is wanted, and every ground; those of one kind that differ get a name."""
    from go1exp.evaluate.viewer.requests import FLAT, grounds
    from go1exp.sim.task import parse_parts

    known: dict[str, TerrainConfig] = {}
    for name, file in choice_files("terrain", [config_folder()]).items():
        parts, problems = parse_parts({"terrain": load(file)}, ("terrain",))
        if not problems:
            known[name] = parts["terrain"]
    if wanted is None or wanted.kind == "flat":
        return FLAT, grounds(known)
    if wanted not in known.values():
        known[GIVEN] = wanted
    name = next(name for name, config in known.items() if config == wanted)
    return name, grounds(known)


def _sim_page(
    body: Body,
    groups: dict[str, object],
    config: SimConfig,
    robot_at: tuple[str, int],
    seconds: float | None,
    where: tuple[str, int],
) -> None:
    """Show the robot that a client drives at ``robot_at``, for ``seconds`` or until Ctrl-C, on a page at ``where``."""
    require_studio()
    from go1exp.base.tensors.threads import one_thread
    from go1exp.deploy.sim_robot.alone import greeting

    with one_thread():
        from go1exp.evaluate.viewer import web
        from go1exp.evaluate.viewer.sim_process import RobotProcess
        from go1exp.evaluate.viewer.sim_window import SimShow, SimWindow

        process = RobotProcess(groups, body.tile, config, robot_at, seconds, partial(print, flush=True))
        try:
            print(greeting(config.start, process.address), flush=True)
            show = SimShow(process, body)
            web.run(show, [SimWindow()], title="go1exp sim", host=where[0], port=where[1])
        finally:
            process.close()


def log(file: Path, where: tuple[str, int]) -> None:
    """Show a recording, until Ctrl-C."""
    require_studio()
    from go1exp.logs.recording import read

    recording = read(file)
    from go1exp.evaluate.viewer import web
    from go1exp.evaluate.viewer.replay import ReplayShow, of_recording
    from go1exp.evaluate.viewer.replay_window import ReplayWindow
    from go1exp.sim.task import required_parts

    robot = required_parts({"robot": load(config_folder() / "robot" / "go1.yaml")})["robot"]
    story = of_recording(recording)
    show = ReplayShow(story, robot)
    web.run(show, [ReplayWindow(story)], title=f"go1exp: {file.name}", host=where[0], port=where[1])


def gap(folder: Path, robot: Robot, config: RobotConfig, where: tuple[str, int]) -> None:
    """Show the answer of ``go1exp gap`` in a folder about a robot, which may be a Go1 of this configuration."""
    require_studio()
    from go1exp.gap import files
    from go1exp.robot import JOINTS

    result = files.load(folder)
    from go1exp.evaluate.viewer import web
    from go1exp.evaluate.viewer.replay import ReplayShow, model_of, of_result
    from go1exp.evaluate.viewer.replay_window import ReplayWindow

    story = of_result(result, str(folder / files.RESULT))
    joints = story.pieces[0].joints
    if not set(joints) <= set(robot.joints):
        strange = ", ".join(joint for joint in joints if joint not in robot.joints)
        raise Expected(f"{folder / files.RESULT}: is about joints that the robot has not ({strange}); say model=...")
    model = None if set(robot.joints) == set(JOINTS) else model_of(robot)
    show = ReplayShow(story, config, model)
    web.run(show, [ReplayWindow(story)], title=f"go1exp gap: {folder}", host=where[0], port=where[1])


BODY = ("robot", "actuator", "effect", "contact", "terrain")
"""Groups of the configuration that describe the robot and its ground."""


def _sim(container: dict[str, object]) -> int:
    from go1exp import robot
    from go1exp.deploy.runtime.udp import listening, parsed_address
    from go1exp.sim.effects.rules import actuator_problems

    settings, parts = parse_with_groups(SimSettings, container, BODY)
    if problems := actuator_problems(parts["actuator"], parts["effect"], robot.JOINTS):
        raise ConfigError(problems)
    where, page = parsed_address(settings.address, HERE), address(settings.host, settings.port)
    listening(*where).close()  # refused before what takes seconds
    announce("starting the simulated robot")

    from go1exp.deploy.sim_robot.machine import Body, Robot

    body, config = Body(**parts, tile=settings.tile), subset(SimConfig, settings)
    if settings.viewer == "web":
        groups = {name: container[name] for name in BODY}
        _sim_page(body, groups, config, where, settings.seconds, page)
        return 0

    import torch

    from go1exp.deploy.sim_robot.alone import greeting, serve
    from go1exp.deploy.sim_robot.server import Server

    torch.set_num_threads(1)
    server = Server(Robot(body, config), config, where[1], where[0])
    print(greeting(settings.start, server.address), flush=True)
    try:
        with suppress(KeyboardInterrupt):  # its usual end
            serve(server, lambda: True, partial(print, flush=True), settings.seconds)
    finally:
        server.close()
    return 0


HERE = ("127.0.0.1", 8007)  # default address; it cannot be reached from the network

SIM = App("sim", _sim, SimSettings)
