"""``go1exp record``, ``go1exp record audit`` and ``go1exp record import``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from go1exp.base import errors
from go1exp.base.files import write_json
from go1exp.base.wording import counted, listed
from go1exp.cli.app import App, announce, parse, parse_with_groups, spinner
from go1exp.cli.places import files_of, names_of, trained, writable
from go1exp.cli.verbs import command
from go1exp.config.compose import compose
from go1exp.config.schema import settings as schema
from go1exp.config.schema.physics import RecordedStep
from go1exp.config.schema.registry import ConfigError, Count, FolderName, Term, bind_list
from go1exp.evaluate.controller.settings import MpcSettings, parse_controller
from go1exp.logs.record.plan import RecordingConfig

if TYPE_CHECKING:
    from go1exp.logs.record.simulate import Rig
    from go1exp.logs.recording import Recording
    from go1exp.sim.env.core import Go1Core


@schema.settings
class RecordSettings(RecordingConfig):
    """``conf/record.yaml`` without the groups.

    Attributes:
        controller: settings of excitation=[mpc].
        excitation: motions by name (go1exp list excitation); with parameters as {chirp: {band: [0.2, 5.0]}}.
        run: run folder of the policy of excitation=[policy]; or give policy.
        policy: name of a policy that comes with the package, such as paper, in place of run.
        episodes: robots that walk under a policy.
        physics_dt: physics step, s.
        out: folder for the recordings.
    """

    controller: Any = None
    excitation: Any = ()
    run: str | None
    policy: str | None
    episodes: Count
    physics_dt: RecordedStep
    out: str

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        wrong = self.empty()
        ratio = 1.0 / (self.sensors.rate_hz * self.physics_dt)
        if ratio < 1 - 1e-9 or abs(ratio - round(ratio)) > 1e-6:
            period = 1 / self.sensors.rate_hz
            wrong.append(f"physics_dt = {self.physics_dt}: 1 / sensors.rate_hz = {period:g} must be a multiple of it")
        if wrong:
            raise ValueError("\n".join(wrong))


@schema.settings
class AuditSettings:
    """``conf/record_audit.yaml``.

    Attributes:
        files: recordings (.parquet), or folders of them.
        tables: whether to print the tables of recordings that are ok, too; that of a single one is always printed.
        out: JSON file for the findings; null writes none.
    """

    files: Annotated[tuple[str, ...], Field(min_length=1)]
    tables: bool
    out: str | None


@schema.settings
class ImportSettings:
    """``conf/record_import.yaml``.

    Attributes:
        source: name of the importer (go1exp list importer).
        path: its file, or a folder of them.
        options: the importer's own parameters, such as {rate_hz: 100.0}, or a FILE.yaml of them.
        drop: impossible leaves out rows that their neighbours rule out; null leaves out none.
        columns: of source=csv: channel -> column, such as {t: time, q_knee: {column: pos, unit: deg}}, or a FILE.yaml.
        out: folder for the recordings.
    """

    source: str
    path: str
    options: dict[str, Any] | str | None
    columns: dict[str, Any] | str | None
    drop: Literal["impossible"] | None
    out: FolderName


RIG = ("robot", "actuator", "effect", "terrain", "backend")
"""Groups of the configuration that describe the robot to be recorded."""

CONTACT = "contact"
"""Group that may be left open: then a policy has the contact of its training, and motions have MuJoCo's own."""

POLICY, MPC = "policy", "mpc"
"""The excitations that are a trained policy, and a model predictive controller, walking."""

COMMANDS = "gentle"  # random commands (``conf/command``) that a model predictive controller walks under


def rig_groups(container: Mapping[str, object]) -> tuple[str, ...]:
    """Return the groups of a configuration that describe the robot to be recorded, the contact if there is a choice."""
    return (*RIG, CONTACT) if container.get(CONTACT) is not None else RIG


