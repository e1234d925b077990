"""``go1exp gap loop``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.base.files import write_json
from go1exp.cli.app import App
from go1exp.config.schema.registry import ConfigError

if TYPE_CHECKING:
    from go1exp.gap.stages.loop import Turn

TABLE = "loop.json"
"""Name of the file with a row for each round."""


def _task(container: dict[str, Any]) -> int:
    import go1exp.logs.excitations
    import go1exp.logs.record.motions  # noqa: F401  (registers every excitation)
    from go1exp import robot as go1
    from go1exp.cli.gap import _progress, refuse_unknown
    from go1exp.cli.parts import parse_with_groups
    from go1exp.cli.record import RIG, _motions
    from go1exp.cli.settings import GapLoopSettings
    from go1exp.gap.robots.description import Go1Model, parse_model
    from go1exp.sim.effects.rules import actuator_problems

    readers: dict[str, Any] = {"excitation": _motions, "model": parse_model}
    settings, parts = parse_with_groups(GapLoopSettings, container, RIG, **readers)
    refuse_unknown(settings.search.effects)
    problems = actuator_problems(parts["actuator"], parts["effect"], go1.JOINTS)
    if not isinstance(parts["model"], Go1Model):
        problems.append("model: the simulated robot is a Go1; only model.tolerances can be changed here")
    if settings.support != "suspended":
        problems.append(f"support = {settings.support!r}: designs are for a robot that is hung")
    if any(m.entry.traits.get("closed_loop") for m in parts["excitation"]):
        problems.append("excitation: motions only; a policy or a controller walks on the ground")
    if problems:
        raise ConfigError(problems)

    from go1exp.cli.logs import writable
    from go1exp.gap.robots.choice import robot_of
    from go1exp.gap.stages.loop import loop, table
    from go1exp.logs.record import plan
    from go1exp.logs.record.simulate import Rig

    rig = Rig(**{name: parts[name] for name in RIG}, physics_dt=settings.physics_dt)
    episodes = plan.episodes(parts["excitation"], settings)
    out = writable(settings.out)
    rows = loop(
        rig,
        episodes,
        settings.sensors,
        robot_of(parts["model"], parts["robot"]),
        settings.search,
        settings.design,
        settings.rounds,
        lambda turn: _keep(turn, out),
        _progress(),
    )
    write_json(out / TABLE, [row.as_dict() for row in rows], indent=1)
    print(f"\n{table(rows)}\n\nwritten to {out / TABLE}")
    return 0 if rows[-1].ended == "one name is left" else 1


def _keep(turn: Turn, out: Path) -> None:
    """Write what a round leaves, and say what it found."""
    from go1exp.cli.gap_next import save
    from go1exp.gap import files
    from go1exp.gap.stages.loop import table
    from go1exp.logs import recording

    folder = out / f"round_{turn.row.number}"
    (out / "recordings").mkdir(parents=True, exist_ok=True)
    for r in turn.recordings:
        recording.write(out / "recordings" / f"{r.meta.episode}.parquet", r)
    files.save(turn.result, folder)
    if turn.design:
        save(turn.design, folder)
    print(f"\n{table([turn.row])}\n", flush=True)


APP = App("gap_loop", _task, title="gap loop")
