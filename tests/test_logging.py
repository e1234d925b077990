"""Where metrics go: a CSV that a resumed run continues byte for byte, TensorBoard, Weights & Biases."""

from __future__ import annotations

import csv
import importlib
import json
import struct
import sys
import time
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common import logger as sb3_logger

from go1exp.config.compose import compose
from go1exp.config.schema.registry import Expected
from go1exp.sim.task import LoggerConfig, WandbConfig, parse_train
from go1exp.train import metrics
from go1exp.train.metrics import CsvWriter, make_logger
from tests import small_run
from tests.small_run import small

ROUGH_NUMBERS = (1 / 3, -1e-17, 12345678.9, 0.1 + 0.2, float("nan"), 6.02e23)


def row(iteration: int) -> dict[str, Any]:
    """An iteration's metrics, as SB3's logger hands them over, wall-clock figures among them."""
    return {
        "train/loss": ROUGH_NUMBERS[iteration % len(ROUGH_NUMBERS)] * iteration,
        "time/steps_per_s": 1000.0 + iteration,
        "iteration": iteration,
        'odd "name", quoted': iteration,
    }


def write(run: Path, first: int, last: int) -> None:
    """Open as a run does that goes on after ``first - 1``, and write the rows up to ``last``."""
    run.mkdir(exist_ok=True)
    writer = CsvWriter(run, first - 1)
    for iteration in range(first, last + 1):
        writer.write(row(iteration), {}, step=64 * iteration)
    writer.close()


def records(file: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(file.read_text().splitlines()))


# ---------------------------------------------------------------------- CSV


def test_wall_clock_figures_stand_in_a_file_of_their_own(tmp_path: Path) -> None:
    write(tmp_path, 1, 2)
    assert records(tmp_path / "timing.csv") == [
        {"iteration": "1", "steps": "64", "time/steps_per_s": "1001.0"},
        {"iteration": "2", "steps": "128", "time/steps_per_s": "1002.0"},
    ]
    assert list(records(tmp_path / "metrics.csv")[0]) == ["iteration", "steps", "train/loss", 'odd "name", quoted']


def test_numbers_are_written_so_that_they_read_back_as_they_were(tmp_path: Path) -> None:
    write(tmp_path, 1, 5)
    read = [float(r["train/loss"]) for r in records(tmp_path / "metrics.csv")]
    assert [repr(x) for x in read] == [repr(float(row(k)["train/loss"])) for k in range(1, 6)]


def test_writing_leaves_the_metrics_to_the_next_writer(tmp_path: Path) -> None:
    given = row(1)
    CsvWriter(tmp_path, 0).write(given, {}, step=64)
    assert given == row(1)


def test_rows_that_a_resumed_run_should_have_are_missed(tmp_path: Path) -> None:
    write(tmp_path, 1, 4)
    (tmp_path / "metrics.csv").write_text("".join((tmp_path / "metrics.csv").read_text().splitlines(True)[:3]))
    with pytest.warns(UserWarning, match=r"metrics\.csv: rows of 2 of 4 iterations are missing"):
        write(tmp_path, 5, 6)
    (tmp_path / "metrics.csv").unlink()
    with pytest.warns(UserWarning, match=r"metrics\.csv: rows of 6 of 6 iterations are missing"):
        write(tmp_path, 7, 7)


