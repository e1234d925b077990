"""``go1exp gap``."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from go1exp.base.errors import DOES_NOT_HOLD, EXIT_CODES
from go1exp.base.files import opened, write_json
from go1exp.cli.app import App, parse_with_groups, spinner
from go1exp.cli.places import long_enough, read_all, writable
from go1exp.cli.play_web import Port, address, gap
from go1exp.cli.verbs import SUBVERBS, command
from go1exp.config.choices import choice_files, config_folder, load
from go1exp.config.hydra_adapter import read_yaml, stored_choices
from go1exp.config.schema import settings as schema
from go1exp.config.schema.registry import ConfigError, FolderName, members, nearest, unknown_name
from go1exp.config.schema.settings import MISSING
from go1exp.gap.result import Angle, GapSettings

if TYPE_CHECKING:
    from go1exp.config.schema.physics import ContactConfig
    from go1exp.gap.result import GapResult
    from go1exp.gap.robots.protocol import Robot
    from go1exp.logs.recording import Recording


Logs = str | tuple[str, ...]
"""A folder of recordings, or folders and files."""


def refuse_no_logs(logs: Logs) -> None:
    """Raise ValueError if no recordings are named: an empty name, as an unset variable leaves it, is a mistake."""
    if not logs or ("" in logs and not isinstance(logs, str)):
        given = list(logs) if isinstance(logs, tuple) else logs
        raise ValueError(f"logs = {given!r}: a folder of recordings is needed, such as logs=recordings")


@schema.settings
class GapVerb:
    """``conf/gap.yaml`` without the groups.

    Attributes:
        logs: folder of recordings, or a list of folders and files.
        stage: check, localise, replay, explain, apply, report or view; all runs explain, apply and report.
        out: folder for verdict.json, effect.yaml, report.html.
        train_dt: physics step of training, s, at which the answer must hold; also that of replay.
        host: interface on which view listens; 127.0.0.1 is this machine alone.
        port: on which view listens; 0 takes the first free one from 8080 on.
        accept: error of an angle that you would not care about, in rad or such as 2mrad; then it counts as right.
        search: how the missing effect is searched for.
    """

    logs: Logs
    stage: Literal["all", "check", "localise", "replay", "explain", "apply", "report", "view"]
    out: FolderName
    train_dt: Annotated[float, Field(ge=1e-5, le=0.02)]
    host: str
    port: Port
    accept: Angle
    search: GapSettings

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.stage not in ("report", "view"):  # which read the answer alone
            refuse_no_logs(self.logs)


def with_logs(container: dict[str, object]) -> dict[str, Any]:
    """Return the settings, without logs for ``report`` and ``view``; raise ConfigError if a stage was to be a verb."""
    from go1exp.cli.completion import STAGES

    words, stage = ("all", *STAGES, *SUBVERBS["gap"]), str(container.get("stage", "all"))
    is_verb = nearest(stage, words, 1) in [[verb] for verb in SUBVERBS["gap"]]
    if stage not in words and (is_verb or container.get("logs") == MISSING):
        raise ConfigError([unknown_name("stage", stage, words, "stage")])
    if container.get("stage") in ("report", "view") and container.get("logs") == MISSING:
        return {**container, "logs": []}
    return container


def _task(container: dict[str, object]) -> int:
    from go1exp.gap.robots.description import parse_model

    groups = ("robot",) if container.get("contact") is None else ("robot", "contact")
    settings, parts = parse_with_groups(GapVerb, with_logs(container), groups, model=parse_model)
    refuse_unknown(settings.search.effects)
    if settings.accept:
        settings = replace(settings, search=replace(settings.search, accept=settings.accept))
    out, where = Path(settings.out), address(settings.host, settings.port)

    from go1exp.gap import files

    if settings.stage == "report":
        return _report(files.load(out), out)
    if settings.stage == "view":
        return _view(settings, parts, where)
    recordings = long_enough(read_all(settings.logs), settings.search.window_s + settings.search.burn_s)
    if not recordings:
        print("go1exp gap: none of these recordings can be compared", file=sys.stderr)
        return EXIT_CODES["bad log"]
    if settings.stage in ("all", "replay", "explain", "apply"):
        writable(settings.out)

    from go1exp.gap.robots.fixed_base import robot_of

    robot = robot_of(parts["model"], parts["robot"], contact=parts.get("contact"))
    if settings.stage == "check":
        return _check(recordings, robot, settings)
    if settings.stage == "localise":
        return _localise(recordings, robot, settings)
    if settings.stage == "replay":
        return _replay(recordings, robot, settings)
    if settings.stage == "apply":
        result = files.load(out)
        _apply(result, recordings, robot, settings)
        return _status(result, out)

    from go1exp.gap.stages.explain import explain

    result = explain(recordings, robot, settings.search, _progress())
    result = replace(result, provenance={**result.provenance, "next": _next(settings)})
    if older := files.remove_older(out):
        print(f"\nremoved, of the earlier answer in {out}: {', '.join(older)}")
    notes = result.warnings if settings.stage == "explain" else ()  # the report, too, has them
    print("", *notes, f"{result.sentence}\n\nwritten to {files.save(result, out)}", sep="\n")
    if settings.stage == "all" and result.verdict != "bad log":
        _apply(result, recordings, robot, settings)
    return _report(result, out) if settings.stage == "all" else result.exit_code


def _next(settings: GapVerb) -> str:
    """Return the call of ``gap next`` on the answer, with the names that were given."""
    from go1exp.cli.hydra_main import overrides

    chosen = next((o.partition("=")[2] for o in overrides() if o.startswith("model=")), "go1")
    logs = settings.logs if isinstance(settings.logs, str) else f"[{','.join(settings.logs)}]"
    given = {"logs": logs, "model": stored_choices("model").get(chosen.strip("'\""), chosen), "out": settings.out}
    return command("gap", "next", settings=given)


def refuse_unknown(effects: Sequence[str]) -> None:
    """Raise ConfigError if no effect has one of the names of ``search.effects``."""
    import go1exp.sim.effects  # noqa: F401  (registers them)

    known = members("effect")
    if wrong := [unknown_name("search.effects", name, known, "effect") for name in effects if name not in known]:
        raise ConfigError(wrong)


def _view(settings: GapVerb, parts: dict[str, Any], where: tuple[str, int]) -> int:
    from go1exp.gap.robots.fixed_base import robot_of

    gap(Path(settings.out), robot_of(parts["model"], parts["robot"]), parts["robot"], where)
    return 0


def _progress() -> Callable[[str, float], None]:
    bar, last = spinner(100, "gap"), [""]

    def show(what: str, share: float) -> None:
        if what != last[0]:
            last[0] = what
            print(f"{what} ...", flush=True)
        bar(round(100 * share), 100)

    return show


def _check(recordings: list[Recording], robot: Robot, settings: GapVerb) -> int:
    """Print whether the logs can be compared, their floors, and the effects that are not identifiable from them."""
    from go1exp.gap.stages.explain import check
    from go1exp.logs.audit import audit

    for recording in recordings:
        report = audit(recording)
        print(f"{recording.meta.episode}: {report.verdict}")
        for flaw in report.flaws:
            print(f"  {flaw.verdict:8} {flaw.channel}: {flaw.message}")
    result = check(recordings, robot, settings.search, _progress())
    print(f"\n{result.text()}")
    return result.exit_code


def _localise(recordings: list[Recording], robot: Robot, settings: GapVerb) -> int:
    from go1exp.gap.report import localisation_text
    from go1exp.gap.stages.explain import check

    result = check(recordings, robot, settings.search, _progress(), screen=False)
    if result.where is not None:
        print(f"\n{localisation_text(result.where)}")
    return result.exit_code


def _replay(recordings: list[Recording], robot: Robot, settings: GapVerb) -> int:
    """Print what training's simulator does under the same commands, and write it with its curves."""
    import numpy as np

    from go1exp.gap.stages.replay import replay

    result = replay(recordings, robot, settings.search, settings.train_dt, _progress())
    print(f"\n{result.text()}")
    if result.flaws:
        return result.exit_code
    out = Path(settings.out)
    write_json(out / "replay.json", result.content(), indent=1, allow_nan=False)
    kinds = ("free", "held") if len(result.parts) > 1 else ("",)
    curves: dict[str, Any] = {}
    for part, kind in zip(reversed(result.parts), kinds, strict=True):
        about = {**part.curves, "channels": np.array(part.channels), "episodes": np.array(part.episodes)}
        curves |= {f"{kind}_{name}".lstrip("_"): values for name, values in about.items()}
    with opened(out / "replay.npz") as file:
        np.savez_compressed(file, **curves)
    print(f"\nwritten to {out / 'replay.json'}, {out / 'replay.npz'}")
    return 0


