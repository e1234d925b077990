"""``go1exp report``: groups, curves, verdicts and pages of studies whose truth is known; bad input in one line each."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from scipy import stats

import go1exp.evaluate.protocol.kinds  # noqa: F401  (registers them)
from go1exp.cli.report import _task
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.config.schema.settings import parse
from go1exp.evaluate.quantities import rows_of, write_rows
from go1exp.evaluate.quantities import write as write_evaluation
from go1exp.evaluate.report import curves
from go1exp.evaluate.report.results import Report, report
from go1exp.evaluate.report.settings import ReportSettings
from go1exp.evaluate.report.study import baseline, groups, study
from go1exp.evaluate.report.tables import plain_rows, tables
from go1exp.evaluate.report.writing import page, write
from go1exp.train import run_state
from tests.phone import PHONE, needs_chromium, on_a_phone
from tests.small_run import trained

CONFIG: dict[str, Any] = {
    "seed": 0,
    "reward": {"gait": {"weight": 10.0}, "foot_slip": {"weight": -0.05}},
    "ppo": {"num_envs": 4, "iterations": 40},
    "logger": {"csv": True},
}

COMMANDS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
ROBOTS = 8


def metrics(folder: Path, rows: int, level: float, steps: int = 1000, rate: float = 500.0) -> None:
    """Write metrics that rise to ``level`` in a straight line, and the time that they took."""
    lines = [f"{k},{k * steps},{level * k / rows!r}" for k in range(1, rows + 1)]
    (folder / "metrics.csv").write_text("\n".join(["iteration,steps,rollout/return", *lines, ""]))
    lines = [f"{k},{k * steps},{rate!r}" for k in range(1, rows + 1)]
    (folder / "timing.csv").write_text("\n".join(["iteration,steps,time/steps_per_s", *lines, ""]))


def evaluation(folder: Path, level: float, falls: float, seed: int = 1, generator: int = 0) -> None:
    """Write an evaluation whose errors grow as friction falls; robots fall with that probability."""
    rng = np.random.default_rng([generator, int(level * 1e6) % 2**31])
    commands = np.repeat(np.array(COMMANDS), ROBOTS, axis=0)
    friction = np.random.default_rng(seed).uniform(0.4, 1.1, len(commands))
    errors = level * np.exp(-friction)[:, None] * np.ones(3) + 0.002 * rng.normal(size=(len(commands), 3))
    fell = rng.random(len(commands)) < falls
    draws = {"friction": friction, "mass": np.random.default_rng(seed + 1).uniform(11.0, 14.0, len(commands))}
    rows = rows_of(commands, ROBOTS, errors, fell, np.full(len(commands), 8.0), draws, {})
    settings = {"episodes": ROBOTS, "noise": True, "randomize": True, "seed": seed}
    about = {"settings": settings, "robot": {}, "commands": [{"command": c} for c in COMMANDS]}
    write_evaluation({**about, "rows": rows}, folder / "eval.json")


def run(folder: Path, seed: int, weight: float = 10.0, rows: int = 20, **changes: Any) -> Path:
    """Write a finished run; ``changes``: state, level (of errors), falls, evaluated."""
    folder.mkdir(parents=True)
    config = {**CONFIG, "seed": seed, "reward": {**CONFIG["reward"], "gait": {"weight": weight}}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    state, cause = changes.get("state", "done"), changes.get("cause", "")
    (folder / "state.json").write_text(json.dumps({"state": state, "cause": cause}))
    metrics(folder, rows, 10.0 + weight + 0.1 * seed)
    if changes.get("evaluated", True):
        level = changes.get("level", 0.3) + 0.01 * np.random.default_rng([seed, int(weight)]).normal()
        evaluation(folder, level, changes.get("falls", 0.1), generator=seed)
    return folder


def settings(*folders: Path, **changes: Any) -> ReportSettings:
    container = compose("report", [f"folders=[{','.join(map(str, folders))}]"])
    del container["protocol"]
    return parse(ReportSettings, {**container, **changes})


def made(*folders: Path, **changes: Any) -> Report:
    wanted = settings(*folders, **changes)
    return report(study(wanted.folders, wanted.unfinished), wanted, {"folders": [str(f) for f in folders]})


@pytest.fixture(scope="module")
def two_groups(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two groups of six runs: without the gait reward errors are larger, and falls as many."""
    folder = tmp_path_factory.mktemp("study") / "sweep"
    for seed in range(6):
        run(folder / f"with{seed}", seed, 10.0)
        run(folder / f"without{seed}", seed, 0.0, level=0.5)
    return folder


