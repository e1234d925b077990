"""The estimator beyond the runs at hand: SCALER's logs with faults, filters fed slowly, no allocation in an update."""

from __future__ import annotations

import os
import platform
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.mocap import evaluate
from go1exp.base.paths import data_root
from go1exp.deploy.estimation import go1, make_filter, readings, scaler
from go1exp.logs.importers import import_recordings
from go1exp.logs.importers.scaler_walk_mocap import motion_capture
from go1exp.logs.importers.source import load_npz
from go1exp.logs.recording import VECTORS, RecordingError
from go1exp.robot import NOMINAL_STANCE
from go1exp.robot.attitude import vertical
from tests.kalman import NumpyFilter

DATA = Path(os.environ.get("GO1EXP_DATA", data_root().parent / "shared/data")) / "scaler_walk_mocap"


def run(number: int) -> dict[str, np.ndarray]:
    """The arrays of a real run."""
    if not DATA.is_dir():
        pytest.skip(f"no {DATA.name} in {DATA.parent}; set GO1EXP_DATA")
    with np.load(DATA / f"run_{number}.npz") as file:
        return {key: file[key] for key in file.files}


def saved(folder: Path, arrays: dict[str, np.ndarray], name: str = "run_99") -> Path:
    path = folder / f"{name}.npz"
    np.savez(path, allow_pickle=False, **arrays)
    return path


# ---------------------------------------------------------------------- what the importer mends


def test_the_accelerometer_is_turned_back_to_specific_force() -> None:
    """Against an acceleration that nothing of the importer knows: motion capture's."""
    arrays = run(15)
    (r,) = import_recordings("scaler_walk_mocap", DATA / "run_15.npz", {})
    (logged,) = import_recordings("scaler_walk_mocap", DATA / "run_15.npz", {"reversed_acceleration": False})
    capture = motion_capture(load_npz(DATA / "run_15.npz"), r.t, r.block(*VECTORS["imu_gyro"]))
    grid = np.arange(1.0, 6.5, 0.01)
    place = np.stack([np.interp(grid, capture.t, one) for one in capture.position.T], axis=1)
    acceleration = (place[20:] - 2 * place[10:-10] + place[:-20]) / 0.1**2  # mean over a triangle of 0.2 s
    attitude = Rotation.from_quat(r.block(*VECTORS["base_quat"]), scalar_first=True)
    triangle = np.convolve(np.ones(10) / 10, np.ones(10) / 10)
    for recording, sign in ((r, 1.0), (logged, -1.0)):
        world = attitude.apply(recording.block(*VECTORS["imu_acc"])) - [0.0, 0.0, 9.81]
        felt = np.stack([np.interp(grid, r.t, one) for one in world.T], axis=1)
        smooth = np.stack([np.convolve(one, triangle, "same") for one in felt.T], axis=1)[10:-10]
        match = np.corrcoef(smooth[20:-20].T, acceleration[20:-20].T).diagonal(3)
        assert (sign * match > 0.6).all(), (sign, match)
    np.testing.assert_array_equal(logged.block(*VECTORS["imu_acc"]), arrays["accel_body"])
    assert "imu_acc is worked out" in r.meta.notes
    assert "no specific force" in logged.meta.notes


@pytest.mark.slow("go1exp/deploy/estimation/", "go1exp/evaluate/agents.py", "assets/estimation/", "hatch_build.py")
@pytest.mark.parametrize("number", [14, 15])
def test_motion_capture_a_stride_off_is_moved_back(number: int, tmp_path: Path) -> None:
    """Run 14 came so; run 15 is made so."""
    right = evaluate(DATA / "run_15.npz", scaler()) if run(15) else None
    assert right is not None
    assert right.clock_shift == 0.0
    arrays = run(number)
    if number == 15:
        arrays["mocap_t"] = arrays["mocap_t"] - 0.51
    path = saved(tmp_path, arrays)
    result = evaluate(path, scaler())
    assert result.clock_shift == pytest.approx(0.51, abs=0.03)
    assert result.truth_distance == pytest.approx(right.truth_distance, rel=0.02)  # the same walk
    (r,) = import_recordings("scaler_walk_mocap", path, {})
    assert "clock was moved by +0.5" in r.meta.notes
    (left,) = import_recordings("scaler_walk_mocap", path, {"resync": False})
    assert "clock was moved" not in left.meta.notes


