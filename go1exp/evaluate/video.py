"""Videos of a policy: to a file, as pictures, or live in a window; a stick figure where nothing can be drawn."""

from __future__ import annotations

import errno
import os
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache
from itertools import chain
from pathlib import Path

import matplotlib
import mujoco
import numpy as np
import torch
from imageio.v2 import get_writer
from PIL import Image, ImageDraw, ImageFont

from go1exp import robot
from go1exp.base.files import replacing
from go1exp.evaluate.rollout import planar_velocity
from go1exp.mdp.commands import FixedVelocity
from go1exp.sim.env import camera as view
from go1exp.sim.env.camera import Camera, Picture, RenderingUnavailable, Stage, draw_velocities
from go1exp.sim.env.core import Go1Core
from go1exp.train.policy import Policy

AVERAGE_TIME = 0.5  # time over which the velocity in the caption is averaged, s: about a gait cycle
WIDTH, HEIGHT = 640, 480  # of a picture without a gait diagram, pixels
GIF_WIDTH = 320  # of a GIF, pixels

GIF_BYTES = 3 * GIF_WIDTH * GIF_WIDTH * HEIGHT // WIDTH
"""What a picture of a GIF takes in memory, at least: its palette is of all pictures, so all are kept until the end."""

GIF_COLOURS = 128  # colours of a GIF, of at most 256; fewer compress better
PANELS = 6  # pictures of a strip

SPAN = 2.0  # time that a gait diagram shows, s; the right edge is now
TICK = 0.5  # time between two lines of it, s

FIRST_RGB, SECOND_RGB = (90, 170, 255), (255, 176, 70)
"""Colours of the diagonal pairs FR with RL, and FL with RR: of a trot one colour at a time is on the ground."""

COLOURS = {"FR": FIRST_RGB, "RL": FIRST_RGB, "FL": SECOND_RGB, "RR": SECOND_RGB}
GROUND_RGB, ROW_RGB, LINE_RGB = (28, 30, 34), (44, 47, 53), (88, 92, 100)
ROW_SHARE = 0.022  # height of a row over the height of the picture


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Return a font with digits of one width, so that changing numbers do not move."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSansMono.ttf")), size)