def table(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.read_text().splitlines()))


# ---------------------------------------------------------------------- groups


def test_groups_are_configurations_without_the_seed_named_by_what_differs(two_groups: Path) -> None:
    got = made(two_groups)
    assert [g.name for g in got.groups] == ["reward.gait.weight=0.0", "reward.gait.weight=10.0"]
    assert [[r.seed for r in g.runs] for g in got.groups] == [list(range(6))] * 2
    assert got.groups[0].settings == {"reward.gait.weight": 0.0}
    assert "returns are of different rewards" in got.study.notes


def test_the_baseline_is_named_by_name_part_or_settings(two_groups: Path) -> None:
    those = groups(study([str(two_groups)], False))
    for wanted in ("reward.gait.weight=0.0", "weight=0.0", "reward.gait.weight=0.0, reward.gait.weight=0.0"):
        assert baseline(those, wanted).settings == {"reward.gait.weight": 0.0}
    with pytest.raises(ConfigError, match=r"2 groups of these: 'reward.gait.weight=0.0', 'reward.gait.weight=10.0'"):
        baseline(those, "gait")
    with pytest.raises(ConfigError, match="no group of these"):
        baseline(those, "feet")


def test_groups_of_a_sweep_have_the_names_of_its_jobs(tmp_path: Path) -> None:
    jobs = []
    for name, weight in (("none", 10.0), ("no_gait", 0.0), ("half_gait", 5.0)):
        for seed in (0, 1):
            run(tmp_path / f"{name}{seed}", seed, weight)
            job = f"+experiment/ablation={name} seed={seed}"
            jobs.append({"name": job, "state": "done", "run_folder": f"{name}{seed}"})
    (tmp_path / "sweep.json").write_text(json.dumps({"jobs": jobs}))
    got = study([str(tmp_path)], False)
    those = groups(got)
    assert sorted(g.name for g in those) == ["ablation=half_gait", "ablation=no_gait", "ablation=none"]
    assert baseline(those, "ablation=none").settings == {"reward.gait.weight": 10.0}
    got.runs[0] = replace(got.runs[0], job="")  # one that no sweep names: settings tell all of them apart
    assert {g.name for g in groups(got)} == {f"reward.gait.weight={w}" for w in ("0.0", "5.0", "10.0")}


def test_a_sweep_names_jobs_lists_those_that_wait_and_says_why_others_failed(tmp_path: Path) -> None:
    run(tmp_path / "one", 0)
    run(tmp_path / "two", 1, state="failed", cause="No space left on device: metrics.csv", evaluated=False)
    states = enumerate((("one", "done"), ("two", "failed"), ("three", "waiting")))
    jobs = [{"name": f"seed={k}", "state": state, "run_folder": folder} for k, (folder, state) in states]
    (tmp_path / "sweep.json").write_text(json.dumps({"jobs": jobs}))
    got = study([str(tmp_path)], False)
    assert [(r.label, r.job) for r in got.runs] == [("one", "seed=0")]
    assert {(a.label, a.state, a.cause) for a in got.absent} == {
        ("two", "failed", "No space left on device: metrics.csv"),
        ("seed=2", "waiting", "has no run folder yet"),
    }
    assert [r.label for r in study([str(tmp_path)], True).runs] == ["one", "two"]


# ---------------------------------------------------------------------- curves


def test_a_curve_ends_where_the_first_run_of_its_group_does(tmp_path: Path) -> None:
    run(tmp_path / "long", 0, rows=40)
    run(tmp_path / "short", 1, rows=20)
    got = made(tmp_path)
    steps, hours = ([c for c in got.curves if c.axis == axis] for axis in ("steps", "hours"))
    assert (steps[0].x[0], steps[0].x[-1]) == pytest.approx((0.001, 0.020))
    assert steps[0].last == pytest.approx([20.0 * 20 / 40, 20.1])
    assert steps[0].middle[-1] == pytest.approx((10.0 + 20.1) / 2)
    assert hours[0].x[-1] == pytest.approx(20 * 1000 / 500 / 3600)