def _apply(result: GapResult, recordings: list[Recording], robot: Robot, settings: GapVerb) -> None:
    """Write the effect files, read them back as training does, and score them at training's step."""
    from go1exp.gap.files import APPLIED
    from go1exp.gap.stages import apply

    out = Path(settings.out)
    written = apply.write(result, out)
    contents = {path.name: read_yaml(path) for path in written}
    proof = apply.prove(recordings, robot, settings.search, result, contents, settings.train_dt)
    about = {**asdict(proof), "files": [path.name for path in written]}
    write_json(out / APPLIED, about)
    print(f"\nwritten to {', '.join(str(path) for path in written)}")
    print(
        f"at training's step of {1e3 * proof.physics_dt:.4g} ms the held-out error is {1 + proof.after:.3g} times the "
        f"floor ({1 + proof.before:.3g} without; {1 + proof.effect_only:.3g} with {apply.EFFECT} alone)"
    )
    if not proof.holds:
        better = "in the search it was" if proof.after <= proof.before else "the nominal model has"
        least = proof.reported if proof.after <= proof.before else proof.before
        print(f"NOT applied: the error is {1 + proof.after:.3g} with the files at this step; {better} {1 + least:.3g}")
        return
    _print_next(contents[apply.EFFECT], robot, out / apply.EFFECT, result.contact)


