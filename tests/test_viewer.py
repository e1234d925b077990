"""The robot of the browser, without a browser: what is asked for happens and is seen; no token, no sight."""

from __future__ import annotations

import asyncio
import math
import re
import socket
from http import HTTPStatus
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.datastructures import Headers
from websockets.http11 import Request

from go1exp import robot
from go1exp.base.errors import Expected
from go1exp.cli.play_web import _agents, _grounds
from go1exp.cli.subjects import agent, named
from go1exp.config.compose import compose
from go1exp.config.schema.physics import MUJOCO_CONTACT
from go1exp.config.schema.registry import ConfigError
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.page_server import Gate, instructions, listening
from go1exp.evaluate.viewer.replay import (
    Change,
    Motion,
    Piece,
    Player,
    ReplayShow,
    Story,
    of_recording,
    of_result,
)
from go1exp.evaluate.viewer.requests import Setup, catalogue, resized
from go1exp.evaluate.viewer.session import SPAN, History, Robots, Session
from go1exp.evaluate.viewer.walk import WalkShow
from go1exp.gap.result import GapResult, Overlay
from go1exp.logs.recording import Meta, Recording, RecordingError, joint_channels
from go1exp.sim.task import parse_parts
from tests.made import meta

GO1 = parse_parts(compose("train", []), ("robot",))[0]["robot"]

# ---------------------------------------------------------------------- a robot that walks


def clock_robots() -> Robots:
    """Everything that ``go1exp play policy=clock viewer=web`` offers."""
    subject = named(None, "clock", None, None, "play.mp4")
    first = agent(subject, {})
    return Robots(_agents(subject, first, {}), _grounds(None)[1], catalogue(first.task.effect, False)[0])


@pytest.fixture(scope="module")
def robots() -> Robots:
    return clock_robots()


@pytest.fixture
def session(robots: Robots) -> Session:
    return Session(robots, "clock", Setup(), (0.0, 0.0, 0.0))


def qpos(session: Session) -> NDArray[np.float64]:
    return session.core.backend.qpos[0].double().numpy().copy()


def velocity(session: Session, seconds: float = 0.5) -> NDArray[np.float64]:
    """Mean true velocity (3,) of the last ``seconds`` s."""
    return np.asarray(session.history.last("true", seconds).mean(0))


def walk(session: Session, seconds: float) -> None:
    for _ in range(round(seconds / session.dt)):
        session.advance()


def test_the_speed_follows_the_command(session: Session) -> None:
    walk(session, 0.6)
    assert abs(velocity(session, 0.2)[0]) < 0.15
    session.ask(ask.Command((0.8, 0.0, 0.0)))
    walk(session, 1.6)
    assert velocity(session)[0] == pytest.approx(0.8, abs=0.2)
    estimated = session.history.last("estimated", 0.5).mean(0)
    assert estimated[0] == pytest.approx(velocity(session)[0], abs=0.15)
    assert session.falls == 0


def test_a_push_moves_the_robot_where_it_points_and_is_marked(session: Session) -> None:
    walk(session, 0.4)
    session.ask(ask.Push(15.0, math.pi / 2))
    walk(session, 0.3)
    sideways = session.history.last("true", 0.3)[:, 1]
    assert sideways.max() > 0.4  # 15 N s on 13 kg
    assert session.history.series("push").max() == 15.0
    assert session.push.angle == pytest.approx(math.pi / 2, abs=0.2)
    view = WalkShow(session).view()
    assert view is not None
    assert len(view.pushes) == 1
    assert -0.35 < view.pushes[0] < -0.2