@pytest.mark.parametrize("damage", [b"\xff\xfe\x00", b"itera`ion,steps\n1,64\n2,128\n", b'"' + b"1" * 200_000, b""])
def test_a_damaged_metrics_file_begins_anew_with_a_warning(damage: bytes, tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_bytes(damage)
    (tmp_path / "timing.csv").write_text("iteration,steps\n1,64\n2,128\n")
    with pytest.warns(UserWarning, match=r"metrics\.csv: rows of 2 of 2 iterations are missing"):
        writer = CsvWriter(tmp_path, 2)
    writer.write({"iteration": 3, "train/kl": 0.1}, {}, step=192)
    assert (tmp_path / "metrics.csv").read_text().splitlines() == ["iteration,steps,train/kl", "3,192,0.1"]


@pytest.mark.parametrize("resumed_after", [0, 1, 3, 5])
def test_a_continued_file_is_byte_for_byte_that_of_one_run(resumed_after: int, tmp_path: Path) -> None:
    write(tmp_path / "whole", 1, 7)
    write(tmp_path / "parts", 1, 5)
    write(tmp_path / "parts", resumed_after + 1, 7)
    for name in ("metrics.csv", "timing.csv"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert {p.name for p in (tmp_path / "parts").iterdir()} == {"metrics.csv", "timing.csv"}


@pytest.mark.parametrize("bytes_left", [1, 2, 10])
def test_a_row_that_was_cut_off_is_forgotten(bytes_left: int, tmp_path: Path) -> None:
    """Even where what is left of iteration 12 reads as iteration 1."""
    write(tmp_path / "whole", 1, 13)
    write(tmp_path / "cut", 1, 12)
    file = tmp_path / "cut/metrics.csv"
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"".join(lines[:-1]) + lines[-1][:bytes_left])
    write(tmp_path / "cut", 12, 13)
    assert file.read_bytes() == (tmp_path / "whole/metrics.csv").read_bytes()


def test_a_file_in_which_nothing_was_written_yet_is_begun_anew(tmp_path: Path) -> None:
    """Killed between opening and writing."""
    write(tmp_path / "whole", 1, 2)
    (tmp_path / "run").mkdir()
    (tmp_path / "run/metrics.csv").write_bytes(b"")
    write(tmp_path / "run", 1, 2)
    assert (tmp_path / "run/metrics.csv").read_bytes() == (tmp_path / "whole/metrics.csv").read_bytes()


def train(run: Path, *overrides: str) -> None:
    small_run.train(run, small("ppo=paper", "logger.tensorboard=true", *overrides, steps=8, iterations=4))


def test_returns_are_in_the_table_even_if_no_episode_ended_in_the_first_iteration(tmp_path: Path) -> None:
    """Columns are those of the first row; episodes here end after 20 steps, in the third iteration."""
    once = ("sim.spread_starts=false", "sim.episode_s=0.4", "termination=none", "logger.tensorboard=false")
    train(tmp_path / "run", *once)
    rows = records(tmp_path / "run/metrics.csv")
    assert "rollout/return" in rows[0]
    assert rows[-1]["rollout/return"] not in ("", "nan")
    assert float(rows[-1]["rollout/length"]) == 20


def test_the_table_agrees_with_what_the_learner_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict[str, Any]] = []
    write = CsvWriter.write

    def recorded(self: CsvWriter, values: dict[str, Any], excluded: Any, step: int = 0) -> None:
        given.append({**values, "steps": step})
        write(self, values, excluded, step)

    monkeypatch.setattr(CsvWriter, "write", recorded)
    train(tmp_path / "run", "logger.tensorboard=false")
    rows = records(tmp_path / "run/metrics.csv")
    assert [r["iteration"] for r in rows] == ["1", "2", "3", "4"]
    assert [r["steps"] for r in rows] == ["32", "64", "96", "128"]
    for r, values in zip(rows, given, strict=True):
        assert {"train/kl", "train/learning_rate", "train/value_loss", "reward/gait"} <= set(r)
        assert r == {k: str(values[k]) for k in r}
    assert all(k.startswith("time/") for k in set(given[0]) - set(rows[0]))


# ---------------------------------------------------------------------- TensorBoard


