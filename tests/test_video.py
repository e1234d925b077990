"""Videos of a policy, the camera, and the gait diagram under a video."""

from __future__ import annotations

import sys
import warnings
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from go1exp.evaluate.video import (
    FIRST_RGB,
    GROUND_RGB,
    SECOND_RGB,
    SPAN,
    Footfalls,
    keeping,
    live,
    record,
    steer,
    write_gif,
    write_mp4,
    write_strip,
)
from go1exp.sim.env import camera as camera_module
from go1exp.sim.env.camera import GROUND_RANGE, Camera, Picture, RenderingUnavailable, Stage, choose_gl
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.gym_env import Go1Env

PLAIN = ("rand=none", "command=forward")
MakeCore = Callable[..., Go1Core]


@pytest.fixture(scope="module")
def gl() -> str:
    try:
        return choose_gl()
    except RenderingUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture
def core(start_core: MakeCore) -> Go1Core:
    core = start_core(*PLAIN, num_envs=2)
    return core


@pytest.fixture
def camera(gl: str, core: Go1Core) -> Iterator[Camera]:
    camera = Camera(core, 320, 240)
    yield camera
    camera.close()


@pytest.fixture
def no_gl_chosen() -> Iterator[None]:
    choose_gl.cache_clear()
    yield
    choose_gl.cache_clear()


def stand(observation: Tensor) -> Tensor:
    return torch.zeros(len(observation), 12)


def robot_pixels(camera: Camera, env: int = 0) -> np.ndarray:
    """(H, W) bool: where the picture differs from one without the robot."""
    picture, model = camera.frame(env).astype(int), camera.stage.model
    groups = model.geom_group.copy()
    model.geom_group[model.geom_bodyid > 0] = 5  # not drawn
    empty = camera.frame(env).astype(int)
    model.geom_group[:] = groups
    return np.abs(picture - empty).max(-1) > 20


def shift(core: Go1Core, env: int, x: float, seconds: float) -> None:
    """Carry a robot along x, m, in some time, s."""
    core.backend.qpos[env, 0] += x
    core.steps[env] += round(seconds / core.task.sim.policy_dt)


# ---------------------------------------------------------------------- camera


def test_a_frame_has_the_asked_size_and_the_robot_in_its_middle(camera: Camera) -> None:
    frame = camera.frame(0)
    assert frame.shape == (240, 320, 3)
    assert frame.dtype == np.uint8
    assert frame.std() > 15
    rows, cols = robot_pixels(camera).nonzero()
    assert len(rows) > 0.06 * 240 * 320
    assert 40 < rows.min() < 120 < rows.max() < 220  # nothing is cut off, and there is room for arrows and caption
    assert 40 < cols.min() < 160 < cols.max() < 280  # nor by a crop to a square


def test_the_camera_follows_and_the_floor_shows_motion(camera: Camera, core: Go1Core) -> None:
    before, robot = camera.frame(0).astype(int), robot_pixels(camera)
    shift(core, 0, 0.5, 2.0)
    after = camera.frame(0).astype(int)
    assert (robot_pixels(camera) == robot).mean() > 0.99
    assert (np.abs(after - before).max(-1) > 5).mean() > 0.2
    shift(core, 0, 3.5, 2.0)  # a whole number of the floor's squares in all
    assert (np.abs(camera.frame(0).astype(int) - before).max(-1) > 5).mean() < 0.02


def test_the_camera_lags_a_little_and_jumps_with_a_new_episode(camera: Camera, core: Go1Core) -> None:
    camera.frame(0)
    shift(core, 0, 0.1, 0.02)
    robot_x = float(core.backend.qpos[0, 0])
    camera.frame(0)
    assert 0.05 < robot_x - camera._view.lookat[0] < 0.1
    core.reset()
    core.backend.qpos[0, 0] += 3.0
    camera.frame(0)
    assert camera._view.lookat[0] == pytest.approx(float(core.backend.qpos[0, 0]))


def test_every_environment_is_drawn_which_changes_nothing_and_repeats(camera: Camera, core: Go1Core) -> None:
    core.step(stand(torch.zeros(2, 1)))
    core.backend.qpos[1, 7:] += 0.3
    state = core.state_dict()["backend"]["state"]
    first, second = camera.frame(0), camera.frame(1)
    assert (first != second).any()
    assert (camera.frame(0) == first).all()
    for name, value in core.state_dict()["backend"]["state"].items():
        assert torch.equal(value, state[name]), name


