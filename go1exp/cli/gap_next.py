"""``go1exp gap next`` and ``go1exp gap loop``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from go1exp.base.errors import FAILED, NOT_SEPARABLE
from go1exp.base.files import write_json
from go1exp.cli.app import App, Reader, parse_with_groups
from go1exp.cli.gap import Logs, _progress, refuse_no_logs, refuse_unknown
from go1exp.cli.places import long_enough, read_all, writable
from go1exp.cli.record import RIG, _motions
from go1exp.cli.verbs import command
from go1exp.config.schema import settings as schema
from go1exp.config.schema.physics import RecordedStep
from go1exp.config.schema.registry import ConfigError, FolderName
from go1exp.gap.design.plan import Attitude, DesignSettings
from go1exp.gap.result import GapSettings
from go1exp.logs.record.plan import RecordingConfig

if TYPE_CHECKING:
    import numpy as np

    from go1exp.gap.stages.loop import Turn
    from go1exp.gap.stages.next import NextResult


@schema.settings
class GapNextSettings:
    """``conf/gap_next.yaml`` without the groups.

    Attributes:
        logs: the recordings that the answer is of: a folder, or a list of folders and files.
        out: folder with the answer (verdict.json of go1exp gap), which gets next.csv and next.json.
        design: what may be designed.
    """

    logs: Logs
    out: FolderName
    design: DesignSettings

    def __post_init__(self) -> None:
        """Check what a type does not."""
        refuse_no_logs(self.logs)


@schema.settings
class GapLoopSettings(RecordingConfig):
    """``conf/gap_loop.yaml`` without the groups.

    Attributes:
        excitation: motions to begin with, by name, as of go1exp record.
        physics_dt: physics step of the simulated robot, s.
        rounds: recordings that may be designed and made, one after the other.
        search: how the missing effect is searched for in every round.
        design: what may be designed.
        out: folder for recordings, answers and designs by round, and the table loop.json.
    """

    excitation: Any = ()
    physics_dt: RecordedStep
    rounds: Annotated[int, Field(ge=0)]
    search: GapSettings
    design: DesignSettings
    out: FolderName

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        wrong, window = self.empty(), self.search.burn_s + self.search.window_s
        if self.seconds < window:
            needed = f"search.burn_s + search.window_s = {window:g} s"
            wrong.append(f"seconds = {self.seconds:g}: shorter than a window, {needed}")
        if wrong:
            raise ValueError("\n".join(wrong))


TARGETS, ANSWER = "next.csv", "next.json"  # names of the files in the output folder


def _next(container: dict[str, object]) -> int:
    from go1exp.gap import files
    from go1exp.gap.robots.description import parse_model

    settings, parts = parse_with_groups(GapNextSettings, container, ("robot",), model=parse_model)
    out = Path(settings.out)
    answer = files.load(out)

    from go1exp.gap.design.plan import DesignError
    from go1exp.gap.robots.fixed_base import robot_of
    from go1exp.gap.stages.next import design

    robot = robot_of(parts["model"], parts["robot"])
    search = files.search_of(answer)
    recordings = long_enough(read_all(settings.logs), search.window_s + search.burn_s)  # as the search left them out
    if not recordings:
        raise DesignError("logs: none of these recordings can be compared")
    result = design(answer, recordings, robot, search, settings.design, _progress())
    save(result, out)
    print("\n" + text(result, out / TARGETS))
    print(f"\nwritten to {', '.join(str(out / name) for name in written(result))}")
    return NOT_SEPARABLE if result.verdict == "not separable" else 0


def written(result: NextResult) -> tuple[str, ...]:
    """Return the names of the files of a result."""
    return (TARGETS, ANSWER) if result.best else (ANSWER,)


def save(result: NextResult, out: Path) -> None:
    """Write the files of a result into a folder; one of an earlier result that this one has not goes."""
    from go1exp.gap.design.rehearsal import write

    (out / TARGETS).unlink(missing_ok=True)
    if result.best:
        write(result.best, result.joints, 1.0 / result.rate_hz, out / TARGETS)
    write_json(out / ANSWER, result.as_dict(), indent=1)


def text(result: NextResult, file: Path) -> str:
    """Return a result as lines for people; ``file`` is where its targets are."""
    known = ", ".join(result.distinguishable)
    lines = [f"already distinguishable by the logs at hand: {known}"] if known else []
    if result.standing:
        names, how = ", ".join(result.standing), ", ".join(dict.fromkeys(result.standing.values()))
        lines.append(f"only a robot on its feet shows {names}: excitation={how}")
    if result.verdict == "nothing left":
        return "\n".join([*lines, "nothing is left to distinguish: no further recording is needed for the answer"])
    best = result.best
    if best is None:
        lines.append(f"not separable: none of {result.tried} designs ({result.beyond} more beyond a limit) separates")
    else:
        design = best.design
        parameters = ", ".join(f"{k} {v}" for k, v in design.about(result.rate_hz)["parameters"].items())
        used = best.used
        lines += [
            f"record next: {design.excitation}, {result.seconds:g} s ({parameters})",
            f"  gains: kp {_few(best.kp)} N m/rad, kd {_few(best.kd)} N m s/rad",
            f"  attitude: {_attitude(design.attitude)}",
            f"  of what is allowed it uses {used.angle:.0%} of the angles, {used.speed:.0%} of the speed, "
            f"{used.torque:.0%} of the torque; {used.power:.0f} W",
        ]
    lines += [f"  {pair.text}" for pair in result.pairs]
    if best is not None and best.design.attitude.roll is not None:
        lines.append(f"on the simulated robot (with the effect=... that it has): {record_command(result, file)}")
    return "\n".join(lines)


def record_command(result: NextResult, file: Path) -> str:
    """Return how ``go1exp record`` makes the recording of a design for a Go1."""
    best = result.best
    assert best is not None
    attitude = best.design.attitude
    settings = {
        "excitation": f"[{{playback: {{file: {file}}}}}]",
        "gains": f"[[{best.kp[0]:g},{best.kd[0]:g}]]",
        "hang": f"[[{attitude.roll:g},{attitude.pitch:g}]]",
        "seconds": f"{result.seconds:g}",
    }
    return command("record", settings=settings)


def _few(values: np.ndarray) -> str:
    """Write gains: one number if all joints have the same."""
    return f"{values[0]:g}" if min(values) == max(values) else ", ".join(f"{v:g}" for v in values)


def _attitude(attitude: Attitude) -> str:
    if attitude.roll is None:
        return "the base as it was in the recordings"
    return f"the trunk at roll {attitude.roll:g} and pitch {attitude.pitch:g} rad"


NEXT = App("gap_next", _next, GapNextSettings)


TABLE = "loop.json"  # name of the file with a row for each round


def _loop(container: dict[str, object]) -> int:
    import go1exp.logs.excitations
    import go1exp.logs.record.motions  # noqa: F401  (registers every excitation)
    from go1exp import robot as go1
    from go1exp.gap.robots.description import Go1Model, parse_model
    from go1exp.sim.effects.rules import actuator_problems

    readers: dict[str, Reader] = {"excitation": _motions, "model": parse_model}
    settings, parts = parse_with_groups(GapLoopSettings, container, RIG, **readers)
    refuse_unknown(settings.search.effects)
    problems = actuator_problems(parts["actuator"], parts["effect"], go1.JOINTS)
    if not isinstance(parts["model"], Go1Model):
        problems.append("model: the simulated robot is a Go1; only model.tolerances can be changed here")
    if settings.support != "suspended":
        problems.append(f"support = {settings.support!r}: designs are for a suspended robot")
    if any(m.entry.traits.get("closed_loop") for m in parts["excitation"]):
        problems.append("excitation: motions only; a policy or a controller walks on the ground")
    if problems:
        raise ConfigError(problems)

    from go1exp.gap.robots.fixed_base import robot_of
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
    write_json(out / TABLE, [asdict(row) for row in rows], indent=1)
    print(f"\n{table(rows)}\n\nwritten to {out / TABLE}")
    return 0 if rows[-1].ended == "one name is left" else FAILED


def _keep(turn: Turn, out: Path) -> None:
    """Write the files of a round, and print its row."""
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


LOOP = App("gap_loop", _loop, GapLoopSettings)
