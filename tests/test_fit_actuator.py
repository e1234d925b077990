"""The actuator net: its rows, its training, its file, its report; on a made-up drive, and on a measured one."""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from go1exp.gap.actuator_net.dataset import fingerprint, smooth_motion, split, windows
from go1exp.gap.actuator_net.fitting import FitResult, fit, plot
from go1exp.gap.actuator_net.report import text
from go1exp.gap.actuator_net.settings import FitError, FitSettings
from go1exp.logs.recording import Meta, Recording, RecordingError, problems
from go1exp.sim.actuator.actuator_net import ActuatorNet, InputName, NetFileError, load
from tests import made

JOINTS = ("FR_hip", "FR_calf")
KP, KD = 20.0, 0.5
LAG, LIMIT = 0.015, 8.0
"""s; N m. The made-up drive answers with a first-order lag and saturates softly."""


def meta(episode: str, **changes: Any) -> Meta:
    usual: dict[str, Any] = {"rate_hz": 200.0, "kp": (KP,) * 2, "kd": (KD,) * 2}
    return made.meta(changes.pop("joints", JOINTS), episode=episode, **(usual | changes))


def drive(episode: str, seed: int, seconds: float = 4.0, **changes: Any) -> Recording:
    """Joints that sway on three sines each, and the torque of a lagging, saturating drive; 200 Hz with jitter."""
    rng = np.random.default_rng(seed)
    fine = np.arange(0, seconds, 0.0005)
    channels: dict[str, np.ndarray] = {}
    at = np.arange(0, len(fine), 10)
    at = np.clip(at + rng.integers(-2, 3, len(at)), 0, len(fine) - 1)
    channels["t"] = fine[at]
    for joint in JOINTS:
        target, q, qd = np.zeros((3, len(fine)))
        for _ in range(3):
            size, frequency, phase = rng.uniform(0.1, 0.5), rng.uniform(0.5, 4.0), rng.uniform(0, 6.28)
            w = 2 * np.pi * frequency
            target += 2 * size * np.sin(w * fine + phase)
            q += size * np.sin(w * fine + phase - 0.4)
            qd += size * w * np.cos(w * fine + phase - 0.4)
        target = target[(np.arange(len(fine)) // 40) * 40]  # a policy's targets: new ones every 20 ms
        ideal = LIMIT * np.tanh((KP * (target - q) - KD * qd) / LIMIT)
        tau = np.zeros(len(fine))
        for i in range(1, len(fine)):
            tau[i] = tau[i - 1] + 0.0005 / LAG * (ideal[i] - tau[i - 1])
        for name, values in (("q_target", target), ("q", q), ("qd", qd), ("tau_est", tau)):
            channels[f"{name}_{joint}"] = values[at]
    recording = Recording(meta(episode, **changes), channels)
    assert problems(recording) == []
    return recording


def without(recording: Recording, quantity: str) -> Recording:
    kept = {n: v for n, v in recording.channels.items() if n not in [f"{quantity}_{joint}" for joint in JOINTS]}
    return Recording(recording.meta, kept)


QUICK = FitSettings(
    history=6, period=0.005, hidden=(16, 16), epochs=25, patience=25, holdout=("e5", "e6"), validation=("e4",)
)


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return [drive(f"e{i}", i) for i in range(7)]


@pytest.fixture(scope="module")
def result(recordings: list[Recording]) -> FitResult:
    return fit(recordings, QUICK)


@pytest.fixture(scope="module")
def by_kind(recordings: list[Recording]) -> FitResult:
    return fit(recordings, replace(QUICK, share="kind", epochs=2, half_net=False))


# ---------------------------------------------------------------------- rows


def test_rows_equal_a_slow_search_on_an_irregular_clock(recordings: list[Recording]) -> None:
    recording = recordings[0]
    rows = windows([recording], ("position_error", "velocity"), 4, 0.007)
    t, target, q, qd = (recording.channels[n] for n in ("t", "q_target_FR_calf", "q_FR_calf", "qd_FR_calf"))

    def linear(values: np.ndarray, when: float) -> float:
        k = max(i for i in range(len(t)) if t[i] <= when + 1e-12)
        if k == len(t) - 1:
            return float(values[k])
        return float(values[k] + (values[k + 1] - values[k]) * (when - t[k]) / (t[k + 1] - t[k]))

    calf = rows.take(rows.joint == 1)
    assert np.all(calf.t >= t[0] + 3 * 0.007 - 1e-6)
    assert len(calf) == int((t >= t[0] + 3 * 0.007 - 1e-6).sum())
    for row in range(0, len(calf), 97):
        when = [calf.t[row] - 0.007 * i for i in range(4)]
        held = [float(target[max(i for i in range(len(t)) if t[i] <= w + 1e-6)]) for w in when]
        expected = [h - linear(q, w) for h, w in zip(held, when, strict=True)] + [linear(qd, w) for w in when]
        np.testing.assert_allclose(calf.x[row], expected, rtol=0, atol=1e-9)
        assert calf.y[row] == recording.channels["tau_est_FR_calf"][np.flatnonzero(t == calf.t[row])[0]]


def test_a_window_never_looks_ahead(recordings: list[Recording]) -> None:
    before = windows(recordings[:1], ("position_error", "velocity"), 3, 0.005)
    t = recordings[0].t
    moment = t[len(t) // 2]
    changed = {n: np.where(t > moment, v + 1.0, v) if n != "t" else v for n, v in recordings[0].channels.items()}
    after = windows([Recording(recordings[0].meta, changed)], ("position_error", "velocity"), 3, 0.005)
    past = before.t <= moment
    assert np.array_equal(before.x[past], after.x[past])
    assert not np.array_equal(before.x[~past], after.x[~past])


def test_rows_over_gaps_and_with_drives_off_are_left_out(recordings: list[Recording]) -> None:
    base = recordings[1]
    on = np.ones(len(base.t), bool)
    on[300:305] = False
    t = base.t.copy()
    t[500:] += 0.2
    changed = Recording(base.meta, {**base.channels, "t": t, "torque_enable": on})
    rows = windows([changed], ("velocity",), 3, 0.005)
    stamps = rows.t[rows.joint == 0]
    for stamp in stamps:
        inside = (t >= stamp - 0.01 - 1e-6) & (t <= stamp)
        assert on[inside].all()
        assert not (stamp - 0.01 < t[499] + 0.19 and stamp > t[499])
    assert {t[298], t[310], t[499], t[504]} <= set(stamps)


def test_a_missing_channel_is_named(recordings: list[Recording]) -> None:
    needed: dict[str, InputName] = {"qd": "velocity", "q_target": "position_error", "tau_est": "position"}
    for quantity, name in needed.items():
        broken = [without(recordings[0], quantity), *recordings[1:]]
        with pytest.raises(RecordingError, match=rf"e0: no channel '{quantity}_FR_hip'"):
            fit(broken, replace(QUICK, inputs=(name,)))
    with pytest.raises(RecordingError, match="no channel 'tau_cmd_FR_hip'"):
        fit(recordings, replace(QUICK, inputs=("tau_cmd", "velocity")))


def test_joint_torque_replaces_the_reported_one(recordings: list[Recording]) -> None:
    def dynamics(recording: Recording) -> np.ndarray:
        known = np.tile(recording.t[:, None], (1, 2))
        known[:50] = np.nan
        return known

    bare = [without(r, "tau_est") for r in recordings]
    rows = windows(bare, ("velocity",), 2, 0.005, "joint_torque", dynamics)
    np.testing.assert_array_equal(rows.y, rows.t)
    assert (rows.t >= min(r.t[50] for r in recordings)).all()
    with pytest.raises(FitError, match="inverse dynamics"):
        fit(bare, replace(QUICK, target="joint_torque"))


# ---------------------------------------------------------------------- episodes


def test_episodes_are_split_whole_and_repeats_stay_together() -> None:
    made = [drive(f"e{i}", i, 0.2) for i in range(8)]
    made += [drive(name, 9, 0.2, repeat_of=other) for name, other in (("r0", "e0"), ("r1", "r0"), ("x", "y"))]
    drawn = set()
    for seed in range(8):
        parts = split(made, 0.25, 0.25, seed)
        everything = [*parts.train, *parts.validation, *parts.held_out]
        assert sorted(everything) == sorted(r.meta.episode for r in made)
        assert sum({"e0", "r0", "r1"} <= set(p) for p in (parts.train, parts.validation, parts.held_out)) == 1
        assert parts == split(made, 0.25, 0.25, seed)
        drawn.add(parts.held_out)
    assert len(drawn) > 3
    assert split(made, ("r0",), 0.2, 0).held_out == ("e0", "r0", "r1")
    assert split(made, ("e1",), ("e2", "e3"), 0).validation == ("e2", "e3")


def test_a_split_that_cannot_be_is_refused() -> None:
    made = [drive("a", 0, 0.2), drive("b", 1, 0.2, repeat_of="a"), drive("c", 2, 0.2)]
    with pytest.raises(FitError, match="3 episodes in 2 groups of repeats"):
        split(made, 0.2, 0.2, 0)
    with pytest.raises(FitError, match="holdout: unknown episode 'd'"):
        split(made, ("d",), 0.2, 0)
    with pytest.raises(FitError, match="repeats an episode"):
        split(made, ("a",), ("b",), 0)
    with pytest.raises(FitError, match="a occurs more than once"):
        split([made[0], made[0]], 0.2, 0.2, 0)


def test_recordings_that_do_not_fit_together_are_refused(recordings: list[Recording]) -> None:
    first, *rest = recordings

    def odd(**changes: Any) -> list[Recording]:
        return [Recording(replace(first.meta, **changes), first.channels), *rest]

    with pytest.raises(FitError, match="robot is go1, but go2"):
        fit(odd(robot="go2"), QUICK)
    with pytest.raises(FitError, match=r"kp differs between the recordings.*gains=\[20,0.5\]"):
        fit(odd(kp=(20.0, 30.0)), QUICK)
    with pytest.raises(FitError, match="period: set it; e1 was recorded at 200 Hz, but e0 at 300 Hz"):
        fit(odd(rate_hz=300.0), replace(QUICK, period=None))
    with pytest.raises(FitError, match="taps closer than that"):
        fit(recordings, replace(QUICK, period=0.002))
    with pytest.raises(FitError, match="no recordings"):
        fit([], QUICK)
    with pytest.raises(FitError, match="shorter than the history"):
        fit(recordings, replace(QUICK, history=5000))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"inputs": ()}, "at least 1 item"),
        ({"inputs": ("torque",)}, "position_error"),
        ({"inputs": ("velocity", "velocity")}, "each only once"),
        ({"history": 0}, "greater than or equal to 1"),
        ({"history": 3.5}, "valid integer"),
        ({"period": -0.1}, "greater than 0"),
        ({"share": "leg"}, "'all', 'kind' or 'none'"),
        ({"target": "tau"}, "'tau_est' or 'joint_torque'"),
        ({"holdout": 1.5}, "less than 1"),
        ({"holdout": ()}, "name at least one"),
        ({"holdout": 0.6, "validation": 0.5}, "nothing to train on"),
        ({"holdout": ("a", "b"), "validation": ("b",)}, "b cannot be held out too"),
        ({"batches": 3}, "batches"),
    ],
)
def test_wrong_settings_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        FitSettings(**wrong)


