"""A story in its scene: the measured robot, and beside or over it others, which are shapes of the same model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from go1exp.evaluate.viewer.replay import HELD_AT, STEP_S, Motion, Player, Request, Story
from go1exp.robot.config import RobotConfig
from go1exp.sim.env.camera import AZIMUTH
from go1exp.sim.physics.scene import build_model
from go1exp.sim.terrain import TerrainConfig, build_terrain

Array = NDArray[np.float64]

APART = 0.9
"""Distance to the right, as the camera sees it, of the model after from that before, in extents of the robot."""


@dataclass(frozen=True)
class Ghost:
    """A robot that is drawn beside the model's own.

    Attributes:
        name: of its motion.
        qpos: its coordinates.
        shift: (3,) by which it stands beside them, m.
    """

    name: str
    qpos: Array
    shift: Array


@dataclass(frozen=True)
class ReplayView:
    """What the panels draw of the story, which they have themselves: it is long, and this is sent often.

    Attributes:
        number: of the piece.
        time: s from its beginning.
        row: number of the sample.
        running: whether time passes.
        speed: s of the recording per s.
        magnify: how much larger than they are errors are shown.
        ghosts: robots beside the model's own, which is the first motion shown.
    """

    number: int
    time: float
    row: int
    running: bool
    speed: float
    magnify: float
    ghosts: tuple[Ghost, ...]


class ReplayShow:
    """A story as something to show.

    Attributes:
        player: where one is in it.
        model: the scene with one robot.
        data: its state.
    """

    def __init__(self, story: Story, config: RobotConfig, model: mujoco.MjModel | None = None) -> None:
        """Build the scene: with the Go1, or with the model of another robot, on its base.

        Raises:
            ValueError: if the model has no such joint.
        """
        self.player = Player(story)
        if model is None:
            ground = build_terrain(TerrainConfig(kind="flat"))
            model = build_model(config, ground, 0.002, decoration=True)[0]
            model.vis.headlight.ambient[:] = 0.25
        self.model, self.data = model, mujoco.MjData(model)
        self._free = bool(model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE)
        names = story.pieces[0].joints
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in names]
        if min(ids) < 0:
            raise ValueError(f"the model has no joint {names[ids.index(-1)]!r}")
        self._at = model.jnt_qposadr[ids]
        wide = APART * float(model.stat.extent) * (0.4 if self._free else 1.0)
        self._apart = wide * np.array([math.sin(math.radians(AZIMUTH)), -math.cos(math.radians(AZIMUTH)), 0.0])
        self._place()

    def ask(self, request: Request) -> None:
        """Do what a user asks for."""
        self.player.ask(request)

    def tick(self) -> float:
        """Let a moment pass; return how long it is, s."""
        self.player.advance(STEP_S)
        self._place()
        return STEP_S

    def _qpos(self, motion: Motion) -> Array:
        """Return the coordinates of a motion now."""
        qpos = self.model.qpos0.copy()
        q, base = self.player.pose(motion)
        if self._free:
            qpos[:7] = [0.0, 0.0, HELD_AT, 1.0, 0.0, 0.0, 0.0] if base is None else base
        qpos[self._at] = q
        return np.asarray(qpos)

    def _place(self) -> None:
        """Put the model's own robot into the first motion that is shown: of a gap that before."""
        motions = {m.name: m for m in self.player.piece.motions}
        first = motions.get("before", self.player.piece.motions[0])
        self.data.qpos[:] = self._qpos(first)
        self.data.qvel[:] = 0.0
        mujoco.mj_kinematics(self.model, self.data)

    def _ghosts(self) -> tuple[Ghost, ...]:
        poses = {m.name: self._qpos(m) for m in self.player.piece.motions}
        in_place = np.zeros(3)
        if self.player.story.kind == "log":
            return tuple(Ghost(name, qpos, in_place) for name, qpos in poses.items() if name != "measured")
        measured = poses["measured"]
        return (
            Ghost("measured", measured, in_place),
            Ghost("after", poses["after"], self._apart),
            Ghost("measured", measured, self._apart),
        )

    def view(self) -> ReplayView:
        """Return what is to be drawn."""
        p = self.player
        return ReplayView(p.number, p.time, p.row, p.running, p.speed, p.magnify, self._ghosts())


def model_of(robot: Any) -> mujoco.MjModel:
    """Return the compiled model of a robot of ``go1exp gap`` on its base."""
    return robot.build(1, 0.002, (1.0, 0.0, 0.0, 0.0), 1)[0].model
