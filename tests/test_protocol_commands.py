"""``go1exp eval protocol=...`` and ``go1exp compare`` as commands: files, refusals, bundles, what each key does."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import go1exp.evaluate.protocol.kinds  # noqa: F401  (registers them)
from go1exp.cli import compare, evaluate, subjects
from go1exp.cli.app import begin
from go1exp.cli.evaluate import chosen_protocols as protocols_chosen
from go1exp.cli.evaluate import playable
from go1exp.cli.helptext import show
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.export.build import build
from go1exp.deploy.runtime.bundle import BundleError
from tests.small_run import trained
from tests.test_cli import assert_refused

QUICK = (
    *("protocol=corners", "protocol.corners.robots=2", "protocol.corners.seconds=0.3"),
    *("protocol.corners.settle_s=0.2", "protocol.corners.rest_s=0.1", "protocol.corners.claims={}"),
    "protocol.corners.commands=[[0.5,0.0,0.0]]",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two tiny iterations, randomised as in Table I."""
    return trained(tmp_path_factory.mktemp("protocols") / "run", "rand=table1", "terrain=flat")


@pytest.fixture(scope="module")
def bundle(run: Path) -> Path:
    file = run / "bundle.zip"
    file.write_bytes(build(run, seconds=0.1))
    return file


