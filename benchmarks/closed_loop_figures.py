"""Figures of ``benchmarks/closed_loop.py``: what fine-tuning wins back of what a hidden robot adds, and its tables."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap import hidden
from go1exp.evaluate.statistics.intervals import Interval, bootstrap_interval, mean_interval, share_interval

POLICIES = ("before", "plain", "net", "effects")
"""As trained; fine-tuned on the plain model, with the actuator net, and with the named effects."""


@dataclass(frozen=True)
class Walks:
    """Walks of a policy on a robot, of each of its trainings: errors (t, n) m/s, falls (t, n) bool.

    The k-th walk has the k-th seed, in all trainings and of all policies.
    """

    errors: np.ndarray
    fell: np.ndarray

    @classmethod
    def read(cls, *files: Path) -> Walks:
        """Read what ``evaluate`` wrote, a file of each training."""
        each = [json.loads(file.read_text()) for file in files]
        return cls(np.array([w["errors"] for w in each]), np.array([w["fell"] for w in each], dtype=bool))

    @property
    def mean(self) -> np.ndarray:
        """Mean error over the trainings of each walk, (n,) m/s."""
        return np.asarray(self.errors.mean(axis=0))


def won_back(nominal: np.ndarray, before: np.ndarray, after: np.ndarray) -> Interval:
    """Return the share of what a robot adds to the mean (over the nominal one) that fine-tuning takes away again.

    (before - after) / (before - nominal) of the means, with the bootstrap over walks (n,), which belong together by
    their seeds. NaN where the robot adds nothing: where the interval of what it adds holds zero.
    """

    def added(walks: np.ndarray) -> float:
        return float(before[walks].mean() - nominal[walks].mean())

    if not bootstrap_interval(added, len(before)).low > 0:
        return Interval(float("nan"), float("nan"), float("nan"), len(before))
    return bootstrap_interval(lambda k: float(before[k].mean() - after[k].mean()) / added(k), len(before))


def median_over(robots: Sequence[float]) -> Interval:
    """Return the median over robots, NaNs left out, with the bootstrap over robots."""
    each = np.array([value for value in robots if np.isfinite(value)])
    return bootstrap_interval(lambda k: float(np.median(each[k])), len(each), draws=4000)


def falls_won_back(nominal: Walks, robots: Sequence[Mapping[str, Walks]], policy: str) -> Interval:
    """Return the share of the falls added by all robots that fine-tuning takes away, with the bootstrap over robots."""

    def share(k: np.ndarray) -> float:
        before, after = (sum(robots[i][which].fell.mean() for i in k) for which in ("before", policy))
        added = before - len(k) * nominal.fell.mean()
        return float((before - after) / added) if added > 0 else float("nan")

    return bootstrap_interval(share, len(robots), draws=4000)


def row_of(name: str, verdict: Mapping[str, Any], nominal: Walks, walks: Mapping[str, Walks]) -> dict[str, Any]:
    """Return a robot's row of the table: errors with 95 % intervals, falls, shares won back.

    Of several trainings these are means; the intervals are over walks, and ``_each`` has the share of every training.
    """
    row: dict[str, Any] = {"robot": name, "hides": hidden.SECRETS[name].about, "walks": len(nominal.mean)}
    row |= {"logs": verdict["logs"], "verdict": verdict["verdict"], "named": ", ".join(verdict["named"])}
    for policy, each in {"nominal": nominal, **walks}.items():
        error = mean_interval(each.mean)
        falls = share_interval(int(each.fell.sum()), each.fell.size)
        row |= {f"{policy}_error": error.estimate, f"{policy}_error_low": error.low, f"{policy}_error_high": error.high}
        row |= {f"{policy}_falls": int(each.fell.sum()), f"{policy}_falls_low": falls.low}
        row |= {f"{policy}_falls_high": falls.high}
    for policy in POLICIES[1:]:
        share = won_back(nominal.mean, walks["before"].mean, walks[policy].mean)
        if len(trainings := walks[policy].errors) > 1:
            shares = (won_back(nominal.mean, walks["before"].mean, errors).estimate for errors in trainings)
            row[f"won_back_{policy}_each"] = " ".join(f"{each:.3f}" for each in shares)
        row |= {f"won_back_{policy}": share.estimate, f"won_back_{policy}_low": share.low}
        row |= {f"won_back_{policy}_high": share.high}
    return {key: round(value, 5) if isinstance(value, float) else value for key, value in row.items()}


def figures_of(
    rows: Sequence[Mapping[str, Any]], nominal: Walks, walks: Sequence[Mapping[str, Walks]]
) -> dict[str, float | int | str | None]:
    """Return the figures of all robots: the median share of the error won back, and the share of the falls."""
    figures: dict[str, float | int | str | None] = {"closed_loop_robots": len(rows)}
    figures["closed_loop_walks"] = len(nominal.mean)
    figures["closed_loop_trainings"] = max(len(each["effects"].errors) for each in walks)
    for policy, end in (("effects", ""), ("plain", "_plain"), ("net", "_net")):
        shares = median_over([row[f"won_back_{policy}"] for row in rows])
        falls = falls_won_back(nominal, walks, policy)
        figures["closed_loop_robots_hurt"] = shares.n
        for key, figure in ((f"won_back{end}", shares), (f"falls_won_back{end}", falls)):
            parts = {"": figure.estimate, "_low": figure.low, "_high": figure.high}
            figures |= {f"closed_loop_{key}{k}": round(v, 4) if np.isfinite(v) else None for k, v in parts.items()}
    return figures


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as lines for people."""
    lines = [f"{'robot':14} {'nominal':>8}" + "".join(f"{p:>16}" for p in POLICIES) + "  won back (95 %), named"]
    for row in rows:
        cells = "".join(f"{row[f'{p}_error']:8.3f} ({row[f'{p}_falls']:2d} fell)" for p in POLICIES)
        shares = "; ".join(
            f"{p} {row[f'won_back_{p}']:.0%} ({row[f'won_back_{p}_low']:.0%} to {row[f'won_back_{p}_high']:.0%})"
            for p in POLICIES[1:]
        )
        lines.append(
            f"{row['robot']:14} {row['nominal_error']:8.3f}{cells}  {shares}; {row['named'] or 'nothing named'}"
        )
    return "\n".join(lines)


def write_table(out: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the rows as ``robots.json`` and ``robots.csv``; what is not defined is null, or empty."""
    plain = [{k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()} for row in rows]
    (out / "robots.json").write_text(json.dumps(plain, indent=1) + "\n")
    with open(out / "robots.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(plain[0]))
        writer.writeheader()
        writer.writerows(plain)