def events_of(run: Path) -> Any:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run / "tensorboard"))
    return events.Reload()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_tensorboard_reads_back_what_was_logged_but_beyond_the_checkpoint_that_a_run_went_on_from(
    tmp_path: Path,
) -> None:
    config = LoggerConfig(csv=False, tensorboard=True, wandb=None)
    for first, last, value in ((1, 3, 0.25), (3, 4, 0.5)):
        logger = make_logger(config, tmp_path, first - 1, {}, steps=64 * (first - 1))
        for iteration in range(first, last + 1):
            logger.record("train/kl", value)
            logger.record("reward/gait", -1.5)
            logger.dump(step=64 * iteration)
        logger.close()
    events = events_of(tmp_path)
    assert set(events.Tags()["scalars"]) == {"train/kl", "reward/gait"}
    assert [e.value for e in events.Scalars("reward/gait")] == [-1.5] * 4
    assert not (tmp_path / "metrics.csv").exists()
    assert [(e.step, e.value) for e in events.Scalars("train/kl")] == [(64, 0.25), (128, 0.25), (192, 0.5), (256, 0.5)]


def test_without_tensorboard_the_other_writers_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sb3_logger, "SummaryWriter", None)
    logger = make_logger(LoggerConfig(csv=True, tensorboard=True, wandb=None), tmp_path, 0, {})
    logger.record("iteration", 1)
    logger.record("train/kl", 0.5)
    logger.dump(step=64)
    logger.close()
    assert "tensorboard" in capsys.readouterr().out
    assert records(tmp_path / "metrics.csv") == [{"iteration": "1", "steps": "64", "train/kl": "0.5"}]


# ---------------------------------------------------------------------- Weights & Biases


def wandb_records(file: Path) -> Iterator[Any]:
    """Read a .wandb file: a header, then LevelDB's log of 32 KiB blocks that holds protobuf records."""
    records = importlib.import_module("wandb.proto.wandb_internal_pb2")
    data = file.read_bytes()
    assert data[:7] == b":W&B" + struct.pack("<HB", 0xBEE1, 0)
    position, parts = 7, b""
    while position + 7 <= len(data):
        left = 32768 - position % 32768
        if left < 7:
            position += left
            continue
        checksum, length, kind = struct.unpack("<IHB", data[position : position + 7])
        payload = data[position + 7 : position + 7 + length]
        position += 7 + length
        if len(payload) < length:
            return  # still being written
        if (checksum, length, kind) == (0, 0, 0):
            continue
        assert zlib.crc32(bytes([kind]) + payload) == checksum
        parts += payload
        if kind in (1, 4):  # a whole record, or the last piece of one
            record = records.Record()
            record.ParseFromString(parts)
            yield record
            parts = b""


def history(file: Path) -> list[dict[str, Any]]:
    """Return what was logged; wandb's own process may still be writing when ``finish`` comes back."""
    for _ in range(100):
        if any(record.WhichOneof("record_type") == "exit" for record in wandb_records(file)):
            break
        time.sleep(0.1)
    found = []
    for record in wandb_records(file):
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            found.append({"/".join(i.nested_key) or i.key: json.loads(i.value_json) for i in items})
    return found


OFFLINE = WandbConfig(project="go1exp-tests", mode="offline", group="tests", entity=None)