def test_half_written_and_repeated_rows_are_left_out_and_said(tmp_path: Path) -> None:
    folder = run(tmp_path / "a", 0)
    file = folder / "metrics.csv"
    whole, _ = curves.read(folder, ["rollout/return"])
    file.write_text(file.read_text() + "21,21000,7")
    cut, remark = curves.read(folder, ["rollout/return"])
    assert remark == f"{file}: has incomplete rows; they are excluded"
    assert cut.columns["rollout/return"].tolist() == whole.columns["rollout/return"].tolist()
    file.write_text(file.read_text() + "\n20,20000,9.0\n22,22000\n23,23000,8.0\n")
    again, remark = curves.read(folder, ["rollout/return"])
    assert again.columns["iteration"].tolist() == [*range(1, 22), 23]
    assert "incomplete" in remark
    file.write_text("")
    assert curves.read(folder, ["rollout/return"])[1] == f"{file}: holds no complete row"


def test_a_metric_that_runs_lack_is_said(two_groups: Path) -> None:
    got = made(two_groups, curves=("rollout/return", "train/kl"))
    assert {c.metric for c in got.curves} == {"rollout/return"}
    (note,) = [n for n in got.study.notes if "train/kl" in n]
    assert re.match(
        r"train/kl: is not in the metrics of with\w+ and 11 more runs; it has iteration, steps,",
        note.replace("without", "with"),
    )


# ---------------------------------------------------------------------- evaluations


def test_a_worse_group_is_told_and_one_alike_is_not(two_groups: Path) -> None:
    got = made(two_groups, baseline="weight=10.0")
    (outcome,) = got.outcomes
    words = {v.column.name: v.word for v in outcome.verdicts}
    assert words == {"error_xy": "worse", "error_yaw": "worse", "fell": "no significant difference"}
    told = next(v for v in outcome.verdicts if v.column.name == "error_yaw")
    assert told.difference.p == pytest.approx(2 / math.comb(12, 6))
    assert told.adjusted_p == pytest.approx(3 * 2 / math.comb(12, 6))
    assert told.difference.estimate.low > 0.0
    assert told.difference.improvement == 1.0
    assert told.needed is None
    assert not told.hopeless


def test_figures_are_means_of_runs_and_shares_have_three_intervals(two_groups: Path) -> None:
    (outcome,) = made(two_groups).outcomes
    fell = next(f for f in outcome.figures if f.column.name == "fell" and f.group.endswith("=10.0"))
    assert fell.robots is not None
    assert fell.bootstrap is not None
    assert (fell.runs.n, fell.robots.n, len(fell.values)) == (6, 6 * 24, 6)
    assert fell.runs.estimate == pytest.approx(fell.values.mean()) == pytest.approx(fell.robots.estimate)
    error = next(f for f in outcome.figures if f.column.name == "error_yaw" and f.group.endswith("=10.0"))
    first = table_of_run(two_groups / "with0")
    assert error.values[0] == pytest.approx(np.mean(first["error_yaw"]))
    of_one = [f for f in outcome.by_condition if f.column.name == "error_yaw" and f.group == error.group]
    assert [dict(f.condition) for f in of_one] == [dict(zip(["x", "y", "yaw"], c, strict=True)) for c in COMMANDS]
    assert np.mean([f.values[0] for f in of_one]) == pytest.approx(error.values[0])


def table_of_run(folder: Path) -> dict[str, list[float]]:
    columns: dict[str, list[float]] = pq.read_table(folder / "eval.parquet").to_pydict()
    return columns


def test_what_was_drawn_and_what_was_swept_go_with_the_error(two_groups: Path) -> None:
    (outcome,) = made(two_groups).outcomes
    by_name = {(e.association.name, e.column.name): e for e in outcome.sensitivities}
    friction = by_name["friction", "error_yaw"]
    assert friction.association.spearman < -0.9
    assert friction.association.n == len(COMMANDS) * ROBOTS  # the same robots for all runs: one observation each
    assert friction.adjusted_p < 0.01
    assert by_name["mass", "error_yaw"].adjusted_p > 0.05
    swept = by_name["reward.gait.weight", "error_yaw"]
    assert (swept.source, swept.association.n) == ("setting", 12)
    assert swept.adjusted_p < 0.01


