"""``go1exp record``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from go1exp.cli.app import App, spinner
from go1exp.cli.quoting import command
from go1exp.config.schema.registry import ConfigError, Term, bind_list
from go1exp.evaluate.controller.settings import MpcSettings, parse_controller

if TYPE_CHECKING:
    from pathlib import Path

    from go1exp.cli.settings import RecordSettings
    from go1exp.logs.record.plan import Episode
    from go1exp.logs.record.simulate import Rig
    from go1exp.logs.recording import Recording
    from go1exp.sim.env.core import Go1Core

RIG = ("robot", "actuator", "effect", "terrain", "backend")
"""Groups of the configuration that describe the robot to be recorded."""

CONTACT = "contact"
"""Group that may be left open: then a policy has the contact of its training, and motions have MuJoCo's own."""

POLICY, MPC = "policy", "mpc"
"""The excitations that are a trained policy, and a model predictive controller, walking."""

COMMANDS = "gentle"
"""Random commands (``conf/command``) that a model predictive controller walks under."""


def rig_groups(container: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the groups of a configuration that describe the robot to be recorded, the contact if there is a choice."""
    return (*RIG, CONTACT) if container.get(CONTACT) is not None else RIG


def _motions(given: Any) -> list[Term]:
    """Resolve the excitations; raise ConfigError with every problem of them."""
    if not given or not isinstance(given, list):
        what = "at least one is needed" if given == [] else "must be a list"
        raise ConfigError([f"excitation = {given!r}: {what}, such as [steps,{{chirp: {{band: [0.2, 5.0]}}}}]"])
    return bind_list("excitation", given, "excitation")


def _unused(settings: RecordSettings) -> list[str]:
    """Return complaints about settings of motions that a policy does not heed."""
    wrong = []
    if len(settings.gains) > 1 or settings.repeats or len(settings.seeds) > 1:
        wrong.append("gains, seeds, repeats: are for motions; a policy's gains are actuator.kp and actuator.kd")
    if len(settings.hang) > 1:
        wrong.append("hang: a policy hangs one way at a time")
    return wrong


def _task(container: dict[str, Any]) -> None:
    import go1exp.logs.excitations
    import go1exp.logs.record.motions  # noqa: F401  (registers every excitation)
    from go1exp import robot
    from go1exp.cli.parts import parse_with_groups
    from go1exp.cli.runs import trained
    from go1exp.cli.settings import RecordSettings
    from go1exp.sim.effects.rules import actuator_problems, has_gains

    readers = {"excitation": _motions, "controller": parse_controller}
    groups = rig_groups(container)
    settings, parts = parse_with_groups(RecordSettings, container, groups, **readers)
    motions = parts["excitation"]
    problems = actuator_problems(parts["actuator"], parts["effect"], robot.JOINTS)
    names = {m.entry.name for m in motions}
    if MPC in names:
        problems += _misfits(settings, parts)
    if not problems and names - {POLICY} and not has_gains(parts["actuator"]):
        problems.append(f"gains: actuator {parts['actuator'].entry.name!r} has none to set; use excitation=[policy]")
    if POLICY in names and not (settings.run or settings.policy):
        problems.append("run: required for excitation=[policy], such as run=runs/NAME, or policy=paper")
    if names <= {POLICY, MPC}:
        problems += _unused(settings)
    if problems:
        raise ConfigError(problems)
    walk = trained(settings.run, settings.policy, "", "")[0] if settings.run or settings.policy else None

    from go1exp.base.wording import counted
    from go1exp.cli.logs import writable
    from go1exp.logs.record import plan

    driven = [m for m in motions if m.entry.name not in (POLICY, MPC)]
    episodes = plan.episodes(driven, settings)  # refuses wrong settings before the folder is made
    if names & {POLICY, MPC}:
        plan.refuse_too_long(settings, "episodes", settings.episodes)
    from go1exp.logs.record.simulate import Rig

    rig = Rig(**{name: parts[name] for name in groups}, physics_dt=settings.physics_dt)
    out = writable(settings.out)
    if present := sorted(p.name for p in out.glob("*.parquet")):
        held = counted(len(present), "recording")
        print(f"note: {out} holds {held} already; they stay, those of the same name are replaced")
    recordings = _record_motions(rig, episodes, settings)
    if walk and POLICY in names:
        recordings += _record_policy(rig, walk, settings)
    if MPC in names:
        recordings += _record_mpc(rig, parts["controller"], settings)
    _write(out, recordings)


def _record_motions(rig: Rig, episodes: list[Episode], settings: RecordSettings) -> list[Recording]:
    """Drive simulated robots through the motions; return a recording of each episode."""
    from go1exp.logs.record import simulate

    if not episodes:
        return []
    show = spinner(1, f"recording {len(episodes)} episodes")
    return simulate.play(rig, episodes, settings.sensors, settings.seed, show)


def _record_policy(rig: Rig, run: Path, settings: RecordSettings) -> list[Recording]:
    """Let the policy of a run move simulated robots; return a recording of each."""
    from go1exp.logs.record import simulate
    from go1exp.train.policy import load_run

    config, policy, _ = load_run(run)
    names = [f"policy_{settings.seed}_{k}" for k in range(settings.episodes)]
    hang = settings.hang[0] if settings.support == "suspended" else None
    walk = simulate.Walk(config.task, policy, names, settings.seconds, hang)
    show = spinner(1, "recording a policy")
    return simulate.play_policy(rig, walk, settings.sensors, settings.seed, show)


def _misfits(settings: RecordSettings, parts: dict[str, Any]) -> list[str]:
    """Return why a model predictive controller cannot walk this robot, and look for its solver."""
    from go1exp.evaluate.controller.forces import solver

    wrong = []
    if parts["controller"].name != MPC:
        wrong.append(f"controller.name = {parts['controller'].name!r}: excitation=[mpc] needs controller=mpc")
    if settings.support == "suspended":
        wrong.append("support = 'suspended': excitation=[mpc] walks on the ground; use support=auto")
    solver()
    return wrong


def _record_mpc(rig: Rig, controller: MpcSettings, settings: RecordSettings) -> list[Recording]:
    """Let a model predictive controller walk simulated robots by targets alone; return a recording of each."""
    from go1exp.cli import controllers
    from go1exp.config.compose import compose
    from go1exp.evaluate.controller.adapters import AsTargets
    from go1exp.evaluate.controller.batch import Driven
    from go1exp.logs.record import simulate
    from go1exp.sim.task import parse_train

    task = parse_train(compose("train", [f"command={COMMANDS}"])).task
    make = controllers.maker(controller, task)
    gains = [np.array(simulate.configured(rig.actuator, name)) for name in ("kp", "kd")]
    names = [f"mpc_{settings.seed}_{k}" for k in range(settings.episodes)]

    def drive(core: Go1Core) -> Driven:
        return Driven(core, lambda: AsTargets(make(), *gains), noise=False, seed=settings.seed)

    walk = simulate.Walk(task, None, names, settings.seconds, None, drive, MPC)
    return simulate.play_policy(rig, walk, settings.sensors, settings.seed, spinner(1, "recording a controller"))


def _write(out: Path, recordings: list[Recording]) -> None:
    """Write the recordings and print what to do with them."""
    from go1exp.base.wording import counted
    from go1exp.logs import recording

    for r in recordings:
        recording.write(out / f"{r.meta.episode}.parquet", r)
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    print(f"{counted(len(recordings), 'recording')}, {total:.0f} s, in {out}")
    print(f"now: {command('record', 'audit', str(out))}")


APP = App("record", _task)
