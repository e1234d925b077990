"""Draw docs/results/gap.png from a report of the demo's recordings.

go1exp gap logs=assets/demo/suspended_go1 out=runs/gap search.overlays=8
python -m benchmarks.gap_figure runs/gap/report.json docs/results/gap.png
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

BEFORE, AFTER = "#b3541e", "#1f6f8b"


def draw(report: dict[str, Any], file: Path, joint: str = "RR_thigh") -> None:
    """Save the angle of one joint over held-out windows, and the errors of all joints, before and after.

    Args:
        report: content of ``report.json``, with overlays.
        file: PNG to write.
        joint: joint of the left axes.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    start = 0.0
    for window in report["overlays"][:4]:
        t = start + np.array(window["t"]) - window["t"][0]
        for values, color, width in (("measured", "0.75", 4.0), ("before", BEFORE, 1.3), ("after", AFTER, 1.3)):
            left.plot(t, window[values][f"q_{joint}"], color=color, linewidth=width)
        start = t[-1] + 0.04
    left.set(xlabel="time in four held-out windows, s", ylabel=f"angle of {joint}, rad")
    names = list(report["errors"]["by_joint"])
    errors = 1e3 * np.array([report["errors"]["by_joint"][name] for name in names])
    rows = np.arange(len(names))
    right.barh(rows - 0.2, errors[:, 0], 0.4, color=BEFORE, label="nominal model")
    right.barh(rows + 0.2, errors[:, 1], 0.4, color=AFTER, label="with the identified effect")
    right.set(yticks=rows, yticklabels=names, xlabel="median RMS error of the joint angle, mrad", xscale="log")
    right.invert_yaxis()
    left.plot([], [], color="0.75", linewidth=4.0, label="measured")
    measured, labels = left.get_legend_handles_labels()
    bars, names = right.get_legend_handles_labels()
    figure.legend(measured + bars, labels + names, loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    draw(json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2]))
