"""Asynchronous evaluation of a training with the best policy kept, videos, and rules that end it early."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from go1exp.cli.train import _refuse_other
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.config.schema.training import ROWS, StopRule
from go1exp.evaluate.asynchronous import answered, score
from go1exp.sim.task import parse_train
from go1exp.train import checkpoint, early_stop, run_folder
from go1exp.train.asynchronous import AsyncEvaluation
from go1exp.train.early_stop import EarlyStop
from tests.small_run import SMALL, train

BRIEF = ("eval.x=[0.5]", "eval.y=[]", "eval.yaw=[]", "eval.episodes=2", "eval.seconds=0.4", "eval.settle_s=0.2")


def evaluating(run: Path, iteration: int = 0, *more: str) -> AsyncEvaluation:
    """The evaluation beside a training that begins, or goes on after an iteration."""
    return AsyncEvaluation(parse_train(compose("train", [*SMALL, "eval.every=1", *more])), run, iteration)


def rows(file: Path) -> list[dict[str, float]]:
    return [{k: float(v) for k, v in r.items()} for r in csv.DictReader(file.read_text().splitlines())]


# ---------------------------------------------------------------------- evaluation and videos


def test_a_job_gives_the_figures_of_its_policy(tmp_path: Path) -> None:
    train(tmp_path, (*SMALL, "checkpoint.every=1"))
    settings = dataclasses.asdict(parse_train(compose("train", [*SMALL, *BRIEF])).eval)
    job = {"kind": "evaluate", "iteration": 1, "steps": 16, "policy": str(tmp_path / "checkpoints/000001.pt")}
    result = answered(tmp_path, {**job, "settings": settings})
    assert set(result["figures"]) == {"score", "error_xy", "error_yaw", "fall_share"}
    assert 0.0 < result["figures"]["error_xy"] <= result["figures"]["score"] < 2.0
    lost = answered(tmp_path, {**job, "policy": "none.pt", "settings": settings})
    assert lost["problem"].startswith("evaluate during the training failed: FileNotFoundError")


@pytest.mark.slow("go1exp/evaluate/", "go1exp/train/")
def test_policies_are_evaluated_and_the_best_is_kept(tmp_path: Path) -> None:
    plain = train(tmp_path / "plain", (*SMALL, "ppo.iterations=4"))
    evaluation = train(tmp_path / "run", (*SMALL, "ppo.iterations=4", "eval.every=2", *BRIEF))
    table = rows(tmp_path / "run/evals.csv")
    assert [(r["iteration"], r["steps"]) for r in table] == [(2, 32), (4, 64)]
    best = min(table, key=lambda r: r["score"])
    assert json.loads((tmp_path / "run/best.json").read_text()) == best
    kept = checkpoint.read(tmp_path / "run/best.pt")
    assert kept["iteration"] == best["iteration"]
    for name, value in plain.policy.state_dict().items():  # training knows nothing of it
        assert torch.equal(value, evaluation.policy.state_dict()[name])
    assert (tmp_path / "plain/metrics.csv").read_text() == (tmp_path / "run/metrics.csv").read_text()
    from go1exp.train.policy import load_run

    assert load_run(tmp_path / "run", tmp_path / "run/best.pt")[2]["iteration"] == best["iteration"]


def test_a_run_that_goes_on_drops_evaluations_of_later_iterations(tmp_path: Path) -> None:
    head = "iteration,steps,score,error_xy,error_yaw,fall_share\n"
    (tmp_path / "evals.csv").write_text(f"{head}1,16,0.5,0.5,0.5,0.0\n2,32,0.4,0.4,0.5,0.0\n3,48,0.3")
    evaluating(tmp_path, 1)
    assert [r["iteration"] for r in rows(tmp_path / "evals.csv")] == [1]


def take(evaluation: AsyncEvaluation, iteration: int, score: float, file: Path) -> dict[str, Any]:
    """Give it the result of a policy, a byte with its iteration; return the figures for the log."""
    file.write_bytes(bytes([iteration]))
    result = {"kind": "evaluate", "iteration": iteration, "steps": 16 * iteration, "policy": str(file)}
    return evaluation._take({**result, "figures": {"score": score, "fall_share": 0.0}})


def evaluated_run(run: Path, scores: dict[int, float]) -> None:
    """A run in which policies had these scores by iteration."""
    evaluation = evaluating(run)
    (run / "evals").mkdir()
    for iteration, value in scores.items():
        figures = take(evaluation, iteration, value, run / f"evals/{iteration:06d}.pt")
        assert figures == {"eval/iteration": iteration, "eval/score": value, "eval/fall_share": 0.0}


def best_of(run: Path) -> tuple[int, int, float]:
    """What is in best.pt, and the iteration and score that best.json says."""
    row = json.loads((run / "best.json").read_text())
    return (run / "best.pt").read_bytes()[0], row["iteration"], row["score"]


@pytest.mark.parametrize("policies", [True, False])
def test_a_best_policy_of_later_iterations_gives_way_when_a_run_goes_on_before_it(
    tmp_path: Path, policies: bool
) -> None:
    """It was kept, and a worse one of the new rows then took its place, as these knew nothing of it."""
    evaluated_run(tmp_path, {1: 0.5, 2: 0.4, 3: 0.2})
    if not policies:  # somebody made room
        for file in (tmp_path / "evals").glob("*.pt"):
            file.unlink()
    again = evaluating(tmp_path, 2)
    assert [r["iteration"] for r in rows(tmp_path / "evals.csv")] == [1, 2]
    assert (tmp_path / "evals/000003.pt").read_bytes() == bytes([3])  # nothing is lost
    if policies:
        assert best_of(tmp_path) == (2, 2, 0.4)
    else:
        assert not (tmp_path / "best.pt").exists()
        assert not (tmp_path / "best.json").exists()
    take(again, 3, 0.45, tmp_path / "new.pt")
    assert best_of(tmp_path) == ((2, 2, 0.4) if policies else (3, 3, 0.45))


def test_a_crash_between_row_and_best_policy_is_made_good(tmp_path: Path) -> None:
    evaluated_run(tmp_path, {1: 0.5, 2: 0.2, 3: 0.4})
    table = (tmp_path / "evals.csv").read_text()
    head, first, second, third = table.splitlines(keepends=True)
    (tmp_path / "evals.csv").write_text(head + first + third)  # the row of the best is lost
    evaluating(tmp_path, 3)
    assert (tmp_path / "evals.csv").read_text() == table
    (tmp_path / "evals.csv").unlink()
    evaluating(tmp_path, 3)
    assert (tmp_path / "evals.csv").read_text() == head + second
    assert best_of(tmp_path) == (2, 2, 0.2)
    (tmp_path / "evals.csv").write_text(table)
    (tmp_path / "best.pt").write_bytes(bytes([1]))
    (tmp_path / "best.json").write_text(json.dumps({"iteration": 1, "steps": 16, "score": 0.5, "fall_share": 0.0}))
    evaluating(tmp_path, 3)  # killed after the row of the second was written
    assert best_of(tmp_path) == (2, 2, 0.2)
    (tmp_path / "best.json").write_text('{"iteration": 2, "st')
    evaluating(tmp_path, 3)
    assert best_of(tmp_path) == (2, 2, 0.2)


def test_a_policy_that_waited_before_a_crash_is_not_evaluated_for_the_one_of_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evals").mkdir()
    (tmp_path / "evals/000002.pt").write_bytes(b"of a training that went on otherwise")
    evaluation = evaluating(tmp_path, 1, "video.every=1")
    sent = io.StringIO()
    monkeypatch.setattr(evaluation, "_begin", lambda: SimpleNamespace(stdin=sent))
    policy = SimpleNamespace(state_dict=dict)
    evaluation.offer(SimpleNamespace(iteration=2, num_timesteps=32, policy=policy), last=False)  # type: ignore[arg-type]
    assert len(sent.getvalue().splitlines()) == 2
    assert torch.load(tmp_path / "evals/000002.pt")["num_timesteps"] == 32


@pytest.mark.slow("go1exp/evaluate/", "go1exp/train/")
def test_a_failure_beside_is_one_line_and_training_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluation = evaluating(tmp_path)
    policy = SimpleNamespace(state_dict=dict)
    evaluation.offer(SimpleNamespace(iteration=1, num_timesteps=16, policy=policy), last=False)  # type: ignore[arg-type]
    assert evaluation.finish(wait=True) == {}
    (problem,) = evaluation.problems
    assert problem.startswith("evaluate during the training failed: FileNotFoundError")
    assert "not a run folder" in problem


def test_nothing_is_started_where_nothing_is_asked_for(tmp_path: Path) -> None:
    evaluation = AsyncEvaluation(parse_train(compose("train", [*SMALL])), tmp_path, 0)
    evaluation.offer(SimpleNamespace(iteration=1, num_timesteps=16), last=True)  # type: ignore[arg-type]
    assert evaluation.finish(wait=True) == {}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow("go1exp/evaluate/", "go1exp/train/")
def test_videos_are_made(tmp_path: Path) -> None:
    train(tmp_path / "run", (*SMALL, "ppo.iterations=2", "video.every=2", "video.seconds=0.4"))
    film = tmp_path / "run/videos/000002.mp4"
    if film.is_file():  # a machine without any graphics has none, and says so
        assert film.stat().st_size > 1000


def test_time_on_the_ground_counts_as_the_whole_command() -> None:
    def row(x: float, moving: float, error: float) -> dict[str, Any]:
        return {"x": x, "y": 0.0, "moving_s": moving, "error_xy": error}

    assert score([row(1.5, 8.0, 0.2)], 8.0) == pytest.approx(0.2)
    assert score([row(1.5, 4.0, 0.0)], 8.0) == pytest.approx(1.5 / math.sqrt(2))
    assert score([row(0.0, 0.0, 0.0)], 8.0) == pytest.approx(1.0)


# ---------------------------------------------------------------------- early stop


def test_a_training_ends_when_a_figure_is_good_enough_and_is_complete(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="stop.figure: unknown metric 'steps_total'"):
        ppo = train(tmp_path, (*SMALL, "ppo.iterations=6", "stop.figure=steps_total", "stop.at=1.0"))
    assert ppo.iteration == 6  # no such metric: no rule
    rule = ("ppo.iterations=6", "stop.figure=train/learning_rate", "stop.better=lower", "stop.at=1.0")
    ppo = train(tmp_path / "early", (*SMALL, *rule))
    assert ppo.iteration == 1
    assert [p.name for p in checkpoint.checkpoints(tmp_path / "early")] == ["000001.pt"]
    config = parse_train(compose("train", [*SMALL, *rule]))
    reason = early_stop.ended(tmp_path / "early", config.stop)
    assert reason.startswith("stopped early after iteration 1: train/learning_rate = ")
    assert early_stop.ended(tmp_path / "early", StopRule()) == ""


def test_patience_counts_from_the_best_and_goes_on_after_a_pause(tmp_path: Path) -> None:
    rule = StopRule(figure="r", patience=3, least=0.5)
    values = [1.0, 2.0, 2.4, 2.3, 2.2, 9.0]
    stop = EarlyStop(rule, tmp_path, 0)
    reasons = [stop.reason(k, {"r": v}) for k, v in enumerate(values, 1)]
    assert [bool(r) for r in reasons] == [False, False, False, False, True, False]
    assert reasons[4] == "r is no better than 2 since iteration 2"
    table = "\n".join(["iteration,steps,r", *(f"{k},{k},{v}" for k, v in enumerate(values, 1)), ""])
    (tmp_path / "metrics.csv").write_text(table)
    for pause in range(1, 5):  # after the best one, too
        resumed = EarlyStop(rule, tmp_path, pause)
        assert [resumed.reason(k, {"r": values[k - 1]}) for k in range(pause + 1, 6)] == reasons[pause:5]


def test_a_rule_on_an_evaluation_goes_on_from_the_rows_of_evals(tmp_path: Path) -> None:
    (tmp_path / ROWS).write_text("iteration,steps,score\n2,20,0.5\n4,40,0.9\n6,60,0.1\n")
    rule = StopRule(figure="eval/score", better="lower", patience=3)
    resumed = EarlyStop(rule, tmp_path, 4)
    assert resumed.reason(5, {"eval/score": 0.6}) == "eval/score is no better than 0.5 since iteration 2"


def test_a_rule_needs_a_figure_and_a_limit() -> None:
    with pytest.raises(ConfigError, match="figure = None: at and patience need one"):
        parse_train(compose("train", ["stop.at=1.0"]))
    with pytest.raises(ConfigError, match="needs at or patience"):
        parse_train(compose("train", ["stop.figure=rollout/return"]))
    by_score = ["stop.figure=eval/score", "stop.at=0.1"]
    with pytest.raises(ConfigError, match=r"stop.figure = 'eval/score'.*set eval.every"):
        parse_train(compose("train", by_score))
    assert parse_train(compose("train", [*by_score, "eval.every=5"])).stop.figure == "eval/score"


def test_a_rule_on_a_metric_that_there_is_not_is_said_once(tmp_path: Path) -> None:
    stop = EarlyStop(StopRule(figure="rollout/retrun", at=1.0), tmp_path, 0)
    with pytest.warns(UserWarning, match="stop.figure: unknown metric 'rollout/retrun'; did you mean 'rollout/return'"):
        assert stop.reason(1, {"rollout/return": 2.0}) == ""
    assert stop.reason(2, {"rollout/return": 2.0}) == ""  # every warning is an error
    later = EarlyStop(StopRule(figure="eval/score", at=1.0), tmp_path, 0)
    assert later.reason(1, {"rollout/return": 2.0}) == ""


def test_runs_of_older_versions_have_none_of_it_and_may_get_it(tmp_path: Path) -> None:
    old = compose("train", [*SMALL])
    for key in ("eval", "video", "stop"):
        del old[key]
    assert parse_train(old).eval.every == 0
    run_folder.write(tmp_path, old)
    _refuse_other(tmp_path, compose("train", [*SMALL, "eval.every=5"]))


# ---------------------------------------------------------------------- what a run folder says


def test_the_run_folder_has_all_versions_and_what_was_not_committed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*arguments: str) -> str:
        return {"rev-parse": "abc", "status": " M file", "diff": "-old\n+new"}[arguments[0]]

    monkeypatch.setattr(run_folder, "_git", git)
    run_folder.write(tmp_path, compose("train", [*SMALL]))
    meta = json.loads((tmp_path / "meta.json").read_text())
    assert meta["installed"]["torch"] == meta["packages"]["torch"]
    assert {"mujoco-warp", "warp-lang"} <= set(meta["packages"])
    assert len(meta["installed"]) > 20
    assert (tmp_path / "git.diff").read_text() == "-old\n+new\n"