# ---------------------------------------------------------------------- runs with faults


@pytest.mark.slow("go1exp/deploy/estimation/", "go1exp/evaluate/agents.py", "assets/estimation/", "hatch_build.py")
def test_broken_rows_and_missing_sensors_do_not_stop_a_run(tmp_path: Path) -> None:
    whole = evaluate(DATA / "run_19.npz", scaler()) if run(19) else None
    arrays = run(19)
    del arrays["foot_wrench_raw"], arrays["mocap_valid"]
    arrays["accel_body"][300] = np.nan
    arrays["joint_pos"][500, 2, 1] = np.inf
    arrays["t"][700] = arrays["t"][699]
    arrays["mocap_pos"][900:903] = np.nan
    path = saved(tmp_path, arrays)
    (r,) = import_recordings("scaler_walk_mocap", path, {})
    assert len(r.t) == len(arrays["t"]) - 3
    assert "3 rows were not finite or not newer" in r.meta.notes
    result = evaluate(path, scaler())
    assert whole is not None
    assert result.filter_rmse == pytest.approx(whole.filter_rmse, abs=0.01)
    assert result.filter_distance == pytest.approx(whole.filter_distance, abs=0.02)


def test_the_table_names_the_runs_that_it_leaves_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, blind = run(20), run(22)
    del blind["mocap_t"]
    numb = {key: value for key, value in run(23).items() if key != "joint_pos"}
    for name, arrays in (("a", whole), ("b", blind), ("c", numb)):
        saved(tmp_path, arrays, name)
    (tmp_path / "d.npz").write_bytes(b"not one")
    table = runpy.run_path(str(data_root() / "benchmarks/estimation.py"))["real"]
    table(tmp_path, False)
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("| a | 2.15 |")
    assert "no array 'mocap_t'" in lines[3]
    assert "no array 'joint_pos'" in lines[4]
    assert "d.npz: not a whole .npz" in lines[5]
    with pytest.raises(RecordingError, match="no such file or folder"):
        table(tmp_path / "nowhere", False)


# ---------------------------------------------------------------------- other rates


def test_the_vertical_is_the_third_row_of_the_attitude() -> None:
    attitude = Rotation.random(20, rng=np.random.default_rng(0))
    np.testing.assert_allclose(
        vertical(attitude.as_quat(scalar_first=True)), attitude.as_matrix()[:, 2], rtol=0, atol=1e-15
    )