# ---------------------------------------------------------------------- training


def test_a_torque_that_is_the_command_is_refused_by_name(recordings: list[Recording]) -> None:
    """A net would reproduce the command to the last digit and say nothing of the actuator."""
    *others, last = recordings
    commanded = {f"tau_cmd_{joint}": last.channels[f"tau_est_{joint}"].copy() for joint in JOINTS}
    with pytest.raises(FitError, match=rf"{last.meta.episode}: tau_est_\w+ equals tau_cmd_\w+ in 100.0%"):
        fit([*others, Recording(last.meta, last.channels | commanded)], QUICK)
    measured = {f"q_target_{joint}": last.channels[f"q_{joint}"].copy() for joint in JOINTS}
    with pytest.raises(FitError, match=r"q_target_\w+ equals q_\w+ in 100.0%.*in the place of the target"):
        fit([*others, Recording(last.meta, last.channels | measured)], QUICK)


def test_the_net_beats_every_reference_on_a_drive_that_lags_and_saturates(result: FitResult) -> None:
    cell = result.report.cell()
    assert set(cell.rmse) == {"net", "command", "pd", "linear", "half_net"}
    assert cell.rmse["net"] < 0.6 * cell.rmse["linear"]
    assert cell.rmse["net"] < 0.3 * cell.rmse["pd"]
    assert cell.rmse["net"] < 0.2 * cell.rms
    error, still = np.full(6, 0.2), np.zeros(6)
    ahead, behind = result.net.torque(np.stack([np.concatenate([error, still]), np.concatenate([-error, still])]))
    assert behind < -1.0 < 1.0 < ahead


