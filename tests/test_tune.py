"""``go1exp tune``, and the sweep of Weights & Biases: searches that call ``go1exp train``."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml

from go1exp.base.errors import Expected
from go1exp.base.paths import data_root
from go1exp.cli.tune import _ranges
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.task import parse_train
from go1exp.train import metrics, run_state
from go1exp.train.sweep import trials
from go1exp.train.sweep.command import Ended
from go1exp.train.sweep.tune import Range, Search, TuneSettings
from tests.command import environment
from tests.command import run as cli
from tests.small_run import SMALL

ABOUT = ("go1exp/train/sweep/", "go1exp/cli/tune.py", "conf/tune.yaml")
NEEDS_OPTUNA = pytest.mark.skipif(
    importlib.util.find_spec("optuna") is None and not os.environ.get("GO1EXP_TEST_TUNE"),
    reason="no optuna: pip install 'go1exp[tune]'",
)
SPACE = 'space=["ppo.learning_rate=tag(log,interval(1e-4,3e-3))","ppo.gamma=choice(0.97,0.99)"]'


def test_the_agent_of_weights_and_biases_gets_a_command_that_composes(monkeypatch: pytest.MonkeyPatch) -> None:
    from wandb.sdk.launch.sweeps.utils import create_sweep_command, create_sweep_command_args

    sweep = yaml.safe_load((data_root() / "docs/wandb_sweep.yaml").read_text())
    given = {"ppo.learning_rate": {"value": 0.0007}, "ppo.minibatches": {"value": 8}}
    words: list[str] = []
    values = {**create_sweep_command_args({"args": given}), "program": [sweep["program"]]}
    for word in create_sweep_command(sweep["command"]):  # as wandb's agent puts them together
        words += values[word[2:-1]] if word.startswith("${") else [word]
    assert words[:2] == ["go1exp", "train"]
    monkeypatch.delenv("WANDB_MODE", raising=False)
    container = compose("train", words[2:])
    config = parse_train(container)
    assert (config.ppo.learning_rate, config.ppo.minibatches) == (0.0007, 8)
    assert config.logger.wandb is not None
    assert metrics.wandb_mode(config.logger.wandb) == "online"  # what is offline, the search never sees
    assert {*sweep["parameters"]} == {*given}


def test_the_sweep_in_the_document_is_the_file() -> None:
    document = (data_root() / "docs/sweeps.md").read_text()
    (shown,) = re.findall(r"^```yaml\n(program:.*?)^```$", document, re.MULTILINE | re.DOTALL)
    assert yaml.safe_load(shown) == yaml.safe_load((data_root() / "docs/wandb_sweep.yaml").read_text())


@NEEDS_OPTUNA
@pytest.mark.slow(*ABOUT)
def test_a_search_finds_its_best_trial_and_goes_on(tmp_path: Path) -> None:
    settings = ",".join(json.dumps(word) for word in (*SMALL, "ppo.iterations=4"))
    line = (SPACE, f"overrides=[{settings}]", "workers=2", "metric=train/kl", "direction=minimize", "out=search")
    first = cli(tmp_path, "tune", *line, "trials=2")
    assert first.returncode == 0, first.stderr
    again = cli(tmp_path, "tune", *line, "trials=3")
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("trial ") == 2  # the third one, and the best
    jobs = json.loads((tmp_path / "search/sweep.json").read_text())["jobs"]
    assert [(job["run_folder"], job["state"]) for job in jobs] == [(f"trial-{n:04}", "done") for n in range(3)]
    best = json.loads((tmp_path / "search/best.json").read_text())
    (now,) = [row for row in again.stdout.splitlines() if row.startswith("now: ")]
    config = parse_train(compose("train", shlex.split(now)[3:]))
    assert config.ppo.learning_rate == best["overrides"]["ppo.learning_rate"]
    other = cli(tmp_path, "tune", 'space=["ppo.epochs=range(1,3)"]', "out=search")
    assert (other.returncode, other.stderr.count("\n")) == (1, 1)
    assert "holds a search for" in other.stderr
    nobody = cli(tmp_path, "tune", SPACE, "storage=sqlite:////nowhere/at/all.db", "out=elsewhere")
    assert (nobody.returncode, nobody.stderr.count("\n")) == (1, 1)
    assert "cannot be used" in nobody.stderr


# ---------------------------------------------------------------------- draws


class Drawing(Search):
    """A search whose trainings are over at once: what it draws is all there is to see."""

    def _train(self, trial: Any, run: Path, share: tuple[int, ...]) -> tuple[Ended, list[tuple[int, float]], bool]:
        return Ended(0, ""), [(1, trial.params["ppo.gamma"])], False


def searched(out: Path, **changes: Any) -> Drawing:
    settings: dict[str, Any] = parsed_defaults() | {"trials": 3, "out": str(out), **changes}
    search = Drawing(TuneSettings(**settings), {"ppo.gamma": Range(low=0.9, high=0.999)}, lambda overrides, run: None)
    search.run()
    return search


def parsed_defaults() -> dict[str, Any]:
    plain = yaml.safe_load((data_root() / "conf/tune.yaml").read_text())
    return {key: plain[key] for key in TuneSettings.__dataclass_fields__} | {"space": (), "overrides": ()}


def gammas(search: Search) -> list[float]:
    return [trial.params["ppo.gamma"] for trial in search._study().get_trials()]


@NEEDS_OPTUNA
def test_the_same_search_from_nothing_draws_the_same_and_one_that_goes_on_draws_others(tmp_path: Path) -> None:
    first, twin = gammas(searched(tmp_path / "a")), gammas(searched(tmp_path / "b"))
    assert first == twin
    longer = gammas(searched(tmp_path / "a", trials=12))
    assert longer[:3] == first
    assert len({*longer}) == 12
    assert gammas(searched(tmp_path / "c", trials=12)) == longer  # in one sitting or, between two trials, in two
    assert gammas(searched(tmp_path / "d", seed=1)) != first
    assert not list((tmp_path / "a" / trials.SEARCHES).iterdir())


# ---------------------------------------------------------------------- killed


@NEEDS_OPTUNA
def test_a_trial_whose_search_was_killed_goes_on_and_one_whose_search_lives_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from optuna.trial import TrialState

    study = searched(tmp_path, trials=1)._study()
    for search in ("killed", "lives", "elsewhere", ""):
        trial = study.ask()
        trial.suggest_float("ppo.gamma", 0.9, 0.999)
        if search:
            trial.set_user_attr(trials.SEARCH, search)
            trial.set_user_attr(trials.FOLDER, f"trial-{trial.number:04}")
    (tmp_path / trials.SEARCHES / "killed").mkdir()
    with run_state.locked(tmp_path / trials.SEARCHES / "lives"):
        trials.put_back(study, tmp_path)
    states = [trial.state for trial in study.get_trials()]
    running, waiting = TrialState.RUNNING, TrialState.WAITING
    assert states == [TrialState.COMPLETE, TrialState.FAIL, running, running, running, waiting]
    _, lost, *_, again = study.get_trials()
    assert again.user_attrs[trials.FOLDER] == lost.user_attrs[trials.FOLDER] == "trial-0001"
    assert again.system_attrs["fixed_params"] == lost.params
    monkeypatch.setattr(trials, "NAMELESS", timedelta(0))  # a minute later
    assert searched(tmp_path, trials=5)._study().get_trials()[5].params == lost.params


def with_a_killed_search(study: Any, folder: Path) -> Any:
    """Return a trial, running, whose search is gone; its training had a folder."""
    trial = study.ask()
    trial.suggest_float("ppo.gamma", 0.9, 0.999)
    trial.set_user_attr(trials.SEARCH, "killed")
    trial.set_user_attr(trials.FOLDER, f"trial-{trial.number:04}")
    (folder / trials.SEARCHES / "killed").mkdir()
    return trial


class Killed(BaseException):
    """What a kill leaves behind: nothing of the search is done any more."""


class Stopping(Drawing):
    """A search that is stopped in its first training."""

    def _train(self, trial: Any, run: Path, share: tuple[int, ...]) -> tuple[Ended, list[tuple[int, float]], bool]:
        self._stopping = True
        return Ended(1, ""), [], False


def die_at_the_second_call(patch: pytest.MonkeyPatch) -> None:
    """Have a search die between telling a trial as failed and putting the one that goes on with it in front."""
    from optuna.study import Study

    calls: list[str] = []

    def dying(name: str) -> Any:
        real = getattr(Study, name)

        def call(*arguments: Any, **keys: Any) -> Any:
            calls.append(name)
            if len(calls) > 1:
                raise Killed
            return real(*arguments, **keys)

        return call

    for name in ("tell", "enqueue_trial"):
        patch.setattr(Study, name, dying(name))


@NEEDS_OPTUNA
@pytest.mark.parametrize("again", [False, True], ids=["as it stops", "as it starts, too"])
def test_a_search_that_is_killed_while_it_hands_on_a_trial_does_not_lose_it(
    again: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = TuneSettings(**parsed_defaults() | {"trials": 1, "out": str(tmp_path)})
    search = Stopping(settings, {"ppo.gamma": Range(low=0.9, high=0.999)}, lambda overrides, run: None)
    with monkeypatch.context() as patch:
        die_at_the_second_call(patch)
        with pytest.raises(Killed):
            search.run()
    if again:
        study = search._study()
        trials.put_back(study, tmp_path)
        assert study.ask().user_attrs[trials.FOLDER] == "trial-0000"  # goes on; killed before it draws
        (tmp_path / "trial-0000").mkdir()
        with monkeypatch.context() as patch:
            die_at_the_second_call(patch)
            with pytest.raises(Killed):
                trials.put_back(study, tmp_path)
    first, *_, newest = searched(tmp_path, trials=1)._study().get_trials()
    assert [first.state.name, newest.state.name, newest.number] == ["FAIL", "COMPLETE", 1 + again]
    assert newest.user_attrs[trials.FOLDER] == "trial-0000"
    assert newest.params == first.params


@NEEDS_OPTUNA
def test_of_two_trials_that_go_on_with_the_same_one_only_the_older_runs(tmp_path: Path) -> None:
    """Two searches that start at once may both put it in front."""
    study = searched(tmp_path, trials=1)._study()
    lost = with_a_killed_search(study, tmp_path)
    for _ in range(2):
        study.enqueue_trial(lost.params, user_attrs={trials.FOLDER: "trial-0001", trials.CONTINUES: lost.number})
    found = searched(tmp_path, trials=3)._study().get_trials()
    assert [trial.state.name for trial in found] == ["COMPLETE", "FAIL", "COMPLETE", "FAIL", "COMPLETE"]
    assert found[2].params == lost.params
    assert found[4].params != lost.params


@NEEDS_OPTUNA
def test_a_trial_that_was_killed_before_it_had_a_name_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whose it is shows only after a while; the search that goes on at once had one trial less than asked for."""
    from optuna.trial import TrialState

    monkeypatch.setattr(trials, "NAMELESS", timedelta(seconds=1.5))
    monkeypatch.setattr(trials, "LOOK_S", 0.1)
    study = searched(tmp_path, trials=1)._study()
    study.ask()  # killed here
    states = [trial.state for trial in searched(tmp_path, trials=3)._study().get_trials()]
    assert states == [TrialState.COMPLETE, TrialState.FAIL, TrialState.COMPLETE, TrialState.COMPLETE]
    named = study.ask()
    named.set_user_attr(trials.SEARCH, "killed")  # killed here, before it drew and had a folder
    (tmp_path / trials.SEARCHES / "killed").mkdir()
    states = [trial.state for trial in searched(tmp_path, trials=4)._study().get_trials()]
    assert states[4:] == [TrialState.FAIL, TrialState.COMPLETE]