@pytest.mark.parametrize("other", ["paper", "mpc"])
def test_another_driver_takes_over_while_the_robot_walks(session: Session, other: str) -> None:
    if other not in session.robots.agents:
        pytest.skip("the extra mpc is not installed")
    session.ask(ask.Command((0.4, 0.0, 0.0)))
    walk(session, 0.8)
    before = qpos(session)
    session.ask(ask.SelectPolicy(other))
    assert (session.label, session.message) == (other, "")
    assert np.linalg.norm(qpos(session)[:3] - before[:3]) < 0.05
    walk(session, 1.4)  # the MPC begins its gait from standing
    assert session.falls == 0
    assert qpos(session)[0] > before[0] + 0.05
    assert velocity(session, 0.2)[0] > 0.1


def test_an_effect_acts_by_its_size_and_goes(session: Session) -> None:
    def weight() -> float:
        return float(session.core.backend.field("body_mass")[0].sum())

    plain = float(session.core.backend.compiled("body_mass").sum())
    session.ask(ask.SetEffects({"payload": 2.0}))
    assert weight() == pytest.approx(plain + 2.0, abs=1e-6)
    session.ask(ask.SetEffects({"payload": 0.0}))
    assert not session.core.plant.effects.effects
    walk(session, 0.1)
    assert session.falls == 0


def test_sizes_are_multiples_of_the_distance_from_null(robots: Robots) -> None:
    strength = robots.effects["strength"]
    half = resized(strength, 0.5, MUJOCO_CONTACT)
    scale = strength.parameters["scale"]
    given = scale if isinstance(scale, float) else scale[0]
    shrunk = half.parameters["scale"] if isinstance(scale, float) else half.parameters["scale"][0]
    assert shrunk == pytest.approx(1.0 + 0.5 * (given - 1.0))
    assert resized(robots.effects["coulomb"], 0.0, MUJOCO_CONTACT).parameters["bound"] == (0.0, 0.0, 0.0)
    assert half.slots == {"spread": {}}


def test_noise_delay_and_physics_rate_are_in_force(session: Session) -> None:
    session.ask(ask.Conditions(noise=True, delay=0.02, physics_dt=0.001, trunk_velocity="exact"))
    assert session.message == ""
    assert session.core.noise
    assert session.core.task.sim.physics_dt == pytest.approx(0.001)
    assert float(session.core.plant.effects.effects["command_delay"].delay[0, 0]) == pytest.approx(0.02)
    walk(session, 0.1)


def test_grounds_and_their_levels(session: Session) -> None:
    session.ask(ask.SelectGround("rough", 5.0, "bumps"))
    core = session.core
    column = int(core.tile_column[0])
    assert core.terrain.tile_types[column] == "bumps"
    assert np.allclose(qpos(session)[:2], core.terrain.tile_origins[5, column, :2], atol=1e-6)
    session.ask(ask.SelectGround("slope_up", 12.0))
    rise = session.core.terrain.heights.max()
    assert rise == pytest.approx(5.0 * math.tan(math.radians(12.0)), rel=0.02)
    view = WalkShow(session).view()
    assert view is not None
    assert view.grounds["slope_up"].unit == "deg"


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        (ask.SelectPolicy("nobody"), "nobody"),
        (ask.SetEffects({"wings": 1.0}), "wings"),
        (ask.SelectGround("moon"), "moon"),
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(session: Session, request_: ask.Request, why: str) -> None:
    walk(session, 0.1)
    core, setup, history = session.core, session.setup, session.history.count
    session.ask(request_)
    assert why in session.message
    assert "\n" not in session.message
    assert (session.core, session.setup, session.label) == (core, setup, "clock")
    session.advance()
    assert session.history.count == history + 1
    with pytest.raises(ConfigError, match="moon"):
        Session(session.robots, "clock", Setup(ground="moon"), (0.0, 0.0, 0.0))


def test_time_stands_still_and_goes_on_by_steps(session: Session) -> None:
    show = WalkShow(session)
    session.ask(ask.Pace(True, 1.0))
    show.tick()
    assert session.time == 0.0
    session.ask(ask.Step())
    show.tick()
    show.tick()
    assert session.time == pytest.approx(session.dt)
    session.ask(ask.Pace(False, 0.5))
    assert show.tick() == pytest.approx(2.0 * session.dt)