def evaluated(folder: Path, *overrides: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows and numbers of a small protocol."""
    evaluate.APP.task(begin("eval", compose("eval", [*QUICK, f"folder={folder}", *overrides])))
    return pq.read_table(folder / "corners.parquet").to_pylist(), json.loads((folder / "corners.json").read_text())


def compared(folder: Path, *overrides: str) -> dict[str, Any]:
    compare.APP.task(begin("compare", compose("compare", [*QUICK, f"folder={folder}", *overrides])))
    assert {f.name for f in folder.iterdir()} == {"compare.html", "compare.json", "corners.parquet"}
    content: dict[str, Any] = json.loads((folder / "compare.json").read_text())
    return content


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("eval policy=clock protocol=sinusoids", ("sinusoids", "did you mean 'sinusoid'")),
        ("eval policy=clock protocol=sinusoid noise=true", ("noise = True", "protocol.sinusoid.noise")),
        ("eval policy=clock protocol=kicks episodes=3", ("episodes = 3", "protocol.kicks.robots")),
        ("eval policy=clock folder=there", ("folder = 'there'", "out=")),
        ("eval policy=clock protocol.kicks.robots=3", ("protocol.kicks",)),
        ("eval policy=clock protocol=kicks protocol.kicks.measures=[strides]", ("unknown measure term 'strides'",)),
        ("eval bundle=nowhere.zip protocol=kicks", ("bundle = 'nowhere.zip'", "no such file")),
        ("eval bundle=a.zip policy=clock protocol=kicks", ("only one of them",)),
        ("eval bundle=a.zip", ("protocol=grid takes run or policy",)),
        ("eval protocol=kicks", ("run: required",)),
        ("compare clock", ("subjects = ['clock']", "at least 2")),
        ("compare", ("subjects: required, such as go1exp compare clock paper protocol=kicks",)),
        ("compare clock clock", ("each only once",)),
        ("compare clock nothing", ("'nothing' is no run folder, no bundle (.zip), no shipped policy",)),
        ("compare clock clock@5hz", ("'clock@5hz': after @ comes a rate of 10 to 1000 hz",)),
        ("compare clock mpc@mujco", ("'mpc@mujco': after @ comes", "mujoco or physx")),
        ("eval controller=mpc protocol=rate", ("protocol=rate: varies the rate of a policy; mpc has one of its own",)),
        ("eval policy=clock protocol=rate policy_dt=0.01", ("policy_dt = 0.01: protocol=rate has rates of its own",)),
        ("compare clock mpc protocol=paper", ("subjects: mpc has a rate of its own; leave rate out",)),
        ("compare clock clock@estimated protocol=rate", ("clock@estimated is varied in what protocol=rate varies",)),
        ("eval controller=mpc bundle=a.zip protocol=kicks", ("bundle = 'a.zip': is a policy",)),
        ("eval controller=mpc policy=clockk protocol=kicks", ("unknown shipped policy 'clockk'",)),
        ("compare clock paper protocol=grid", ("protocol=grid", "go1exp eval")),
    ],
)
def test_what_is_wrong_is_said_at_once(arguments: str, said: tuple[str, ...], tmp_path: Path) -> None:
    assert_refused(tmp_path, arguments.split(), *said)


def test_a_bundle_plays_what_its_run_plays(run: Path, bundle: Path, tmp_path: Path) -> None:
    """By ONNX from readings, but for rounding; with noise it is the sensors'."""
    quiet = "protocol.corners.noise=false"
    ours, about = evaluated(tmp_path / "run", f"run={run}", quiet)
    theirs, about_bundle = evaluated(tmp_path / "bundle", f"bundle={bundle}", quiet)
    for a, b in zip(ours, theirs, strict=True):
        assert a["rmse_x"] == pytest.approx(b["rmse_x"], abs=1e-3)
    assert about_bundle["agent"]["sha256"] == hashlib.sha256(bundle.read_bytes()).hexdigest()
    assert about_bundle["agent"]["trained"]["iteration"] == about["agent"]["iteration"]
    noisy, _ = evaluated(tmp_path / "noisy", f"bundle={bundle}")
    assert [r["rmse_x"] for r in noisy] != [r["rmse_x"] for r in theirs]


def test_another_controller_plays_and_is_compared(run: Path, tmp_path: Path) -> None:
    rows, about = evaluated(tmp_path / "mpc", "controller=mpc", f"run={run}", "protocol.corners.noise=false")
    assert about["agent"]["controller"]["name"] == "mpc"
    assert [row["fell"] for row in rows] == [False, False]
    content = compared(tmp_path / "both", f"subjects=[mpc,{run}]")
    assert [result["subject"] for result in content["results"]["corners"]] == ["mpc", str(run)]


def test_of_several_protocols_a_controller_leaves_out_the_rates(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    agent = subjects.agent(subjects.word("mpc", ""), {})
    protocols, _ = protocols_chosen(compose("eval", ["protocol=[rate,corners]"]), {})
    assert [c.key for c in playable(protocols, agent)] == ["corners"]
    assert "rate: not played" in capsys.readouterr().out


@pytest.mark.skipif(importlib.util.find_spec("sapien") is None, reason="needs the extra physx")
def test_another_engine_plays(run: Path, tmp_path: Path) -> None:
    here, _ = evaluated(tmp_path / "here", f"run={run}")
    there, about = evaluated(tmp_path / "there", f"run={run}", "engine=physx")
    assert about["rates"]["engine"]["name"] == "physx"
    assert [r["rmse_x"] for r in here] != [r["rmse_x"] for r in there]
    content = compared(tmp_path / "both", f"subjects=[{run},{run}@physx]")
    assert len(content["results"]["corners"]) == 2


def test_a_bundle_that_was_changed_is_refused_before_anything_is_played(bundle: Path, tmp_path: Path) -> None:
    content = bytearray(bundle.read_bytes())
    content[len(content) // 2] ^= 1
    changed = tmp_path / "changed.zip"
    changed.write_bytes(bytes(content))
    with pytest.raises(BundleError, match=r"changed\.zip"):
        evaluated(tmp_path / "out", f"bundle={changed}")
    assert not (tmp_path / "out").exists()


def test_seed_and_rates_act_on_every_protocol(run: Path, tmp_path: Path) -> None:
    plain, about = evaluated(tmp_path / "a", f"run={run}")
    assert evaluated(tmp_path / "b", f"run={run}")[0] == plain
    for k, change in enumerate(("seed=7", "policy_dt=0.01", "physics_dt=0.001", "effect=coulomb")):
        rows, changed = evaluated(tmp_path / f"{k}", f"run={run}", change)
        assert [r["rmse_x"] for r in rows] != [r["rmse_x"] for r in plain]
        assert changed != about


def test_results_lie_in_the_run_folder_unless_the_user_says(run: Path) -> None:
    evaluate.APP.task(begin("eval", compose("eval", [*QUICK, f"run={run}"])))
    assert (run / "protocols" / "corners.html").is_file()


def test_results_that_will_be_replaced_are_named(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluated(tmp_path, f"run={run}")
    assert "note:" not in capsys.readouterr().out
    evaluated(tmp_path, f"run={run}")
    assert f"note: {tmp_path} holds corners.json of an earlier call" in capsys.readouterr().out


def test_the_help_says_what_the_keys_of_a_protocol_are(capsys: pytest.CaptureFixture[str]) -> None:
    show("eval", ["protocol", "protocol=kicks"])
    shown = capsys.readouterr().out
    assert re.search(r"protocol\.kicks\.robots=200 +number of robots in each condition", shown)
    assert re.search(r"protocol\.kicks\.recovery\.height=0\.015\s+largest difference", shown)


# ---------------------------------------------------------------------- comparisons


def test_a_comparison_pairs_robots_and_says_where_it_comes_from(run: Path, bundle: Path, tmp_path: Path) -> None:
    content = compared(tmp_path / "c", f"subjects=[{run},{run}@100hz,{run}@estimated,{bundle}]")
    subjects_of = {d["subject"] for d in content["differences"]["corners"]}
    assert subjects_of == {f"{run}@100hz", f"{run}@estimated", str(bundle)}
    assert content["robot_of"] == str(run)
    rows = pq.read_table(tmp_path / "c" / "corners.parquet").to_pylist()
    by_subject = {s: [r["rmse_x"] for r in rows if r["subject"] == s] for s in {r["subject"] for r in rows}}
    assert len({tuple(v) for v in by_subject.values()}) == 4
    assert {len(v) for v in by_subject.values()} == {2}


def test_same_robot_seed_and_physics_step_act(run: Path, tmp_path: Path) -> None:
    pair = f"subjects=[clock,{run}]"
    rows = {}
    changes = {"plain": "seed=1", "own": "same_robot=false", "seed": "seed=5", "dt": "physics_dt=0.001"}
    for name, change in changes.items():
        compared(tmp_path / name, pair, change)
        every = pq.read_table(tmp_path / name / "corners.parquet").to_pylist()
        rows[name] = {s: [r["rmse_x"] for r in every if r["subject"] == s] for s in ("clock", str(run))}
    assert rows["plain"]["clock"] == rows["own"]["clock"]
    assert rows["plain"][str(run)] != rows["own"][str(run)]
    for name in ("seed", "dt"):
        assert rows[name]["clock"] != rows["plain"]["clock"]


def test_words_name_subjects(run: Path, bundle: Path) -> None:
    named, variation = subjects.varied(f"{run}@100hz@estimated", "x")
    assert (named.run, variation.policy_dt, variation.trunk_velocity) == (run, 0.01, "estimated")
    assert subjects.word(str(bundle), "x").bundle == bundle
    assert np.isclose(subjects.varied("clock@33.3hz", "x")[1].policy_dt or 0.0, 1 / 33.3)
    with pytest.raises(ConfigError, match="after @ comes"):
        subjects.varied("clock@fast", "x")