def test_two_cameras_do_not_disturb_each_other_nor_one_that_is_dropped(camera: Camera, core: Go1Core) -> None:
    frame = camera.frame(0)
    other, dropped = Camera(core, 160, 120, decoration=False), Camera(core, 160, 120)
    assert robot_pixels(other).mean() > 0.06  # the shapes that touch
    dropped.frame(0)
    other.close()
    other.close()
    with pytest.raises(RuntimeError, match="closed"):
        other.frame(0)
    camera.frame(0)
    del dropped
    assert (camera.frame(0) == frame).all()


def test_arrows_show_command_and_velocity(camera: Camera, core: Go1Core) -> None:
    def green() -> int:
        r, g, b = camera.frame(0).astype(int).transpose(2, 0, 1)
        return int(((g > r + 60) & (g > b + 60)).sum())

    core.command.value[0] = torch.tensor([1.0, 0.0, 0.0])
    assert green() == 0
    shift(core, 0, 0.0, 2.0)
    core.backend.qvel[0, 0] = 1.0
    assert green() > 30


def test_the_drawn_ground_is_the_ground_walked_on(start_core: MakeCore) -> None:
    core = start_core(*PLAIN, "terrain=rough", num_envs=1)
    stage, terrain = Stage(core), core.terrain
    edge = 2.0 * GROUND_RANGE / terrain.resolution + 1
    assert stage.model.hfield_data.size == edge**2 < 0.05 * terrain.heights.size
    x_min, x_max, y_min, _ = terrain.extent
    only_group_0 = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    for x, y in ((0.37, 0.21), (9.3, -4.9), (10.1, -4.9), (x_max - 0.6, y_min + 0.6), (x_min + 0.6, 3.3), (33.3, 61.7)):
        core.backend.qpos[0, :2] = torch.tensor([x, y])
        stage.place(0)
        down, hit = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
        distance = mujoco.mj_ray(stage.model, stage.data, np.array([x, y, 9.0]), down, only_group_0, 1, -1, hit)
        assert hit[0] == stage.model.geom("floor").id
        assert 9.0 - distance == pytest.approx(float(terrain.height_at((x, y))), abs=1e-6)


def test_a_rough_ground_is_drawn_and_exchanged_on_the_way(gl: str, start_core: MakeCore) -> None:
    core = start_core(*PLAIN, "terrain=rough", num_envs=1)
    camera = Camera(core, 160, 120)
    camera.frame(0)
    core.backend.qpos[0, :3] = torch.tensor([-32.0, 20.0, 0.3])
    arrived = camera.frame(0)
    fresh = Camera(core, 160, 120)
    assert (np.abs(arrived.astype(int) - fresh.frame(0)).max(-1) > 5).mean() < 0.02
    assert robot_pixels(camera).mean() > 0.06
    camera.close()
    fresh.close()


def test_gymnasium_renders(gl: str) -> None:
    env = Go1Env([*PLAIN, "backend.threads=1"], render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    env.close()
    assert frame is not None
    assert frame.shape == (480, 640, 3)


# ---------------------------------------------------------------------- nothing to draw with


def test_a_missing_library_is_explained(core: Go1Core, monkeypatch: pytest.MonkeyPatch, no_gl_chosen: None) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "wgl")  # neither EGL nor OSMesa can be imported with it
    with pytest.raises(RenderingUnavailable) as caught:
        Camera(core)
    message = str(caught.value)
    for part in ("libegl1 libopengl0 libgl1-mesa-dri", "libosmesa6", "MUJOCO_GL=egl", "egl: ", "osmesa: "):
        assert part in message
    assert "\n" not in message


def test_the_second_library_is_taken_when_the_first_fails(monkeypatch: pytest.MonkeyPatch, no_gl_chosen: None) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(camera_module, "_why_not", lambda name: "broken" if name == "egl" else "")
    assert choose_gl() == "osmesa"


@pytest.mark.parametrize(("value", "message"), [("direct3d", "'direct3d' is no GL library"), ("osmesa", "with osmesa")])
def test_a_wrong_choice_is_explained(
    core: Go1Core, monkeypatch: pytest.MonkeyPatch, no_gl_chosen: None, value: str, message: str
) -> None:
    monkeypatch.setenv("MUJOCO_GL", value)
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", None)
    with pytest.raises(RenderingUnavailable, match=message) as caught:
        Camera(core)
    assert "libosmesa6" in str(caught.value)


@pytest.mark.parametrize("display", [None, ":77"])
def test_a_window_needs_a_display(core: Go1Core, monkeypatch: pytest.MonkeyPatch, display: str | None) -> None:
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    if display:
        monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(RenderingUnavailable, match="display"):
        live(core, stand)


def test_keys_steer() -> None:
    command = [0.0] * 3
    for key in (265, 265, 264, 44, 263, 263, 999):
        steer(command, key)
    assert command == [0.1, 0.1, 0.4]
    steer(command, 32)
    assert command == [0.0, 0.0, 0.0]