def test_a_reset_puts_the_robot_back_and_keeps_the_command(session: Session) -> None:
    session.ask(ask.Command((1.0, 0.0, 0.0)))
    walk(session, 0.6)
    assert qpos(session)[0] > 0.1
    session.ask(ask.Reset())
    assert np.allclose(qpos(session)[:2], 0.0)
    session.advance()
    assert session.history.last("command", 0.02)[0, 0] == pytest.approx(1.0)


def test_a_fall_is_told_and_the_robot_starts_again(session: Session) -> None:
    session.ask(ask.Push(200.0, 0.0))
    walk(session, 1.5)
    assert session.falls >= 1
    assert session.message.endswith("; reset")


def test_every_reward_term_is_shown(session: Session) -> None:
    walk(session, 1.2)
    view = WalkShow(session).view()
    assert view is not None
    assert [r.name for r in view.rewards] == [t.key for t in session.core.terms.rewards]
    assert len(view.rewards) > 20
    assert all(len(r.curve) == len(view.rewards[0].curve) > 0 for r in view.rewards)
    assert sum(r.mean for r in view.rewards) == pytest.approx(view.total, abs=1e-9)
    result = session.core.reward_terms()
    assert view.rewards[0].curve[-1] == pytest.approx(float(result[view.rewards[0].name][0]) / session.dt)


def test_the_curves_are_what_happened(session: Session) -> None:
    session.ask(ask.Command((0.5, 0.0, 0.0)))
    walk(session, 1.0)
    view = WalkShow(session).view()
    assert view is not None
    assert len(view.t) == len(view.height) == len(view.true[0]) == len(view.torque[11]) == 50
    assert view.t[-1] == 0.0
    assert view.t[0] == pytest.approx(-49 * session.dt)
    assert 0.2 < view.height[-1] < 0.45
    assert all(0.0 <= v <= 1.0 + 1e-6 for line in view.torque for v in line)
    steps = [len(runs) for runs in view.contacts]
    assert min(steps) >= 2  # every foot has been lifted
    assert all(a < b for runs in view.contacts for a, b in runs)


def test_the_history_forgets_what_is_older_than_it_shows() -> None:
    history = History({"a": 1, "b": 2}, 0.02)
    for k in range(round(SPAN / 0.02) + 30):
        history.add({"a": np.array([float(k)]), "b": np.array([k, -k], float)})
    assert history.filled == round(SPAN / 0.02)
    assert history.series("a")[0, 0] == 30.0
    assert history.series("b")[-1].tolist() == [529.0, -529.0]
    assert (history.series("a", 4)[:, 0] % 4 == 0).all()
    assert history.times(4)[-1] == pytest.approx(-0.02)
    history.add({"a": np.array([1.0])})
    assert np.isnan(history.series("b")[-1]).all()


# ---------------------------------------------------------------------- who may look


def test_only_the_token_opens_the_gate() -> None:
    gate = Gate(8080)
    here = "127.0.0.1:8080"
    assert gate.admits(f"/?token={gate.token}", "", None, here)
    assert gate.admits("/state?sid=1", gate.header.split(";")[0], f"http://{here}", here)
    assert gate.admits("/state", f"other=1; {gate.header.split(';')[0]}", None, here)
    for path, cookie, origin in (
        ("/", "", None),
        ("/?token=", "", None),
        (f"/?token={gate.token[:-1]}", "", None),
        (f"/?token={gate.token}x", "", None),
        ("/?token=ü", "", None),
        ("/", f"go1exp_8081={gate.token}", None),
        ("/", "go1exp_8080=wrong", None),
        (f"/?token={gate.token}", "", "http://evil.example"),
        ("/state", gate.header.split(";")[0], "http://127.0.0.1:9999"),
        ("/state", gate.header.split(";")[0], "null"),
    ):
        assert not gate.admits(path, cookie, origin, here), (path, cookie, origin)
    assert len(gate.token) >= 20
    assert Gate(8080).token != gate.token
    assert {"HttpOnly", "SameSite=Strict"} <= {part.strip() for part in gate.header.split(";")}


