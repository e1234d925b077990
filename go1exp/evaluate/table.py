"""An evaluation report as a table."""

from __future__ import annotations

from typing import Any

from go1exp.evaluate.rollout import AXES

HEADER = ("command x, y, yaw", "mean x, y, yaw", "RMSE x, y, yaw", "falls", "mean time s")


def _triple(values: Any) -> str:
    return ", ".join(f"{v:+.2f}" for v in values)


def rows(report: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return one row of text per command of a report of ``rollout.evaluate``."""
    lines: list[tuple[str, ...]] = []
    for c in report["commands"]:
        mean = _triple(c["mean"][a] for a in AXES) if c["mean"] else "-"
        rmse = ", ".join(f"{c['rmse'][a]:.2f}" for a in AXES) if c["rmse"] else "-"
        lines.append((_triple(c["command"]), mean, rmse, f"{c['falls']}/{c['episodes']}", f"{c['mean_time_s']:.1f}"))
    return lines


def _summary(report: dict[str, Any]) -> str:
    policy, settings = report["policy"], report["settings"]
    on = [name for name in ("noise", "randomize", "push", "train_ground") if settings[name]]
    rmse = ", ".join(f"{axis} {report['rmse'][axis]:.3f}" for axis in AXES) if report["rmse"] else "-"
    return (
        f"policy after {policy['num_timesteps'] / 1e6:.2f} M steps; RMSE over all: {rmse}; "
        f"falls {report['falls']} in {report['episodes']} episodes of {settings['duration_s']:g} s; "
        f"with {', '.join(on) if on else 'no noise, randomisation or pushes, on flat ground'}"
    )


def text(report: dict[str, Any]) -> str:
    """Return the report as text for a terminal; m/s and rad/s."""
    lines = [HEADER, *rows(report)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(HEADER))]
    laid = ["  ".join(cell.rjust(w) for cell, w in zip(line, widths, strict=True)) for line in lines]
    return "\n".join([*laid, "", _summary(report)])


def markdown(report: dict[str, Any]) -> str:
    """Return the report as a Markdown table."""
    lines = [f"| {' | '.join(line)} |" for line in [HEADER, ("---",) * len(HEADER), *rows(report)]]
    return "\n".join([*lines, "", _summary(report)])
