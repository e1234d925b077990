"""The laws of the actuators: against values by hand, slow loops, and the ways in which each may be misused."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from go1exp import robot
from go1exp.config.schema.registry import ConfigError, Term, members
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.actuator_net import ActuatorNet, load
from go1exp.sim.actuator.delay import Delay
from go1exp.sim.actuator.grouped_mlp import FEWEST, LANES, GroupedMLP, padded_rows
from go1exp.sim.actuator.net import Net
from go1exp.sim.effects.stack import EffectStack
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig
from tests.rounding import alone_and_in_a_batch

Drives = Callable[..., ActuatorSetup]
EFFORT = np.array([23.7, 23.7, 35.55] * 4)


def motor(setup: ActuatorSetup, **parameters: Any) -> Any:
    return members("actuator")["dc_motor"].target(setup, **parameters)


def rows(values: float | list[float] | np.ndarray) -> Tensor:
    """One robot: the same value in every joint, or one each."""
    return torch.as_tensor(np.broadcast_to(np.asarray(values, dtype=float), (1, 12)).copy())


def assert_joint_by_joint(drive: Any, slow: Callable[[float, float, float, int], float], n: int, atol: float) -> None:
    """Compare the torques of n robots with ``slow(target, q, qd, joint)``."""
    rng = np.random.default_rng(0)
    target, q, qd = rng.normal(size=(n, 12)), rng.normal(size=(n, 12)), rng.normal(0.0, 15.0, (n, 12))
    expected = [[slow(target[i, j], q[i, j], qd[i, j], j) for j in range(12)] for i in range(n)]
    np.testing.assert_allclose(drive.torque(*map(torch.as_tensor, (target, q, qd))), expected, rtol=0, atol=atol)


# ---------------------------------------------------------------------- dc_motor


@pytest.mark.parametrize(
    ("speed", "most"), [(0, 23.7), (10, 15.8), (15, 11.85), (20, 7.9), (30, 0), (45, -11.85), (-10, 23.7), (-60, 23.7)]
)
def test_the_most_that_a_hip_can_do_at_a_speed(speed: float, most: float, drives: Drives) -> None:
    """Values of Isaac Lab's motor: 23.7 N m and 30 rad/s; the calf has 1.5 times the torque at 1 / 1.5 of the speed."""
    drive = motor(drives(1), kp=1000.0, kd=0.0, speed=[30.0, 30.0, 20.0])
    qd = np.tile([speed, speed, speed / 1.5], 4)
    for sign in (1.0, -1.0):
        tau = drive.torque(rows(sign * 9.0), rows(0.0), rows(sign * qd))
        np.testing.assert_allclose(tau[0], sign * np.tile([most, most, 1.5 * most], 4), atol=1e-9)


def test_a_motor_at_a_voltage_is_its_circuit(drives: Drives) -> None:
    """The current of U = R i + L di/dt + k qd, integrated until it rests, times k; then the limit of the current."""

    def slow(target: float, q: float, qd: float, joint: int) -> float:
        nominal, stall, speed, supply = 12.0, 18.0 if joint == 4 else 30.0, 25.0, [1.0, 0.8, 1.2][joint % 3]
        k = nominal / speed
        resistance = k * nominal / stall
        duty = max(-1.0, min(1.0, (15.0 * (target - q) - 0.3 * qd) / stall))
        current, inductance, dt = 0.0, 1e-3, 1e-4
        for _ in range(3000):
            current += dt / inductance * (duty * supply * nominal - resistance * current - k * qd)
        limit = [23.7, 23.7, 35.55][joint % 3]
        return max(-limit, min(limit, k * current))

    make = members("actuator")["voltage"].target
    stall = {**dict.fromkeys(robot.JOINTS, 30.0), "FL_thigh": 18.0}
    drive: Any = make(drives(2), kp=15.0, kd=0.3, stall=stall, speed=25.0, supply=[1.0, 0.8, 1.2])
    assert_joint_by_joint(drive, slow, 2, 1e-9)


def test_a_motor_at_a_voltage_brakes_what_pushes_it_and_has_nothing_left_at_top_speed(drives: Drives) -> None:
    make = members("actuator")["voltage"].target
    drive: Any = make(drives(1), kp=20.0)
    top = rows([30.1, 30.1, 20.06] * 4)
    assert torch.allclose(drive.torque(rows(9.0), rows(0.0), top), rows(0.0), atol=1e-12)  # pd: the peak torque
    pushed = 0.5 * top
    power = drive.torque(rows(0.0), rows(0.0), pushed) * pushed
    assert torch.allclose(power, -0.25 * rows([23.7, 23.7, 35.55] * 4) * top)


