"""``go1exp bench``."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from go1exp.base.files import write_json
from go1exp.cli.app import App, parse, spinner
from go1exp.cli.record import RecordSettings
from go1exp.config.compose import compose
from go1exp.config.schema import settings as schema
from go1exp.config.schema.physics import Threads
from go1exp.config.schema.registry import ConfigError, Count, Duration

if TYPE_CHECKING:
    from go1exp.evaluate.bench.env import Measured
    from go1exp.sim.task import TaskConfig, TrainConfig


@schema.settings
class BenchSettings:
    """``conf/bench.yaml``.

    Attributes:
        suite: env (stepping), train (learning), actuator (nets, effects, recording), deploy (runtime), mpc,
            report (go1exp report) or gpu (Warp).
        num_envs: environments of the batch.
        rounds: alternating measurements of each subject, of which the median counts.
        seconds: length of a measurement, s.
        threads: physics threads; 0 takes all cores.
        overrides: settings of the training that is measured, such as [terrain=rough].
        out: JSON file for the figures; null writes none.
    """

    suite: Literal["env", "train", "actuator", "deploy", "mpc", "report", "gpu"]
    num_envs: Count
    rounds: Count
    seconds: Duration
    threads: Threads
    overrides: tuple[str, ...]
    out: str | None


GOALS = {
    "env_over_bare": (0.75, "environment over bare mujoco.batch of the same model"),
    "env_over_subproc": (5.0, "environment over SB3's SubprocVecEnv of our Go1Env on all cores"),
    "train_over_env": (0.35, "end-to-end training over environment"),
    "net_over_pd": (0.65, "environment with actuator=net over actuator=pd"),
    "effects_over_none": (0.80, "environment with five joint effects over none"),
    "record_s": (20.0, "seconds to record 60 s of a suspended robot with three gain sets (at most)"),
    "gpu_env_over_bare": (0.70, "environment over bare mujoco-warp of the same model"),
    "gpu_train_over_env": (0.65, "training over environment"),
    "gpu_train_over_numpy": (1.0, "training over training through SB3's own loop"),
    "paper_minutes": (30.0, "minutes for the paper's 491 M steps (at most)"),
    "first_update_cold_s": (60.0, "seconds from start to first update, nothing compiled (at most)"),
    "first_update_warm_s": (15.0, "seconds from start to first update, kernels compiled (at most)"),
    "command_p50_ms": (0.3, "ms from waking up to the command sent, at 400 Hz (at most)"),
    "command_p99_ms": (0.8, "the same, 99th percentile (at most)"),
    "missed_400hz": (0.1, "per cent of deadlines missed at 400 Hz (at most); idle_missed_400hz is the timer's own"),
    "packets_us": (40.0, "us to pack, check and unpack a command and a state, both ends together (at most)"),
    "policy_us": (60.0, "us for one inference, one thread (at most)"),
    "mpc_p50_ms": (0.5, "ms for one tick of controller=mpc, one core (at most)"),
    "mpc_p99_ms": (1.5, "the same, 99th percentile (at most)"),
    "start_s": (2.0, "seconds from the runtime's start to its first command (at most)"),
    "memory_mb": (150.0, "MB resident of the runtime (at most)"),
    "report_s": (20.0, "seconds for go1exp report on 100 runs of 5,000 rows (at most)"),
    "report_mb": (1024.0, "MB resident of it (at most)"),
    "memory_per_env_kb": (100.0, "memory per environment beyond the first, kB (at most)"),
}
"""Figures with a goal: its value and what it is. Lower limits, but where they say `at most`."""

LIMIT = "_limit"
"""End of the name of a figure that says what another one could be at best: with an update of matrix products alone, or
with the memory of a robot's state alone; an environment is at best as fast as its engine."""


def _task(container: dict[str, object]) -> None:
    settings = parse(BenchSettings, container)
    show = spinner(settings.rounds, f"measuring {settings.suite}", at_once=True)

    from go1exp.sim.env.batch import refuse_too_many
    from go1exp.sim.task import parse_train

    on_gpu = settings.suite == "gpu"
    engine = "backend=warp" if on_gpu else f"backend.threads={settings.threads}"
    overrides = [engine, "ppo.coarse_physics=1", *settings.overrides]  # trainings step as what they are compared with
    container = compose("train", overrides)
    config = parse_train(container)

    from go1exp.evaluate.bench import env

    refuse_too_many("num_envs", settings.num_envs, config.task)
    much = env.Measured(settings.num_envs, settings.rounds, settings.seconds, show)
    if settings.suite == "env":
        figures = env.run(config.task, overrides, much)
    elif settings.suite == "train":
        figures = env.train(config, much)
    elif settings.suite == "deploy":
        from go1exp.evaluate.bench import deploy

        figures = deploy.run(container, much)
    elif settings.suite == "report":
        from go1exp.evaluate.bench import report

        figures = report.run(container, show)
    elif settings.suite == "mpc":
        figures = _mpc(config.task, much)
    elif on_gpu:
        figures = _gpu(config, overrides, much)
    else:
        figures = _actuator(config.task, much)
    about = " ".join(settings.overrides) or "defaults"
    print(f"suite={settings.suite} N={settings.num_envs} ({about})\n{env.machine()}\n")
    for name, value in figures.items():
        if name.endswith(LIMIT):
            continue
        goal, meaning = GOALS.get(name, (None, name.replace("_per_s", " per second").replace("_", " ")))
        limit = figures.get(name + LIMIT, 1.0 if name.endswith("env_over_bare") else None)
        aim, most = ("" if v is None else f"{k} {v:.3g}" for k, v in (("goal", goal), ("limit", limit)))
        print(f"{value:12,.2f}  {aim:10} {most:11} {meaning}")
    if settings.out:
        out = Path(settings.out)
        out.parent.mkdir(parents=True, exist_ok=True)
        write_json(out, figures)
        print(f"\nwritten to {out}")


def _actuator(task: TaskConfig, much: Measured) -> dict[str, float]:
    import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
    from go1exp.evaluate.bench import actuator

    record = compose("record")
    wanted = {f.name for f in fields(RecordSettings)}
    settings = parse(RecordSettings, {k: v for k, v in record.items() if k in wanted})
    return actuator.run(task, settings.sensors, settings.physics_dt, much)


def _mpc(task: TaskConfig, much: Measured) -> dict[str, float]:
    from go1exp.cli import subjects
    from go1exp.evaluate.bench import deploy

    settings = subjects.chosen_controller(compose("record")["controller"])
    assert settings is not None
    return deploy.run_mpc(task, settings, much)


def _gpu(config: TrainConfig, overrides: list[str], much: Measured) -> dict[str, float]:
    import torch

    if not torch.cuda.is_available():
        raise ConfigError(["suite=gpu: torch finds no CUDA device"])
    from go1exp.evaluate.bench import gpu

    print(gpu.gpu())
    return gpu.run(config, overrides, much)


APP = App("bench", _task, BenchSettings)
