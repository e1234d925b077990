"""What does not fit into memory is refused before anything is played, by the key that asks for it."""

from __future__ import annotations

import importlib
import re
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from go1exp.base import memory
from go1exp.cli.app import begin
from go1exp.cli.play import APP as PLAY
from go1exp.cli.record import APP as RECORD
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError, TooLongError, members
from go1exp.evaluate import video
from go1exp.evaluate.agents import PolicyAgent
from go1exp.evaluate.protocol.base import chosen
from go1exp.evaluate.protocol.plan import STEP_BYTES, Plan
from go1exp.evaluate.protocol.playing import refuse
from go1exp.evaluate.protocol.stage import Setting, Stage
from go1exp.evaluate.report import evaluating
from go1exp.logs.record.plan import ROW_BYTES
from go1exp.sim.task import TaskConfig, parse_train
from tests.test_protocols import selected

# ---------------------------------------------------------------------- go1exp play


def test_a_gif_that_does_not_fit_is_refused_by_its_key_and_a_film_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a GIF every picture is kept until it is written; of a film none is."""
    monkeypatch.setattr(memory, "free", lambda: 25 * video.GIF_BYTES * 40)
    monkeypatch.setattr(video, "record", lambda *anything, **options: iter(()))
    clip = ["policy=clock", "viewer=clip", "seconds=50", "fps=25"]
    with pytest.raises(ConfigError, match=r"^seconds = 50: a GIF .* 40 s at most would fit; an \.mp4 of any length"):
        PLAY.task(begin("play", compose("play", [*clip, f"out={tmp_path / 'clip.gif'}"])))
    with pytest.raises(ValueError, match="at least one frame"):  # none came, and the length was not in the way
        PLAY.task(begin("play", compose("play", [*clip, f"out={tmp_path / 'clip.mp4'}"])))


# ---------------------------------------------------------------------- go1exp record


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (("repeats=1000",), "repeats = 1000: 1003 recordings of 20 s: it takes at least .*; 7 at most would fit"),
        (("gains=[[20,0.5],[35,0.6]]", "repeats=9"), "repeats = 9: 24 recordings of 20 s: .*; 2 at most would fit"),
        (("seconds=1e9",), "seconds = 1e\\+09: with 3 recordings it takes .*; 66 s at most would fit"),
        (("seconds=100", "repeats=2"), "seconds = 100: with 5 recordings .*; 40 s at most would fit"),
        (("seconds=1e308",), "seconds = 1e\\+308: with 3 recordings it takes at least inf GB, .*; 66 s at most would"),
        (("excitation=[policy]", "policy=clock", "episodes=11"), "episodes = 11: 11 .*; 10 at most would fit"),
        (("excitation=[policy]", "policy=clock", "seconds=201"), "seconds = 201: with 4 recordings .*; 50 s at most"),
    ],
)
def test_recordings_that_do_not_fit_are_refused_by_the_key_that_asks_for_so_many(
    overrides: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(memory, "free", lambda: 200 * 500 * ROW_BYTES)  # 200 s at 500 Hz, in all recordings together
    with pytest.raises(ConfigError, match="^" + said):
        RECORD.task(begin("record", compose("record", list(overrides))))
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------- protocols

FREE = 8_000_000_000
"""Memory that the tests pretend to have, B."""


@pytest.fixture
def stage(make_task: Callable[..., TaskConfig]) -> Stage:
    """Robots that stand, at 50 Hz."""
    task = make_task("backend.threads=1", "sim.physics_dt=0.005", "sim.policy_dt=0.02")
    agent = PolicyAgent("stand", task, lambda observation: torch.zeros(len(observation), 12))
    return Stage(agent, Setting(noise=False, randomize=False, trunk_velocity="exact", seed=0))


@pytest.mark.parametrize(
    ("name", "key", "value", "unit"),
    [
        ("corners", "seconds", "{}", " s at most"),
        ("energy", "seconds", "{}", " s at most"),
        ("gait", "seconds", "{}", " s at most"),
        ("hardware", "seconds", "{}", " s at most"),
        ("sinusoid", "seconds", "{}", " s at most"),
        ("rate", "seconds", "{}", " s at most"),
        ("kicks", "first_s", "{}", " s at most"),
        ("kicks", "every_s", "{}", " s at most"),
        ("kicks", "jitter_s", "{}", " s at most"),
        ("push_map", "settle_s", "{}", " s at most"),
        ("push_map", "watch_s", "{}", " s at most"),
        ("terrain", "slack", "{}", " at most"),
        ("terrain", "speeds", "[1.0,{}]", " m/s at least"),
        ("terrain", "robots", "{}", " at most"),
        ("kicks", "robots", "{}", " at most"),
        ("rate", "robots", "{}", " at most"),
    ],
)
def test_a_protocol_that_does_not_fit_is_refused_by_its_key_with_what_fits(
    name: str, key: str, value: str, unit: str, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is offered fits; a twentieth beyond it does not."""
    monkeypatch.setattr(memory, "free", lambda: FREE)
    whole, falling = key == "robots", key == "speeds"
    wrong = "1000000000" if whole else "1e-9" if falling else "1e9"
    with pytest.raises(TooLongError) as caught:
        refuse(selected(name, f"{key}={value.format(wrong)}"), stage)
    (problem,) = caught.value.problems
    offered = re.fullmatch(
        rf"protocol\.{name}\.{key} = \S+: to play \S+ s with \d+ robots takes at least \S+ GB,"
        rf" and 8\.0 GB are free in memory; (\S+){unit} would fit",
        problem,
    )
    assert offered, problem
    number = float(offered[1])
    beyond = number * (0.95 if falling else 1.05)
    given = (str(round(number)), str(round(beyond) + 1)) if whole else (f"{number!r}", f"{beyond!r}")
    refuse(selected(name, f"{key}={value.format(given[0])}"), stage)
    with pytest.raises(TooLongError, match=rf"protocol\.{name}\."):  # by another key where that can mend it as well
        refuse(selected(name, f"{key}={value.format(given[1])}"), stage)


