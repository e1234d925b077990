"""The size of a physics step must not show: 2 ms against 0.25 ms, the engine's own drives, and the order of the error.

``python tests/test_numerics.py`` prints the tables of docs/notebook/actuators.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind, members
from go1exp.sim.effects.rules import on_mount
from go1exp.sim.env.plant import Plant, actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import Sensors, build_model
from go1exp.sim.task import MANY_TERMS, TaskConfig, parse_task
from go1exp.sim.terrain import build_terrain

GAINS = ((20.0, 0.5), (35.0, 0.6), (35.0, 1.2))
FINE, COARSE = 0.00025, 0.002
STEP, EVERY, SETTLE_S, TAKES_S = 0.2, 0.004, 0.4, 0.25
SMALL = 0.02
"""A step so small that forces quadratic in the speed do not matter, rad."""
BAR = 0.5
"""mrad; about the noise of an encoder."""

BARS: dict[str, tuple[tuple[float, float, float], str]] = {
    "backlash": ((4.0, 4.0, 4.0), "flanks hit each other within a step, in three coupled joints; a few ms at a time"),
    "dead_band": ((0.5, 0.66, 0.5), "hardly damped: the torque jumps by kp x band up to half a step late"),
    "fixed_point": ((0.5, 0.59, 0.5), "hardly damped: kd 0.6 becomes 0.5625"),
    "flexibility": ((0.5, 0.75, 0.5), "the rotor swings at 30 to 70 Hz"),
    "kd_scale": ((0.5, 0.65, 0.5), "hardly damped: the leapfrog's error of phase, (frequency x step)^2 / 24, adds up"),
    "lag": ((0.5, 0.85, 0.5), "hardly damped: a lag takes kp x time from kd"),
    "soft_mount": ((0.5, 0.63, 0.5), "hardly damped, and legs swing at other frequencies on a trunk that yields"),
    "stribeck": ((0.7, 0.55, 0.5), "a jump of the target frees a stuck joint half a step late"),
    "torque_delay": ((0.5, 0.8, 0.5), "hardly damped: a delay takes kp x delay from kd"),
}
"""Effects that cannot keep ``BAR``: the bar they keep instead, by gains, some 15 % above what was measured, and why."""


@cache
def task() -> TaskConfig:
    return parse_task(compose("train", ["rand=none", "actuator=pd", "contact=soft", "backend.threads=1"]))


def held(dt: float, mounted: bool = False) -> tuple[mujoco.MjModel, Sensors]:
    return build_model(task().robot, build_terrain(task().terrain), dt, held=(1.0, 0.0, 0.0, 0.0), mounted=mounted)


def choice(name: str) -> dict[str, Any]:
    found = OmegaConf.to_container(OmegaConf.load(data_root() / f"conf/effect/{name}.yaml"))
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def hanging(dt: float, effects: Mapping[str, Any]) -> Plant:
    """Hang up one robot for each of ``GAINS``."""
    n = len(GAINS)
    terms = []
    for name, values in effects.items():
        term, problems = bind("effect", name, values, f"effect.{name}", MANY_TERMS["effect"])
        assert term, problems
        terms.append(term)
    backend = MujocoCpu(*held(dt, on_mount(terms)), n, 1)
    plant = Plant(backend, actuator_setup(task().robot, dt, backend, EnvRandom(0, n)), task().actuator, terms)
    kp, kd = (torch.tensor([[g[i]] for g in GAINS], dtype=torch.float64).expand(n, robot.NUM_JOINTS) for i in (0, 1))
    plant.set_gains(kp, kd)
    plant.startup()
    return plant


def step_response(dt: float, qpos: Tensor, advance: Callable[[Tensor], object], step: float = STEP) -> Tensor:
    """Settle, step all targets, and return the joint angles (T, N, J) every ``EVERY`` s; ``qpos`` is live."""
    stance = torch.as_tensor(robot.NOMINAL_STANCE).repeat(len(qpos), 1)
    for _ in range(round((SETTLE_S if step == STEP else 3.0 * SETTLE_S) / dt)):
        advance(stance)
    read = [qpos.clone()]
    for k in range(round(TAKES_S / dt)):
        advance(stance + step)
        if (k + 1) % round(EVERY / dt) == 0:
            read.append(qpos.clone())
    return torch.stack(read)


def ours(dt: float, effects: Mapping[str, Any], step: float = STEP) -> Tensor:
    """The response of drives and effects as the package steps them."""
    plant = hanging(dt, effects)
    stance = torch.as_tensor(robot.NOMINAL_STANCE).repeat(len(GAINS), 1)
    everyone, qpos = torch.ones(len(GAINS), dtype=torch.bool), torch.zeros_like(plant.backend.qpos)
    qpos[:, -robot.NUM_JOINTS :] = stance
    plant.backend.reset(everyone, qpos, torch.zeros_like(plant.backend.qvel))
    plant.reset(everyone, stance)
    return step_response(dt, plant.q, plant.step, step)


def at_face_value(dt: float) -> Tensor:
    """The response if a drive takes MuJoCo's qpos and qvel for the state at one instant, as is usual."""
    backend = MujocoCpu(*held(dt), len(GAINS), 1)
    stance = torch.as_tensor(robot.NOMINAL_STANCE).repeat(len(GAINS), 1)
    backend.reset(torch.ones(len(GAINS), dtype=torch.bool), stance, torch.zeros_like(stance))
    gains = torch.tensor(GAINS, dtype=torch.float64)
    kp, kd = gains[:, :1], gains[:, 1:]
    return step_response(dt, backend.qpos, lambda t: backend.step(kp * (t - backend.qpos) - kd * backend.qvel))


