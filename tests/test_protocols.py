"""Every registered protocol in a small size: rows, JSON, page, figures, comparison; what the stage does; refusals."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from torch import Tensor

import go1exp.evaluate.protocol.kinds  # noqa: F401  (registers them)
from go1exp.base.paths import data_root
from go1exp.cli.evaluate import refuse
from go1exp.config.compose import compose
from go1exp.config.schema.physics import fitting_step
from go1exp.config.schema.registry import ConfigError, members
from go1exp.evaluate.agents import Agent, ControllerAgent, PolicyAgent
from go1exp.evaluate.controller.mpc import Mpc
from go1exp.evaluate.controller.settings import MpcSettings, parse_controller
from go1exp.evaluate.protocol import comparing
from go1exp.evaluate.protocol.base import Chosen, chosen
from go1exp.evaluate.protocol.kinds.corners import step_answer
from go1exp.evaluate.protocol.kinds.push_map import largest_survived
from go1exp.evaluate.protocol.pages import comparison, write
from go1exp.evaluate.protocol.plan import Impulses, Plan
from go1exp.evaluate.protocol.playing import Rates, Result, play
from go1exp.evaluate.protocol.stage import Setting, Stage
from go1exp.evaluate.quantities import FINGERPRINT, ROBOT
from go1exp.sim.task import TaskConfig
from tests.test_every_key_acts import unread

SMALL = {
    "sinusoid": ("robots=2", "seconds=0.8", "ladder=[{amplitude:[0.5,0.3,0.5],period:0.4}]", "claims={}"),
    "kicks": ("robots=2", "impulses=[3.0]", "first_s=2.0", "every_s=2.0", "jitter_s=0.1"),
    "gait": ("robots=3", "seconds=0.6", "settle_s=0.2", "commands=[[0.5,0.0,0.0],[1.0,0.0,0.0]]"),
    "corners": ("robots=2", "seconds=0.6", "settle_s=0.4", "rest_s=0.2", "commands=[[0.5,0.0,0.0]]"),
    "energy": ("robots=2", "seconds=0.6", "settle_s=0.2", "commands=[[0.5,0.0,0.0]]"),
    "hardware": ("robots=2", "seconds=0.4", "settle_s=0.2", "commands=[[0.5,0.0,0.0]]", "delays_ms=[20.0]"),
    "rate": ("robots=2", "seconds=0.3", "settle_s=0.1", "rates_hz=[50.0,100.0]", "delays_ms=[0.0]"),
    "push_map": ("robots=1", "directions=3", "phases=1", "settle_s=1.0", "watch_s=0.5", "halvings=1"),
    "recover": (
        *("robots=2", "settle_s=0.1", "seconds=0.2", "stand.hold_s=0.1", "push.after_s=0.1", "brake.seconds=0.2"),
        "measures=[stride_rate]",
    ),
    "robogauge": (
        *("robots=1", "frictions=[0.5,1.0]", "move_s=0.2", "stand_s=0.1", "pair_s=0.2", "settle_s=0.1"),
        "~grounds",
        "grounds={slope:{lane:slope_up,levels:[1.0,2.0],course:0.5,speed:1.0,seconds:0.2,backward:false}}",
        "measures=[stride_rate]",
    ),
    "terrain": (
        *("robots=1", "speeds=[8.0]", "slack=1.0", "~grounds", "grounds={slope_up:[5.0,10.0],gravel:[0.01,0.02]}"),
        "measures=[stride_rate]",
    ),
}
"""Overrides that make each protocol quick; a new one needs a line."""


@pytest.fixture(scope="module")
def agent(make_task: Callable[..., TaskConfig]) -> PolicyAgent:
    """Robots that sway on the spot."""
    step = [0]

    def sway(observation: Tensor) -> Tensor:
        step[0] += 1
        swing = 0.4 * math.sin(0.3 * step[0])
        return torch.tensor([0.0, swing, -swing] * 4).repeat(len(observation), 1)

    return PolicyAgent("sway", make_task("backend.threads=1", "sim.physics_dt=0.005", "rand=table1"), sway)


def selected(name: str, *overrides: str) -> Chosen:
    """A protocol of conf/protocol with some of its settings changed, or taken away (~)."""
    changed = (f"~protocol.{name}.{o[1:]}" if o.startswith("~") else f"++protocol.{name}.{o}" for o in overrides)
    (one,), grid = chosen(compose("eval", [f"protocol={name}", *changed])["protocol"])
    assert not grid
    return one


def small(name: str, *more: str) -> Chosen:
    return selected(name, *SMALL[name], *more)


@pytest.fixture(scope="module")
def played(agent: PolicyAgent) -> Callable[[str], tuple[Result, list[str]]]:
    """What came of each protocol, played and drawn once, and the keys that nothing read."""

    def once(name: str) -> tuple[Result, list[str]]:
        found: list[Result] = []

        def work() -> None:
            found.append(play(small(name), agent, Rates(seed=1)))
            found[0].chosen.protocol.drawings(found[0].played, found[0].summary)

        kind: Any = members("protocol")[name].target
        left = unread([kind], work)
        return found[0], left

    return cache(once)


@pytest.fixture(scope="module")
def result(played: Callable[[str], tuple[Result, list[str]]]) -> Callable[[str], Result]:
    return lambda name: played(name)[0]


EVERY = list(members("protocol"))


def test_every_protocol_has_a_file_and_a_small_size() -> None:
    assert set(EVERY) == set(SMALL)
    for name in EVERY:
        one = selected(name)
        assert one.kind == name
        assert one.protocol.claims


def unclosed(page: str) -> list[str]:
    """Elements of a page that are not closed in order."""
    wrong: list[str] = []
    still_open: list[str] = []
    for closing, tag, alone in re.findall(r"<(/?)([a-z][\w:]*)(?:[^>\"]|\"[^\"]*\")*?(/?)>", page):
        if closing and (not still_open or still_open.pop() != tag):
            wrong.append(tag)
        elif not (closing or alone or tag in ("meta", "br")):
            still_open.append(tag)
    return wrong + still_open


@pytest.mark.parametrize("name", EVERY)
def test_a_protocol_makes_rows_json_and_a_page(name: str, result: Callable[[str], Result], tmp_path: Path) -> None:
    one = result(name)
    rows_file, json_file, page_file = write(one, tmp_path)
    rows = pq.read_table(rows_file).to_pylist()
    keys, columns = one.chosen.protocol.keys, {c.name for c in one.chosen.protocol.columns()}
    assert rows
    for row in rows:
        assert {*keys, ROBOT, "fell", "left_map", "moving_s", FINGERPRINT} <= row.keys()
    assert {c.name for c in one.chosen.protocol.robot_columns} <= {k for row in rows for k in row} & columns
    content = json.loads(json_file.read_text())  # NaN would not be JSON
    assert "NaN" not in json_file.read_text()
    for entry in content["summary"]:
        for figure in entry["figures"].values():
            assert {"estimate", "low", "high", "n", "unit"} <= figure.keys()
            if figure["low"] is not None:
                assert figure["low"] <= figure["high"]
    assert len(content["claims"]) == len(one.chosen.protocol.claims)
    text = page_file.read_text()
    outside = set(re.findall(r'(?:src|href)="([^"#][^"]*)"', text))
    assert all(link.startswith("data:") for link in outside)
    assert "<script" not in text
    drawn = one.chosen.protocol.drawings(one.played, one.summary)
    assert text.count("<svg") == len(drawn) > 0
    assert unclosed(text) == []


@pytest.mark.parametrize("name", EVERY)
def test_a_subject_is_not_told_apart_from_itself(name: str, result: Callable[[str], Result]) -> None:
    one = result(name)
    again = dataclasses.replace(one, label="again")
    differences = comparing.compared(one, again)
    assert {d.verdict for d in differences} == {"no significant difference"}
    assert all(d.difference.estimate == 0.0 or math.isnan(d.difference.estimate) for d in differences)
    assert "no significant difference" in comparison({name: [one, again]}, {name: differences}, {})


@pytest.mark.parametrize("name", EVERY)
def test_every_key_of_a_protocol_is_read(name: str, played: Callable[[str], tuple[Result, list[str]]]) -> None:
    kind = members("protocol")[name].target.__name__
    velocity = [f"{kind}.trunk_velocity"] if name == "rate" else []  # it has velocities in its place
    assert [key for key in played(name)[1] if key not in velocity] == []


def test_robots_of_the_nominal_protocol_count_once(agent: PolicyAgent) -> None:
    still = play(small("corners", "noise=false", "randomize=false", "robots=3"), agent, Rates(seed=1))
    assert (len(still.played.rows), still.repeats) == (1, 2)
    random = play(small("corners", "robots=3"), agent, Rates(seed=1))
    assert (len(random.played.rows), random.repeats) == (3, 0)


def test_a_better_subject_is_called_better_and_a_worse_one_worse(result: Callable[[str], Result]) -> None:
    """Rows whose difference is known: every error is 0.1 less, hardly more for some, one of which robots is missing."""
    one = result("gait")
    rows = [
        {**row, "rmse_x": row["rmse_x"] - 0.1 - 1e-4 * row[ROBOT], "fell": True}
        for row in one.played.rows
        if row[ROBOT] < 99
    ]
    other = dataclasses.replace(one, label="other", played=dataclasses.replace(one.played, rows=rows[:-1]))
    found = {(d.figure, tuple(d.condition.values())): d for d in comparing.compared(one, other)}
    d = found["rmse_x", (0.5, 0.0, 0.0)]
    assert (d.verdict, d.difference.n) == ("better", 3)
    assert d.difference.estimate == pytest.approx(-0.1, abs=1e-3)
    assert found["rmse_x", (1.0, 0.0, 0.0)].difference.n == 2
    assert found["rmse_x", (1.0, 0.0, 0.0)].verdict == "no significant difference"


# ---------------------------------------------------------------------- the stage


def stage(agent: Agent, **changes: Any) -> Stage:
    return Stage(agent, Setting(**{"noise": True, "randomize": True, "trunk_velocity": "exact", "seed": 1, **changes}))


def test_a_command_is_seen_in_the_step_that_it_is_for(stands: PolicyAgent) -> None:
    observations: list[Tensor] = []

    def listens(observation: Tensor) -> Tensor:
        observations.append(observation.clone())
        return stands.policy(observation)

    command = np.zeros((6, 1, 3))
    command[:, 0, 0] = np.arange(6) * 0.1
    quiet = stage(dataclasses.replace(stands, policy=listens), noise=False, randomize=False)
    motion = quiet.run(Plan(command))
    np.testing.assert_allclose(motion.command[:, 0, 0], command[:, 0, 0], atol=1e-7)
    seen = torch.cat(observations).numpy()
    column = [c for c in range(seen.shape[1]) if np.allclose(seen[:, c], command[:, 0, 0], atol=1e-6)]
    assert len(column) == 1


def test_a_session_that_is_put_back_does_the_same_again(agent: PolicyAgent) -> None:
    """Bit for bit, and another kick does something else; also where the agent must play it all again."""
    nothing = np.zeros((2, 1))
    task = agent.task
    plain = PolicyAgent("stands", task, lambda observation: torch.zeros(len(observation), 12))
    session = stage(plain).session(Plan(np.zeros((20, 2, 3)), impulses=Impulses(nothing, nothing, nothing, 0.05)))
    session.run(8)
    state = session.save()
    first = session.run(12)
    session.load(state, 8)
    assert np.array_equal(session.run(12).velocity, first.velocity)
    session.load(state, 8)
    session.use(Impulses(nothing + 0.2, nothing + 5.0, nothing, 0.05))
    assert np.abs(session.run(12).velocity - first.velocity).max() > 0.2
    session.load(None, 8)
    session.use(Impulses(nothing, nothing, nothing, 0.05))
    assert np.array_equal(session.run(12).velocity, first.velocity)


def test_a_kick_moves_a_robot_by_its_momentum(stage: Stage) -> None:
    """In the air, before it touches: m dv is the impulse, whatever the legs do."""
    kick = Impulses(np.zeros((1, 1)), np.full((1, 1), 6.4), np.full((1, 1), np.pi / 2), 0.02)
    session = stage.session(Plan(np.zeros((1, 1, 3)), impulses=kick))
    session.core.backend.qpos[:, 2] += 1.0
    session.run(1)
    model = session.core.backend.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = session.core.backend.qpos[0].numpy(), session.core.backend.qvel[0].numpy()
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    mass = float(model.body_subtreemass[1])
    np.testing.assert_allclose(mass * data.subtree_linvel[1, :2], [0.0, 6.4], atol=0.01)


@pytest.mark.parametrize(("rate", "step"), [(25, 0.002), (100 / 3, 0.002), (200, 0.005 / 3), (400, 0.00125)])
def test_the_physics_step_fits_the_rate(rate: float, step: float) -> None:
    assert fitting_step(1.0 / rate, 0.002) == pytest.approx(step)


def test_an_agent_that_cannot_be_put_back_plays_it_all_again(agent: PolicyAgent) -> None:
    """The filter of an estimated velocity cannot: the map is that of kicks on the same walk all the same."""
    one = play(small("push_map", "trunk_velocity=estimated", "watch_s=0.5"), agent, Rates(seed=1))
    assert [row["impulse"] is not None for row in one.played.rows] == [not row["fell"] for row in one.played.rows]


# ---------------------------------------------------------------------- searches and answers


def test_bisection_finds_known_thresholds() -> None:
    known = np.array([0.0, 0.1, 7.3, 30.0, 59.9, 75.0])
    tries = []

    def survives(impulse: np.ndarray) -> np.ndarray:
        tries.append(impulse)
        return impulse <= known

    found = largest_survived(survives, len(known), 60.0, 8)
    assert len(tries) == 9
    np.testing.assert_allclose(found[:-1], known[:-1], atol=60.0 / 2**8)
    assert (found <= np.minimum(known, 60.0)).all()
    assert found[-1] == 60.0


def test_the_answer_to_a_step_is_that_of_a_first_order_lag() -> None:
    dt, lag = 0.02, 0.3
    t = np.arange(300) * dt
    along = np.where(t >= 1.0, 0.8 * (1.0 - np.exp(-(t - 1.0) / lag)), 0.0)
    answer = step_answer(along, 50, 200, dt)
    assert answer["answer"] == pytest.approx(0.8, abs=1e-3)
    assert answer["rise_s"] == pytest.approx(lag * math.log(10.0), abs=2 * dt)
    assert answer["overshoot"] == pytest.approx(0.0, abs=1e-3)


def test_a_robot_comes_back_when_it_does(agent: PolicyAgent) -> None:
    kicks: Any = small("kicks", "recovery={height:0.015,speed:0.15,hold_s:0.5,smooth_s:0.0}").protocol
    dt = 0.02
    t = np.arange(400) * dt
    height = 0.3 - 0.1 * ((t >= 4.0) & (t < 4.7))
    velocity = np.zeros((400, 2))
    rest = slice(100, 200)
    assert kicks.back(height, velocity, 200, rest, dt) == pytest.approx(0.7, abs=dt)
    assert kicks.back(np.where(t >= 4.0, 0.2, 0.3), velocity, 200, rest, dt) is None
    assert kicks.back(height * 0 + 0.3, velocity, 200, rest, dt) == 0.0


# ---------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ("sinusoid protocol.sinusoid.measures=[strid_rate]", "protocol.sinusoid.measures.strid_rate: unknown measure"),
        ("kicks protocol.kicks.claims.first_kick.quantity=survivd", "did you mean 'survived'"),
        ("kicks protocol.kicks.robots=0", "protocol.kicks.robots = 0"),
        ("kicks +protocol.kicks.robot=4", "protocol.kicks.robot"),
        ("sinusoid protocol.sinusoid.seconds=5.0", "must be at least two periods"),
        ("rate protocol.rate.slower_faster=[50.0,75.0]", "rates_hz has no 75"),
        ("corners protocol.corners.settle_s=9.0", "settle_s = 9.0: must lie between"),
        ("terrain protocol.terrain.grounds.waves=[0.2,0.1]", "grounds.waves = [0.2, 0.1]: must rise"),
        ("kicks protocol.kicks.impulses=[5.0,6.0,5.0]", "protocol.kicks.impulses: has 5.0 twice"),
        ("rate protocol.rate.delays_ms=[5.0,5.0]", "protocol.rate.delays_ms: has 5.0 twice"),
        (
            "gait protocol.gait.commands=[[1.0,0.0,0.0],[1.0,0.0,0.0]]",
            "protocol.gait.commands: has (1.0, 0.0, 0.0) twice",
        ),
        ("hardware protocol.hardware.delays_ms=[20.0,10.0]", "delays_ms = [20.0, 10.0]: must rise"),
        ("hardware protocol.hardware.settle_s=9.0", "settle_s = 9.0: must lie between"),
        ("kicks +protocol.nothing={}", "protocol.nothing: unknown protocol 'nothing'"),
        ("kicks protocol.kicks.impulses=[6.4,1e300]", "protocol.kicks.impulses.1 = 1e+300: must be from 0 to 500 N s"),
        ("kicks protocol.kicks.point=[0.0,0.0,-1e300]", "protocol.kicks.point.2 = -1e+300: must be from -0.5 to 0.5 m"),
        ("push_map protocol.push_map.largest=1e300", "protocol.push_map.largest = 1e+300: must be from 0 to 500 N s"),
        (
            "terrain protocol.terrain.speeds=[1e30]",
            "protocol.terrain.speeds.0 = 1e+30: must be from -100 to 100 (m/s or rad/s)",
        ),
        (
            "gait protocol.gait.commands=[[0.0,1e30,0.0]]",
            "protocol.gait.commands.0.1 = 1e+30: must be from -100 to 100",
        ),
        (
            "terrain protocol.terrain.grounds.stairs_up=[10,15]",
            "grounds.stairs_up = [10.0, 15.0]: must rise, to at most 2 m",
        ),
        ("terrain protocol.terrain.grounds.slope_up=[10,95]", "must rise, to at most 60 deg"),
        ("recover protocol.recover.stand.height=22", "protocol.recover.stand.height = 22: must be from 0 to 1 m"),
        ("robogauge protocol.robogauge.grounds.waves.levels=[1,2,3,4,5,6,7,8,9,10,11]", "at most 10 items"),
        ("recover protocol.recover.stand.tilt=4.0", "protocol.recover.stand.tilt = 4.0"),
        ("recover protocol.recover.push.impulse=1e300", "must be from 0 to 500 N s"),
        ("recover protocol.recover.hold=[-1.0,1.0]", "protocol.recover.hold.0 = -1.0"),
        ("recover protocol.recover.settle_s=0.0", "protocol.recover.settle_s = 0.0"),
        ("robogauge protocol.robogauge.frictions=[0.5,0.5]", "protocol.robogauge.frictions: has 0.5 twice"),
        ("robogauge protocol.robogauge.grounds.waves.levels=[0.2,0.1]", "grounds.waves.levels = [0.2, 0.1]: must rise"),
        ("robogauge protocol.robogauge.pass_share=1.5", "protocol.robogauge.pass_share = 1.5"),
        ("robogauge +protocol.robogauge.grounds.flat=null", "grounds.flat: has no levels and is always played"),
    ],
)
def test_a_wrong_protocol_is_refused_in_words(overrides: str, said: str) -> None:
    name, *rest = overrides.split(" ")
    with pytest.raises(ConfigError, match=re.escape(said)):
        chosen(compose("eval", [f"protocol={name}", *rest])["protocol"])


def test_a_policy_that_does_not_see_the_velocity_is_refused(agent: PolicyAgent) -> None:
    without = tuple(t for t in agent.task.observation if t.entry.name != "base_linear_velocity")
    blind = PolicyAgent("blind", dataclasses.replace(agent.task, observation=without), agent.policy)
    with pytest.raises(ConfigError, match=r"protocol.rate.velocities = 'estimated': the policy of blind"):
        refuse([small("rate")], blind)
    refuse([small("kicks")], blind)


def test_paper_is_all_of_the_papers() -> None:
    found, grid = chosen(compose("eval", ["protocol=paper"])["protocol"])
    assert [c.key for c in found] == ["sinusoid", "kicks", "terrain", "rate"]
    terrain: Any = found[2].protocol
    assert list(terrain.ladders) == ["slope_up", "slope_down", "gravel"]
    assert not grid
    assert chosen(compose("eval", [])["protocol"]) == ([], True)


def test_the_mpc_is_put_back_to_an_instant(make_task: Callable[..., TaskConfig]) -> None:
    """It walks on as it did, bit for bit: a push map need not be walked again for every kick."""
    pytest.importorskip("daqp")
    file = data_root() / "conf/controller/mpc.yaml"
    settings = parse_controller(yaml.safe_load(file.read_text()) | {"stand": 0.0})
    assert isinstance(settings, MpcSettings)
    agent = ControllerAgent("mpc", make_task("backend.threads=1", "rand=table1"), lambda: Mpc(settings))
    nothing, command = np.zeros((2, 1)), np.broadcast_to([0.5, 0.0, 0.0], (40, 2, 3))
    session = stage(agent).session(Plan(command, impulses=Impulses(nothing, nothing, nothing, 0.05)))
    session.run(20)
    state = session.save()
    assert state is not None
    first = session.run(20)
    session.load(state, 20)
    assert np.array_equal(session.run(20).velocity, first.velocity)
    assert stage(agent, trunk_velocity="estimated").session(Plan(command)).save() is None