def test_where_no_setting_alone_can_mend_it_all_are_named(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free", lambda: FREE)
    words = (
        r"protocol\.kicks: first_s = 1e\+09, every_s = 1e\+09, jitter_s = 0\.4, robots = 200: .* s at most would fit"
    )
    with pytest.raises(TooLongError, match=words):
        refuse(selected("kicks", "first_s=1e9", "every_s=1e9"), stage)
    monkeypatch.setattr(memory, "free", lambda: None)
    refuse(selected("kicks", "first_s=1e9"), stage)


@pytest.mark.parametrize("measures", ["[]", "[stride_rate]"])
@pytest.mark.parametrize("name", list(members("protocol")))
def test_a_protocol_plays_the_lengths_that_it_says(
    name: str, measures: str, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else what is refused would be another protocol than what is played."""

    class Seen(Exception):
        pass

    plans: list[Plan] = []

    def seen(self: Stage, plan: Plan) -> None:
        plans.append(plan)
        raise Seen

    monkeypatch.setattr(Stage, "session", seen)
    protocol = selected(name, f"measures={measures}").protocol
    with pytest.raises(Seen):
        protocol.play(stage)
    length, (plan,) = protocol.lengths()[0], plans
    assert plan.robots == length.robots
    assert len(plan.command) == stage.steps(length.seconds, length.policy_dt)
    assert plan.policy_dt == length.policy_dt
    if name != "push_map":  # which records none
        assert (plan.listen_from is not None) == length.recorded
    if plan.listen_from is not None:
        assert plan.listen_from == stage.steps(length.settle_s, length.policy_dt)


def test_a_step_takes_what_a_plan_and_its_motion_are_made_of(stage: Stage) -> None:
    plan = Plan(np.zeros((3, 2, 3)))
    motion = stage.run(plan)
    arrays = [v for v in vars(motion).values() if isinstance(v, np.ndarray) and v.shape[:2] == (3, 2)]
    assert sum(v.nbytes for v in [plan.command, *arrays]) == 3 * 2 * STEP_BYTES


@pytest.mark.parametrize("value", ["-1.0", "0.0", ".nan", ".inf", "-.inf"])
@pytest.mark.parametrize(
    ("name", "key"),
    [
        *((name, "seconds") for name in ("corners", "energy", "gait", "hardware", "sinusoid", "rate")),
        *(("kicks", key) for key in ("first_s", "every_s", "push_s")),
        *(("push_map", key) for key in ("settle_s", "watch_s", "push_s")),
        *(("recover", key) for key in ("settle_s", "seconds")),
        *(("robogauge", key) for key in ("move_s", "pair_s")),
        ("terrain", "slack"),
    ],
)
def test_a_duration_that_is_none_is_refused_by_its_key(name: str, key: str, value: str) -> None:
    number = float(value.replace(".nan", "nan").replace(".inf", "inf"))
    given = {**compose("eval", [f"protocol={name}"])["protocol"][name], key: number}
    with pytest.raises(ConfigError, match=rf"^protocol\.{name}.*{key}\b"):
        chosen({name: given})


def test_a_report_asks_no_run_for_what_does_not_fit(
    make_task: Callable[..., TaskConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is the call's settings that are wrong, so that it ends; what is wrong with a run is a remark."""

    def too_long(*anything: Any) -> None:
        raise TooLongError(["seconds = 1e+09: too much"])

    monkeypatch.setattr(evaluating, "evaluate_run", too_long)
    monkeypatch.setattr(evaluating, "play_protocol", too_long)
    run: Any = types.SimpleNamespace(folder=Path("run"), label="run")
    show = lambda number, count, label: lambda done, total: None  # noqa: E731
    settings: Any = None
    with pytest.raises(TooLongError, match=r"^evaluation\.seconds = "):
        evaluating.evaluate_missing([(run, None)], settings, show)
    with pytest.raises(TooLongError, match=r"^seconds = "):
        evaluating.evaluate_missing([(run, selected("gait"))], settings, show)


# ---------------------------------------------------------------------- too short, or without end


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("gait", ("seconds=0.001", "settle_s=0.0")),
        ("energy", ("seconds=0.4", "settle_s=0.399")),
        ("hardware", ("seconds=0.4", "settle_s=0.399")),
        ("rate", ("seconds=0.02", "settle_s=0.019")),
    ],
)
def test_a_protocol_without_a_step_that_counts_is_refused(name: str, overrides: tuple[str, ...], stage: Stage) -> None:
    words = rf"^protocol\.{name}\.seconds = 0\.\d+: of these 0\.\d+ s no step of the policy \(0\.0\d s\) is left"
    with pytest.raises(ConfigError, match=words):
        refuse(selected(name, *overrides), stage)