def test_few_runs_are_said_to_be_unable_to_tell(tmp_path: Path) -> None:
    for seed in range(3):
        run(tmp_path / f"a{seed}", seed)
        run(tmp_path / f"b{seed}", seed, 0.0, level=3.0)
    got = made(tmp_path)
    assert all(v.hopeless and v.word == "no significant difference" for v in got.outcomes[0].verdicts)
    assert "at least 5 runs per group" in tables(got)[0].note
    plain = made(tmp_path, correction="none", paired=True)
    assert all(v.difference.least_p == 2 / 8 for v in plain.outcomes[0].verdicts)
    assert "at least 6 runs per group" in tables(plain)[0].note  # 2 / 2**6 < 0.05 < 2 / 2**5
    alone = made(tmp_path, correction="none")
    assert all(v.hopeless for v in alone.outcomes[0].verdicts)
    assert "at least 4 runs per group" in tables(alone)[0].note  # 2 / 70 < 0.05 < 2 / 20


def test_policies_are_compared_on_the_same_robots_too(two_groups: Path) -> None:
    """Against the robots of the files one by one: what the same friction does to both cancels."""
    (outcome,) = made(two_groups, baseline="weight=10.0").outcomes
    verdict = next(v for v in outcome.verdicts if v.column.name == "error_yaw")
    robots = verdict.robots
    assert robots is not None
    values = {
        side: np.array([table_of_run(two_groups / f"{side}{seed}")["error_yaw"] for seed in range(6)]).mean(axis=0)
        for side in ("with", "without")
    }
    each = (values["without"] - values["with"]).reshape(len(COMMANDS), ROBOTS)
    assert (robots.n, robots.estimate) == (each.size, pytest.approx(each.mean()))
    error = math.sqrt(each.var(axis=1, ddof=1).mean() / each.size)
    assert robots.high - robots.estimate == pytest.approx(stats.t.ppf(0.975, each.size - len(COMMANDS)) * error)
    # Of unpaired robots the interval would be wider: most of their difference is that of their friction.
    apart = math.sqrt(sum(one.reshape(3, ROBOTS).var(axis=1, ddof=1).mean() / each.size for one in values.values()))
    assert error < 0.5 * apart
    row = next(r for r in plain_rows(made(two_groups))["grid_comparison"] if r["figure"] == "error_yaw")
    assert abs(row["same_robots"]) == pytest.approx(robots.estimate)


def test_without_anything_random_there_are_no_robots_to_pair(tmp_path: Path) -> None:
    for seed in range(2):
        for weight in (10.0, 0.0):
            folder = run(tmp_path / f"{weight}{seed}", seed, weight)
            about = json.loads((folder / "eval.json").read_text())
            about["settings"] |= {"noise": False, "randomize": False}
            (folder / "eval.json").write_text(json.dumps(about))
    (outcome,) = made(tmp_path).outcomes
    assert all(v.robots is not None and math.isnan(v.robots.low) for v in outcome.verdicts)


def kicked(folder: Path, evaluated: bool = False) -> None:
    """Write two groups of six runs that were kicked; with a larger weight they recover sooner."""
    protocol = compose("eval", ["protocol=kicks"])["protocol"]["kicks"]
    for seed in range(6):
        for group, level in ((10.0, 1.0), (0.0, 2.0)):
            place = run(folder / f"g{group:.0f}s{seed}", seed, group, evaluated=evaluated) / "protocols"
            place.mkdir()
            rng = np.random.default_rng([seed, int(group)])
            rows = [
                {"impulse": impulse, "robot": n, "fell": False, "left_map": False, "moving_s": 4.0, "fingerprint": n}
                | {"recovered": True, "recovery_s": level + 0.1 * rng.random()}
                for impulse in protocol["impulses"]
                for n in range(4)
            ]
            write_rows(place / "kicks.parquet", rows, {})
            about = {"kind": "kicks", "settings": protocol, "rates": {"seed": 1}, "robot": {}}
            (place / "kicks.json").write_text(json.dumps(about))


# ---------------------------------------------------------------------- bad input


def test_folders_without_runs_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("no run")
    for folder, words in (
        (tmp_path / "none", "there is no such folder"),
        (tmp_path / "empty", "there is no run in it"),
        (tmp_path / "text.txt", r"text.txt': is a file; give a run folder \(with config.yaml\), a sweep, or"),
    ):
        with pytest.raises(ConfigError, match=words):
            study([str(folder)], False)
    run(tmp_path / "late", 0, state="failed", cause="was killed")
    with pytest.raises(ConfigError, match=r"none of the 1 runs in them counts: late: failed \(was killed\)"):
        study([str(tmp_path / "late")], False)


