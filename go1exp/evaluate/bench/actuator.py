"""``suite=actuator``: what actuator nets and effects cost, and how long a recording takes."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path

from go1exp.config.schema.registry import Term, members
from go1exp.evaluate.bench.env import Measured, core_subject, rates, ratio, speeds
from go1exp.gap.actuator_net.fitting import fit
from go1exp.gap.actuator_net.settings import FitSettings
from go1exp.logs import recording
from go1exp.logs.record import plan, simulate
from go1exp.logs.record.sensors import SensorConfig
from go1exp.sim.task import TaskConfig

EFFECTS = {
    "coulomb": {"bound": 0.2},
    "viscous": {"damping": 0.05},
    "command_delay": {"delay": 0.01},
    "lag": {"time": 0.005},
    "strength": {"scale": 0.95},
}
"""Five joint effects, with the values that the suite switches on."""


def small_net(rig: simulate.Rig, sensors: SensorConfig, folder: Path) -> Path:
    """Fit an actuator net of the usual size to a short recording of the rig, and return its file."""
    config = plan.RecordingConfig(((20.0, 0.5),), 10.0, (0, 1, 2), 0, "suspended", ((0.0, 0.0),), 0, sensors)
    motion = Term("multisine", members("excitation")["multisine"], {})
    made = simulate.play(rig, plan.episodes([motion], config), sensors, 0, lambda done, total: None)
    result = fit(made, FitSettings(share="kind", epochs=15, half_net=False))
    file = folder / "net.npz"
    result.net.save(file)
    return file


def record_seconds(rig: simulate.Rig, sensors: SensorConfig, folder: Path) -> float:
    """Return how long it takes to record and write 60 s of a suspended robot with three gain sets, s."""
    start = time.perf_counter()
    gains = ((20.0, 0.5), (35.0, 0.6), (35.0, 1.2))
    config = plan.RecordingConfig(gains, 20.0, (0,), 0, "suspended", ((0.0, 0.0),), 0, sensors)
    motions = [Term(name, members("excitation")[name], {}) for name in ("chirp", "steps", "slow_ramps")]
    for r in simulate.play(rig, plan.episodes(motions, config), sensors, 0, lambda done, total: None):
        recording.write(folder / f"{r.meta.episode}.parquet", r)
    return time.perf_counter() - start


def run(task: TaskConfig, sensors: SensorConfig, record_dt: float, much: Measured) -> dict[str, float]:
    """Measure; return the figures by name. Recordings are simulated at ``record_dt``, s."""
    rig = simulate.Rig(task.robot, task.actuator, (), task.terrain, task.backend, record_dt)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        net = Term("net", members("actuator")["net"], {"file": str(small_net(rig, sensors, folder)), "period": "exact"})
        effects = tuple(Term(key, members("effect")[key], values, {"spread": {}}) for key, values in EFFECTS.items())
        subjects = {
            "pd": core_subject(task, much.num_envs),
            "net": core_subject(dataclasses.replace(task, actuator=net), much.num_envs),
            "effects": core_subject(dataclasses.replace(task, effect=effects), much.num_envs),
        }
        measured = rates(subjects, much)
        recorded = record_seconds(rig, sensors, folder)
    return {
        **speeds(measured),
        "net_over_pd": ratio(measured, "net", "pd"),
        "effects_over_none": ratio(measured, "effects", "pd"),
        "record_s": recorded,
    }