# ---------------------------------------------------------------------- films


def test_record_runs_the_policy_in_simulated_time(gl: str, core: Go1Core) -> None:
    calls: list[tuple[int, int]] = []
    frames = list(record(core, stand, 0.4, 1, 25, lambda *at: calls.append(at), width=160, height=120))
    assert len(frames) == 10
    assert calls == [(k, 10) for k in range(1, 11)]
    assert core.steps.tolist() == [18, 18]  # the last picture is of 9/25 s
    assert (frames[0] != frames[-1]).any()


def test_a_caption_covers_the_lower_edge_only(gl: str, core: Go1Core) -> None:
    (plain,) = record(core, stand, 0.04, width=320, height=240, caption=False)
    (captioned,) = record(core, stand, 0.04, width=320, height=240)
    changed = (plain != captioned).any(-1).any(-1)
    assert changed[-15:].all()
    assert not changed[:-30].any()


def test_a_film_that_breaks_off_leaves_no_file(gl: str, core: Go1Core, tmp_path: Path) -> None:
    def broken(observation: Tensor) -> Tensor:
        if core.steps[0] == 4:
            raise ArithmeticError("stopped here")
        return stand(observation)

    with pytest.raises(ArithmeticError, match="stopped here"):
        write_mp4(tmp_path / "film.mp4", record(core, broken, 1.0, width=160, height=120))
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def frames() -> list[Picture]:
    """Ten pictures, (120, 162, 3), of a white square that moves to the right over grey stripes."""
    pictures = np.full((10, 120, 162, 3), 90, np.uint8)
    pictures[:, ::4] = 110
    for k in range(10):
        pictures[k, 40:80, 10 * k : 10 * k + 40] = 255
    return list(pictures)


def test_an_mp4_reads_back(frames: list[Picture], tmp_path: Path) -> None:
    path = tmp_path / "new" / "film.mp4"
    write_mp4(path, iter(frames), fps=20)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # imageio's reader
        back = iio.imread(path, plugin="FFMPEG")
        about: dict[str, Any] = iio.immeta(path, plugin="FFMPEG")
    assert back.shape == (10, 120, 162, 3)
    assert np.abs(back.astype(int) - np.stack(frames)).mean() < 8
    assert (about["codec"], about["fps"]) == ("h264", 20)
    assert about["pix_fmt"].startswith("yuv420p")
    assert [p.name for p in path.parent.iterdir()] == ["film.mp4"]


def test_a_strip_shows_first_to_last(frames: list[Picture], tmp_path: Path) -> None:
    write_strip(tmp_path / "strip.png", frames, count=4, size=80)
    strip = iio.imread(tmp_path / "strip.png")
    assert strip.shape == (80, 4 * 80 + 3, 3)
    for panel, index in enumerate((0, 3, 6, 9)):
        middle = strip[40, 81 * panel : 81 * panel + 80, 0]
        expected = np.flatnonzero(frames[index][60, 21:141, 0] == 255).mean() * 80 / 120
        assert np.flatnonzero(middle > 200).mean() == pytest.approx(expected, abs=1)
    write_strip(tmp_path / "short.png", frames[:2], count=6, size=40)
    assert iio.imread(tmp_path / "short.png").shape == (40, 81, 3)


def test_a_film_of_any_length_takes_the_memory_of_a_few_pictures(tmp_path: Path) -> None:
    drawn: list[weakref.ref[Picture]] = []
    living: list[int] = []

    def pictures() -> Iterator[Picture]:
        for _ in range(40):
            picture = np.zeros((32, 32, 3), np.uint8)
            drawn.append(weakref.ref(picture))
            living.append(sum(one() is not None for one in drawn))
            yield picture

    kept: list[Picture] = []
    write_mp4(tmp_path / "film.mp4", keeping(pictures(), 40, kept, count=3))
    assert len(drawn) == 40
    assert len(kept) == 3
    assert max(living) <= 3 + 3  # what is kept, the film's first, the one in work and the one before it


def test_the_strip_of_a_film_that_is_written_picture_by_picture_is_that_of_all(
    frames: list[Picture], tmp_path: Path
) -> None:
    kept: list[Picture] = []
    assert list(keeping(iter(frames), len(frames), kept, count=4)) == frames
    write_strip(tmp_path / "kept.png", kept, count=4, size=40)
    write_strip(tmp_path / "all.png", frames, count=4, size=40)
    assert (tmp_path / "kept.png").read_bytes() == (tmp_path / "all.png").read_bytes()