def _status(result: GapResult, out: Path) -> int:
    """Return the exit status of an answer and what was applied of it: what is certified may not hold in training."""
    from go1exp.gap.files import APPLIED

    applied = out / APPLIED
    proof = json.loads(applied.read_text()) if applied.is_file() else {"holds": True}
    certified = any(named.status == "certified" for named in result.named)
    return DOES_NOT_HOLD if certified and not proof["holds"] else result.exit_code


def _print_next(effects: dict[str, Any], robot: Robot, file: Path, contact: ContactConfig | None = None) -> None:
    """Print how to train with the effects in ``file``, if there are any, and contact that is not MuJoCo's own."""
    from go1exp.robot import JOINTS

    if not effects:
        print(f"nothing is certified: {file} is empty, and training with it would change nothing")
    elif robot.joints == JOINTS:
        print(f"now: {command('train', settings={'effect': file, **_contact_choice(contact)})}")


def _contact_choice(contact: ContactConfig | None) -> dict[str, str]:
    """Return the choice of ``contact`` that training needs; nothing if it is the default or not known."""
    from go1exp.config.schema.physics import MUJOCO_CONTACT, read_contact

    if contact is None or contact == MUJOCO_CONTACT:
        return {}
    names = [n for n, file in choice_files("contact", [config_folder()]).items() if read_contact(load(file)) == contact]
    if names:
        return {"contact": names[0]}
    return {f"contact.{name}": str(value) for name, value in asdict(contact).items()}


def _report(result: GapResult, out: Path) -> int:
    from go1exp.gap.report import text, write_report

    status = _status(result, out)
    print(f"\n{text(result, status)}")
    print(f"\nwritten to {', '.join(str(path) for path in write_report(result, out))}")
    return status


APP = App("gap", _task, GapVerb)