@pytest.fixture
def no_account(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of the machine's own Weights & Biases settings is read or written."""
    for name in ("WANDB_CONFIG_DIR", "WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "wandb_home"))
    for name in ("MODE", "DIR", "PROJECT", "RUN_ID", "DISABLED", "NAME", "RUN_GROUP", "TAGS", "NOTES", "ENTITY"):
        monkeypatch.delenv(f"WANDB_{name}", raising=False)


def log_to_wandb(run: Path, iterations: range) -> str:
    """Log as a run does that goes on after the first of ``iterations``; return the run's id."""
    logger = make_logger(LoggerConfig(csv=False, tensorboard=False, wandb=OFFLINE), run, iterations[0], {"seed": 7})
    for iteration in iterations:
        logger.record("iteration", iteration)
        logger.record("train/kl", 0.25 * iteration)
        logger.dump(step=64 * iteration)
    logger.close()
    return (run / "wandb_id").read_text()


def test_an_offline_wandb_run_holds_the_metrics_and_is_continued_under_its_id(
    tmp_path: Path, no_account: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    identity = log_to_wandb(run, range(1, 4))
    (file,) = run.rglob("*.wandb")
    assert identity in file.name
    assert f"send it with: wandb sync {file.parent}\n" in capsys.readouterr().out
    found = history(file)
    assert [h["train/kl"] for h in found] == [0.25, 0.5, 0.75]
    assert [h["_step"] for h in found] == [64, 128, 192]
    assert [h["iteration"] for h in found] == [1, 2, 3]
    (about,) = [r.run for r in wandb_records(file) if r.WhichOneof("record_type") == "run"][:1]
    assert (about.run_id, about.project, about.run_group) == (identity, "go1exp-tests", "tests")
    settings = {u.key: json.loads(u.value_json) for u in about.config.update}
    assert settings["seed"] == 7

    time.sleep(1.0)  # wandb names folders by the second
    assert log_to_wandb(run, range(4, 6)) == identity
    (second,) = [f for f in run.rglob("*.wandb") if f != file]
    assert identity in second.name
    assert [h["_step"] for h in history(second)] == [256, 320]
    (again,) = [r.run for r in wandb_records(second) if r.WhichOneof("record_type") == "run"][:1]
    assert again.run_id == identity


def of_kind(file: Path, kind: str) -> list[Any]:
    return [getattr(r, kind) for r in wandb_records(file) if r.WhichOneof("record_type") == kind]


def test_an_offline_run_holds_name_group_tags_notes_config_videos_evaluations_and_artifacts(
    tmp_path: Path, no_account: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What ``wandb sync`` sends later."""
    run = tmp_path / "sweep" / "gait-0_seed-1"
    (run / "checkpoints").mkdir(parents=True)
    (run.parent / "sweep.json").write_text("{}")
    for name in ("checkpoints/000002.pt", "best.pt", "best.json", "config.yaml", "bundle.zip", "video.mp4"):
        (run / name).write_bytes(name.encode())
    (run / "evals.csv").write_text("iteration,steps,score\n1,64,0.5\n2,128,0.25\n")
    monkeypatch.setattr(metrics, "_bundle", lambda folder: folder / "bundle.zip")
    config = replace(OFFLINE, group=None, tags=("trot", "ablation"), notes="why", artifacts=True)
    settings = {"seed": 7, "reward": {"gait": {"weight": 10.0}}}
    logger = make_logger(LoggerConfig(csv=False, tensorboard=False, wandb=config), run, 0, settings)
    logger.record("iteration", 1)
    logger.dump(step=64)
    metrics.log_video(logger, 64, run / "video.mp4")
    logger.record("eval/score", 0.25)
    metrics.dump_late(logger, 128)
    logger.close()
    (file,) = run.rglob("*.wandb")
    rows = history(file)
    about = of_kind(file, "run")[0]
    assert (about.display_name, about.run_group, about.notes) == ("gait-0_seed-1", "sweep", "why")
    assert set(about.tags) == {"trot", "ablation"}
    logged = {u.key: json.loads(u.value_json) for u in about.config.update}
    assert (logged["seed"], logged["reward"]) == (7, {"gait": {"weight": 10.0}})
    columns = {key for row in rows for key in row}
    assert "eval/score" in columns
    videos = [row for row in rows if any(key.startswith("video") and "steps" not in key for key in row)]
    assert videos
    assert any(key.startswith("evaluations") for key in columns)
    kept = {item.path for record in of_kind(file, "files") for item in record.files}
    assert any(path.startswith("media/videos/video") for path in kept)
    assert any(path.startswith("media/table/evaluations") for path in kept)
    artifacts = {a.type: [e.path for e in a.manifest.contents] for a in of_kind_of_requests(file)}
    assert set(artifacts) >= {"model", "bundle"}
    assert set(artifacts["model"]) == {"000002.pt", "best.pt", "best.json", "config.yaml"}
    assert artifacts["bundle"] == ["bundle.zip"]


def of_kind_of_requests(file: Path) -> list[Any]:
    """Artifacts, which stand in records of their own or in requests."""
    direct = of_kind(file, "artifact")
    requests = [r for r in of_kind(file, "request") if r.WhichOneof("request_type") == "log_artifact"]
    return [*direct, *(r.log_artifact.artifact for r in requests)]


def test_variables_of_the_environment_go_before_the_settings(
    tmp_path: Path, no_account: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = {"PROJECT": "theirs", "RUN_GROUP": "g", "NAME": "n", "TAGS": "a,b", "NOTES": "why", "RUN_ID": "abcd1234"}
    for name, value in chosen.items():
        monkeypatch.setenv(f"WANDB_{name}", value)
    monkeypatch.setenv("WANDB_DIR", str(tmp_path / "elsewhere"))
    (tmp_path / "elsewhere").mkdir()
    assert log_to_wandb(tmp_path, range(1, 2)) == "abcd1234"
    (file,) = (tmp_path / "elsewhere").rglob("*.wandb")
    history(file)  # wait for the end
    about = of_kind(file, "run")[0]
    assert (about.run_id, about.project, about.run_group) == ("abcd1234", "theirs", "g")
    assert (about.display_name, about.notes, set(about.tags)) == ("n", "why", {"a", "b"})
    monkeypatch.setenv("WANDB_MODE", "online")
    assert metrics.wandb_mode(OFFLINE) == "online"


def test_the_tables_of_a_report_are_logged(tmp_path: Path, no_account: None) -> None:
    (tmp_path / "report.html").write_text("<p>report</p>")
    tables = {
        "grid_comparison": [{"group": "a", "p": 0.5, "runs_needed": ""}, {"group": "b", "p": 0.1, "runs_needed": 7}]
    }
    metrics.log_tables(tables, tmp_path / "report.html", "go1exp-tests", "offline", tmp_path)
    (file,) = tmp_path.rglob("*.wandb")
    history(file)  # wait for the end
    assert of_kind(file, "run")[0].job_type == "report"
    (table,) = tmp_path.rglob("grid_comparison*.table.json")
    content = json.loads(table.read_text())
    assert content["columns"] == ["group", "p", "runs_needed"]
    assert content["data"] == [["a", 0.5, None], ["b", 0.1, 7.0]]


def test_without_a_bundle_there_is_a_line_that_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert metrics._bundle(tmp_path / "none") is None
    assert "no bundle for Weights & Biases: go1exp export: run" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_tensorboard_has_the_configuration_as_hyperparameters(tmp_path: Path) -> None:
    from tensorboard.plugins.hparams import plugin_data_pb2

    settings = {"seed": 7, "reward": {"gait": {"weight": 10.0}}, "resume": None, "devices": [1, 2]}
    config = LoggerConfig(csv=False, tensorboard=True, wandb=None)
    make_logger(config, tmp_path, 0, settings).close()
    make_logger(config, tmp_path, 1, settings, steps=64).close()
    events = events_of(tmp_path)
    content = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    found = plugin_data_pb2.HParamsPluginData.FromString(content).session_start_info.hparams
    assert found["reward.gait.weight"].number_value == 10.0
    assert found["seed"].number_value == 7
    assert found["devices"].string_value == "[1, 2]"
    assert "resume" not in found


def test_without_wandb_the_message_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(Expected, match=r"pip install wandb.*logger=local"):
        make_logger(LoggerConfig(csv=True, tensorboard=False, wandb=OFFLINE), tmp_path, 0, {})


def test_the_choice_logger_wandb_stays_offline() -> None:
    config = parse_train(compose("train", ["logger=wandb"])).logger
    assert config.wandb is not None
    assert config.wandb.mode == "offline"
    assert config.csv
    assert parse_train(compose("train")).logger.wandb is None


def test_without_writers_a_run_is_silent(tmp_path: Path) -> None:
    logger = make_logger(LoggerConfig(csv=False, tensorboard=False, wandb=None), tmp_path, 0, {})
    logger.record("iteration", 1)
    logger.dump(step=1)
    logger.close()
    assert list(tmp_path.iterdir()) == []
    assert metrics.CLOCK == "time/"