@NEEDS_OPTUNA
def test_a_search_that_was_killed_while_it_said_what_it_is_of_goes_on(tmp_path: Path) -> None:
    import optuna

    optuna.create_study(study_name=tmp_path.name, storage=f"sqlite:///{tmp_path / 'optuna.db'}").set_user_attr(
        "metric", parsed_defaults()["metric"]
    )
    study = searched(tmp_path, trials=1, direction="minimize")._study()
    assert study.user_attrs == {"metric": parsed_defaults()["metric"], "space": ["ppo.gamma"]}
    with pytest.raises(Expected, match="holds a search for"):
        searched(tmp_path, trials=1, direction="minimize", metric="train/kl")


@NEEDS_OPTUNA
def test_a_training_that_does_not_end_holds_nobody_up_and_its_trial_goes_on_when_it_has(tmp_path: Path) -> None:
    from optuna.trial import TrialState

    study = searched(tmp_path, trials=1)._study()
    with_a_killed_search(study, tmp_path)
    (tmp_path / "trial-0001").mkdir()
    with run_state.locked(tmp_path / "trial-0001"):
        begin = time.monotonic()
        assert trials.put_back(study, tmp_path, patience=0.2)
        assert time.monotonic() - begin < 0.2 + 3 * trials.LOOK_S
        assert trials.put_back(study, tmp_path, patience=0.0)
        assert study.get_trials()[1].state is TrialState.RUNNING
    assert not trials.put_back(study, tmp_path, patience=0.0)
    assert [t.state for t in study.get_trials()[1:]] == [TrialState.FAIL, TrialState.WAITING]


