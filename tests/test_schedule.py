"""Settings that change while a policy is trained."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from go1exp import robot
from go1exp.cli import helptext
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.task import parse_train
from go1exp.train import checkpoint, preflight, trainer
from go1exp.train.schedule import Schedule
from tests import test_resume
from tests.test_resume import SIX, assert_the_same_run, rows, train

FLAT = (*test_resume.FLAT, "reward=paper_literal", "schedule=none", "actuator=pd", "contact=soft", "command=paper")

STEPS = 64
"""Of all robots together in an iteration of ``FLAT``."""

WEIGHT = "set: reward.gait.weight, from: 1.0, to: 3.0"


STIFF = "set: contact.time_constant, from: 0.02, to: 0.005"


def ramp(text: str, key: str = "x") -> str:
    return f"+schedule.{key}={{{text}}}"


def train_config(*overrides: str) -> Any:
    ours = [o for o in FLAT if "backend=warp" not in overrides or not o.startswith("backend.")]
    return parse_train(compose("train", (*ours, *overrides)))


def problems(*overrides: str) -> list[str]:
    with pytest.raises(ConfigError) as refused:
        preflight.check(train_config(*overrides))
    return refused.value.problems


def built(*overrides: str) -> tuple[Any, Schedule]:
    ppo = trainer.build(train_config(*overrides))
    return ppo.get_env().core, ppo.schedule  # type: ignore[union-attr]


def stepped(core: Any, times: int = 6) -> torch.Tensor:
    """The last reward of robots that do the same in every environment."""
    core.reset()
    rng = np.random.default_rng(0)
    for _ in range(times):
        action = torch.from_numpy(rng.normal(0.0, 1.0, (8, robot.NUM_JOINTS)).astype(np.float32))
        result = core.step(action)
    reward: torch.Tensor = result.reward
    return reward.clone()


def test_a_ramp_is_the_line_between_its_ends_in_steps_of_all_robots(tmp_path: Path) -> None:
    delay = "set: actuator.command, from: [0.0, 0.0], to: [0.0, 0.02], over: 0, start: 200"
    train(tmp_path, [*FLAT, SIX, "actuator=delay", ramp(f"{WEIGHT}, start: 96, over: 128"), ramp(delay, "d")])
    log = rows(tmp_path / "metrics.csv")
    # Iterations begin after 0, 64, 128, ... steps: 1 + 2 (128 - 96) / 128 = 1.5 in the third.
    assert [float(row["schedule/x"]) for row in log] == [1.0, 1.0, 1.5, 2.5, 3.0, 3.0]
    assert [float(row["schedule/d_high"]) for row in log] == [0.0, 0.0, 0.0, 0.0, 0.02, 0.02]
    assert [float(row["schedule/d_low"]) for row in log] == [0.0] * 6


def test_a_ramp_without_an_end_leads_to_the_configured_value() -> None:
    delay = "set: actuator.command, from: [0.0, 0.0], over: 100"
    contact = "set: contact.time_constant, from: 0.02, over: 100"
    ramps = [ramp("set: reward.gait.weight, from: 1.0, over: 100"), ramp(delay, "d"), ramp(contact, "c")]
    settings = ["reward.gait.weight=7.0", "actuator=delay", "actuator.command=[0.01,0.02]", "contact=stiff"]
    schedule = train_config(*settings, *ramps).schedule
    assert {key: of_key.last for key, of_key in schedule.items()} == {"x": 7.0, "d": (0.01, 0.02), "c": 0.005}


def test_an_optional_ramp_is_left_out_of_a_task_without_its_setting() -> None:
    delay, slow = "set: actuator.command, from: [0.0, 0.0]", "set: command.slow_fraction, from: 0.0"
    ramps = [ramp(f"{text}, over: 100, optional: true", key) for key, text in (("d", delay), ("s", slow))]
    assert set(train_config("actuator=delay", "command=widening", *ramps).schedule) == {"d", "s"}
    assert set(train_config("actuator=pd", "command=paper", *ramps).schedule) == set()


@pytest.mark.parametrize(
    "times",
    [
        "start: 2, over: 4, unit: iterations",
        "start: 0.2, over: 0.4, unit: share",
        "when: {measure: gait/trot_error, below: 0.1, iterations: 1}, over: 4, unit: iterations",
    ],
)
def test_a_ramp_may_count_iterations_or_shares_of_the_training(times: str) -> None:
    _, schedule = built(ramp(f"{WEIGHT}, {times}"), "ppo.iterations=10")
    values = []
    for iteration in range(8):
        schedule.advance(iteration * STEPS, {"gait/trot_error": 0.3 if iteration < 2 else 0.1})
        values.append(schedule.metrics()["schedule/x"])
    assert values == [1.0, 1.0, 1.0, 1.5, 2.0, 2.5, 3.0, 3.0]


@pytest.mark.parametrize(
    ("path", "value", "overrides"),
    [
        ("reward.gait.weight", 3.0, ()),
        ("reward.touchdown_speed.weight", -20.0, ("+reward.touchdown_speed={weight: 0.0}",)),
        ("reward.linear_velocity_error.scale", 0.25, ()),
        ("reward.gait.full_cycle", 0.2, ("reward=paper",)),
        ("actuator.command", [0.02, 0.02], ("actuator=delay",)),
        ("contact.time_constant", 0.005, ()),
        ("command.slow_fraction", 0.9, ("command=widening",)),
        ("command.zero_fraction", 0.9, ("command=widening",)),
        ("command.lin_vel_x", [1.0, 2.0], ("command=widening",)),
        ("command.ang_vel_z", [1.0, 1.2], ("command=widening",)),
    ],
)
def test_a_setting_that_was_changed_acts_as_if_it_had_been_configured(
    path: str, value: float | list[float], overrides: tuple[str, ...]
) -> None:
    jump = f"set: {path}, from: {value}, to: {value}, over: 0"
    changed, plain = (built(*overrides, *more)[0] for more in ([ramp(jump)], []))
    configured, _ = built(*overrides, f"{path}={value}")
    reward = stepped(changed)
    torch.testing.assert_close(reward, stepped(configured), rtol=1e-5, atol=1e-6)
    assert not torch.allclose(reward, stepped(plain), rtol=1e-4)


def test_values_are_written_in_place_where_a_captured_step_reads_them() -> None:
    texts = {
        "w": "set: reward.gait.weight, from: 1, to: 3",
        "p": "set: reward.gait.scale, from: 0.1, to: 0.3",
        "d": "set: actuator.command, from: [0.0, 0.0], to: [0.01, 0.02]",
        "c": "set: contact.time_constant, from: 0.02, to: 0.005",
    }
    core, schedule = built("actuator=delay", *(ramp(f"{text}, over: 100", key) for key, text in texts.items()))
    gait = next(t for t in core.terms.rewards if t.key == "gait")
    feet = core.backend.ids("geom", tuple(f"{leg}_foot" for leg in robot.LEGS))

    def live() -> list[torch.Tensor]:
        scale, delays = gait.parameters["scale"], core.plant.actuator._range
        return [core.terms.weights, scale, delays, core.backend.field("geom_solref")]

    places = [tensor.data_ptr() for tensor in live()]
    schedule.advance(50, {})
    weights, scale, delays, contact = live()
    assert weights[core.terms.rewards.index(gait)] == pytest.approx(2.0 * 0.02)
    assert scale == pytest.approx(0.2)
    assert delays.tolist() == pytest.approx([0.005, 0.01])
    assert contact[:, feet, 0].unique().item() == pytest.approx(0.0125)
    core.reset()
    assert (core.plant.actuator.delay >= 0.005).all()
    assert (core.plant.actuator.delay <= 0.01).all()
    assert [tensor.data_ptr() for tensor in live()] == places


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_captured_step_sees_what_was_changed() -> None:
    stiff, late = (
        "set: contact.time_constant, from: 0.02, to: 0.005",
        "set: actuator.command, from: [0, 0], to: [0.01, 0.02]",
    )
    fast = "set: reward.joint_velocity.weight, from: 0, to: -100"
    texts = (f"{stiff}, over: 0, start: 1", f"{late}, over: 0, start: 1", f"{fast}, over: 0, start: 1")
    more = ("backend=warp", "actuator=delay", "rand=none", "~event.push", "sim.episode_s=20")
    core, schedule = built(*more, *(ramp(text, f"k{i}") for i, text in enumerate(texts)))
    still = torch.zeros(8, robot.NUM_JOINTS, device=core.device)

    def standing() -> tuple[torch.Tensor, torch.Tensor]:
        core.reset()
        for _ in range(50):
            result = core.step(still)
        return result.reward.clone(), core.snapshot().foot_height.mean()

    assert core.captures
    reward, soft = standing()
    schedule.advance(1, {})
    priced, hard = standing()
    assert hard - soft > 0.0002  # MuJoCo's own contact sinks by 1 mm, m
    assert (priced < reward).all()
    assert (core.plant.actuator.delay >= 0.01 - 1e-6).all()


def test_a_metric_starts_a_ramp_when_its_mean_reaches_the_threshold() -> None:
    when = "when: {measure: gait/trot_error, below: 0.1, iterations: 2}"
    _, schedule = built(ramp(f"{WEIGHT}, over: 100, {when}"))
    seen = []
    for steps, error in ((50, 0.3), (100, 0.08), (150, float("nan")), (200, 0.1), (250, 0.5), (300, 0.5)):
        schedule.advance(steps, {"gait/trot_error": error})
        seen.append(schedule.metrics()["schedule/x"])
    assert seen == [1.0, 1.0, 1.0, 1.0, 2.0, 3.0]  # 0.09 is the mean after 200 steps, where the ramp starts
    with pytest.raises(ConfigError, match="unknown metric 'gait/trot_error'"):
        built(ramp(f"{WEIGHT}, over: 100, {when}"))[1].advance(50, {"gait/duty_mean": 0.5})


def test_a_ramp_may_wait_for_two_metrics_at_once() -> None:
    also = "also: {measure: tracking/rmse_x, below: 0.5, iterations: 1}"
    _, schedule = built(ramp(f"{WEIGHT}, over: 0, when: {{measure: rollout/return, above: 1, iterations: 2, {also}}}"))
    seen = []
    both = ((2, 0.4), (2, 0.6), (math.nan, 0.4), (0, 0.4), (2, math.nan), (2, 0.4), (0, 0.9))
    for steps, (value, error) in enumerate(both):
        schedule.advance(steps, {"rollout/return": value, "tracking/rmse_x": error})
        seen.append(schedule.metrics()["schedule/x"])
    assert seen == [1.0, 1.0, 1.0, 3.0, 3.0, 3.0, 3.0]  # the mean of 2 and 0 is 1; what is not measured is not there
    (said,) = problems(
        ramp(f"{WEIGHT}, over: 0, when: {{measure: rollout/return, above: 1, also: {{measure: rmse, below: 1}}}}")
    )
    assert said.startswith("schedule.x.when.also.measure: unknown metric 'rmse'")


def test_a_training_says_when_its_schedule_begins_and_that_it_never_began(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    soon = "when: {measure: rollout/length, above: 0, iterations: 2}"
    never = "when: {measure: train/std, below: 0.001, iterations: 1, also: {measure: rollout/length, above: 0}}"
    train(tmp_path, [*FLAT, SIX, ramp(f"{WEIGHT}, over: 1, {soon}"), ramp(f"{STIFF}, over: 1, {never}", "y")])
    said = [line for line in capsys.readouterr().err.splitlines() if "ramps" in line]
    assert said[0] == "iteration 2: these ramps begin: x"
    never_begun = "these ramps have not begun: y (waiting for train/std <= 0.001"
    for line, iteration in zip(said[1:], (3, 6), strict=True):
        row = rows(tmp_path / "metrics.csv")[iteration - 1]
        assert line.startswith(f"warning: iteration {iteration}/6: {never_begun}")
        assert f"(now {float(row['train/std']):.3g}) and rollout/length >= 0.0 (now " in line


@pytest.mark.parametrize(
    ("rows", "left"), [(("gait",), ("linear_velocity_error",)), (("gait", "linear_velocity_error"), ())]
)
def test_a_ramp_does_not_wait_for_a_reward_that_was_taken_away(rows: tuple[str, ...], left: tuple[str, ...]) -> None:
    config = parse_train(compose("train", [f"reward.{row}.weight=0" for row in rows]))
    preflight.check(config)
    smooth = config.schedule["smooth"]
    assert tuple(t.measure for t in (smooth.when.all() if smooth.when else ())) == tuple(
        f"reward/{row}" for row in left
    )


def test_a_run_that_was_stopped_continues_its_schedule_to_the_bit(tmp_path: Path) -> None:
    settings = [
        *(*FLAT, "actuator=delay", "+reward.touchdown_speed={weight: 0.0}"),
        ramp("set: reward.touchdown_speed.weight, from: 0.0, to: -20.0, start: 64, over: 256", "soft"),
        ramp("set: reward.gait.scale, from: 0.1, to: 0.2, start: 0, over: 384", "wide"),
        ramp("set: actuator.command, from: [0.0, 0.0], to: [0.0, 0.02], start: 0, over: 384", "late"),
        ramp("set: contact.time_constant, from: 0.02, to: 0.005, start: 64, over: 256", "stiff"),
        ramp("set: reward.gait.weight, from: 1, to: 10, over: 128, when: {measure: task/fall_share, above: 0.0, "
             "iterations: 3, also: {measure: rollout/length, above: 0.0, iterations: 2}}", "when"),
    ]  # fmt: skip
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(whole, [*settings, SIX])
    train(parts, [*settings, "ppo.iterations=3"])
    train(parts, [*settings, SIX])
    assert_the_same_run(parts, whole)
    assert {float(row["schedule/when"]) for row in rows(whole / "metrics.csv")} >= {1.0, 5.5, 10.0}
    assert checkpoint.load_latest(whole)[0]["schedule"]["when"]["started"] is not None


def test_a_run_without_a_schedule_has_no_trace_of_one(tmp_path: Path) -> None:
    train(tmp_path, [*FLAT, "ppo.iterations=1"])
    assert "schedule" not in checkpoint.load_latest(tmp_path)[0]
    assert not [column for column in rows(tmp_path / "metrics.csv")[0] if column.startswith("schedule")]
    container = compose("train", FLAT)
    del container["schedule"]  # a run of an older version
    assert parse_train(container).schedule == {}


def test_every_metric_of_a_training_may_start_a_ramp(tmp_path: Path) -> None:
    train(tmp_path, [*FLAT, "ppo.iterations=1"])
    constant = {"train/clip_range", "train/clip_range_vf", "train/n_updates"}
    for name in set(rows(tmp_path / "metrics.csv")[0]) - {"iteration", "steps"} - constant:
        preflight.check(train_config(ramp(f"{WEIGHT}, over: 1, when: {{measure: {name}, below: 0}}")))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("set: reward.gaits.weight, from: 0, to: 1, over: 1", "unknown setting 'reward.gaits.weight'; did you mean 'r"),
        ("set: reward.gait.scales, from: 1, to: 2, over: 1", "did you mean 'reward.gait.scale'"),
        ("set: reward.gait.weight, from: 0, to: 1", "schedule.x.over: required"),
        ("set: reward.gait.weight, from: 0, to: 1, over: -1", "schedule.x.over = -1"),
        ("set: reward.gait.weight, from: 0, to: one, over: 1", "schedule.x.to = 'one'"),
        ("set: reward.gait.weight, from: 0, to: 1, over: 1, begin: 3", "unknown key 'begin'"),
        ("set: reward.gait.weight, from: 0, to: [0, 1], over: 1", "schedule.x.to = [0.0, 1.0]: must be one number"),
        ("set: reward.gait.weight, from: [0, 1], to: [0, 1], over: 1", "schedule.x.from = [0.0, 1.0]: must be one"),
        ("set: reward.gait.scale, from: 0, to: 1, over: 1", "schedule.x.from = 0.0: input should be greater than 0"),
        ("set: reward.gait.scale, from: [1, 2], to: [1, 2], over: 1", "schedule.x.from = [1.0, 2.0]: input should be"),
        ("set: contact.time_constant, from: 0.02, to: 0.5, over: 1", "schedule.x.to = 0.5: input should be less than"),
        ("set: actuator.command, from: [0, 0], to: [0, 0.01], over: 1", "needs actuator=delay"),
        ("set: command.slow_fraction, from: 0, over: 1", "needs a command.slow_fraction above 0"),
        ("set: command.lin_vel_x, from: [1, 0], over: 1", "schedule.x.from = [1.0, 0.0]: low must not exceed high"),
        ("set: command.lin_vel_x, from: 1, over: 1", "schedule.x.from = 1.0: input should be a valid array"),
        ("set: reward.gait.weight, from: 0, to: 1, over: 1, start: 1, when: {measure: rollout/return, above: 1}",
         "start has no meaning beside it"),
        ("set: reward.gait.weight, from: 0, to: 1, over: 1, when: {measure: rollout/return}", "one of below and above"),
        ("set: reward.gait.weight, from: 0, to: 1, over: 1, when: {measure: gait/trot, above: 1}",
         "schedule.x.when.measure: unknown metric 'gait/trot'; did you mean 'gait/trot_error'"),
        ("set: reward.gait.weight, from: 0, to: 1, over: 1, when: {measure: eval/score, above: 1}", "evaluation"),
    ],
)  # fmt: skip
def test_a_schedule_that_cannot_be_followed_is_refused(text: str, problem: str) -> None:
    said = problems(ramp(text))
    assert problem in said[0]
    assert all(line.startswith("schedule.x") for line in said)


def test_a_delay_stays_within_the_configured_one_and_a_setting_has_one_ramp() -> None:
    long = "set: actuator.command, from: [0, 0], to: [0, 0.03], over: 1"
    (said,) = problems("actuator=delay", "actuator.command=[0.0,0.02]", ramp(long))
    assert said == "schedule.x.to = [0.0, 0.03]: exceeds actuator.command = [0.0, 0.02], the longest"
    (said,) = problems(ramp(f"{WEIGHT}, over: 1"), ramp(f"{WEIGHT}, over: 1", "y"))
    assert said == "schedule.y.set = 'reward.gait.weight': is set by schedule.x too"


@pytest.mark.parametrize("other", ["+rand.ground_stiffness={}", "+effect.ground_compliance={time_constant: 0.01}"])
def test_only_one_of_two_sets_the_contact(other: str) -> None:
    (said,) = problems(ramp("set: contact.time_constant, from: 0.02, to: 0.01, over: 1"), other)
    assert f"{other[1:].split('=')[0]} sets the contact of each robot" in said


def test_help_explains_the_keys_of_a_ramp(capsys: pytest.CaptureFixture[str]) -> None:
    helptext.show("train", ["schedule", ramp(f"{WEIGHT}, over: 1")])
    shown = capsys.readouterr().out
    assert "schedule.NAME.when" in shown
    assert "schedule.x.set=reward.gait.weight" in shown
