"""The settings of ``go1exp gap`` and of the verbs after it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from go1exp.cli.play_settings import Port
from go1exp.config.schema.registry import FolderName
from go1exp.config.schema.settings import settings
from go1exp.gap.design.settings import DesignSettings
from go1exp.gap.result import Angle, GapSettings
from go1exp.logs.record.plan import RecordingConfig

Logs = str | tuple[str, ...]
"""A folder of recordings, or folders and files."""


def refuse_no_logs(logs: Logs) -> None:
    """Raise ValueError if no recordings are named: an empty name, as an unset variable leaves it, is a mistake."""
    if not logs or ("" in logs and not isinstance(logs, str)):
        given = list(logs) if isinstance(logs, tuple) else logs
        raise ValueError(f"logs = {given!r}: a folder of recordings is needed, such as logs=recordings")


@settings
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


@settings
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


@settings
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
    physics_dt: Annotated[float, Field(gt=0, le=0.002)]
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
