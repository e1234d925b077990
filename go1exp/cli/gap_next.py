"""``go1exp gap next``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.base.files import write_json
from go1exp.cli.app import App
from go1exp.cli.quoting import command

if TYPE_CHECKING:
    from go1exp.gap.stages.next import NextResult

NOT_SEPARABLE = 16
"""Exit status if no recording tells apart what is left."""

TARGETS, ANSWER = "next.csv", "next.json"
"""Names of the files in the output folder."""


def _task(container: dict[str, Any]) -> int:
    from go1exp.cli.gap import _progress
    from go1exp.cli.logs import long_enough, read_all
    from go1exp.cli.parts import parse_with_groups
    from go1exp.cli.settings import GapNextSettings
    from go1exp.gap import files
    from go1exp.gap.robots.description import parse_model

    settings, parts = parse_with_groups(GapNextSettings, container, ("robot",), model=parse_model)
    out = Path(settings.out)
    answer = files.load(out)

    from go1exp.gap.design.limits import DesignError
    from go1exp.gap.robots.choice import robot_of
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
    from go1exp.gap.design.written import write

    (out / TARGETS).unlink(missing_ok=True)
    if result.best:
        write(result.best, result.joints, 1.0 / result.rate_hz, out / TARGETS)
    write_json(out / ANSWER, result.as_dict(), indent=1)


def text(result: NextResult, file: Path) -> str:
    """Return a result as lines for people; ``file`` is where its targets are."""
    lines = [f"settled by the logs at hand: {', '.join(result.settled)}"] if result.settled else []
    if result.verdict == "nothing left":
        return "\n".join([*lines, "nothing is left to be told apart: no further recording is needed for the answer"])
    best = result.best
    if best is None:
        lines.append(f"not separable: none of {result.tried} designs ({result.beyond} more beyond a limit) tells apart")
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


def _few(values: Any) -> str:
    """Write gains: one number if all joints have the same."""
    return f"{values[0]:g}" if min(values) == max(values) else ", ".join(f"{v:g}" for v in values)


def _attitude(attitude: Any) -> str:
    if attitude.roll is None:
        return "the base as it was in the recordings"
    return f"the trunk at roll {attitude.roll:g} and pitch {attitude.pitch:g} rad"


APP = App("gap_next", _task, title="gap next")