def test_one_seed_gives_one_net_and_leaves_torchs_threads_and_random_state_alone(
    recordings: list[Recording], result: FitResult
) -> None:
    before, threads = torch.random.get_rng_state(), torch.get_num_threads()
    again = fit(recordings, QUICK)
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.get_num_threads() == threads
    for name, values in result.net.arrays().items():
        assert np.array_equal(values, again.net.arrays()[name]), name
    assert again.net.info == result.net.info
    other = fit(recordings, replace(QUICK, seed=1, epochs=1, half_net=False))
    assert not np.array_equal(other.net.weights[0], result.net.weights[0])


def test_training_stops_when_validation_does_not_get_better(recordings: list[Recording]) -> None:
    rng = np.random.default_rng(0)
    noise = [
        Recording(r.meta, {n: rng.normal(size=v.shape) if n[:3] == "tau" else v for n, v in r.channels.items()})
        for r in recordings
    ]
    got = fit(noise, replace(QUICK, epochs=40, patience=3, hidden=(64, 64), half_net=False))
    validation = got.curves["all"][:, 1]
    best = int(np.argmin(validation))
    assert len(validation) == best + 1 + 3 < 40
    rows = windows(noise, QUICK.inputs, QUICK.history, 0.005)
    four = rows.take(rows.episode == 4)
    assert np.sqrt(np.mean((got.net.torque(four.x) - four.y) ** 2)) == pytest.approx(validation[best], rel=1e-4)