@cache
def engines_own(dt: float, step: float = STEP) -> Tensor:
    """The response of MuJoCo's position actuators under its Runge-Kutta integrator: nothing of ours but the model."""
    found = []
    for kp, kd in GAINS:
        model = held(dt)[0]
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_gainprm[:, 0] = kp
        model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = -kp, -kd
        data = mujoco.MjData(model)
        data.qpos[:] = robot.NOMINAL_STANCE

        def advance(target: Tensor, model: mujoco.MjModel = model, data: mujoco.MjData = data) -> None:
            data.ctrl[:] = target[0]
            mujoco.mj_step(model, data)

        found.append(step_response(dt, torch.from_numpy(data.qpos).unsqueeze(0), advance, step))
    return torch.cat(found, dim=1)


def worst(a: Tensor, b: Tensor) -> list[float]:
    """Return the largest difference of any joint, mrad, for each of ``GAINS``."""
    return [1e3 * x for x in (a - b).abs().amax((0, 2)).tolist()]


@pytest.mark.slow("go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/", "go1exp/sim/actuator/")
def test_an_effect_moves_the_same_at_a_coarse_and_a_fine_step(effect: str) -> None:
    bars, _ = BARS.get(effect, ((BAR,) * len(GAINS), ""))
    found = worst(ours(COARSE, choice(effect)), ours(FINE, choice(effect)))
    assert all(error < bar for error, bar in zip(found, bars, strict=True)), found


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "effect" in metafunc.fixturenames:
        metafunc.parametrize("effect", ["none", *members("effect")])


def test_every_exception_names_an_effect_and_a_reason() -> None:
    assert set(BARS) <= set(members("effect"))
    assert all(max(bars) > BAR and reason for bars, reason in BARS.values())


def test_drives_agree_with_the_engines_own_under_runge_kutta() -> None:
    reference = engines_own(1e-4)
    assert float((reference[-1] - reference[0]).abs().min()) > 0.5 * STEP  # it moved
    hardly_damped = 0.6  # at kd 0.6; 0.53 measured
    found = worst(ours(COARSE, {}), reference)
    assert all(error < bar for error, bar in zip(found, (BAR, hardly_damped, BAR), strict=True)), found
    assert max(worst(ours(FINE, {}), reference)) < 0.08


def test_the_error_falls_with_the_square_of_the_step() -> None:
    """Fast motion adds an error of first order: MuJoCo's Coriolis torque is that of the speed half a step ago."""
    reference = engines_own(1e-4, SMALL)
    errors = np.array([worst(ours(dt, {}, SMALL), reference) for dt in (0.004, 0.002, 0.001)])
    ratios = errors[:-1] / errors[1:]
    assert (ratios > 3.2).all(), ratios
    assert (ratios < 4.5).all(), ratios


def test_state_taken_at_face_value_would_not_do() -> None:
    """The test has teeth, and the extrapolation is what makes the difference."""
    found = worst(at_face_value(COARSE), at_face_value(FINE))
    assert min(found) > 2.0, found
    assert max(found) > 4.0, found


@pytest.mark.parametrize("bound", [0.1, 0.3])
def test_dry_friction_is_rigid_within_a_step(bound: float) -> None:
    found = worst(ours(COARSE, {"coulomb": {"bound": bound}}), ours(FINE, {"coulomb": {"bound": bound}}))
    assert max(found) < BAR, found


def main() -> None:
    def line(name: str, *columns: Any) -> None:
        print(f"| {name} | " + " | ".join(c if isinstance(c, str) else f"{c:.2f}" for c in columns) + " |")

    gains = [f"kp {kp:g}, kd {kd:g}" for kp, kd in GAINS]
    line("2 ms against 0.25 ms, mrad", *gains)
    line("state at face value", *worst(at_face_value(COARSE), at_face_value(FINE)))
    for bound in (0.0, 0.1, 0.3, 0.6, 1.0, 2.0):
        line(f"dry friction {bound:g} N m", *worst(*(ours(dt, {"coulomb": {"bound": bound}}) for dt in (COARSE, FINE))))
    for name in members("effect"):
        line(f"`{name}`", *worst(*(ours(dt, choice(name)) for dt in (COARSE, FINE))))
    line("against MuJoCo's own drives, RK4 at 0.1 ms, mrad", *gains)
    for dt in (0.004, 0.002, 0.001, 0.0005, 0.00025):
        line(f"{1e3 * dt:g} ms", *worst(ours(dt, {}), engines_own(1e-4)))
    for dt in (0.004, 0.002, 0.001, 0.0005, 0.00025):
        line(
            f"{1e3 * dt:g} ms, {SMALL:g} rad",
            *(f"{x:.3f}" for x in worst(ours(dt, {}, SMALL), engines_own(1e-4, SMALL))),
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
