"""``go1exp compare``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from go1exp.base.files import write_json, write_text
from go1exp.cli import subjects
from go1exp.cli.app import App, announce, parse, spinner
from go1exp.cli.evaluate import RATES, note_replaced, refuse
from go1exp.cli.places import writable
from go1exp.cli.subjects import Named, Variation, agent, varied
from go1exp.config.schema import settings as schema
from go1exp.config.schema.physics import PhysicsStep
from go1exp.config.schema.registry import ConfigError

if TYPE_CHECKING:
    from go1exp.evaluate.controller.types import TrunkVelocity
    from go1exp.evaluate.protocol.base import Chosen
    from go1exp.evaluate.protocol.comparing import Difference
    from go1exp.evaluate.protocol.playing import Result


@schema.settings
class CompareSettings:
    """``conf/compare.yaml`` without the groups.

    Attributes:
        subjects: two or more, each a shipped policy, a run folder or a bundle (.zip); with @100hz at that rate, with
            @estimated or @exact velocity. All others are compared with the first.
        same_robot: all on the robot of the first: its actuators, effects, contact, randomisation and falls; false takes
            each one's own.
        seed: seed of everything random, the same for all.
        physics_dt: another physics step, s; null keeps that of training.
        folder: for compare.html, compare.json and the rows.
    """

    subjects: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=2)]
    same_robot: bool
    seed: Annotated[int, Field(ge=0)]
    physics_dt: PhysicsStep | None
    folder: Annotated[str, Field(min_length=1)]

    def __post_init__(self) -> None:
        if len(set(self.subjects)) < len(self.subjects):
            raise ValueError(f"subjects = {list(self.subjects)}: each only once")


def _task(container: dict[str, object]) -> None:
    import go1exp.evaluate.protocol.kinds  # noqa: F401  (registers them)
    from go1exp.evaluate.protocol.base import chosen

    other, container = subjects.split_robot(container)
    protocols, grid = chosen(container.pop("protocol"))
    settings = parse(CompareSettings, container)
    if grid:
        raise ConfigError(
            ["protocol=grid: go1exp compare plays others, such as protocol=sinusoid; go1exp eval the grid"]
        )
    named_subjects = [varied(given, "") for given in settings.subjects]
    if any(c.kind == RATES for c in protocols):
        _refuse_rates(named_subjects)
    folder = Path(settings.folder)
    if folder.exists() and not folder.is_dir():
        raise ConfigError([f"folder = {settings.folder!r}: is a file"])

    announce(f"comparing {', '.join(settings.subjects)}")
    from go1exp.evaluate.protocol.playing import Rates, play, refuse_lengths

    first = agent(named_subjects[0][0], other)
    robot_of = first.task if settings.same_robot else None
    agents = [first, *(agent(named, other, robot_of) for named, _ in named_subjects[1:])]
    of_each = [_with(protocols, how.trunk_velocity) for _, how in named_subjects]
    rates = [Rates(settings.seed, how.policy_dt, settings.physics_dt, how.engine) for _, how in named_subjects]
    for theirs, drives, pace in zip(of_each, agents, rates, strict=True):
        refuse(theirs, drives)
        refuse_lengths(theirs, drives, pace)
    writable(settings.folder, "folder")
    note_replaced(folder, ["compare.json"])
    plays: dict[str, list[Result]] = {}
    origin = {"robot": subjects.robot_as_data(other), "robot_of": settings.subjects[0] if robot_of else "each its own"}
    for k, protocol in enumerate(protocols):
        results = []
        for theirs, drives, pace in zip(of_each, agents, rates, strict=True):
            show = spinner(1, f"{protocol.key}: {drives.label}")
            results.append(play(theirs[k], drives, pace, origin, show))
        plays[protocol.key] = results
    _report(plays, folder, {**dataclasses.asdict(settings), **origin})


def _refuse_rates(named_subjects: list[tuple[Named, Variation]]) -> None:
    """Raise ConfigError naming a subject whose rate or velocity is not that which protocol=rate varies."""
    for named, how in named_subjects:
        if named.controller or how.policy_dt or how.trunk_velocity:
            reason = "has a rate of its own" if named.controller else f"is varied in what protocol={RATES} varies"
            raise ConfigError([f"subjects: {named.label} {reason}; leave {RATES} out, also of protocol=paper"])


def _with(protocols: list[Chosen], trunk_velocity: TrunkVelocity | None) -> list[Chosen]:
    """Return the protocols with another velocity, where a subject has one."""
    if trunk_velocity is None:
        return protocols
    return [
        dataclasses.replace(c, protocol=dataclasses.replace(c.protocol, trunk_velocity=trunk_velocity))
        for c in protocols
    ]


def _report(plays: dict[str, list[Result]], folder: Path, about: dict[str, object]) -> None:
    from go1exp.evaluate.protocol import comparing
    from go1exp.evaluate.protocol.pages import comparison
    from go1exp.evaluate.protocol.playing import as_json
    from go1exp.evaluate.quantities import finite, write_rows

    differences = {
        key: [d for r in results[1:] for d in comparing.compared(results[0], r)] for key, results in plays.items()
    }
    folder.mkdir(parents=True, exist_ok=True)
    for key, results in plays.items():
        rows = [{"subject": r.label, **row} for r in results for row in r.played.rows]
        write_rows(folder / f"{key}.parquet", rows, {"protocol": key})
    content = {
        **about,
        "differences": {key: [comparing.as_json(d) for d in those] for key, those in differences.items()},
        "results": {key: [{**as_json(r), "curves": {}} for r in results] for key, results in plays.items()},
    }
    write_json(folder / "compare.json", finite(content), indent=1, allow_nan=False)
    write_text(folder / "compare.html", comparison(plays, differences, about))
    print("\n".join(lines(differences)))
    print(f"written to {folder / 'compare.html'}, {folder / 'compare.json'}, rows beside them")


def lines(differences: Mapping[str, Sequence[Difference]]) -> list[str]:
    """Return the lines for a terminal: significant differences, and the number of the others."""
    from go1exp.base.report.table import interval_text
    from go1exp.evaluate.protocol.pages import condition_text

    text_lines = []
    for key, those in differences.items():
        for subject in dict.fromkeys(d.subject for d in those):
            of_subject = [d for d in those if d.subject == subject]
            clear = [d for d in of_subject if d.verdict != "no significant difference"]
            text_lines.append(f"{key}: {subject}: {len(clear)} of {len(of_subject)} differences are significant")
            for d in clear:
                change = interval_text(d.difference.estimate, d.difference.low, d.difference.high)
                where = condition_text(d.condition)
                text_lines.append(f"  {d.verdict:7} {d.figure} {d.first:.3g} -> {d.other:.3g}, {change} ({where})")
    return text_lines


APP = App("compare", _task, CompareSettings)