def test_a_run_without_evaluation_and_one_evaluated_otherwise_are_named(tmp_path: Path) -> None:
    for seed in range(3):
        run(tmp_path / f"a{seed}", seed)
    run(tmp_path / "bare", 3, evaluated=False)
    evaluation(run(tmp_path / "other", 4, evaluated=False), 0.3, 0.1, seed=2)
    old = run(tmp_path / "old", 5, evaluated=False)
    (old / "eval.json").write_text("{}")
    notes = made(tmp_path).study.notes
    assert "grid: other excluded, evaluated with other settings (seed) than most" in notes
    assert "old: eval.json without eval.parquet; eval=true makes both" in notes
    assert any(n.startswith("grid: no evaluation of 2 runs (bare, old)") for n in notes)


def test_a_damaged_run_or_index_is_named_and_the_others_stay(tmp_path: Path) -> None:
    """A full disk leaves files that are empty or end in the middle."""
    for seed in range(3):
        run(tmp_path / f"sweep/a{seed}", seed)
    (tmp_path / "sweep/a1/config.yaml").write_text("")
    (tmp_path / "sweep/a2/config.yaml").write_text("seed: 2\nppo: {num_envs: 4,")
    (tmp_path / "sweep/sweep.json").write_text('{"jobs": [{"name": "seed=0"')
    got = made(tmp_path)
    assert [r.label for r in got.study.runs] == ["a0"]
    assert {(a.label, a.state, a.cause) for a in got.study.absent} == {
        (f"a{seed}", "damaged", f"{tmp_path}/sweep/a{seed}/config.yaml is not the configuration of a run")
        for seed in (1, 2)
    }
    assert any(n.startswith(f"{tmp_path}/sweep/sweep.json: is damaged (JSONDecodeError") for n in got.study.notes)
    (tmp_path / "sweep/a0/config.yaml").write_text("")
    with pytest.raises(ConfigError, match=r"none of the 3 runs in them counts: a0: damaged \(.*config.yaml is not"):
        study([str(tmp_path)], False)


def test_damaged_rows_are_named_and_the_others_stay(tmp_path: Path) -> None:
    for seed in range(2):
        run(tmp_path / f"a{seed}", seed)
    (tmp_path / "a1/eval.parquet").write_bytes(b"half")
    got = made(tmp_path)
    assert any("a1/eval.json: cannot be read" in n for n in got.study.notes)
    assert list(got.outcomes[0].evaluation.runs) == [(tmp_path / "a0").resolve()]
    (tmp_path / "a1/eval.parquet").write_bytes((tmp_path / "a0/eval.parquet").read_bytes())
    (tmp_path / "a1/eval.json").write_text("[]")  # JSON, but no report
    got = made(tmp_path)
    assert any("a1/eval.json: cannot be read (TypeError" in n for n in got.study.notes)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"kind": "kickz"}, "unknown protocol 'kickz'; did you mean 'kicks'?"),
        ({"settings": {"old": 1}}, "protocol.kicks.old: unknown key 'old'"),
        ({"settings": {"measures": ["lost"]}}, "protocol.kicks.measures.lost: unknown measure term 'lost'"),
        ({"kind": None}, "it has no kind, or no settings, of a protocol"),
    ],
    ids=["kind", "key", "measure", "none"],
)
@pytest.mark.parametrize("old", [1, 12])
def test_protocols_of_another_version_are_named_and_the_others_stay(
    change: dict[str, Any], why: str, old: int, tmp_path: Path
) -> None:
    """One line for each file, also where all are old; it was a refusal of the whole report, or a traceback."""
    kicked(tmp_path)
    files = sorted(tmp_path.glob("*/protocols/kicks.json"))[:old]
    for file in files:
        about = json.loads(file.read_text())
        parts = {k: {**about[k], **v} if isinstance(v, dict) else v for k, v in change.items()}
        file.write_text(json.dumps({**about, **parts}))
    got = made(tmp_path)
    lines = [n for n in got.study.notes if "its settings are not of this version" in n]
    assert len(lines) == old
    assert all(any(line.startswith(str(file)) for line in lines) for file in files)
    assert all(why in line for line in lines)
    assert [len(o.evaluation.runs) for o in got.outcomes] == ([11] if old == 1 else [])


