"""docs/own_robot.md, followed literally: a robot that conf/model does not have, its CSV, and what its model lacks."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pytest

from go1exp.base.paths import data_root
from go1exp.cli import main
from go1exp.cli.hydra_main import choices_from_files
from go1exp.config.compose import compose
from go1exp.config.schema.settings import attributes
from go1exp.gap.result import EXIT_CODES, GapSettings
from go1exp.gap.robots.description import Firmware, ModelConfig, SearchDefaults, parse_model
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.logs.audit import audit as audited
from go1exp.logs.importers.csv import UNITS
from go1exp.logs.recording import read
from go1exp.sim.physics.scene import RIGID

PAGE = data_root() / "docs/own_robot.md"
TEXT = PAGE.read_text()
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
HIDDEN = 0.15
"""Dry friction at the elbow that the page's model does not have, N m."""

STEP = 0.0005
"""Of the hidden robot, s; it is MuJoCo alone, without any of this package's drives and effects."""


def files() -> dict[str, str]:
    """Name -> content of the page's files."""
    texts = {}
    for _, text in BLOCKS:
        first, _, rest = text.partition("\n")
        if match := re.fullmatch(r"(?:# |<!-- )(\S+\.(?:xml|yaml|csv))(?: -->)?", first):
            texts[match[1]] = rest
    return texts


def commands() -> list[list[str]]:
    lines = [line for kind, text in BLOCKS if kind == "bash" for line in text.splitlines()]
    return [shlex.split(line, comments=True) for line in lines]


def log(file: Path, seed: int, seconds: float = 5.0) -> None:
    """Write what the hidden arm logs while it follows sines, in the columns of the page's CSV."""
    model = mujoco.MjModel.from_xml_path("bench_arm.xml")
    model.opt.timestep = STEP
    model.dof_frictionloss[1] = HIDDEN
    model.dof_solref[:], model.dof_solimp[:] = [2 * STEP, 1.0], RIGID
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.3, 1.6, (2, 3)), rng.uniform(0.0, 2 * np.pi, (2, 3))
    rows = []
    for k in range(round(seconds / STEP)):
        if k % 10 == 0:  # the controller and its log run at 200 Hz
            t = k * STEP
            goal = (np.array([0.5, 0.3, 0.15]) * np.sin(2 * np.pi * frequency * t + phase)).sum(1) * min(1.0, t / 0.5)
            angle = data.qpos + 2e-4 * rng.standard_normal(2)
            rows.append([1e3 * t, *np.degrees([*(angle * [1, -1]), *(goal * [1, -1])]), 31])
        data.qfrc_applied[:] = np.clip(15.0 * (goal - data.qpos) - 0.5 * data.qvel, -6.0, 6.0)
        mujoco.mj_step(model, data)
    header = files()["logs/run_0.csv"].splitlines()[0]
    np.savetxt(file, rows, delimiter=",", header=header, comments="", fmt=["%.0f", *["%.4f"] * 4, "%d"])


def lay(number: int, seconds: float = 5.0) -> None:
    """Write the page's files, and this many logs of the hidden robot in the place of the three rows shown."""
    for name, text in files().items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    for seed in range(number):
        log(Path(f"logs/run_{seed}.csv"), seed, seconds)


def follow(words: list[str], monkeypatch: pytest.MonkeyPatch, *more: str) -> int:
    monkeypatch.setattr(sys, "argv", [*words, *more])
    return main()


def test_the_robot_is_nowhere_in_the_repository() -> None:
    assert set(files()) == {"bench_arm.xml", "bench_arm.yaml", "logs/run_0.csv", "table.yaml"}
    shipped = [*(data_root() / "conf").rglob("*.yaml"), *(data_root() / "assets").rglob("*.xml")]
    assert shipped
    assert [file for file in shipped if "bench_arm" in file.read_text()] == []


def test_the_page_is_followed_up_to_the_audit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    lay(2, seconds=2.0)
    bring, audit, check, _ = commands()
    assert follow(bring, monkeypatch) == 0
    first = read(Path("recordings/run_0.parquet"))
    assert (first.meta.joints, first.meta.kp, first.meta.rate_hz) == (("shoulder", "elbow"), (15.0, 15.0), 200.0)
    raw = np.loadtxt("logs/run_0.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(first.joint("q"), np.radians(raw[:, 1:3]) * [1, -1], atol=1e-12)
    assert follow(audit, monkeypatch) in (0, 3)
    assert "left out: temperature" in capsys.readouterr().out
    (chosen,) = [word for word in check if word.startswith("model=")]
    model = parse_model(compose("gap", choices_from_files([chosen], "gap"))["model"])
    assert isinstance(model, ModelConfig)
    assert FixedBase.from_config(model).flaws(first, audited(first)) == []


@pytest.mark.slow(
    "docs/own_robot.md", "go1exp/gap/", "go1exp/logs/importers/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py"
)
def test_the_page_is_followed_to_the_hidden_friction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    lay(6, seconds=6.0)
    bring, _, check, gap = commands()
    assert follow(bring, monkeypatch) == 0
    assert follow(check, monkeypatch, "search.threads=1") == 0
    error = re.search(r"the plain model's error is ([\d.]+) times the floor", capsys.readouterr().out)
    assert error
    assert float(error[1]) > 20.0
    status = follow(gap, monkeypatch, "search.threads=1")
    assert status == EXIT_CODES["explained"]
    verdict = json.loads(Path("gap/verdict.json").read_text())
    assert [n["effect"] for n in verdict["named"]] == ["coulomb"]
    assert verdict["named"][0]["joints"] == ["elbow"]
    assert verdict["named"][0]["params"]["bound"]["elbow"] == pytest.approx(HIDDEN, abs=0.01)
    (shown,) = re.findall(r"^> (The model is missing dry friction .*: bound 0.15)", TEXT, re.MULTILINE)
    assert verdict["sentence"].startswith(shown)
    assert Path("gap/report.html").is_file()
    assert "coulomb" in Path("gap/effect.yaml").read_text()


# ---------------------------------------------------------------------- tables


def key_rows() -> list[str]:
    """The page's table of keys, as the classes have them."""
    parts: Mapping[str, tuple[type, Mapping[str, str]]] = {
        "": (ModelConfig, attributes(ModelConfig)),
        "firmware.": (Firmware, attributes(Firmware)),
        "search.": (SearchDefaults, attributes(GapSettings)),
    }
    rows = []
    for path, (kind, texts) in parts.items():
        for field in dataclasses.fields(kind):
            needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            default = (
                "required" if needed else "none" if field.default in (None, dataclasses.MISSING) else field.default
            )
            rows.append(f"| `{path}{field.name}` | {default} | {texts[field.name].replace('``', '`')} |")
    return rows


def test_the_page_has_every_key_of_a_model_as_the_classes_have_it() -> None:
    section = TEXT[TEXT.index("## All keys of a model") :]
    assert re.findall(r"^\| `.*$", section, re.MULTILINE) == key_rows()


def test_the_page_has_every_unit() -> None:
    section = TEXT[TEXT.index("| channel | our unit |") : TEXT.index("The audit looks at")]
    table = re.findall(r"^\| (`.*) \| (.*) \| (.*?) ?\|$", section, re.MULTILINE)
    units = {}
    for channels, ours, others in table:
        for quantity in re.findall(r"`(\w+?)(?:_JOINT|_LEG|_\*(?:_[wb])?)?`", channels):
            units[quantity] = [ours, *(u for u in others.split(", ") if u)]
    assert units == {quantity: list(known) for quantity, known in UNITS.items()}