@pytest.mark.parametrize(("name", "rest"), [("kicks", "every_s"), ("push_map", "watch_s")])
def test_a_push_that_outlasts_its_time_is_refused(name: str, rest: str) -> None:
    """Its steps would not fit into memory, and the next kick would begin within it."""
    with pytest.raises(ConfigError, match=rf"^protocol\.{name}\.push_s = 1000000000\.0: must be at most {rest} = "):
        selected(name, "push_s=1e9")


def test_a_length_beyond_all_numbers_is_refused_too(stage: Stage) -> None:
    with pytest.raises(TooLongError, match="takes at least inf GB"):
        refuse(selected("kicks", "first_s=1e308", "every_s=1e308"), stage)


@pytest.mark.parametrize(
    ("verb", "overrides", "words"),
    [
        ("eval", ("policy=clock", "seconds=1e308"), "seconds = 1e+308: input should be less than or equal to"),
        ("eval", ("policy=clock", "seconds=0.4", "settle_s=0.399"), "seconds = 0.4: no step of the policy (0.02"),
        ("play", ("policy=clock", "viewer=clip", "seconds=1e308"), "seconds = 1e+308: input should be less than or eq"),
        ("play", ("policy=clock", "viewer=clip", "seconds=0.001"), "seconds = 0.001: shorter than a picture at fps ="),
        ("record", ("seconds=0.0001",), "seconds = 0.0001: shorter than a sample of the motion at"),
    ],
)
def test_a_time_without_an_end_or_without_a_step_is_refused(
    verb: str, overrides: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    app = importlib.import_module(f"go1exp.cli.{'evaluate' if verb == 'eval' else verb}").APP
    with pytest.raises(ConfigError) as caught:
        app.task(begin(verb, compose(verb, list(overrides))))
    assert caught.value.problems[0].startswith(words)


@pytest.mark.parametrize(
    ("key", "value", "bound"),
    [
        ("sim.episode_s", 1e308, "less than or equal to 1000000000"),
        ("sim.episode_s", 1e300, "less than or equal to 1000000000"),
        ("sim.physics_dt", 1e-12, "greater than or equal to 0.00001"),
        ("terrain.tile_size", 1e300, "less than or equal to 10000"),
        ("terrain.border", 1e300, "less than or equal to 10000"),
        ("terrain.resolution", 1e-300, "greater than or equal to 0.001"),
        ("terrain.rows", 10**30, "less than or equal to 1000000000"),
        ("backend.threads", 10**6, "less than or equal to 1024"),
        ("ppo.iterations", 10**30, "less than or equal to 1000000000"),
        ("ppo.coarse_physics", 10**14, "less than or equal to 10000"),
        ("eval.seconds", 1e300, "less than or equal to 1000000000"),
    ],
)
def test_a_setting_beyond_all_measure_is_refused_by_its_key(key: str, value: float, bound: str) -> None:
    with pytest.raises(ConfigError, match=rf"^{re.escape(f'{key} = {value}')}: input should be {bound}$"):
        parse_train(compose("train", ["terrain=rough", f"{key}={value}"]))


def test_robots_of_an_evaluation_that_do_not_fit_are_refused_with_or_without_measures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(memory, "free", lambda: FREE)
    given = compose("eval", ["policy=clock", "episodes=1000000", "measures=[]"])
    with pytest.raises(ConfigError, match=r"^episodes = 1000000: with 12000000 robots it takes .* at most would fit$"):
        importlib.import_module("go1exp.cli.evaluate").APP.task(begin("eval", given))