def test_a_dc_motor_is_pd_within_its_line(drives: Drives) -> None:
    def slow(target: float, q: float, qd: float, joint: int) -> float:
        effort, speed = ([23.7, 23.7, 35.55][joint % 3], [30.1, 30.1, 20.06][joint % 3])
        stall = 33.0 if joint == 4 else effort
        high = max(-effort, min(effort, stall * (1.0 - qd / speed)))
        low = min(effort, max(-effort, -stall * (1.0 + qd / speed)))
        return max(low, min(high, [20.0, 25.0, 30.0][joint % 3] * (target - q) - 0.6 * qd))

    drive = motor(drives(50), kp=[20.0, 25.0, 30.0], kd=0.6, stall={"FL_thigh": 33.0})
    assert_joint_by_joint(drive, slow, 50, 1e-12)


# ---------------------------------------------------------------------- delay


def repeater(setup: ActuatorSetup, shortest: float, longest: float) -> Delay:
    """A delayed drive whose torque is its target."""
    delay = Delay(setup, command=(shortest, longest), drive={"term": "pd", "kp": 1.0, "kd": 0.0})
    delay.reset(torch.ones(setup.num_envs, dtype=torch.bool))
    return delay


@pytest.mark.parametrize("delay", [0.0, 0.002, 0.006, 0.005, 0.0137])
def test_the_target_is_that_of_a_while_ago_and_feedback_is_not(delay: float, drives: Drives) -> None:
    rng = np.random.default_rng(0)
    late = Delay(drives(1), command=(delay, delay), drive={"term": "pd", "kp": 2.0, "kd": 0.5})
    late.reset(torch.ones(1, dtype=torch.bool))
    times, targets = 0.002 * np.arange(40), rng.normal(size=(40, 12))
    for k in range(40):
        q, qd = rng.normal(size=12), rng.normal(size=12)
        tau = late.torque(rows(targets[k]), rows(q), rows(qd))[0]
        then = [np.interp(times[k] - delay, times[: k + 1], targets[: k + 1, j]) for j in range(12)]
        np.testing.assert_allclose(tau, 2.0 * (np.array(then) - q) - 0.5 * qd, atol=1e-6)


def test_each_robot_draws_its_delay_anew_for_each_episode(drives: Drives) -> None:
    setup = drives(400)
    late = repeater(setup, 0.004, 0.012)
    first = late.delay.clone()
    assert first.shape == (400, 1)
    assert ((first >= 0.004) & (first <= 0.012)).all()
    assert first.mean().item() == pytest.approx(0.008, abs=0.0005)  # 4 standard errors
    assert first.std().item() == pytest.approx(0.008 / 12**0.5, rel=0.1)
    again = torch.arange(400) % 3 == 0
    late.reset(again)
    assert torch.equal(late.delay[~again], first[~again])
    assert (late.delay[again] != first[again]).all()


def test_a_new_episode_does_not_see_the_last_one(drives: Drives, monkeypatch: pytest.MonkeyPatch) -> None:
    setup, told = drives(2), list[Tensor]()
    late, still = repeater(setup, 0.01, 0.01), setup.zeros()
    monkeypatch.setattr(late.drive, "reset", told.append)
    for _ in range(10):
        late.torque(still + 1.0, still, still)
    late.reset(torch.tensor([True, False]))
    for _ in range(3):
        assert late.torque(still + 5.0, still, still)[:, 0].tolist() == [5.0, 1.0]
    assert [mask.tolist() for mask in told] == [[True, False]]


def test_a_drive_without_delay_is_that_drive(make_core: Callable[..., Go1Core]) -> None:
    """In the environment, and so with its resets; bit for bit."""

    def run(*overrides: str) -> Tensor:
        core = make_core("sim.episode_s=0.1", *overrides)
        core.reset()
        generator = torch.Generator().manual_seed(0)
        for _ in range(12):
            core.step(torch.randn(4, 12, generator=generator))
        return core.backend.qpos.clone()

    wrapped = ("actuator=delay", "actuator@actuator.drive=dc_motor")
    plain = run("actuator=dc_motor")
    assert torch.equal(run(*wrapped, "actuator.command=[0.0,0.0]"), plain)
    assert not torch.equal(run(*wrapped, "actuator.command=[0.0,0.02]"), plain)


