"""``go1exp export``, ``go1exp export check`` and ``go1exp export import``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from go1exp.base.errors import Expected
from go1exp.base.files import write_bytes
from go1exp.cli.app import App, parse, spinner
from go1exp.cli.places import checkpoint_file, trained, writable
from go1exp.cli.verbs import command
from go1exp.config.schema import settings as schema
from go1exp.config.schema.registry import FolderName

if TYPE_CHECKING:
    from rich.table import Table

    from go1exp.deploy.runtime.bundle import Bundle


@schema.settings
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


@schema.settings
class ExportCheckSettings:
    """``conf/export_check.yaml``.

    Attributes:
        file: bundle that go1exp export wrote.
    """

    file: Annotated[str, Field(min_length=1)]


def _export(container: dict[str, object]) -> None:
    settings = parse(ExportSettings, container)
    run, out = trained(settings.run, settings.policy, "bundle.zip", settings.out)
    checkpoint = checkpoint_file(run, settings.checkpoint)
    writable(str(out.parent))
    show = spinner(1, "recording a trace", at_once=True)

    from go1exp.deploy.export.build import build
    from go1exp.deploy.runtime.bundle import loads
    from go1exp.sim.effects.rules import has_gains
    from go1exp.sim.task import parse_parts
    from go1exp.train import run_folder

    data = build(run, checkpoint, seconds=settings.seconds, seed=settings.seed, on_step=show)
    bundle = loads(data, str(out))
    write_bytes(out, data)
    worst = max(bundle.differences.values())
    print(f"{len(bundle.trace['time'])} steps of the environment replayed, largest difference {worst:.1e}")
    print(f"written to {out} ({len(data) / 1e6:.2f} MB), SHA-256 {bundle.seal}")
    print(f"now: {command('export', 'check', str(out))}")
    parts, _ = parse_parts(run_folder.read_config(run), ("actuator",))
    if not has_gains(parts["actuator"]):
        name, line = parts["actuator"].entry.name, command("deploy", str(out), "actuator=pd")
        print(f"note: trained with actuator={name}, which has no gains to command; on a simulated robot: {line}")


APP = App("export", _export, ExportSettings)


WIDTH = 120  # of the table where there is no terminal, characters


def _check(container: dict[str, object]) -> None:
    settings = parse(ExportCheckSettings, container)

    from rich.console import Console

    from go1exp.deploy.runtime.bundle import BundleError, load
    from go1exp.deploy.runtime.job import refuse_unfit

    try:
        bundle = load(Path(settings.file))
    except BundleError as error:
        raise Expected(str(error)) from None  # the answer of this verb, not a refusal of its setting
    refuse_unfit(bundle)
    width = None if sys.stdout.isatty() else WIDTH
    console = Console(width=width, highlight=False, emoji=False, markup=False, soft_wrap=False)
    with console.capture() as text:  # a reader that leaves ends rich with status 1
        for table in tables(bundle):
            console.print(table)
    print(text.get(), end="")
    worst = max(bundle.differences.values())
    steps = len(bundle.trace["time"])
    print(f"good: every hash matches, {steps} steps replayed, largest difference {worst:.1e}")


def tables(bundle: Bundle) -> list[Table]:
    """Return rich tables of what a bundle holds: the policy, its inputs and outputs, its joints, the members."""
    from rich.table import Table

    def table(title: str, *columns: str) -> Table:
        made = Table(title=title, title_justify="left", title_style="bold")
        for column in columns:
            made.add_column(column, overflow="fold")
        return made

    about = bundle.metadata
    what = table("policy", "what", "value")
    for name, value in summary(bundle):
        what.add_row(name, value)
    ports = table("graph", "", "name", "size", "unit", "frame", "meaning")
    for kind, ports_of_kind in (("in", about.inputs), ("out", about.outputs)):
        for port in ports_of_kind:
            ports.add_row(kind, port.name, str(port.size), port.unit, port.frame, port.meaning)
    terms = table("observation", "columns", "term", "noise in training")
    for block in about.observation:
        terms.add_row(f"{block.start} to {block.start + block.size - 1}", block.key, f"{block.noise:g}")
    joints = table("joints", "name", "nominal rad", "kp N m/rad", "kd N m s/rad", "stops rad", "torque N m")
    for k, name in enumerate(about.joints):
        low, high = about.joint_limits[k]
        kp, kd = ("unknown" if g is None else f"{g[k]:g}" for g in (about.kp, about.kd))
        joints.add_row(
            name, f"{about.nominal_stance[k]:g}", kp, kd, f"{low:g} to {high:g}", f"{about.torque_limit[k]:g}"
        )
    members = table("members", "name", "bytes")
    for name, size in bundle.sizes.items():
        members.add_row(name, f"{size:,}")
    return [what, ports, terms, joints, members]


def summary(bundle: Bundle) -> list[tuple[str, str]]:
    """Return what a bundle is, as names and values."""
    about, versions = bundle.metadata, bundle.versions
    run = versions.get("run") or {}
    commit = f"{run.get('git') or 'unknown'}{' (with changes)' if run.get('git_dirty') else ''}"
    ranges = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in about.command_ranges.items())
    packages = ", ".join(f"{name} {version}" for name, version in versions.get("packages", {}).items())
    limits = f"cut at +-{about.action_clip:g}"
    if about.action_max_step is not None:
        limits += f", the target changed by at most {about.action_max_step:g} rad"
    return [
        ("file", f"{bundle.source}, SHA-256 {bundle.seal}"),
        ("robot", about.robot),
        ("trained", f"{about.trained.num_timesteps / 1e6:.2f} M steps, {about.trained.checkpoint}, commit {commit}"),
        ("rates", f"policy {1 / about.policy_dt:g} Hz, actuators {1 / about.physics_dt:g} Hz (in training)"),
        ("action", f"target = nominal stance + {about.action_scale:g} rad x action, {limits}"),
        ("commands", ranges or "unknown"),
        ("estimator", estimator(about.estimator)),
        ("exported by", f"go1exp {versions.get('go1exp')}, Python {versions.get('python')}, {packages}"),
    ]


def estimator(settings: dict[str, Any]) -> str:
    """Return the estimator's settings in a line, without its legs."""
    plain = {name: value for name, value in settings.items() if not isinstance(value, list | dict)}
    parts = (
        f"{name} {value:g}" if isinstance(value, float | int) else f"{name} {value}" for name, value in plain.items()
    )
    return ", ".join(parts) or "no settings of its own: those of a Go1"


CHECK = App("export_check", _check, ExportCheckSettings)


@schema.settings
class ExportImportSettings:
    """``conf/export_import.yaml``.

    Attributes:
        network: ONNX or TorchScript file of another framework's policy.
        spec: isaaclab, mjlab, legged_gym, unitree_rl, or a YAML file with the policy's contract.
        out: the bundle; null writes NETWORK.zip here.
        force: write it even where the policy falls, or another contract is likelier.
    """

    network: Annotated[str, Field(min_length=1)]
    spec: Annotated[str, Field(min_length=1)]
    out: str | None
    force: bool


def _import(container: dict[str, object]) -> None:
    settings = parse(ExportImportSettings, container)
    file = Path(settings.network)
    out = Path(settings.out or f"{file.stem}.zip")
    writable(str(out.parent))

    from go1exp.deploy.export.contract import build_foreign

    data, lines = build_foreign(file, settings.spec, force=settings.force)
    write_bytes(out, data)
    for line in (*lines, f"written to {out}", f"now: {command('export', 'check', str(out))}"):
        print(line)


IMPORT = App("export_import", _import, ExportImportSettings)
