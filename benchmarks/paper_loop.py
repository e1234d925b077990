"""The paper's loop in simulation: a drive unknown to the training is recorded, fitted and compared on new motions.

    python benchmarks/paper_loop.py run=RUN [out=DIR] [seconds=15]

RUN is a run folder trained with ideal drives (``go1exp train experiment=minute``). Prints the
RMSE of the joint angles of a suspended robot against those with the hidden actuator, under the same targets in closed
loop, for ideal PD actuators and for the net.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from benchmarks import commands
from go1exp.cli.record import RIG
from go1exp.config.compose import compose
from go1exp.config.schema.registry import Term, members
from go1exp.logs.record import plan, simulate
from go1exp.logs.record.sensors import Channel, SensorConfig
from go1exp.sim.task import parse_parts

HIDDEN = [
    "effect=[lag,coulomb,torque_speed_limit]",
    "effect.lag.time=0.008",
    "effect.coulomb.bound=[0.3,0.3,0.4]",
    "effect.torque_speed_limit.peak=0.8",
    "effect.torque_speed_limit.droop=1.25",
]
"""The hidden drive: torque follows in 8 ms, dry friction of 0.3 to 0.4 N m, a battery at 0.8 of its voltage."""

MOTIONS = ("multisine", "gait", "steps", "chirp")
SEEDS = (101, 102)
PERFECT = Channel(0.0, 0.0)


def trajectories(overrides: list[str]) -> dict[str, np.ndarray]:
    """Return noise-free joint angles (T, 12) of a suspended robot on motions that no recording has."""
    container = compose("record", overrides)
    parts, problems = parse_parts(container, RIG)
    assert not problems, problems
    names = ("q", "qd", "tau_est", "gyro", "acc", "attitude", "foot_force")
    sensors = SensorConfig(rate_hz=500.0, jitter=0.0, dropped=0.0, truth=False, **dict.fromkeys(names, PERFECT))
    config = plan.RecordingConfig(((20.0, 0.5),), 10.0, SEEDS, 0, "suspended", ((0.0, 0.0),), 0, sensors)
    terms = [Term(name, members("excitation")[name], {}) for name in MOTIONS]
    rig = simulate.Rig(**parts, physics_dt=0.001)
    made = simulate.play(rig, plan.episodes(terms, config), sensors, 0, lambda done, total: None)
    return {f"{r.meta.excitation} {r.meta.episode.split('_')[-1]}": r.joint("q") for r in made}


def main() -> None:
    """Record, fit, compare."""
    given = dict(a.split("=", 1) for a in sys.argv[1:])
    out, run, seconds = Path(given.get("out", "runs/paper_loop")), given["run"], given.get("seconds", "15")
    common = [*HIDDEN, f"seconds={seconds}", "physics_dt=0.001", f"out={out / 'recordings'}"]
    walk = ["excitation=[policy]", f"run={run}", "support=suspended", "episodes=4"]
    commands.run("record", *common, *walk)
    commands.run("record", *common, "excitation=[multisine,steps,chirp,slow_ramps]", "seeds=[1,2,3,4,5]")
    taps = ["history=8", "period=0.004", "smoothing=0.02", "epochs=40", "half_net=false", "plots=false"]
    for target in ("tau_est", "joint_torque"):
        commands.run(
            "fit-actuator", f"recordings={out / 'recordings'}", f"target={target}", f"out={out / target}", *taps
        )
    hidden = trajectories(HIDDEN)
    results = {"pd": trajectories([])}
    for target in ("tau_est", "joint_torque"):
        net = out / target / "net.npz"
        results[target] = trajectories(["actuator=net", f"actuator.file={net}", "actuator.period=resample"])
    heads = "".join(f"{name:>14}" for name in results)
    print(f"\nRMSE of the joint angles to the hidden drive's, mrad\n{'motion':16}{heads}")
    total = {name: 0.0 for name in results}
    for motion, truth in hidden.items():
        errors = {name: float(np.sqrt(np.mean((q[motion] - truth) ** 2))) for name, q in results.items()}
        total = {name: total[name] + errors[name] ** 2 / len(hidden) for name in results}
        print(f"{motion:16}" + "".join(f"{1e3 * e:14.2f}" for e in errors.values()))
    print(f"{'all':16}" + "".join(f"{1e3 * e**0.5:14.2f}" for e in total.values()))
    for name in list(results)[1:]:
        print(f"net fitted to {name}: {(total['pd'] / total[name]) ** 0.5:.1f} times closer than pd")


if __name__ == "__main__":
    import go1exp.logs.excitations  # noqa: F401  (registers every excitation)

    main()