@pytest.mark.parametrize("inner", ["pd", "dc_motor"])
def test_effects_on_gains_reach_the_drive_inside(inner: str, drives: Drives) -> None:
    setup = drives(2)
    late = Delay(setup, command=(0.0, 0.0), drive={"term": inner})
    terms = [
        Term("kp_scale", members("effect")["kp_scale"], {"scale": 0.5}, {"spread": {}}),
        Term("kd_scale", members("effect")["kd_scale"], {"scale": 2.0}, {"spread": {}}),
    ]
    EffectStack(terms, setup).set_gains(late, late.kp.clone(), late.kd.clone())
    tau = late.torque(setup.zeros() + 0.1, setup.zeros(), setup.zeros() + 1.0)
    assert tau.flatten().tolist() == pytest.approx([10.0 * 0.1 - 1.0 * 1.0] * 24)


# ---------------------------------------------------------------------- net: the form of the file


@pytest.fixture
def shares(make_net: Callable[..., Path]) -> dict[str, Path]:
    return {share: make_net(share=share, seed=k) for k, share in enumerate(("all", "kind", "none"))}


def motion(steps: int, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Target, angle and speed (steps, n, 12)."""
    rng = np.random.default_rng(seed)
    target, q, qd = (rng.normal(0.0, scale, (steps, n, 12)) for scale in (0.3, 0.3, 3.0))
    return target, q, qd


def played(actuator: Net, series: tuple[np.ndarray, ...], restarts: dict[int, list[int]] | None = None) -> np.ndarray:
    """Torques (steps, n, 12); at the steps of ``restarts`` an episode begins for the robots that it names."""
    found = []
    for k, inputs in enumerate(zip(*series, strict=True)):
        if restarts and k in restarts:
            actuator.reset(torch.tensor([i in restarts[k] for i in range(inputs[0].shape[0])]))
        found.append(actuator.torque(*map(torch.as_tensor, inputs)).numpy().copy())
    return np.array(found)


def slow(
    net: ActuatorNet,
    period: str,
    dt: float,
    series: tuple[np.ndarray, ...],
    restarts: dict[int, list[int]] | None = None,
) -> np.ndarray:
    """One robot, one joint, one step at a time, with the file's own function in float64."""
    target, q, qd = series
    signals = {"position_error": target - q, "velocity": qd, "position": q}
    steps, n, _ = q.shape
    every = round(net.info.period / dt) if period == "hold" else 1
    tau = np.zeros_like(q)
    for i in range(n):
        begin = 0
        for t in range(steps):
            if t in (restarts or {}) and i in (restarts or {})[t]:
                begin = t
            now = t - (t - begin) % every
            ago = dt * (now - begin) - net.info.period * np.arange(net.info.history)
            for j in range(12):
                row = []
                for name in net.info.inputs:
                    seen = signals[name][begin : t + 1, i, j]
                    row += [np.interp(a, dt * np.arange(len(seen)), seen) for a in ago]
                group = net.info.groups.index(
                    {"all": "all", "kind": robot.JOINTS[j][3:], "none": robot.JOINTS[j]}[net.info.share]
                )
                tau[t, i, j] = np.clip(net.torque(np.array([row]), group)[0], -EFFORT[j], EFFORT[j])
    return tau


@pytest.mark.parametrize("share", ["all", "kind", "none"])
def test_a_net_is_the_function_in_its_file(share: str, shares: dict[str, Path], drives: Drives) -> None:
    series, restarts = motion(12, 3), {5: [1], 8: [0, 2]}
    expected = slow(load(shares[share]), "exact", 0.002, series, restarts)
    np.testing.assert_allclose(
        played(Net(drives(3), file=str(shares[share])), series, restarts), expected, atol=2e-5, rtol=0
    )
    assert np.abs(expected).mean() > 3.0
    assert len(np.unique(expected.round(6))) > 0.9 * expected.size


@pytest.mark.parametrize(
    "settings",
    [
        {"inputs": ("velocity", "position_error")},
        {"inputs": ("position", "velocity", "position_error"), "history": 2},
        {"inputs": ("position_error",), "history": 1},
        {"hidden": (64, 64, 64)},
        {"hidden": (5,)},
        {"hidden": (9, 3)},
        {"hidden": (3, 9, 3)},
        {"skip": 0.5},
        {"joints": tuple(sorted(robot.JOINTS))},
        {"joints": (*robot.JOINTS[::-1], "tail"), "share": "none"},
    ],
    ids=lambda settings: " ".join(f"{k}={v}" for k, v in settings.items())[:40],
)
def test_a_net_may_have_other_inputs_layers_and_joints(
    settings: dict[str, Any], make_net: Callable[..., Path], drives: Drives
) -> None:
    path, series = make_net(**settings), motion(6, 2)
    expected = slow(load(path), "exact", 0.002, series)
    np.testing.assert_allclose(played(Net(drives(2), file=str(path)), series), expected, atol=2e-5, rtol=0)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("counts", [(12,), (4, 4, 4), (1,) * 12, (5, 7)])
def test_every_thread_gets_whole_vectors_of_columns(counts: tuple[int, ...], threads: int) -> None:
    """With fewer than 12 columns to a thread MKL sums in another order: a robot alone would differ from a batch."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for robots in (1, 2, 3, 16, 701, 4096):
            rows = padded_rows(robots, counts, torch.device("cpu"))
            assert robots <= rows < robots + LANES * (threads + 1)
            assert all(count * rows % LANES == 0 and count * rows >= LANES * threads for count in counts)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("share", ["all", "kind", "none"])
def test_a_big_batch_is_its_robots(share: str, shares: dict[str, Path], drives: Drives) -> None:
    """More columns than a block; to the bit where the matrix library allows it."""
    n = 701
    series = motion(4, n)
    together = played(Net(drives(n), file=str(shares[share])), series)
    for i in (0, 1, 350, 351, 700):
        alone = played(Net(drives(1), file=str(shares[share])), tuple(x[:, i : i + 1] for x in series))
        atol = alone_and_in_a_batch(shares[share], largest_input=20.0)
        np.testing.assert_allclose(alone[:, 0], together[:, i], atol=atol, rtol=0)


@pytest.mark.parametrize("columns", [[2], [5000], [4096, 4096], [3000, 2, 3000], [4097, 2], [2] * 12])
def test_blocks_cover_every_column_once(columns: list[int]) -> None:
    rng = np.random.default_rng(0)
    nets = [
        [(rng.normal(size=(3, 4)), rng.normal(size=4)), (rng.normal(size=(4, 1)), rng.normal(size=1))] for _ in columns
    ]
    skips = [rng.normal(size=3) for _ in columns]
    mlp = GroupedMLP(nets, skips, columns, torch.device("cpu"))
    x = rng.normal(size=(3, sum(columns)))
    mlp.inputs.copy_(torch.as_tensor(x))
    for _ in range(2):  # nothing is left behind
        got, start = mlp().numpy(), 0
        for net, skip, count in zip(nets, skips, columns, strict=True):
            part = x[:, start : start + count]
            h = net[0][0].T @ part + net[0][1][:, None]
            expected = net[1][0][:, 0] @ (h / (1 + np.abs(h))) + net[1][1] + skip @ part
            np.testing.assert_allclose(got[start : start + count], expected, atol=1e-5)
            start += count


def test_a_run_of_one_column_is_refused() -> None:
    with pytest.raises(ValueError, match=f"at least {FEWEST}"):
        GroupedMLP([[(np.ones((1, 1)), np.ones(1))]], [np.zeros(1)], [1], torch.device("cpu"))


# ---------------------------------------------------------------------- net: its period


@pytest.mark.parametrize(
    ("period", "native", "dt"),
    [
        ("exact", 0.005, 0.005),
        ("hold", 0.005, 0.005),
        ("resample", 0.005, 0.005),
        ("hold", 0.01, 0.002),
        ("resample", 0.01, 0.002),
        ("resample", 0.005, 0.002),
        ("resample", 0.02, 0.003),
        ("resample", 0.002, 0.005),
    ],
)
def test_the_history_is_spaced_as_the_period_says(
    period: str, native: float, dt: float, make_net: Callable[..., Path], drives: Drives
) -> None:
    path = make_net(period=native, seed=7)
    series, restarts = motion(40, 3), {13: [1], 22: [0, 2], 23: [2]}
    net = Net(drives(3, physics_dt=dt), file=str(path), period=period)  # type: ignore[arg-type]
    expected = slow(load(path), period, dt, series, restarts)
    np.testing.assert_allclose(played(net, series, restarts), expected, atol=5e-5, rtol=0)


@pytest.mark.parametrize(("period", "native"), [("hold", 0.01), ("resample", 0.007)])
def test_with_a_period_of_its_own_a_net_continues_from_its_saved_state(
    period: str, native: float, make_net: Callable[..., Path], drives: Drives
) -> None:
    path, series, restarts = make_net(period=native), motion(40, 3), {13: [1], 14: [0, 2]}
    whole, first, second = (Net(drives(3), file=str(path), period=period) for _ in range(3))  # type: ignore[arg-type]
    full = played(whole, series, restarts)
    played(first, tuple(x[:17] for x in series), restarts)
    second.load_state_dict(first.state_dict())
    assert np.array_equal(played(second, tuple(x[17:] for x in series)), full[17:])


def firmware_at_20ms(path: Path, like: ActuatorNet, period: float) -> Path:
    """Write a net such as walk-these-ways published: tau = 20 e(t - P) - 0.5 qd(t), the firmware one sample late.

    Its own P is 20 ms. Written down with another ``period`` it is what one gets who counts samples.
    """
    skip = np.zeros_like(like.skip)
    skip[:, 1], skip[:, 3] = 20.0, -0.5  # features: e(t), e(t-P), e(t-2P), qd(t), ...
    plain = {"input_mean": np.zeros_like(like.input_mean), "input_std": np.ones_like(like.input_std)}
    made = dataclasses.replace(
        like,
        info=dataclasses.replace(like.info, period=period),
        weights=tuple(np.zeros_like(w) for w in like.weights),
        biases=tuple(np.zeros_like(b) for b in like.biases),
        skip=skip,
        output_mean=np.zeros_like(like.output_mean),
        output_std=np.ones_like(like.output_std),
        **plain,
    )
    made.save(path)
    return path


def test_a_net_stepped_faster_than_it_was_recorded_is_another_drive_unless_its_period_is_kept(
    tmp_path: Path, make_net: Callable[..., Path], drives: Drives
) -> None:
    like = load(make_net())
    own = firmware_at_20ms(tmp_path / "own.npz", like, 0.02)
    by_taps = firmware_at_20ms(tmp_path / "taps.npz", like, 0.005)
    times = 0.005 * np.arange(200)

    def smooth(frequency: float) -> np.ndarray:
        return np.broadcast_to(0.2 * np.sin(2 * np.pi * frequency * times)[:, None, None], (200, 1, 12))

    q = smooth(2.0)
    series = smooth(3.0), q, np.gradient(q, 0.005, axis=0)
    error = series[0] - q
    setup = drives(1, physics_dt=0.005)

    def law(lag: int) -> np.ndarray:
        past = np.concatenate([np.repeat(error[:1], lag, axis=0), error[:-lag]])
        return 20.0 * past - 0.5 * series[2]

    with pytest.raises(ConfigError, match=r"spaced 0\.02 s and the physics step is 0\.005 s"):
        Net(setup, file=str(own))
    resampled = played(Net(setup, file=str(own), period="resample"), series)
    np.testing.assert_allclose(resampled, law(4), atol=1e-5)
    held = played(Net(setup, file=str(own), period="hold"), series)
    np.testing.assert_allclose(held, np.repeat(law(4)[::4], 4, axis=0), atol=1e-5)
    trapped = played(Net(setup, file=str(by_taps)), series)
    np.testing.assert_allclose(trapped, law(1), atol=1e-5)
    assert np.abs(trapped - resampled).max() > 1.0


# ---------------------------------------------------------------------- net: refusals


def refusal(setup: ActuatorSetup, path: Path, **parameters: Any) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        Net(setup, file=str(path), **parameters)
    assert all(p.startswith(f"actuator net {path}: ") for p in caught.value.problems)
    return [p.removeprefix(f"actuator net {path}: ") for p in caught.value.problems]


def test_another_spacing_is_refused_with_the_ways_out(make_net: Callable[..., Path], drives: Drives) -> None:
    (said,) = refusal(drives(1), make_net(period=0.02))
    for part in ("0.02 s", "0.002 s", "sim.physics_dt", "period=hold", "period=resample"):
        assert part in said
    Net(drives(1), file=str(make_net(period=0.002 * (1 + 1e-9))))


@pytest.mark.parametrize(("native", "dt"), [(0.005, 0.002), (0.002, 0.005)])
def test_holding_needs_a_whole_number_of_steps(
    native: float, dt: float, make_net: Callable[..., Path], drives: Drives
) -> None:
    (said,) = refusal(drives(1, physics_dt=dt), make_net(period=native), period="hold")
    assert "whole multiple" in said
    assert "period=resample" in said


def test_a_net_for_something_else_is_refused(make_net: Callable[..., Path], drives: Drives) -> None:
    (said,) = refusal(drives(1), make_net(robot="so101", joints=("shoulder", "elbow"), share="all"))
    assert said == "is for 'so101' with joints shoulder, elbow; there is none for FR_hip"
    (said,) = refusal(drives(1), make_net(robot="go2"))
    assert said == "is for robot 'go2', not for 'go1'"
    both = refusal(drives(1), make_net(inputs=("position_error", "tau_cmd"), period=0.02))
    assert both[0].startswith("wants tau_cmd, which a position controller does not have")
    assert len(both) == 2


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["actuator=net"], "actuator.file: required, but not given"),
        (["actuator=net", "actuator.file=a/b.npz"], "actuator.file = 'a/b.npz': no such file"),
        (["actuator=net", "actuator.file=pyproject.toml"], "actuator.file = 'pyproject.toml': must be an .npz"),
        (["actuator=delay", "actuator@actuator.drive=net"], "actuator.drive.file: required, but not given"),
        (["actuator=delay", "actuator.drive.kp=-1.0"], "actuator.drive.kp = -1.0: "),
        (
            ["actuator=delay", "actuator.drive.term=pid"],
            "actuator.drive: unknown actuator term 'pid'; did you mean 'pd'?",
        ),
        (["actuator=delay", "~actuator.drive.term"], "actuator.drive.term: required, but not given"),
        (["actuator=delay", "+actuator.drive.ki=1.0"], "actuator.drive.ki: unknown key 'ki'"),
        (["actuator=delay", "actuator.drive.kp={FX: 1.0}"], "actuator.drive.kp = {'FX': 1.0}: no joint is called 'FX'"),
        (["actuator=delay", "actuator.drive.kp={FR: 1.0}"], "actuator.drive.kp = {'FR': 1.0}: gives FL_hip, "),
        (
            ["actuator=delay", "actuator.command=[0.02,0.01]"],
            "actuator.command = [0.02, 0.01]: low must not exceed high",
        ),
        (["actuator=delay", "actuator.command=[0.0,0.5]"], "actuator.command.1 = 0.5: "),
        (["actuator=dc_motor", "actuator.stall=0.0"], "actuator.stall = 0.0: every value must be between 1 and 500"),
        (["actuator=dc_motor", "actuator.kd={hip: 1.0}"], "actuator.kd = {'hip': 1.0}: gives FR_thigh, "),
    ],
)
def test_a_mistake_is_named_by_its_key(overrides: list[str], line: str, make_task: Callable[..., TaskConfig]) -> None:
    with pytest.raises(ConfigError) as caught:
        make_task(*overrides)
    assert [p for p in caught.value.problems if p.startswith(line)], caught.value.problems


def test_effects_on_gains_need_a_drive_that_has_them(
    make_task: Callable[..., TaskConfig], make_net: Callable[..., Path]
) -> None:
    effect, file = "effect=[kp_scale]", make_net()
    make_task(effect, "actuator=delay")
    for drive in (
        ["actuator=net", f"actuator.file={file}"],
        ["actuator=delay", "actuator@actuator.drive=net", f"actuator.drive.file={file}"],
    ):
        with pytest.raises(ConfigError, match=r"effect\.kp_scale: changes kp or kd"):
            make_task(effect, *drive)


def test_a_run_folder_has_a_copy_of_its_net_even_of_one_that_a_delay_wraps(make_net: Any, tmp_path: Path) -> None:
    from go1exp.train import run_folder

    net = make_net()
    for name, actuator in (
        ("plain", {"term": "net", "file": str(net)}),
        ("wrapped", {"term": "delay", "command": [0.0, 0.01], "drive": {"term": "net", "file": str(net)}}),
    ):
        run = tmp_path / name
        container = {"actuator": actuator, "seed": 0}
        run_folder.write(run, container)
        assert run_folder.read_as_written(run) == container
        own = run_folder.read_config(run)["actuator"]
        file = Path(own.get("file") or own["drive"]["file"])
        assert file.parent == run
        assert file.read_bytes() == net.read_bytes()
        run_folder.write(run, run_folder.read_config(run))  # as a run that goes on does
        assert file.read_bytes() == net.read_bytes()