@NEEDS_OPTUNA
def test_a_trial_whose_settings_are_refused_has_failed(tmp_path: Path) -> None:
    def refuse(overrides: Sequence[str], run: Path) -> None:
        raise ValueError("no such thing")

    search = Drawing(
        TuneSettings(**parsed_defaults() | {"out": str(tmp_path)}), {"ppo.gamma": Range(low=0.9, high=1.0)}, refuse
    )
    with pytest.raises(ValueError, match="no such thing"):
        search.run()
    assert [trial.state.name for trial in search._study().get_trials()] == ["FAIL"]


def words(*more: str) -> str:
    return "overrides=[" + ",".join(json.dumps(word) for word in (*SMALL, *more)) + "]"


@NEEDS_OPTUNA
@pytest.mark.slow(*ABOUT)
def test_a_search_that_is_killed_loses_neither_its_trial_nor_its_count(tmp_path: Path) -> None:
    line = (
        "tune",
        SPACE,
        words("ppo.iterations=150", "checkpoint.every=5"),
        "trials=1",
        "metric=train/kl",
        "out=search",
    )
    killed = subprocess.Popen([sys.executable, "-m", "go1exp", *line], cwd=tmp_path, env=environment())
    run = tmp_path / "search/trial-0000"
    try:
        limit = time.monotonic() + 200.0
        while not any((run / "checkpoints").glob("*.pt")):
            assert killed.poll() is None
            assert time.monotonic() < limit
            time.sleep(0.05)
    finally:
        killed.kill()
        killed.wait()
    again = cli(tmp_path, *line)
    assert again.returncode == 0, again.stderr
    assert "trial 0: its search was killed; goes on now" in again.stdout
    assert "continuing from" in (run / "job.log").read_text()
    jobs = json.loads((tmp_path / "search/sweep.json").read_text())["jobs"]
    assert [(job["run_folder"], job["state"]) for job in jobs] == [("trial-0000", "done")]


