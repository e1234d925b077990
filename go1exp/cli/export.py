"""``go1exp export``."""

from __future__ import annotations

from typing import Any

from go1exp.base.files import write_bytes
from go1exp.cli.app import App, spinner
from go1exp.cli.quoting import command


def _task(container: dict[str, Any]) -> None:
    from go1exp.cli.runs import checkpoint_file, trained
    from go1exp.cli.settings import ExportSettings, parse

    settings = parse(ExportSettings, container)
    run, out = trained(settings.run, settings.policy, "bundle.zip", settings.out)
    checkpoint = checkpoint_file(run, settings.checkpoint)

    from go1exp.cli.logs import writable
    from go1exp.deploy.export.build import build
    from go1exp.deploy.runtime.bundle import loads
    from go1exp.sim.effects.rules import has_gains
    from go1exp.sim.task import parse_parts
    from go1exp.train import run_folder

    writable(str(out.parent))
    show = spinner(1, "recording a trace")
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


APP = App("export", _task)