def test_progress_is_told(recordings: list[Recording]) -> None:
    progress: list[tuple[str, int, int, float, float]] = []
    fit(recordings, replace(QUICK, epochs=2, share="kind"), lambda *what: progress.append(what))
    expected = [(f"{size} {kind}", n, 2) for size in ("net", "half net") for kind in ("hip", "calf") for n in (1, 2)]
    assert [what[:3] for what in progress] == expected
    assert all(np.isfinite(what[3:]).all() for what in progress)


def test_the_papers_form_has_no_linear_part(recordings: list[Recording]) -> None:
    got = fit(recordings, replace(QUICK, skip=False, half_net=False, epochs=40, patience=40))
    assert not got.net.skip.any()
    assert got.report.cell().rmse["net"] < got.report.cell().rmse["linear"]


# ---------------------------------------------------------------------- the report


def test_the_reports_numbers_are_those_of_net_and_recordings(recordings: list[Recording], result: FitResult) -> None:
    truth, predicted, ideal = [], [], []
    for recording in recordings[5:]:
        calf = {n: recording.channels[f"{n}_FR_calf"] for n in ("q", "qd", "q_target", "tau_est")}
        rows = windows([recording], QUICK.inputs, 6, 0.005)
        rows = rows.take(rows.joint == 1)
        keep = np.isin(recording.t, rows.t)
        truth.append(calf["tau_est"][keep])
        ideal.append((KP * (calf["q_target"] - calf["q"]) - KD * calf["qd"])[keep])
        predicted.append(result.net.torque(rows.x))
    error = np.concatenate(predicted) - np.concatenate(truth)
    cell = result.report.cell("FR_calf")
    assert cell.rows == len(error)
    assert cell.rmse["net"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
    assert cell.rmse["pd"] == pytest.approx(np.sqrt(np.mean((np.concatenate(ideal) - np.concatenate(truth)) ** 2)))
    assert result.net.info.provenance.held_out_rmse == result.report.cell().rmse["net"]


def test_still_slow_and_fast_rows_are_all_rows(result: FitResult) -> None:
    for joint in (*JOINTS, "all"):
        total = result.report.cell(joint)
        parts = [result.report.cell(joint, regime) for regime in ("still", "slow", "fast")]
        assert sum(p.rows for p in parts) == total.rows
        pooled = sum(p.rows * p.rmse["net"] ** 2 for p in parts) / total.rows
        assert np.sqrt(pooled) == pytest.approx(total.rmse["net"])
        by_episode = [c for c in result.report.episodes if c.joint == joint]
        assert {c.episode for c in by_episode} == {"e5", "e6"}
        assert sum(c.rows for c in by_episode) == total.rows


def test_reversals_are_near_changes_of_sign() -> None:
    t = np.arange(0, 2, 0.005)
    qd = np.cos(2 * np.pi * t)  # changes sign at 0.25, 0.75, 1.25, 1.75 s
    channels = {"t": t}
    for joint in JOINTS:
        channels |= {f"qd_{joint}": qd, f"q_{joint}": qd, f"tau_est_{joint}": qd}
    rows = windows([Recording(meta("a"), channels)], ("velocity",), 1, 0.005)
    turns = np.array([0.25, 0.75, 1.25, 1.75])
    expected = np.abs(rows.t[:, None] - turns).min(axis=1)
    np.testing.assert_allclose(rows.since_reversal, expected, atol=0.0051)


def test_what_cannot_be_had_is_missing_with_a_reason(recordings: list[Recording]) -> None:
    bare = [Recording(replace(r.meta, kp=None, kd=None), r.channels) for r in recordings]
    got = fit(bare, replace(QUICK, epochs=1, half_net=False))
    assert set(got.report.missing) == {"command", "pd", "half_net"}
    assert set(got.report.cell().rmse) == {"net", "linear"}
    printed = text(got.report)
    assert "pd: none (kp and kd" in printed
    assert "e5" in printed
    torques = {f"tau_cmd_{joint}": np.cos(recordings[0].t) for joint in JOINTS}
    rows = windows([Recording(bare[0].meta, {**bare[0].channels, **torques})], ("tau_cmd",), 1, 0.005)
    np.testing.assert_array_equal(rows.command, np.cos(rows.t))


def test_the_report_is_text_and_json_and_a_page_per_joint(result: FitResult, tmp_path: Path) -> None:
    assert json.loads(json.dumps(asdict(result.report)))["cells"][0]["joint"] == "FR_hip"
    lines = text(result.report).splitlines()
    row = next(line for line in lines if line.startswith("all") and " all " in line)
    assert f"{result.report.cell().rmse['net']:.4f}*" in row
    files = plot(result, tmp_path / "plots")
    assert [f.name for f in files] == ["actuator_net_FR_hip.png", "actuator_net_FR_calf.png"]
    assert all(f.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and f.stat().st_size > 20_000 for f in files)


# ---------------------------------------------------------------------- the file and the other forms


def test_a_net_survives_its_file(by_kind: FitResult, tmp_path: Path) -> None:
    path = tmp_path / "a" / "net.npz"
    by_kind.net.save(path)
    back = load(path)
    assert back.info == by_kind.net.info
    for name, values in by_kind.net.arrays().items():
        assert np.array_equal(values, back.arrays()[name]), name
    assert [p.name for p in path.parent.iterdir()] == ["net.npz"]
    assert back.info.groups == ("hip", "calf")
    assert back.info.group_of == (0, 1)


def test_a_damaged_or_foreign_file_is_refused(result: FitResult, tmp_path: Path) -> None:
    good, bad = tmp_path / "good.npz", tmp_path / "bad.npz"
    with pytest.raises(NetFileError, match=r"bad\.npz: no such file"):
        load(bad)
    result.net.save(good)
    raw, arrays = good.read_bytes(), dict(np.load(good, allow_pickle=False))
    header = str(arrays["header"])

    def saved(array: np.ndarray) -> bytes:
        np.save(tmp_path / "one.npy", array, allow_pickle=True)
        return (tmp_path / "one.npy").read_bytes()

    def changed(**changes: np.ndarray | None) -> bytes:
        np.savez(bad, **{name: values for name, values in (arrays | changes).items() if values is not None})
        return bad.read_bytes()

    def headed(old: str, new: str) -> bytes:
        assert old in header
        return changed(header=np.array(header.replace(old, new)))

    with zipfile.ZipFile(tmp_path / "nonsense.npz", "w") as archive:
        archive.writestr("header.npy", "nonsense")
    flipped = raw[:3000] + bytes([raw[3000] ^ 1]) + raw[3001:]
    foreign = (b"", b"hello", raw[: len(raw) // 2], flipped, (tmp_path / "nonsense.npz").read_bytes())
    cases = [(content, "not an actuator net") for content in (*foreign, saved(np.array([{}], dtype=object)))]
    cases += [
        (saved(np.zeros(3)), "no .npz archive"),
        (changed(**dict.fromkeys(arrays), a=np.zeros(3)), "no header"),
        (changed(weight_0=arrays["weight_0"][:, :-1]), "weight_0: must be float64"),
        (changed(skip=arrays["skip"] * np.nan), "skip: must be finite"),
        (changed(input_std=arrays["input_std"] * 0), "input_std: must be positive"),
        (changed(bias_1=None), "arrays missing: bias_1"),
        (headed('"format":1', '"format":2'), "header.format"),
        (headed('"history":6', '"history":"6"'), "header.history"),
        (headed('"groups":["all"]', '"groups":["hip"]'), "header.groups"),
    ]
    for content, message in cases:
        bad.write_bytes(content)
        with pytest.raises(NetFileError, match=rf"bad\.npz: .*{message}"):
            load(bad)


@pytest.mark.parametrize("form", ["one", "several"])
def test_onnx_agrees_with_the_formula(form: str, result: FitResult, by_kind: FitResult, tmp_path: Path) -> None:
    import onnxruntime

    net = result.net if form == "one" else by_kind.net
    nets = len(net.info.groups)
    net.export_onnx(tmp_path / "net.onnx")
    assert [p.name for p in tmp_path.iterdir()] == ["net.onnx"]
    session = onnxruntime.InferenceSession(tmp_path / "net.onnx", providers=["CPUExecutionProvider"])
    assert session.get_modelmeta().custom_metadata_map["period_s"] == "0.005"
    rng = np.random.default_rng(0)
    for rows in (1, 7, 5000):
        x = rng.normal(size=(nets, rows, net.info.features)) * net.input_std[:, None] + net.input_mean[:, None]
        expected = np.stack([net.torque(x[k], k) for k in range(nets)])
        given = x.astype(np.float32) if nets > 1 else x[0].astype(np.float32)
        (by_onnx,) = session.run(["torque"], {"features": given})
        assert by_onnx.shape == given.shape[:-1]
        np.testing.assert_allclose(by_onnx.reshape(nets, rows), expected, rtol=0, atol=1e-5)


def test_a_net_says_where_it_comes_from_and_the_range_it_was_trained_in(
    recordings: list[Recording], result: FitResult
) -> None:
    origin = result.net.info.provenance
    assert (origin.train, origin.validation, origin.held_out) == (("e0", "e1", "e2", "e3"), ("e4",), ("e5", "e6"))
    assert origin.recordings == {r.meta.episode: fingerprint(r) for r in recordings}
    assert result.net.info.kp == (KP, KP)
    rows = windows(recordings[:4], QUICK.inputs, 6, 0.005)
    assert result.net.input_low[0, 1] == rows.x[:, 6:].min()
    assert result.net.input_high[0, 0] == rows.x[:, :6].max()
    moved = Recording(recordings[0].meta, {**recordings[0].channels, "t": recordings[0].t + 1e-9})
    assert fingerprint(moved) != fingerprint(recordings[0])
    assert fingerprint(Recording(meta("e0", notes="x"), recordings[0].channels)) != fingerprint(recordings[0])


def test_arrays_that_do_not_fit_make_no_net(result: FitResult) -> None:
    with pytest.raises(ValueError, match="weights: 2 layers for 2 hidden"):
        replace(result.net, weights=result.net.weights[:2])
    with pytest.raises(ValueError, match="output_mean: must be float64"):
        replace(result.net, output_mean=result.net.output_mean.astype(np.float32))
    assert isinstance(result.net, ActuatorNet)


# ---------------------------------------------------------------------- smooth motion


def test_smoothing_keeps_a_cubic_and_its_derivatives() -> None:
    t = np.arange(0, 1, 0.002)
    channels = {"t": t, **{f"q_{joint}": 2 * t**3 - t**2 + 0.5 for joint in JOINTS}}
    recording = Recording(meta("a", rate_hz=500.0), channels)
    motion = smooth_motion(recording, 0.06)
    inner = np.isfinite(motion.q[:, 0])
    assert inner.sum() == len(t) - 2 * 15
    np.testing.assert_allclose(motion.q[inner, 0], channels["q_FR_hip"][inner], atol=1e-9)
    np.testing.assert_allclose(motion.qd[inner, 0], (6 * t**2 - 2 * t)[inner], atol=1e-9)
    np.testing.assert_allclose(motion.qdd[inner, 1], (12 * t - 2)[inner], atol=1e-6)
    with pytest.raises(FitError, match="is 3 samples"):
        smooth_motion(recording, 0.005)


# ---------------------------------------------------------------------- a measured drive


def test_the_net_beats_the_linear_map_on_a_measured_drive() -> None:
    """Elbow and shoulder of the AK80 double pendulum: episode 02 held out, as its command's repetition 13 is."""
    from go1exp.logs.importers import import_recordings

    folder = made.real("ak80_double_pendulum/design_A_0")
    names = [folder / f"trajectory_{n}.npz" for n in ("00", "01", "02", "03", "04")]
    logs = [import_recordings("ak80_double_pendulum", name, {})[0] for name in names]
    settings = FitSettings(
        inputs=("tau_cmd", "velocity"),
        history=20,
        period=0.002,
        epochs=12,
        half_net=False,
        holdout=("ak80_a_trajectory_02",),
        validation=("ak80_a_trajectory_04",),
    )
    got = fit(logs, settings)
    for joint in ("shoulder", "elbow"):
        cell = got.report.cell(joint)
        assert cell.rmse["net"] < 0.9 * cell.rmse["linear"]
        assert cell.rmse["linear"] < cell.rmse["command"]