def test_a_gif_loops_and_is_small(gl: str, core: Go1Core, tmp_path: Path) -> None:
    frames = list(record(core, stand, 1.0, fps=12.5, width=320, height=240))
    write_gif(tmp_path / "film.gif", frames, fps=12.5, width=320)
    with Image.open(tmp_path / "film.gif") as gif:
        assert gif.size == (320, 240)
        assert gif.n_frames == len(frames) == 12  # type: ignore[attr-defined]
        assert gif.info["duration"] == 80
        assert gif.info["loop"] == 0
        back = np.asarray(gif.convert("RGB")).astype(int)
    assert np.abs(back - frames[0]).mean() < 8
    assert (tmp_path / "film.gif").stat().st_size < 2e6 / 6


@pytest.mark.parametrize(("write", "name"), [(write_mp4, "a.mp4"), (write_strip, "a.png"), (write_gif, "a.gif")])
def test_what_cannot_be_written_says_so(write: Callable, name: str, frames: list[Picture], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=f"cannot be written.*file/{name}"):
        write(tmp_path / "file" / name, frames)
    (tmp_path / name).mkdir()
    with pytest.raises(OSError, match="cannot be written"):
        write(tmp_path / name, frames)
    with pytest.raises(ValueError, match="at least one frame"):
        write(tmp_path / f"none-{name}", [])
    assert sorted(p.name for p in tmp_path.iterdir()) == [name, "file"]


DT = 0.02
FRAME = np.full((480, 640, 3), 200, np.uint8)


def diagram(footfalls: Footfalls, frame: np.ndarray = FRAME) -> np.ndarray:
    drawn = footfalls.under(frame)
    assert drawn.shape[0] % 2 == 0  # films need even sides
    assert drawn.shape[1:] == frame.shape[1:]
    np.testing.assert_array_equal(drawn[: len(frame)], frame)
    return drawn[len(frame) :]


def filled(strip: np.ndarray, rgb: tuple[int, int, int]) -> np.ndarray:
    """Where the strip has a colour, without the letters at the left."""
    part = slice(76, 580) if strip.shape[1] == 640 else slice(None)
    return (strip == rgb).all(-1)[:, part]


def test_a_trot_shows_one_pair_at_a_time() -> None:
    footfalls = Footfalls(DT)
    for step in range(200):
        first = step // 10 % 2 == 0
        footfalls.add([first, not first, not first, first])
    strip = diagram(footfalls)
    one, other = (filled(strip, rgb).any(0) for rgb in (FIRST_RGB, SECOND_RGB))
    assert not (one & other).any()
    assert 0.4 < one.mean() < 0.55
    assert 0.4 < other.mean() < 0.55


def test_the_newest_contact_is_at_the_right_edge_and_the_oldest_leaves_at_the_left() -> None:
    footfalls = Footfalls(DT)
    for _ in range(round(SPAN / DT)):
        footfalls.add([False] * 4)
    footfalls.add([True, False, False, False])
    columns = np.flatnonzero(filled(diagram(footfalls), FIRST_RGB).any(0))
    assert 2 <= len(columns) <= 8
    right = columns.max()
    for _ in range(50):
        footfalls.add([False] * 4)
    moved = np.flatnonzero(filled(diagram(footfalls), FIRST_RGB).any(0))
    assert right - moved.max() == pytest.approx(0.5 * 502, abs=4)  # 1 s of 2 s
    for _ in range(60):
        footfalls.add([False] * 4)
    assert not filled(diagram(footfalls), FIRST_RGB).any()


def test_each_foot_has_a_row_of_its_own_and_another_episode_begins_with_an_empty_one() -> None:
    tops = []
    for foot in range(4):
        footfalls = Footfalls(DT)
        for _ in range(100):
            footfalls.add([k == foot for k in range(4)])
        strip = diagram(footfalls)
        rows = np.flatnonzero((filled(strip, FIRST_RGB) | filled(strip, SECOND_RGB)).mean(1) > 0.5)
        tops.append(rows.min())
        assert len(rows) >= 8
    assert tops == sorted(set(tops))
    footfalls.clear()
    assert not (filled(diagram(footfalls), FIRST_RGB) | filled(diagram(footfalls), SECOND_RGB)).any()


@pytest.mark.parametrize("size", [(64, 64), (120, 160), (720, 1280)])
def test_a_picture_of_any_size_gets_a_diagram(size: tuple[int, int]) -> None:
    footfalls = Footfalls(DT)
    footfalls.add([True] * 4)
    strip = diagram(footfalls, np.zeros((*size, 3), np.uint8))
    assert 10 < len(strip) < 0.5 * size[0]
    assert (strip == GROUND_RGB).all(-1).any()