class Footfalls:
    """Remembers the contacts of one robot's feet for the last ``SPAN`` s and draws them."""

    def __init__(self, dt: float) -> None:
        """Begin without a past; ``dt`` is the time between two calls of ``add``, s."""
        self._past: deque[Sequence[bool]] = deque(maxlen=max(1, round(SPAN / dt)))
        self._length = self._past.maxlen or 1
        self._tick = TICK / dt

    def add(self, contact: Sequence[bool]) -> None:
        """Take in which feet, FR FL RR RL, are on the ground now."""
        self._past.append(contact)

    def clear(self) -> None:
        """Forget the past: another episode begins."""
        self._past.clear()

    def under(self, picture: Picture) -> Picture:
        """Return the picture (H, W, 3) with the diagram below it, higher by an even number of rows.

        The diagram keeps to the middle of the picture, so that it survives a crop to a square.
        """
        height, width = picture.shape[:2]
        row = max(4, round(ROW_SHARE * height))
        gap = max(1, row // 5)
        strip = 2 * ((robot.NUM_LEGS * (row + gap) + 3 * gap + 1) // 2)
        side = min(width, height + strip)
        image = Image.new("RGB", (width, strip), GROUND_RGB)
        draw, letters = ImageDraw.Draw(image), font(max(6, row))
        left = (width - side) // 2 + round(letters.getlength("FR  "))
        span = (width + side) // 2 - left - row
        for k, leg in enumerate(robot.LEGS):
            top = 2 * gap + k * (row + gap)
            bottom = top + row - 1
            draw.text((left - letters.getlength("FR "), top + row // 2), leg, COLOURS[leg], letters, anchor="lm")
            draw.rectangle((left, top, left + span, bottom), ROW_RGB)
            for start, stop in self._stances(k):
                x0, x1 = (left + round(span * (at / self._length)) for at in (start, stop))
                draw.rectangle((x0, top, max(x0, x1 - 1), bottom), COLOURS[leg])
        for k in range(1, round(self._length / self._tick)):
            x = left + round(span * (1.0 - k * self._tick / self._length))
            draw.line((x, 0, x, strip), LINE_RGB)
        return np.concatenate([picture, np.asarray(image)])

    def _stances(self, foot: int) -> list[tuple[int, int]]:
        """Return begin and end of each time on the ground, in samples from the left edge."""
        flags = np.zeros(self._length + 2, np.int8)
        past = [bool(contact[foot]) for contact in self._past]
        flags[1 + self._length - len(past) : -1] = past
        change = np.diff(flags)
        return list(zip(np.flatnonzero(change == 1).tolist(), np.flatnonzero(change == -1).tolist(), strict=True))


def record(
    core: Go1Core,
    policy: Policy,
    seconds: float,
    env: int = 0,
    fps: float = 25,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
    *,
    caption: bool = True,
    footfalls: bool = False,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> Iterator[Picture]:
    """Reset the environments, run the policy, and yield the pictures of one of them, one by one.

    ``seconds`` are simulated, with ``fps`` pictures each; where an episode ends, the next one follows. ``on_frame``
    gets the numbers of pictures done and of all. ``caption`` writes time, command and velocity (mean over 0.5 s) on
    pictures of ``width`` by ``height`` pixels, and ``footfalls`` adds a gait diagram of the last 2 s below. Raise
    RenderingUnavailable at once without anything to draw with, and NumericalFault while iterating when a value is not
    finite.
    """
    camera = Camera(core, width, height)  # here, not in the generator, so that errors are raised before it starts
    diagram = Footfalls(core.task.sim.policy_dt) if footfalls else None

    def pictures() -> Iterator[Picture]:
        dt = core.task.sim.policy_dt
        total, step = round(seconds * fps), 0
        try:
            observation = core.reset()
            measured = deque([planar_velocity(core)[env].tolist()], maxlen=max(1, round(AVERAGE_TIME / dt)))
            for k in range(total):
                while (step + 0.5) * dt < k / fps:
                    result = core.step(policy(observation))
                    core.check(result)
                    observation = result.observation
                    step += 1
                    ended = bool(result.terminated[env] or result.truncated[env])
                    if ended:
                        measured.clear()
                    measured.append(planar_velocity(core)[env].tolist())
                    if diagram:
                        if ended:
                            diagram.clear()
                        diagram.add(core.snapshot().foot_contact[env].tolist())
                picture = camera.frame(env)
                if caption:
                    _write_caption(picture, step * dt, core.command.value[env].tolist(), np.mean(measured, 0).tolist())
                if diagram:
                    picture = diagram.under(picture)
                on_frame(k + 1, total)
                yield picture
        finally:
            camera.close()

    return pictures()


def evenly(total: int, count: int) -> list[int]:
    """Return ``count`` evenly spaced numbers of ``total`` pictures, the first and the last among them; at most all."""
    return [round(float(k)) for k in np.linspace(0, total - 1, min(count, total))]


def keeping(frames: Iterable[Picture], total: int, kept: list[Picture], count: int = PANELS) -> Iterator[Picture]:
    """Yield ``total`` pictures, and put ``count`` evenly spaced ones into ``kept``: the rest needs no memory."""
    chosen = set(evenly(total, count))
    for k, picture in enumerate(frames):
        if k in chosen:
            kept.append(picture)
        yield picture


def write_mp4(path: Path, frames: Iterable[Picture], fps: float = 25) -> None:
    """Write an H.264 video for browsers, frame by frame, or no file; raise OSError, or ValueError without frames."""
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{path}: a video needs at least one frame")
    with _complete(path) as partial:
        # imageio.v3 has no writer that takes frames one by one and ends ffmpeg when one fails to come. Both sides must
        # be even for yuv420p, the only format that every browser plays; imageio would make them multiples of 16.
        video = get_writer(partial, "FFMPEG", fps=fps, codec="libx264", pixelformat="yuv420p", macro_block_size=2)
        with closing(video):
            for picture in chain([first], frames):
                video.append_data(picture)


def write_strip(path: Path, frames: Sequence[Picture], count: int = PANELS, size: int = 320) -> None:
    """Write ``count`` evenly spaced frames as a PNG of squares; raise OSError, or ValueError without frames."""
    if not len(frames):
        raise ValueError(f"{path}: a strip needs at least one frame")
    chosen = evenly(len(frames), count)
    gap = max(1, size // 80)
    strip = Image.new("RGB", (len(chosen) * (size + gap) - gap, size), "white")
    for k, index in enumerate(chosen):
        picture = frames[index]
        height, width = picture.shape[:2]
        side = min(height, width)
        top, left = (height - side) // 2, (width - side) // 2
        square = Image.fromarray(picture[top : top + side, left : left + side])
        strip.paste(square.resize((size, size), Image.Resampling.LANCZOS), (k * (size + gap), 0))
    with _complete(path) as partial:
        strip.save(partial, optimize=True)


def write_gif(path: Path, frames: Iterable[Picture], fps: float = 12, width: int = GIF_WIDTH) -> None:
    """Write a small looping GIF of frames that are ``fps`` apart (every second one of a video at 25 is about 12).

    Keeps ``GIF_BYTES`` or more of each in memory. Raise OSError if it cannot be written, and ValueError without frames.
    """
    small = [Image.fromarray(f).resize((width, round(width * f.shape[0] / f.shape[1]))) for f in frames]
    if not small:
        raise ValueError(f"{path}: a GIF needs at least one frame")
    # One palette for all, and no dithering: else still ground would flicker. An octree keeps the few bright pixels.
    palette = small[len(small) // 2].quantize(GIF_COLOURS, method=Image.Quantize.FASTOCTREE)
    first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in small)
    with _complete(path) as partial:
        first.save(partial, save_all=True, append_images=rest, duration=10 * round(100 / fps), loop=0)


@contextmanager
def _complete(path: Path) -> Iterator[Path]:
    """Yield a temporary file beside ``path`` to write, and rename it when it is complete."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, keep_suffix=True) as partial:
            partial.touch()
            yield partial
    except OSError as error:
        reason = f"cannot be written: {error.strerror or error}"
        raise OSError(error.errno or errno.EIO, reason, str(path)) from error


def _write_caption(picture: Picture, seconds: float, command: Sequence[float], measured: Sequence[float]) -> None:
    """Write two lines on the lower edge, narrow enough to survive a crop to a square."""
    height, width = picture.shape[:2]
    letters = font(max(7, width // 50))
    line = round(1.35 * letters.size)
    band = picture[height - round(2.5 * line) :]
    band[:] = (0.35 * band).astype(np.uint8)
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    rows = (("command ", command, view.COMMAND_RGB), ("measured", measured, view.MEASURED_RGB))
    for k, (name, (x, y, yaw), rgb) in enumerate(rows):
        text = f"{name} {x:+5.2f} {y:+5.2f} m/s {yaw:+5.2f} rad/s"
        prefix = f"{seconds:5.1f} s  "
        left = 0.5 * (width - letters.getlength(prefix + text))
        top = height - round((2.25 - k) * line)
        if k == 0:
            draw.text((left, top), prefix, "white", letters)
        draw.text((left + letters.getlength(prefix), top), text, tuple(round(255 * c) for c in rgb), letters)
    picture[:] = np.asarray(image)


STEERING = {
    265: (0, 0.1),  # up: faster forward
    264: (0, -0.1),  # down
    44: (1, 0.1),  # comma: left
    46: (1, -0.1),  # full stop: right
    263: (2, 0.2),  # left arrow: turn left
    262: (2, -0.2),  # right arrow
}
"""GLFW key -> axis of the command and its change, m/s or rad/s."""

KEYS = "arrows: forward, back, turn\n, and .: sideways\nspace: stand"


def steer(command: list[float], key: int) -> None:
    """Change a command (x, y, yaw) as a key of the live window says."""
    if key == 32:
        command[:] = [0.0, 0.0, 0.0]
    elif key in STEERING:
        axis, change = STEERING[key]
        command[axis] = round(command[axis] + change, 6)


def live(core: Go1Core, policy: Policy, env: int = 0) -> None:
    """Show an environment until its window is closed; raise RenderingUnavailable without display, or NumericalFault."""
    command = core.command.value[env].tolist()
    stage, dt = Stage(core), core.task.sim.policy_dt
    with _window(stage, lambda key: steer(command, key)) as window:
        core.command = FixedVelocity(core.random.stream("command"))
        core.command.value[:] = torch.tensor(command)
        observation = core.reset()
        camera, far = window.cam, 1.3 * view.DISTANCE
        camera.azimuth, camera.elevation, camera.distance = view.AZIMUTH, view.ELEVATION, far
        due = time.perf_counter()
        while window.is_running():
            core.command.value[:] = torch.tensor(command)
            result = core.step(policy(observation))
            core.check(result)
            observation = result.observation
            with window.lock():
                moved = stage.place(env)
                camera.lookat[:] = stage.data.qpos[:3]
                window.user_scn.ngeom = 0
                draw_velocities(window.user_scn, stage, core.command.value[env], stage.data.qvel[:2])
            if moved:
                window.update_hfield(0)
            x, y, yaw = command
            window.set_texts((None, None, KEYS, f"{x:+.1f} {y:+.1f} m/s\n{yaw:+.1f} rad/s\n"))
            window.sync()
            due = max(due + dt, time.perf_counter())
            time.sleep(max(0.0, due - time.perf_counter()))


@contextmanager
def _window(stage: Stage, on_key: Callable[[int], None]) -> Iterator[mujoco.viewer.Handle]:
    """Open MuJoCo's window on a stage and close it at the end; ``on_key`` is called with GLFW's key codes."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not display:  # without a display MuJoCo would wait without end
        raise RenderingUnavailable(
            "cannot open a window: there is no display (DISPLAY and WAYLAND_DISPLAY are unset); record a video instead"
        )
    try:
        import glfw
        from mujoco.viewer import launch_passive
    except (ImportError, RuntimeError) as error:
        raise RenderingUnavailable(f"cannot open a window: {error}") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not glfw.init():
            raise RenderingUnavailable(
                f"cannot open a window: the display {display!r} does not answer; viewer=clip needs none"
            )
    others = set(threading.enumerate())
    try:
        with launch_passive(
            stage.model, stage.data, key_callback=on_key, show_left_ui=False, show_right_ui=False
        ) as window:
            yield window
    finally:  # the interpreter would hang if it ended before the threads of the window
        for thread in set(threading.enumerate()) - others:
            thread.join(5.0)


POSES = 8  # of a picture


def poses_of(core: Go1Core, policy: Policy, seconds: float) -> list[np.ndarray]:
    """Return poses of robot 0: world x, z (4, 4, 2), m, of each leg's hip, thigh joint, knee and foot."""
    data = mujoco.MjData(core.backend.model)
    steps = round(seconds / core.task.sim.policy_dt)
    wanted = set(np.linspace(steps // 2, steps - 1, POSES).astype(int).tolist())
    poses = []
    observation = core.reset()
    for step in range(steps):
        observation = core.step(policy(observation)).observation
        if step in wanted:
            data.qpos[:] = core.backend.qpos[0].numpy()
            mujoco.mj_kinematics(core.backend.model, data)
            legs = [
                [*(data.body(f"{leg}_{part}").xpos for part in robot.JOINT_KINDS), data.site(f"{leg}_foot").xpos]
                for leg in robot.LEGS
            ]
            poses.append(np.array(legs)[..., [0, 2]])
    return poses


def picture(core: Go1Core, policy: Policy, seconds: float, path: Path) -> None:
    """Run a policy and draw its poses side by side, right legs dark and left legs light."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with torch.no_grad():
        poses = poses_of(core, policy, seconds)
    figure = Figure(figsize=(2.0 * len(poses), 2.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, pose in zip(np.atleast_1d(figure.subplots(1, len(poses), sharey=True)), poses, strict=True):
        centre = pose[:, 0, 0].mean()
        for leg, colour in ((1, "#9db8d2"), (3, "#9db8d2"), (0, "#1f4e79"), (2, "#1f4e79")):
            axes.plot(pose[leg, :, 0] - centre, pose[leg, :, 1], "-o", color=colour, ms=3, lw=2)
        axes.plot(pose[[0, 2], 0, 0] - centre, pose[[0, 2], 0, 1], color="#222222", lw=5)
        axes.axhline(0.0, color="#888888", lw=1)
        axes.set(xlim=(-0.45, 0.45), ylim=(-0.05, 0.5), aspect="equal", title=f"x = {centre:.2f} m")
        axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, keep_suffix=True) as partial:
        figure.savefig(partial, dpi=100)