def hops(every: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A trunk that bounces on feet that give way, at 500 Hz; every so many samples. Return samples and velocity."""
    t = np.arange(0.002, 20.0, 0.002)
    push = np.exp(-0.5 * (((t + 0.05 * np.sin(1.3 * t)) % 0.25 - 0.125) / 0.01) ** 2)  # 10 ms, four times a second
    acc = 60.0 * (push - push.mean())
    speed = np.cumsum(acc) * 0.002
    speed -= speed.mean()
    rows = np.tile(
        np.concatenate([[0, 1, 0, 0, 0], np.zeros(6), NOMINAL_STANCE, np.zeros(24), np.full(4, 30.0)]), (len(t), 1)
    )
    rows[:, readings.T] = t
    rows[:, readings.ACC] = np.stack([0 * acc, 0 * acc, 9.81 + acc], axis=1)
    rows[:, readings.ACC] += np.random.default_rng(seed).normal(0, 0.1, (len(t), 3))
    return rows[every - 1 :: every], speed[every - 1 :: every]


def test_fed_at_a_fifth_of_the_rate_it_knows_what_it_did_not_see() -> None:
    """Impacts between samples are noise in proportion to how far the acceleration jumped; at 500 Hz there are none."""
    spread = {}
    for every in (1, 5):
        rows, _ = hops(every)
        fast = make_filter(go1())
        fast.run(rows)
        spread[every] = np.sqrt(np.diag(fast.covariance)[3:6])
    assert spread[5][2] > 1.5 * spread[1][2]
    assert spread[5][0] < 1.5 * spread[1][0]


def test_an_acceleration_that_rises_steadily_is_integrated_between_slow_samples() -> None:
    """In free fall, with a push that grows by 20 m/s3: v = 10 t2, but for the 2 ms for which a sample stands."""
    rows, _ = hops(1)
    rows = rows[:6].copy()
    rows[:, readings.T] = 0.02 * np.arange(6)
    rows[:, readings.FOOT_FORCE] = 0.0
    rows[:, readings.ACC] = np.stack([np.zeros(6), np.zeros(6), 20.0 * rows[:, 0]], axis=1)
    config = go1(initial_bias=0.0)
    slow = NumpyFilter(config)
    fast = make_filter(config)
    for row in rows:
        slow.update(row)
        fast.update(row)
    expected = 10 * 0.1**2 - 9.81 * 0.1 + 20.0 * 0.1 * 0.001
    assert fast.velocity_w[2] == pytest.approx(expected, abs=1e-9)
    assert slow.x[5] == pytest.approx(expected, abs=1e-9)


# ---------------------------------------------------------------------- memory

COUNTING = """
#include <stddef.h>
static long count;
void *__libc_malloc(size_t);
void *__libc_calloc(size_t, size_t);
void *__libc_realloc(void *, size_t);
void *__libc_memalign(size_t, size_t);
void *malloc(size_t n) { ++count; return __libc_malloc(n); }
void *calloc(size_t n, size_t m) { ++count; return __libc_calloc(n, m); }
void *realloc(void *p, size_t n) { ++count; return __libc_realloc(p, n); }
void *aligned_alloc(size_t a, size_t n) { ++count; return __libc_memalign(a, n); }
int posix_memalign(void **p, size_t a, size_t n) { ++count; *p = __libc_memalign(a, n); return 0; }
long allocations(void) { return count; }
"""

MEASURE = """
import ctypes, sys
import numpy as np
sys.path.insert(0, {tests!r})
from go1exp.deploy.estimation import go1, make_filter
from test_estimation import random_motion
counter = ctypes.CDLL({library!r}).allocations
rows = random_motion(go1(), 5000, seed=7)
few, fast, found = rows[:5].copy(), make_filter(go1()), []
for part in (few, few, rows, few, rows):
    fast.reset()
    before = counter()
    outcome = fast.run(part)
    found.append(counter() - before)
print(*found, *sorted(set(outcome[:, -1].astype(int))))
"""


@pytest.mark.slow("go1exp/deploy/estimation/", "go1exp/evaluate/agents.py", "assets/estimation/", "hatch_build.py")
def test_an_update_allocates_nothing(tmp_path: Path) -> None:
    """Every allocation of the process is counted, C++'s ``new`` too: 5000 updates of every outcome need as many
    as 5 do.
    """
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or sys.platform != "linux" or platform.libc_ver()[0] != "glibc":
        pytest.skip("needs gcc and glibc")
    library = tmp_path / "libcount.so"
    (tmp_path / "count.c").write_text(COUNTING)
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", library, tmp_path / "count.c"], check=True, timeout=60)
    code = MEASURE.format(tests=str(Path(__file__).parent), library=str(library))
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "LD_PRELOAD": str(library)},
        cwd=data_root(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    _, few, many, few_again, many_again, *outcomes = (int(number) for number in done.stdout.split())
    assert outcomes == [0, 1, 2, 3, 4]
    assert few == few_again > 0, "the samples and what is found have arrays of their own"
    assert many == many_again == few