def test_a_request_to_two_hosts_is_a_bad_one() -> None:
    twice = Request("/", Headers([("Host", "127.0.0.1:8080"), ("Host", "127.0.0.1:8080")]))
    answering = SimpleNamespace(respond=lambda status, text: status)
    answer = Gate(8080).guarded(lambda connection, request: None)(answering, twice)
    assert asyncio.run(answer) == HTTPStatus.BAD_REQUEST


def test_a_second_viewer_takes_the_next_port() -> None:
    first = listening("127.0.0.1", 0)
    second = listening("127.0.0.1", 0)
    try:
        taken = first.getsockname()[1]
        assert second.getsockname()[1] > taken
        assert first.getsockname()[0] == "127.0.0.1"
        with pytest.raises(Expected, match=rf"port = {taken}: cannot be listened on .*port=0"):
            listening("127.0.0.1", taken)
    finally:
        first.close()
        second.close()


def test_a_host_that_is_not_ours_is_refused_in_one_line() -> None:
    with pytest.raises(Expected, match=r"host = 'no\.such\.host\.invalid'.*127\.0\.0\.1") as error:
        listening("no.such.host.invalid", 0)
    assert "\n" not in str(error.value)


def test_the_words_say_where_to_look_and_how_to_get_there() -> None:
    text = instructions("127.0.0.1", 8083, "secret")
    assert "http://127.0.0.1:8083/?token=secret" in text
    assert f"ssh -L 8083:127.0.0.1:8083 {socket.gethostname()}" in text
    everywhere = instructions("0.0.0.0", 8083, "secret")
    assert f"http://{socket.gethostname()}:8083/?token=secret" in everywhere
    assert "nothing is encrypted" in everywhere


# ---------------------------------------------------------------------- recordings and answers


def recording(base: str = "floating", **about: str) -> Recording:
    t = 0.002 * np.arange(500)
    angles = robot.NOMINAL_STANCE + 0.1 * np.sin(2 * np.pi * t)[:, None]
    channels = {"t": t, **dict(zip(joint_channels("q", robot.JOINTS), angles.T, strict=True))}
    channels |= dict(zip(joint_channels("q_target", robot.JOINTS), angles.T + 0.05, strict=True))
    if base == "floating":
        channels |= {f"imu_quat_{axis}": np.full(500, float(axis == "w")) for axis in "wxyz"}
    quat = (1.0, 0.0, 0.0, 0.0) if base == "fixed" else None
    known = meta(base=base, base_quat=quat, episode="walk", source="measured", **about)
    return Recording(known, {name: np.asarray(v, dtype=float) for name, v in channels.items()})


@pytest.mark.parametrize("base", ["floating", "fixed"])
def test_a_recording_is_shown_in_its_own_time(base: str) -> None:
    log = recording(base)
    show = ReplayShow(of_recording(log), GO1)
    for _ in range(10):
        show.tick()
    row = show.player.row
    assert log.t[row] == pytest.approx(0.2, abs=0.003)
    assert np.allclose(show.data.qpos[7:], log.joint("q")[row])
    (target,) = show.view().ghosts
    assert target.name == "target"
    assert np.allclose(target.qpos[7:] - show.data.qpos[7:], 0.05)
    show.ask(Change(time=0.7))
    assert not show.player.running
    show.tick()
    assert np.allclose(show.data.qpos[7:], log.joint("q")[350], atol=1e-9)
    show.ask(Change(running=True, speed=1.0))
    for _ in range(20):
        show.tick()
    assert show.player.time < 0.7  # it begins again


def test_a_recording_of_another_robot_is_refused() -> None:
    log = recording()
    joints = tuple(f"x{k}" for k in range(12))
    other = Recording(Meta(**{**vars(log.meta), "joints": joints, "robot": "go9"}), log.channels)
    with pytest.raises(RecordingError, match="go9"):
        of_recording(other)