def test_rows_without_a_column_that_others_have_are_left_out(tmp_path: Path) -> None:
    kicked(tmp_path, evaluated=True)
    for name, lost in (("protocols/kicks.parquet", "impulse"), ("eval.parquet", "robot")):
        file = tmp_path / "g0s0" / name
        pq.write_table(pq.read_table(file).drop_columns([lost]), file)
    got = made(tmp_path)
    assert "kicks: g0s0 excluded, evaluated with other settings (columns of the rows) than most" in got.study.notes
    assert any(
        "g0s0/eval.json: cannot be read (ValueError: its rows have no column 'robot')" in n for n in got.study.notes
    )
    assert [len(o.evaluation.runs) for o in got.outcomes] == [11, 11]


def test_two_sweeps_of_one_name_keep_their_runs_apart_and_count_each_seed_once(tmp_path: Path) -> None:
    for place in ("monday", "tuesday"):
        for seed in range(2):
            run(tmp_path / place / "sweep" / f"s{seed}", seed + (place == "tuesday"))
    got = made(tmp_path / "monday/sweep", tmp_path / "tuesday/sweep")
    assert [r.label for r in got.groups[0].runs] == ["monday/sweep/s0", "monday/sweep/s1", "tuesday/sweep/s1"]
    (twice,) = got.study.absent
    assert twice.label == "tuesday/sweep/s0"
    assert "has the settings and the seed 1 of monday/sweep/s1; each seed counts once" in twice.cause
    again = made(tmp_path / "monday", tmp_path / "monday/sweep")
    assert len(again.groups[0].runs) == 2


def test_figures_are_refused_before_anything_is_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(tmp_path / "a", 0, evaluated=False)
    (tmp_path / "a/checkpoints").mkdir()
    (tmp_path / "a/checkpoints/000001.pt").write_bytes(b"")
    made_of: list[Any] = []

    def noted(wanted: Any, *rest: Any) -> list[str]:
        made_of.append(wanted)
        return []

    monkeypatch.setattr("go1exp.evaluate.report.evaluating.evaluate_missing", noted)
    line = [f"folders=[{tmp_path}]", f"folder={tmp_path}/out", "eval=true", "protocol=[grid,kicks]"]
    with pytest.raises(ConfigError, match=r"figures: unknown figure 'nosuch'; known: .*error_xy.*recovery_s"):
        _task(compose("report", [*line, "figures=[nosuch,error_xy]"]))
    assert made_of == []
    _task(compose("report", [*line, "figures=[recovery_s,error_xy]"]))
    assert len(made_of) == 1


def test_a_figure_that_does_not_exist_is_refused_without_an_evaluation(tmp_path: Path) -> None:
    run(tmp_path / "a", 0, evaluated=False)
    line = [f"folders=[{tmp_path}]", f"folder={tmp_path}/out"]
    for given, named in (("nosuch", "'nosuch'; known: .*error_xy.*recovery_s"), ("eror_xy", "'eror_xy'; did you mean")):
        with pytest.raises(ConfigError, match=rf"^figures: unknown figure {named}"):
            _task(compose("report", [*line, f"figures=[error_xy,{given}]"]))
    assert not (tmp_path / "out").exists()
    _task(compose("report", [*line, "figures=[recovery_s,error_xy]"]))


def test_a_figure_of_one_evaluation_may_be_asked_for_where_there_is_another(tmp_path: Path) -> None:
    kicked(tmp_path, evaluated=True)
    outcomes = {o.evaluation.name: o for o in made(tmp_path, figures=("recovery_s",), baseline="weight=0.0").outcomes}
    assert [(v.column.name, v.word) for v in outcomes["kicks"].verdicts] == [("recovery_s", "better")]
    assert outcomes["grid"].verdicts == []


def test_runs_of_other_tasks_and_a_missing_term_are_named(tmp_path: Path) -> None:
    run(tmp_path / "a", 0)
    run(tmp_path / "b", 0)
    config = yaml.safe_load((tmp_path / "b/config.yaml").read_text())
    del config["reward"]["gait"]
    (tmp_path / "b/config.yaml").write_text(yaml.safe_dump({**config, "command": {"term": "fixed_velocity"}}))
    got = made(tmp_path)
    assert any("no reward.gait" in g.name for g in got.groups)
    assert "training commands differ, so that returns and lengths are of different tasks" in got.study.notes


