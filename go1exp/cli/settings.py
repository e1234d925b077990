"""The settings of the verbs other than ``train``, checked as strictly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from go1exp.cli.gap_settings import GapLoopSettings as GapLoopSettings
from go1exp.cli.gap_settings import GapNextSettings as GapNextSettings
from go1exp.cli.gap_settings import GapVerb as GapVerb
from go1exp.cli.play_settings import PlaySettings as PlaySettings
from go1exp.config.schema import settings as schema
from go1exp.config.schema.registry import Duration, FolderName, NonNegative, Positive, Speed
from go1exp.config.schema.settings import settings
from go1exp.deploy.runtime.controller import Stages
from go1exp.deploy.sim_robot.settings import SimConfig, SimSettings
from go1exp.evaluate.protocol.base import CompareSettings
from go1exp.evaluate.report.settings import ReportSettings
from go1exp.gap.actuator_net.settings import FitSettings
from go1exp.logs.record.plan import RecordingConfig
from go1exp.train.sweep.settings import TuneSettings

T = TypeVar("T")

Count = Annotated[int, Field(ge=1)]


@settings
class Grid:
    """Commanded velocities.

    Attributes:
        x: forward velocities, m/s.
        y: velocities to the left, m/s.
        yaw: turning rates, rad/s.
        cross: every combination of the three axes; false: one axis at a time, the others zero.
    """

    x: tuple[Speed, ...]
    y: tuple[Speed, ...]
    yaw: tuple[Speed, ...]
    cross: bool


@settings
class EvalSettings:
    """``conf/eval.yaml``.

    Attributes:
        controller: what moves the robots: policy, the one of run or policy, or mpc.
        run: run folder to judge; or give policy.
        policy: name of a policy that comes with the package, such as paper, in place of run.
        bundle: file that go1exp export wrote, in place of run; not for protocol=grid.
        checkpoint: file of the run; null takes the newest.
        grid: commanded velocities.
        episodes: episodes of each command, all at once.
        duration_s: length of an episode, s.
        settle_s: time at the start of an episode that does not count for tracking, s.
        noise: add the observation noise of training.
        randomize: randomise robots and starts as in training; false takes the nominal robot.
        push: push the robot as in training.
        train_ground: use the ground of training; false is flat.
        trunk_velocity: what the policy sees of it, exact, or estimated by the robot's filter from its sensors.
        policy_dt: another period of the policy, s; null keeps that of training.
        physics_dt: another physics step, s, such as 0.00125 for policy_dt=0.0025; null keeps that of training.
        measures: gait and contact measures by name (go1exp list measure), [] for none; null takes all of them. With
            parameters as {slip_share: {speed: 0.1}}.
        delay_margin: also run the grid with targets 10, 20, 30 and 40 ms late, until a robot falls.
        seed: seed of everything random.
        out: JSON file; null writes eval.json in the run folder (of a shipped policy paper_eval.json here).
        folder: for the files of other protocols than the grid; null takes protocols in the run folder (of a shipped
            policy paper_protocols here).
    """

    controller: Any = None
    run: FolderName | None
    policy: str | None
    bundle: str | None
    checkpoint: str | None
    grid: Grid
    episodes: Count
    duration_s: Duration
    settle_s: NonNegative
    noise: bool
    randomize: bool
    push: bool
    train_ground: bool
    trunk_velocity: Literal["exact", "estimated"]
    policy_dt: Annotated[float, Field(gt=0, le=0.1)] | None
    physics_dt: Annotated[float, Field(gt=0, le=0.02)] | None
    measures: Any
    delay_margin: bool
    seed: Annotated[int, Field(ge=0)]
    out: str | None
    folder: str | None

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.settle_s >= self.duration_s:
            raise ValueError(f"settle_s = {self.settle_s}: must be shorter than duration_s = {self.duration_s}")


@settings
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
    physics_dt: Annotated[float, Field(gt=0, le=0.002)]
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


@settings
class AuditSettings:
    """``conf/record_audit.yaml``.

    Attributes:
        files: recordings (.parquet), or folders of them.
        out: JSON file for the findings; null writes none.
    """

    files: Annotated[tuple[str, ...], Field(min_length=1)]
    out: str | None


@settings
class ImportSettings:
    """``conf/record_import.yaml``.

    Attributes:
        source: name of the importer (go1exp list importer).
        path: its file, or a folder of them.
        options: the importer's own parameters, such as {rate_hz: 100.0}, or a FILE.yaml of them.
        columns: of source=csv: channel -> column, such as {t: time, q_knee: {column: pos, unit: deg}}, or a FILE.yaml.
        out: folder for the recordings.
    """

    source: str
    path: str
    options: dict[str, Any] | str | None
    columns: dict[str, Any] | str | None
    out: FolderName


@settings
class ExportSettings:
    """``conf/export.yaml``.

    Attributes:
        run: run folder to pack; or give policy.
        policy: name of a policy that comes with the package, such as paper, in place of run.
        checkpoint: file of the run; null takes the newest.
        seconds: length of the trace that loading replays, s.
        seed: seed of everything random in the trace.
        out: file; null writes bundle.zip in the run folder (of a shipped policy paper_bundle.zip here).
    """

    run: FolderName | None
    policy: str | None
    checkpoint: str | None
    seconds: Annotated[float, Field(gt=0, le=600)]
    seed: Annotated[int, Field(ge=0)]
    out: str | None


@settings
class ExportCheckSettings:
    """``conf/export_check.yaml``.

    Attributes:
        file: bundle that go1exp export wrote.
    """

    file: Annotated[str, Field(min_length=1)]


@settings
class SinusoidSettings:
    """Sines of all three velocities.

    Attributes:
        amplitude: amplitudes of x, y, yaw, m/s, m/s, rad/s.
        period: their common period, s.
    """

    amplitude: tuple[float, float, float]
    period: Positive


@settings
class DeploySettings(Stages):
    """``conf/deploy.yaml`` without the groups; the times of the stages are those of the runtime.

    Attributes:
        controller: what moves the robot: policy, that of the bundle, or mpc (robot=sim only).
        bundle: file that go1exp export wrote; check=true needs none.
        robot: sim, a simulated robot in another process, or go1, the real one.
        address: HOST:PORT of robot=go1; null takes 192.168.123.10:8007.
        check: with robot=go1, only look at the robot and calibrate its foot sensors; no torque is ever asked for.
        feet: calibration of foot sensors that count, a real robot's or those of sim.feet=raw, which check=true writes;
            null takes contact from torques alone, and lets check=true write feet.json in out.
        command: velocity as [x m/s, y m/s, yaw rad/s]; or FILE.csv, sinusoid, keyboard, gamepad.
        motion: in place of walking, move a robot that hangs: an excitation of go1exp record, or FILE.csv of targets
            (such as the one of go1exp gap next); its log is a recording for go1exp gap.
        gains: kp N m/rad and kd N m s/rad of motion; null takes those of the file, or [20, 0.5].
        sinusoid: the sines of command=sinusoid.
        rate: rate of policy and commands, Hz; null takes that of training; of a motion, that of its file, or 400.
        seconds: time under the policy, s; null walks until it is stopped (Ctrl-C). Of a motion that is no file: 20.
        keep: newest seconds of the walk that the log has room for.
        stale: time without a state after which the robot counts as lost, s.
        spin: time before each cycle for which the core is kept busy, s; quicker, and it costs that core.
        sim: the simulated robot.
        truth: also record the simulated trunk's true pose and velocity.
        out: folder for the logs.
    """

    controller: Any = None
    bundle: Annotated[str, Field(min_length=1)] | None
    robot: Literal["sim", "go1"]
    address: str | None
    check: bool
    feet: str | None
    command: tuple[float, float, float] | str
    motion: Annotated[str, Field(min_length=1)] | None
    gains: tuple[NonNegative, NonNegative] | None
    sinusoid: SinusoidSettings
    rate: Annotated[float, Field(ge=10, le=1000)] | None
    seconds: Positive | None
    keep: Annotated[float, Field(gt=0, le=3600)]
    stale: Positive
    spin: Annotated[float, Field(ge=0, le=0.01)]
    sim: SimConfig
    truth: bool
    out: str


@settings
class FitActuatorSettings(FitSettings):
    """``conf/fit-actuator.yaml`` without the group.

    Attributes:
        recordings: folder of recordings, or a list of folders and files.
        gains: take only recordings made with these, as [kp N m/rad, kd N m s/rad]; null takes all, which must agree.
        plots: draw torque over time, measured and predicted.
        out: folder for net.npz, net.onnx, report.json and the plots.
    """

    recordings: str | tuple[str, ...]
    gains: tuple[NonNegative, NonNegative] | None
    plots: bool
    out: str


@settings
class ListSettings:
    """``conf/list.yaml``.

    Attributes:
        what: terms, groups, or all.
        group: only this group, such as reward or rand.
    """

    what: Literal["all", "terms", "groups"]
    group: str | None


@settings
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
    seconds: Positive
    threads: Annotated[int, Field(ge=0)]
    overrides: tuple[str, ...]
    out: str | None


EXAMPLES = {
    "space": """'space=["ppo.gamma=interval(0.97,0.995)"]'""",
    "run": "run=runs/NAME",
    "subjects": "go1exp compare trot paper protocol=kicks",
    "folders": "go1exp report runs/sweep_NAME",
    "files": "go1exp record audit recordings/NAME.parquet",
    "file": "go1exp export check runs/NAME/bundle.zip",
    "source": "go1exp record import go2_in_air PATH",
    "path": "go1exp record import go2_in_air PATH",
    "recordings": "recordings=recordings",
    "logs": "logs=recordings",
    "bundle": "go1exp deploy runs/NAME/bundle.zip",
}
"""Settings without a default, and how they are given."""

SETTINGS: dict[str, type] = {
    "eval": EvalSettings,
    "compare": CompareSettings,
    "report": ReportSettings,
    "play": PlaySettings,
    "record": RecordSettings,
    "record_audit": AuditSettings,
    "record_import": ImportSettings,
    "gap": GapVerb,
    "gap_next": GapNextSettings,
    "gap_loop": GapLoopSettings,
    "export": ExportSettings,
    "export_check": ExportCheckSettings,
    "deploy": DeploySettings,
    "sim": SimSettings,
    "fit-actuator": FitActuatorSettings,
    "list": ListSettings,
    "bench": BenchSettings,
    "tune": TuneSettings,
}
"""Verbs besides ``train``, whose sections are in ``go1exp.sim.task``, and the class of each one's settings."""


def parse(kind: type[T], container: Mapping[str, Any]) -> T:
    """Validate a composed configuration as ``kind``; raise ConfigError with every problem."""
    return schema.parse(kind, container, EXAMPLES)