def _motions(given: object) -> list[Term]:
    if not given or not isinstance(given, list):
        what = "at least one is needed" if given == [] else "must be a list"
        raise ConfigError([f"excitation = {given!r}: {what}, such as [steps,{{chirp: {{band: [0.2, 5.0]}}}}]"])
    return bind_list("excitation", given, "excitation")


def _unused(settings: RecordSettings) -> list[str]:
    wrong = []
    if len(settings.gains) > 1 or settings.repeats or len(settings.seeds) > 1:
        wrong.append("gains, seeds, repeats: are for motions; a policy's gains are actuator.kp and actuator.kd")
    if len(settings.hang) > 1:
        wrong.append("hang: a policy hangs one way at a time")
    return wrong


def _record(container: dict[str, object]) -> None:
    import go1exp.logs.excitations
    import go1exp.logs.record.motions  # noqa: F401  (registers every excitation)
    from go1exp import robot
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

    from go1exp.logs.record import plan

    driven = [m for m in motions if m.entry.name not in (POLICY, MPC)]
    episodes = plan.episodes(driven, settings)  # refuses wrong settings before the folder is made
    if names & {POLICY, MPC}:
        plan.refuse_too_long(settings, "episodes", settings.episodes)
    out = writable(settings.out)
    announce("recording")

    from go1exp.logs.record import simulate

    rig = simulate.Rig(**{name: parts[name] for name in groups}, physics_dt=settings.physics_dt)
    if present := sorted(p.name for p in out.glob("*.parquet")):
        held = counted(len(present), "recording")
        print(f"note: {out} holds {held} already; they stay, those of the same name are replaced")
    recordings: list[Recording] = []
    if episodes:
        show = spinner(1, f"recording {len(episodes)} episodes")
        recordings += simulate.play(rig, episodes, settings.sensors, settings.seed, show)
    if walk and POLICY in names:
        recordings += _record_policy(rig, walk, settings)
    if MPC in names:
        recordings += _record_mpc(rig, parts["controller"], settings)
    _write(out, recordings)
    print(f"now: {command('record', 'audit', str(out))}")


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
    from go1exp.cli import subjects
    from go1exp.evaluate.controller.batch import Driven
    from go1exp.evaluate.controller.types import AsTargets
    from go1exp.logs.record import simulate
    from go1exp.sim.task import parse_train

    task = parse_train(compose("train", [f"command={COMMANDS}"])).task
    make = subjects.controller_maker(controller, task)
    gains = [np.array(simulate.configured(rig.actuator, name)) for name in ("kp", "kd")]
    names = [f"mpc_{settings.seed}_{k}" for k in range(settings.episodes)]

    def drive(core: Go1Core) -> Driven:
        return Driven(core, lambda: AsTargets(make(), *gains), noise=False, seed=settings.seed)

    walk = simulate.Walk(task, None, names, settings.seconds, None, drive, MPC)
    return simulate.play_policy(rig, walk, settings.sensors, settings.seed, spinner(1, "recording a controller"))


def _write(out: Path, recordings: list[Recording]) -> None:
    from go1exp.logs import recording

    for r in recordings:
        recording.write(out / f"{r.meta.episode}.parquet", r)
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    print(f"{counted(len(recordings), 'recording')}, {total:.0f} s, in {out}")


APP = App("record", _record, RecordSettings)