# ---------------------------------------------------------------------- files


def test_the_command_writes_page_json_and_tables(
    two_groups: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    container = compose("report", [f"folders=[{two_groups}]", f"folder={tmp_path}", "baseline='weight=10.0'"])
    _task(container)
    out = capsys.readouterr().out
    assert "12 runs in 2 groups; baseline: reward.gait.weight=10.0" in out
    assert re.search(r"worse +reward.gait.weight=0.0: error_yaw", out)
    comparison = table(tmp_path / "grid_comparison.csv")
    assert [r["verdict"] for r in comparison] == ["worse", "worse", "no significant difference"]
    assert {p.name for p in tmp_path.iterdir()} == {
        *("report.html", "report.json", "runs.csv", "curves.csv", "grid_figures.csv", "grid_runs.csv"),
        *("grid_comparison.csv", "grid_sensitivity.csv"),
    }
    assert len(table(tmp_path / "runs.csv")) == 12
    assert len(table(tmp_path / "curves.csv")) == 2 * 2 * 200
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["baseline"] == "reward.gait.weight=10.0"
    assert len(content["grid_comparison"]) == 3


def test_the_page_needs_nothing_beside_it(two_groups: Path) -> None:
    text = page(made(two_groups))
    assert not re.search(r'(?:src|href)="(?!#)', text)
    assert "@import" not in text
    titles = ("grid: comparison with the baseline", "grid: results", "grid: sensitivity", "rollout/return", "Groups")
    assert [title for title in titles if title not in text] == []


def test_eval_true_evaluates_what_is_missing_with_the_runs_own_policy(tmp_path: Path) -> None:
    trained(tmp_path / "r", "ppo.iterations=1")
    run_state.write(tmp_path / "r", "done")
    brief = {"x": [0.5], "y": [], "yaw": [], "episodes": 3, "seconds": 0.2, "settle_s": 0.1}
    changes = [f"evaluation.{key}={value}" for key, value in brief.items()]
    short = ["robots=2", "impulses=[3.0]", "first_s=2.0", "every_s=2.0", "jitter_s=0.1"]
    short += ["recovery.hold_s=0.1", "recovery.smooth_s=0.1"]
    changes += ["protocol=[grid,kicks]", *(f"protocol.kicks.{words}" for words in short)]
    line = [f"folders=[{tmp_path / 'r'}]", f"folder={tmp_path}/out", *changes]
    with pytest.raises(ConfigError, match=r"protocol=\[kicks\]: is what eval=true plays"):
        _task(compose("report", line))
    _task(compose("report", [*line, "eval=true"]))
    rows = table_of_run(tmp_path / "r")
    assert (rows["x"], rows["robot"]) == ([0.0] * 3 + [0.5] * 3, [0, 1, 2] * 2)
    assert {"draw.foot_friction_mean", "draw.center_of_mass_x", "draw.link_mass_range", "trot_error"} <= set(rows)
    assert len(set(rows["draw.foot_friction_mean"])) == 6
    assert all(0.4 <= v <= 1.1 for v in rows["draw.foot_friction_mean"])
    assert len(table(tmp_path / "out/grid_runs.csv")) == 1
    assert len(table(tmp_path / "out/kicks_runs.csv")) == 1
    played = json.loads((tmp_path / "r/protocols/kicks.json").read_text())
    assert (played["kind"], played["settings"]["robots"], played["rates"]["seed"]) == ("kicks", 2, 1)
    before = (tmp_path / "r/protocols/kicks.parquet").stat().st_mtime_ns
    _task(compose("report", [*line, "eval=true"]))  # what is there is not played again
    assert (tmp_path / "r/protocols/kicks.parquet").stat().st_mtime_ns == before


@needs_chromium
def test_a_browser_shows_the_page_and_a_phone_all_of_it(two_groups: Path, tmp_path: Path) -> None:
    shown = on_a_phone(write(made(two_groups), tmp_path)[0].read_text(), tmp_path)
    assert shown["page"] <= shown["width"] == PHONE
    assert shown["drawings"] == 1 + 3 + 3  # one metric, three quantities, and the correlates of each
    assert shown["verdicts"] == 3
    assert shown["wide"] == []