def answer(joints: tuple[str, ...] = robot.JOINTS) -> GapResult:
    """An answer with two windows, in which the model is off by 4 mrad before and by 1 mrad after."""
    t = 2.0 + 0.002 * np.arange(100)
    windows = []
    for episode in ("a", "b"):
        measured = {f"q_{joint}": 0.1 * np.sin(t + k) for k, joint in enumerate(joints)}
        measured |= {f"qd_{joint}": 0.1 * np.cos(t + k) for k, joint in enumerate(joints)}
        before, after = ({name: v + off for name, v in measured.items()} for off in (4e-3, 1e-3))
        windows.append(Overlay(episode, t, measured, before, after, dict.fromkeys(measured, 3e-4)))
    return GapResult("explained", "The model is missing dry friction.", overlays=tuple(windows))


def test_an_answer_is_shown_window_by_window() -> None:
    story = of_result(answer(), "gap/verdict.json")
    assert [piece.title for piece in story.pieces] == ["a, 2.00 s", "b, 2.00 s"]
    errors = story.pieces[0].errors()["FR_calf"]
    assert errors["before"] == pytest.approx(4e-3)
    assert errors["after"] == pytest.approx(1e-3)
    show = ReplayShow(story, GO1)
    assert show.player.magnify == 20.0  # 4 mrad become 80, the largest round number below 150
    measured, after, again = show.view().ghosts
    assert (measured.name, after.name, again.name) == ("measured", "after", "measured")
    assert np.allclose(show.data.qpos[7:] - measured.qpos[7:], 20.0 * 4e-3)
    assert np.allclose(after.qpos[7:] - again.qpos[7:], 20.0 * 1e-3)
    assert np.linalg.norm(after.shift) > 0.5  # beside it
    show.ask(Change(magnify=1.0))
    show.ask(Change(piece=7))
    show.tick()
    assert show.view().number == 1
    assert np.allclose(show.data.qpos[7:] - show.view().ghosts[0].qpos[7:], 4e-3)


def test_an_answer_without_curves_says_what_to_do() -> None:
    with pytest.raises(RecordingError, match=r"verdict\.json: keeps no curves.*search\.overlays"):
        of_result(GapResult("bad log", "Nothing."), "gap/verdict.json")


def test_a_time_beyond_the_ends_is_an_end() -> None:
    t = np.linspace(0.0, 1.0, 11)
    piece = Piece("p", t, (Motion("measured", np.zeros((11, 1))),), {"q": {"j": {"measured": np.zeros(11)}}})
    player = Player(Story("log", "", (piece,)))
    player.ask(Change(time=99.0))
    assert (player.time, player.row) == (1.0, 10)
    player.ask(Change(time=-1.0))
    assert (player.time, player.row) == (0.0, 0)
    player.ask(Change(piece=-3))
    assert player.number == 0


# ---------------------------------------------------------------------- the command line's part


def test_own_effects_of_a_run_that_do_nothing_are_off(robots: Robots) -> None:
    subject = named(None, "robust", None, None, "play.mp4")
    task = agent(subject, {}).task
    _, sizes = catalogue(task.effect, False)
    assert [name for name, size in sizes.items() if size] == []
    own = {term.key for term in task.effect}
    assert own
    spread = catalogue(task.effect, True)
    assert {name for name, size in spread[1].items() if size} == own
    assert all(spread[0][name].slots["spread"] for name in own)


def test_without_studio_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    from go1exp.cli import play_web

    monkeypatch.setattr(play_web.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(Expected, match=r"pip install 'mujoco>=4'"):
        play_web.require_studio()


def test_the_page_of_the_documentation_names_the_keys_of_the_window() -> None:
    from go1exp.base.paths import data_root

    text = (data_root() / "docs/viewer.md").read_text()
    for key in ("arrow", "space", "Backspace", "P"):
        assert re.search(rf"\b{key}", text), key
