"""Measures of gait and contact on patterns made by hand, whose answers are known in closed form."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from go1exp import robot
from go1exp.config.schema.registry import members
from go1exp.extend.testing.traces import random_trace, without
from go1exp.mdp.measures import every_measure, measured
from go1exp.mdp.measures.trace import NotMeasured, Trace, find_runs, largest_within, settled

DT, SAMPLES = 0.002, 10
WALK, STAND = (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)
FR, FL, RR, RL = range(4)

PATTERNS = {
    "trot": (0.0, 0.5, 0.5, 0.0),
    "pace": (0.0, 0.5, 0.0, 0.5),
    "bound": (0.0, 0.0, 0.5, 0.5),
    "pronk": (0.0, 0.0, 0.0, 0.0),
    "amble": (0.0, 0.5, 0.75, 0.25),
}


def pattern(
    phase: tuple[float, ...],
    rate: float = 2.5,
    duty: float = 0.5,
    seconds: float = 4.0,
    command: Any = WALK,
    **more: Any,
) -> Trace:
    """One robot whose feet land at ``phase`` cycles after FR, ``rate`` times a second."""
    t = np.arange(round(seconds / DT)) * DT
    turn = (rate * t[:, None] - np.array(phase) + 1e-9) % 1.0
    steps = len(t) // SAMPLES
    values = {"command": np.broadcast_to(np.array(command), (steps, 1, 3))}
    counts = np.ones((steps, 1), bool)
    return Trace(contact=(turn < duty)[:, None], contact_dt=DT, counts=counts, **{**values, **more})


def value(name: str, trace: Trace, **parameters: Any) -> np.ndarray:
    result: np.ndarray = members("measure")[name].target(trace, **parameters)
    return result[0]


def constant(trace: Trace, *values: float) -> np.ndarray:
    """The same values in every step of one robot."""
    return np.broadcast_to(np.array(values), (trace.steps, 1, len(values)))


# ---------------------------------------------------------------------- timing


@pytest.mark.parametrize("name", PATTERNS)
def test_a_gait_made_by_hand_has_its_phases_name_rate_and_duty(name: str) -> None:
    trace = pattern(PATTERNS[name], duty=0.4)
    np.testing.assert_allclose(value("touchdown_phase", trace), PATTERNS[name], atol=1e-9)
    np.testing.assert_allclose(value("phase_consistency", trace), 1.0)
    assert value("gait", trace) == name
    assert value("gait_clarity", trace) == pytest.approx(1.0)
    assert value("stride_rate", trace) == pytest.approx(2.5)
    np.testing.assert_allclose(value("duty_factor", trace), 0.4)


@pytest.mark.parametrize(
    ("name", "error"), [("trot", 0.0), ("pace", 0.5), ("bound", 0.5), ("pronk", 0.5), ("amble", 0.25)]
)
def test_the_error_to_a_trot_is_the_largest_of_the_three_offsets(name: str, error: float) -> None:
    assert value("trot_error", pattern(PATTERNS[name])) == pytest.approx(error, abs=1e-9)


def test_the_error_to_a_trot_goes_both_ways_around_the_circle() -> None:
    trace = pattern((0.0, 0.46, 0.57, 0.98), rate=2.0)
    np.testing.assert_allclose(value("touchdown_phase", trace), (0.0, 0.46, 0.57, 0.98), atol=2e-3)
    assert value("trot_error", trace) == pytest.approx(0.07, abs=3e-3)
    assert value("gait", trace) == "trot"
    assert 0.6 < value("gait_clarity", trace) < 0.9


def test_phases_just_before_and_after_fr_have_their_mean_at_fr() -> None:
    """RL lands 0.02 of a cycle before FR and after it in turn: the mean is 0, and not 0.5."""
    trace = pattern(PATTERNS["trot"], rate=2.0)
    contact = trace.contact.copy()
    for stride in range(0, 8):
        start = stride * 250 + (5 if stride % 2 else -5)
        contact[max(stride * 250 - 30, 0) : stride * 250 + 30, 0, RL] = False
        contact[max(start, 0) : start + 60, 0, RL] = True
    phase = value("touchdown_phase", dataclasses.replace(trace, contact=contact))[RL]
    assert min(phase, 1.0 - phase) < 0.01


def test_four_beats_are_a_walk_with_the_feet_on_the_ground_for_longer_and_an_amble_otherwise() -> None:
    for phase in ((0.0, 0.5, 0.75, 0.25), (0.0, 0.5, 0.25, 0.75)):
        assert value("gait", pattern(phase, duty=0.7)) == "walk"
        assert value("gait", pattern(phase, duty=0.4)) == "amble"


def test_the_hop_of_version_0_1_is_no_gait_with_a_name() -> None:
    """Its phases at 1 m/s: FL .11, RR .71, RL .05."""
    trace = pattern((0.0, 0.112, 0.712, 0.048), rate=4.0)
    assert value("gait", trace) == "none"
    assert value("trot_error", trace) == pytest.approx(0.388, abs=0.01)


def test_feet_that_land_at_any_phase_are_no_gait() -> None:
    trace = pattern(PATTERNS["trot"], seconds=10.0)
    drifting = pattern(PATTERNS["trot"], rate=2.9, seconds=10.0).contact
    contact = trace.contact.copy()
    contact[:, :, FL] = drifting[:, :, FL]
    trace = dataclasses.replace(trace, contact=contact)
    assert value("phase_consistency", trace)[FL] < 0.2
    assert value("gait", trace) == "none"


def test_trembling_at_25_hz_shows_in_the_stride_rate() -> None:
    trace = pattern(PATTERNS["trot"], rate=25.0)
    assert value("stride_rate", trace) == pytest.approx(25.0)
    assert value("gait", trace) == "trot"


def test_a_bounce_of_the_foot_is_no_stride() -> None:
    trace = pattern(PATTERNS["trot"])
    contact = trace.contact.copy()
    landed = np.flatnonzero(contact[1:, 0, FR] & ~contact[:-1, 0, FR]) + 1
    for k in landed:
        contact[k + 2 : k + 5, 0, FR] = False
        contact[k - 20 : k - 18, 0, FR] = True
    bouncing = dataclasses.replace(trace, contact=contact)
    assert value("stride_rate", bouncing) == pytest.approx(2.5)
    np.testing.assert_allclose(value("duty_factor", bouncing), 0.5, atol=1e-9)


@pytest.mark.parametrize(
    "name", [n for n in ("touchdown_phase", "trot_error", "stride_rate", "duty_factor", "flight_share")]
)
def test_a_robot_told_to_stand_has_no_gait_even_if_it_steps(name: str) -> None:
    assert np.isnan(value(name, pattern(PATTERNS["trot"], command=STAND))).all()


def test_a_robot_that_stands_though_it_is_told_to_walk_makes_no_strides() -> None:
    trace = pattern(PATTERNS["trot"], duty=1.1)
    assert np.isnan(value("stride_rate", trace))
    assert np.isnan(value("trot_error", trace))
    assert value("gait", trace) == ""
    np.testing.assert_array_equal(value("duty_factor", trace), 1.0)
    assert value("flight_share", trace) == 0.0


def test_no_stride_spans_a_time_in_which_the_robot_was_told_to_stand() -> None:
    trace = pattern(PATTERNS["trot"], seconds=6.0)
    command = trace.command.copy() if trace.command is not None else np.zeros(0)
    command[100:190] = 0.0
    paused = dataclasses.replace(trace, command=command)
    assert value("stride_rate", paused) == pytest.approx(2.5)
    np.testing.assert_allclose(value("touchdown_phase", paused), PATTERNS["trot"], atol=1e-9)


def test_a_robot_counts_until_it_falls() -> None:
    trace = pattern(PATTERNS["trot"])
    contact, counts = trace.contact.copy(), trace.counts.copy()
    contact[1000:], counts[100:] = False, False
    fallen = dataclasses.replace(trace, contact=contact, counts=counts)
    assert value("stride_rate", fallen) == pytest.approx(2.5)
    assert value("flight_share", fallen) == 0.0


def test_flight_is_the_share_of_time_with_no_foot_on_the_ground() -> None:
    assert value("flight_share", pattern(PATTERNS["trot"], duty=0.4)) == pytest.approx(0.2)
    assert value("flight_share", pattern(PATTERNS["pronk"], duty=0.4)) == pytest.approx(0.6)


# ---------------------------------------------------------------------- feet


def test_clearance_is_the_mean_over_swings_of_the_sole_s_top() -> None:
    """A parabola of 50 mm in each swing, 2 mm of the lame foot, the ground otherwise."""
    trace = pattern(PATTERNS["trot"])
    turn = (2.5 * np.arange(len(trace.contact))[:, None] * DT - np.array(PATTERNS["trot"]) + 1e-9) % 1.0
    swing = np.clip((turn - 0.5) / 0.5, 0.0, 1.0)
    sole = 4.0 * swing * (1.0 - swing) * np.array([0.05, 0.05, 0.002, 0.05])
    highest = (robot.FOOT_RADIUS + sole).reshape(-1, SAMPLES, 1, 4).max(1)
    np.testing.assert_allclose(
        value("clearance", dataclasses.replace(trace, foot_height=highest)), [0.05, 0.05, 0.002, 0.05], rtol=1e-3
    )


def test_the_step_in_which_a_foot_lands_is_part_of_its_swing() -> None:
    """A foot that rises until it lands, in the middle of a step, is highest in that step."""
    trace = pattern(PATTERNS["trot"], rate=2.3)
    turn = (2.3 * np.arange(len(trace.contact))[:, None] * DT - np.array(PATTERNS["trot"]) + 1e-9) % 1.0
    sole = 0.05 * np.clip((turn - 0.5) / 0.5, 0.0, 1.0)
    highest = (robot.FOOT_RADIUS + sole).reshape(-1, SAMPLES, 1, 4).max(1)
    np.testing.assert_allclose(value("clearance", dataclasses.replace(trace, foot_height=highest)), 0.05, rtol=0.01)


def test_a_lame_leg_has_its_share_of_the_load() -> None:
    trace = pattern(PATTERNS["trot"])
    lame = dataclasses.replace(trace, foot_force=constant(trace, 40.0, 40.0, 6.0, 34.0))
    np.testing.assert_allclose(value("load_share", lame), np.array([40, 40, 6, 34]) / 120)
    np.testing.assert_allclose(value("foot_load", lame), [40, 40, 6, 34])


def test_touchdown_speeds_count_once_a_touchdown() -> None:
    trace = pattern(PATTERNS["trot"], seconds=8.0)
    speed = np.full((trace.steps, 1, 4), 99.0)  # between touchdowns it may be anything
    landed = np.argwhere(trace.contact[1:, 0] & ~trace.contact[:-1, 0]) + np.array([1, 0])
    for k, (sample, foot) in enumerate(landed):
        speed[sample // SAMPLES, 0, foot] = 0.01 * k
    last = 0.01 * (len(landed) - 1)
    assert value("touchdown_speed_p95", dataclasses.replace(trace, foot_touchdown_speed=speed)) == pytest.approx(
        0.95 * last
    )


def test_the_peak_force_is_that_of_each_stance_in_body_weights() -> None:
    trace = pattern(PATTERNS["trot"])
    peak = np.where(trace.contact[::SAMPLES], 50.0, 0.0)
    landed = np.flatnonzero(trace.contact[1:, 0, FL] & ~trace.contact[:-1, 0, FL]) + 1
    peak[landed // SAMPLES, 0, FL] = 240.0
    loaded = dataclasses.replace(trace, foot_peak_force=peak, mass=np.array([12.0]))
    assert value("peak_force_p95", loaded) == pytest.approx(240.0 / (12.0 * 9.81))  # every fourth stance


def test_a_sole_sinks_as_deep_as_it_does_under_load() -> None:
    trace = pattern(PATTERNS["trot"], seconds=4.0)
    sunk = dataclasses.replace(
        trace, foot_depth=constant(trace, 0.001, 0.002, 0.003, 0.05), foot_force=constant(trace, 30.0, 30.0, 30.0, 1.0)
    )
    np.testing.assert_allclose(value("sink_p99", sunk), [0.001, 0.002, 0.003, np.nan], rtol=1e-6)


def test_a_foot_slips_while_it_is_loaded_and_fast() -> None:
    trace = pattern(PATTERNS["trot"], seconds=4.0)
    speed = constant(trace, 0.1, 0.3, 1.0, 1.0)
    force = constant(trace, 30.0, 30.0, 30.0, 1.0)
    slipping = dataclasses.replace(trace, foot_slip_speed=speed, foot_force=force)
    np.testing.assert_array_equal(value("slip_share", slipping), [0.0, 1.0, 1.0, np.nan])
    assert value("slip_share_all", slipping) == pytest.approx(2 / 3, abs=0.02)
    # on the ground for 0.2 s of each stride
    np.testing.assert_allclose(value("slip_distance", slipping), [0.02, 0.06, 0.2, 0.0], rtol=0.12)
    np.testing.assert_array_equal(value("slip_share", slipping, speed=0.05, least_force=0.5), 1.0)


# ---------------------------------------------------------------------- trunk and drives


def test_heave_is_vertical_in_the_world_whichever_way_the_trunk_leans() -> None:
    trace = pattern(PATTERNS["trot"])
    angle = 0.3
    gravity = constant(trace, np.sin(angle), 0.0, -np.cos(angle))  # nose down
    velocity = 0.4 * -gravity * np.sign(np.sin(np.arange(trace.steps) + 0.5))[:, None, None]
    leaning = dataclasses.replace(trace, projected_gravity_b=gravity, base_lin_vel_b=velocity)
    assert value("heave", leaning) == pytest.approx(0.4)
    assert value("trunk_pitch", leaning) == pytest.approx(angle)
    told_to_stand = dataclasses.replace(leaning, command=constant(trace, 0.0, 0.0, 0.0))
    assert value("heave", told_to_stand) == pytest.approx(0.4)
    sideways = dataclasses.replace(leaning, base_lin_vel_b=constant(trace, np.cos(angle), 1.0, np.sin(angle)))
    assert value("heave", sideways) == pytest.approx(0.0, abs=1e-12)


def test_the_step_of_the_target_is_counted_over_20_ms_at_any_rate() -> None:
    for rows_per_step in (1, 10):
        steps = 40
        target = np.repeat(0.1 * (np.arange(steps) % 2), rows_per_step)[:, None, None] * np.ones((1, 1, 12))
        rows = len(target)
        trace = Trace(
            contact=np.ones((rows, 1, 4), bool),
            contact_dt=0.02 / rows_per_step,
            counts=np.ones((rows, 1), bool),
            joint_target=target,
        )
        assert value("target_step_p99", trace) == pytest.approx(0.1)
        target[:rows_per_step] = 9.0  # before the time that counts
        later = np.arange(rows)[:, None] >= rows_per_step
        assert value("target_step_p99", dataclasses.replace(trace, counts=later)) == pytest.approx(0.1)


def test_cost_of_transport_is_positive_work_over_weight_and_way() -> None:
    trace = pattern(PATTERNS["trot"])
    torque, speed = np.zeros(12), np.zeros(12)
    torque[:3], speed[:3] = (10.0, 5.0, -8.0), (2.0, -4.0, -1.0)  # 20 W, braking, 8 W
    moving = dataclasses.replace(
        trace,
        joint_torque=constant(trace, *torque),
        joint_vel=constant(trace, *speed),
        base_lin_vel_b=constant(trace, 0.6, 0.8, 5.0),
        mass=np.array([12.0]),
    )
    assert value("cost_of_transport", moving) == pytest.approx(28.0 / (12.0 * 9.81 * 1.0))
    measured_power = dataclasses.replace(moving, positive_power=np.full((trace.steps, 1), 56.0))
    assert value("cost_of_transport", measured_power) == pytest.approx(56.0 / (12.0 * 9.81))
    walks = np.arange(trace.steps)[:, None] % 2 == 0  # and stands, at other power, in the other half of the time
    half: dict[str, Any] = {
        "command": np.where(walks[..., None], WALK, 0.0),
        "positive_power": np.where(walks, 56.0, 99.0),
    }
    assert value("cost_of_transport", dataclasses.replace(moving, **half)) == pytest.approx(56.0 / (12.0 * 9.81))
    slow = dataclasses.replace(moving, base_lin_vel_b=constant(trace, 0.05, 0.0, 0.0))
    assert np.isnan(value("cost_of_transport", slow))


def test_the_motors_line_counts_torque_and_speed_while_driving_and_torque_while_braking() -> None:
    trace = pattern(PATTERNS["trot"])
    peak, top = robot.per_joint(robot.EFFORT_LIMIT), robot.per_joint(robot.VELOCITY_LIMIT)
    for sign, share in ((1.0, 0.9), (-1.0, 0.6)):
        drive = dataclasses.replace(
            trace, joint_torque=constant(trace, *(0.6 * peak)), joint_vel=constant(trace, *(sign * 0.3 * top))
        )
        assert value("torque_share_p99", drive) == pytest.approx(0.6)
        assert value("joint_speed_share_p99", drive) == pytest.approx(0.3)
        assert value("envelope_share_p99", drive) == pytest.approx(share)


# ---------------------------------------------------------------------- the record


def test_what_was_not_measured_is_none_and_says_which_column_is_missing() -> None:
    trace = without(random_trace(), "foot_height", "base_lin_vel_b")
    values = measured(trace)
    assert {name for name, v in values.items() if v is None} == {"clearance", "heave", "cost_of_transport"}
    with pytest.raises(NotMeasured, match="needs foot_height"):
        value("clearance", trace)


def test_every_measure_has_a_unit_and_a_value_per_robot_or_foot() -> None:
    trace = random_trace()
    for term in every_measure():
        assert term.entry.traits["unit"], term.key
        assert term(trace).shape == (trace.robots, 4)[: 1 + (term.entry.traits.get("per") == "foot")]


def test_a_trace_whose_columns_do_not_fit_is_refused_by_name() -> None:
    trace = random_trace()
    with pytest.raises(ValueError, match=r"joint_vel: must be \(150, 5, 12\)"):
        dataclasses.replace(trace, joint_vel=trace.foot_slip_speed)
    with pytest.raises(ValueError, match="a multiple of the 150 steps"):
        dataclasses.replace(trace, contact=trace.contact[:-1])


def test_runs_know_which_of_their_ends_are_changes_between_air_and_ground() -> None:
    runs = find_runs(np.array([[0, 0, 1, 2, 0, 1, 1, 0], [1, 1, 1, 1, 1, 1, 1, 1]], np.int8))
    assert runs.value.tolist() == [0, 1, 2, 0, 1, 0, 1]
    assert runs.start.tolist() == [0, 2, 3, 4, 5, 7, 0]
    assert runs.begins.tolist() == [False, True, False, False, True, True, False]
    assert runs.ends.tolist() == [True, False, False, True, True, False, False]
    assert len(find_runs(np.zeros((4, 0), np.int8)).start) == 0
    assert settled(np.array([[1, 1, 0, 1, 1, 0, 0, 0, 1, 0, 0]], np.int8), 2).tolist() == [[1] * 5 + [0] * 6]


def test_the_largest_value_of_a_stretch_may_be_its_last_and_the_record_s_last() -> None:
    values = np.array([[1.0, 5.0, 2.0], [7.0, 0.0, 9.0]])
    column, start, stop = np.array([0, 1, 0]), np.array([0, 1, 2]), np.array([2, 3, 3])
    assert largest_within(values, column, start, stop).tolist() == [5.0, 9.0, 2.0]