# ---------------------------------------------------------------------- pruned by evaluation


@NEEDS_OPTUNA
@pytest.mark.slow(*ABOUT)
def test_a_trial_that_evaluation_shows_to_be_bad_ends_early(tmp_path: Path) -> None:
    """Four earlier trials walk without any error; a policy of two iterations cannot, and would train for hours."""
    import optuna
    from optuna.distributions import FloatDistribution

    changes: dict[str, Any] = {"metric": "eval/score", "direction": "minimize", "out": str(tmp_path / "search")}
    brief = ("eval.x=[0.5]", "eval.y=[]", "eval.yaw=[]", "eval.episodes=2", "eval.seconds=0.4", "eval.settle_s=0.2")
    overrides = words("ppo.iterations=1000000", "eval.every=2", *brief)
    space = {"ppo.gamma": Range(low=0.9, high=0.999)}
    (tmp_path / "search").mkdir()
    study = Drawing(TuneSettings(**parsed_defaults() | changes), space, lambda given, run: None)._study()
    for gamma in (0.91, 0.92, 0.93, 0.94):
        good = dict.fromkeys(range(2, 100_000, 50), 0.001)
        study.add_trial(
            optuna.create_trial(
                params={"ppo.gamma": gamma},
                distributions={"ppo.gamma": FloatDistribution(0.9, 0.999)},
                value=0.001,
                intermediate_values=good,
            )
        )
    line = ("tune", 'space=["ppo.gamma=interval(0.9,0.999)"]', "metric=eval/score", "direction=minimize", "out=search")
    done = cli(tmp_path, *line, overrides, "trials=5", "average=1", "warmup=1")
    assert done.returncode == 0, done.stderr
    assert re.search(r"^trial 4: ended early at iteration \d+: ", done.stdout, re.MULTILINE), done.stdout
    assert [trial.state.name for trial in study.get_trials()] == ["COMPLETE"] * 4 + ["PRUNED"]


@NEEDS_OPTUNA
def test_a_metric_of_evaluations_needs_evaluations(tmp_path: Path) -> None:
    done = cli(tmp_path, "tune", SPACE, words(), "metric=eval/score", "direction=minimize")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "metric = 'eval/score': needs evaluations; add eval.every=50 to overrides" in done.stderr


@pytest.mark.parametrize(
    ("drawn", "reason"),
    [
        *((drawn, "is empty; its second number") for drawn in ("range(5,5)", "interval(1,0.1)", "interval(0.1,nan)")),
        ("interval(0.1,inf)", "is empty; its second number must be the larger one, and both finite"),
        ("tag(log,interval(0,1))", "a logarithm needs numbers above 0"),
        ("interval(0.1)", "is none of key=interval"),
    ],
)
def test_a_range_that_holds_nothing_is_refused_before_the_first_trial(drawn: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        _ranges([f"ppo.gamma={drawn}"])
    assert _ranges(["ppo.epochs=range(5,6)"])["ppo.epochs"].high == 5