def _audit(container: dict[str, object]) -> int:
    from go1exp.logs.recording import RecordingError

    settings = parse(AuditSettings, container)

    from go1exp.logs.audit import AuditReport, audit, clock_flaws, clock_kinds
    from go1exp.logs.recording import read

    reports: dict[str, Any] = {}
    robots: dict[str, dict[Path, AuditReport]] = {}
    unreadable: list[RecordingError] = []
    status = 0
    files = files_of(settings.files)
    names = dict(zip(files, names_of(files), strict=True))
    for file in files:
        try:
            recording = read(file)
        except RecordingError as error:
            unreadable.append(error)
            reports[str(file)] = {"verdict": "unreadable", "message": str(error)}
            continue
        report = audit(recording)
        print(
            f"{file}\n{report.text()}\n"
            if settings.tables or len(files) == 1 or report.verdict != "ok"
            else f"{file}: ok by itself"
        )
        reports[str(file)] = report.as_dict()
        robots.setdefault(recording.meta.robot, {})[file] = replace(report, episode=names[file])
        status = max(status, errors.AUDIT[report.verdict])
    for together in robots.values():  # those of one robot, as ``gap`` compares them
        flaws = clock_flaws([*together.values()])
        for file in together:
            if flaw := flaws.get(names[file]):
                print(f"{file}: bad beside the others: {flaw}")
                reports[str(file)] |= {"verdict": "bad", "clocks": flaw}
                status = max(status, errors.AUDIT["bad"])
        if kinds := clock_kinds([*together.values()]):
            print(f"note: {kinds}")
    if settings.out:
        out = Path(settings.out)
        out.parent.mkdir(parents=True, exist_ok=True)
        write_json(out, reports)
        print(f"written to {out}")
    if len(files) > 1:
        counts = Counter(report["verdict"] for report in reports.values())
        print(f"{len(files)} recordings: {', '.join(f'{n} {verdict}' for verdict, n in counts.items())}")
    if unreadable:  # the others have been audited
        raise RecordingError("\n".join(map(str, unreadable)))
    return status


AUDIT = App("record_audit", _audit, AuditSettings)


MOST_NOTES = 10  # most notes of recordings that an import prints


def _import(container: dict[str, object]) -> None:
    from go1exp.cli.hydra_main import mapping_of
    from go1exp.logs.importers import import_recordings

    settings = parse(ImportSettings, container)
    options = mapping_of(settings.options, "options")
    if settings.columns is not None:
        options["columns"] = mapping_of(settings.columns, "columns")
    recordings = import_recordings(settings.source, Path(settings.path), options)
    if settings.drop:
        from go1exp.logs.audit.impossible import impossible, without

        marked = [(r, impossible(r).rows) for r in recordings]
        recordings = [without(r, rows) if rows.any() else r for r, rows in marked]
    out = writable(settings.out)
    names = [f"{r.meta.episode}.parquet" for r in recordings]
    if present := [name for name in names if (out / name).exists()]:
        print(f"note: {out} holds {listed(present)} of an earlier call; new ones replace them (or: out=FOLDER)")
    _write(out, recordings)
    notes = list(dict.fromkeys(r.meta.notes for r in recordings if r.meta.notes))
    for note in [*_wrong_steps(recordings), *notes[:MOST_NOTES]]:
        print(f"note: {note}")
    if len(notes) > MOST_NOTES:
        print(f"note: {len(notes) - MOST_NOTES} more notes, in the metadata of the recordings")


def _wrong_steps(recordings: Sequence[Recording]) -> list[str]:
    """Return what is wrong with clocks whose steps are too long or too short, one line for all of one kind."""
    from go1exp.logs.audit.limits import LEAST_STEP
    from go1exp.logs.audit.signals import Log
    from go1exp.logs.audit.single import wrong_steps

    flaws: dict[str, list[str]] = {}
    for r in recordings:
        log = Log(r)
        if len(r.t) > 1 and (message := wrong_steps(log)):
            if unit := _unit_of(message, log.dt < LEAST_STEP):
                message += f"; with source=csv, columns gives the unit: t: {{column: NAME, unit: {unit}}}"
            flaws.setdefault(f"t {message}", []).append(r.meta.episode)
    return [f"{listed(episodes)}: {message}" for message, episodes in flaws.items()]


def _unit_of(message: str, short: bool) -> str | None:
    """Return the unit of a clock that ``wrong_steps`` names; seconds where the steps are too short."""
    named = next(
        (unit for name, unit in (("millis", "ms"), ("micros", "us"), ("nanos", "ns")) if name in message), None
    )
    return "s" if short else named


IMPORT = App("record_import", _import, ImportSettings)
