"""``go1exp record``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from go1exp.cli.app import App, spinner
from go1exp.cli.quoting import command
from go1exp.schema.registry import ConfigError, Term, bind_list

if TYPE_CHECKING:
    from pathlib import Path

    from go1exp.cli.settings import RecordSettings
    from go1exp.record.plan import Episode
    from go1exp.record.simulate import Rig
    from go1exp.recording import Recording

RIG = ("robot", "actuator", "effect", "terrain", "backend")
"""Groups of the configuration that describe the robot to be recorded."""

POLICY = "policy"
"""The excitation that is a trained policy walking."""


def _motions(given: Any) -> list[Term]:
    """Resolve the excitations; raise ConfigError with every problem of them."""
    if not given or not isinstance(given, list):
        raise ConfigError([f"excitation = {given!r}: must be a list, such as [steps,{{chirp: {{band: [0.2, 5.0]}}}}]"])
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
    import go1exp.excitations
    import go1exp.record.policy  # noqa: F401  (registers every excitation)
    from go1exp import robot
    from go1exp.cli.parts import parse_with_groups
    from go1exp.cli.runs import trained
    from go1exp.cli.settings import RecordSettings
    from go1exp.effects.rules import drive_problems, has_gains

    settings, parts = parse_with_groups(RecordSettings, container, RIG, excitation=_motions)
    motions = parts["excitation"]
    problems = drive_problems(parts["actuator"], parts["effect"], robot.JOINTS)
    if not problems and any(m.entry.name != POLICY for m in motions) and not has_gains(parts["actuator"]):
        problems.append(f"gains: actuator {parts['actuator'].entry.name!r} has none to set; use excitation=[policy]")
    if any(m.entry.name == POLICY for m in motions) and not (settings.run or settings.policy):
        problems.append("run: required for excitation=[policy], such as run=runs/NAME, or policy=paper")
    if all(m.entry.name == POLICY for m in motions):
        problems += _unused(settings)
    if problems:
        raise ConfigError(problems)
    walk = trained(settings.run, settings.policy, "", "")[0] if settings.run or settings.policy else None

    from go1exp.cli.logs import writable
    from go1exp.record import plan
    from go1exp.record.simulate import Rig

    rig = Rig(**{name: parts[name] for name in RIG}, physics_dt=settings.physics_dt)
    driven = [m for m in motions if m.entry.name != POLICY]
    episodes = plan.episodes(driven, settings)  # refuses wrong settings before the folder is made
    out = writable(settings.out)
    if present := sorted(p.name for p in out.glob("*.parquet")):
        print(f"note: {out} holds {len(present)} recordings already; they stay, those of the same name are replaced")
    recordings = _record_motions(rig, episodes, settings)
    if walk and len(driven) < len(motions):
        recordings += _record_policy(rig, walk, settings)
    _write(out, recordings)


def _record_motions(rig: Rig, episodes: list[Episode], settings: RecordSettings) -> list[Recording]:
    """Drive simulated robots through the motions; return a recording of each episode."""
    from go1exp.record import simulate

    if not episodes:
        return []
    show = spinner(1, f"recording {len(episodes)} episodes")
    return simulate.play(rig, episodes, settings.sensors, settings.seed, show)


def _record_policy(rig: Rig, run: Path, settings: RecordSettings) -> list[Recording]:
    """Let the policy of a run move simulated robots; return a recording of each."""
    from go1exp.evaluate.policy import load_run
    from go1exp.record import simulate

    config, policy, _ = load_run(run)
    names = [f"policy_{settings.seed}_{k}" for k in range(settings.episodes)]
    hang = settings.hang[0] if settings.support == "hung" else None
    walk = simulate.Walk(config.task, policy, names, settings.seconds, hang)
    show = spinner(1, "recording a policy")
    return simulate.play_policy(rig, walk, settings.sensors, settings.seed, show)


def _write(out: Path, recordings: list[Recording]) -> None:
    """Write the recordings and print what to do with them."""
    from go1exp import recording

    for r in recordings:
        recording.write(out / f"{r.meta.episode}.parquet", r)
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    print(f"{len(recordings)} recordings, {total:.0f} s, in {out}")
    print(f"now: {command('record', 'audit', str(out))}")


APP = App("record", _task)
