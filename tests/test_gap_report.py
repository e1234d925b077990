"""``go1exp gap`` as a user has it: the page, which says every number and loads nothing, and the command line."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from markupsafe import escape

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from go1exp import robot
from go1exp.base.report.table import NOTHING, Cell, Row
from go1exp.cli.app import parse
from go1exp.cli.gap import APP, DOES_NOT_HOLD
from go1exp.cli.places import long_enough, read_all
from go1exp.cli.record import RecordSettings
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError, bind, members
from go1exp.gap import files
from go1exp.gap.report import localisation_text, text, words, write_report
from go1exp.gap.report.figures import rows_of, shown_joints, split_channel
from go1exp.gap.report.page import page
from go1exp.gap.report.tables import heat_maps, short
from go1exp.gap.result import (
    EXIT_CODES,
    Candidate,
    ClockChoice,
    Floors,
    GapResult,
    Localisation,
    NamedEffect,
    Overlay,
    Verdict,
)
from go1exp.logs.recording import Recording, RecordingError, read, write
from tests.phone import PHONE, needs_chromium, on_a_phone

CALVES = tuple(j for j in robot.JOINTS if j.endswith("calf"))
REGIMES = ("stiction", "reversal", "slow", "fast", "high torque", "after a step", "actuators off", "small angle")
VERDICTS: tuple[str, ...] = get_args(Verdict)
VOID = {"meta", "col", "br", "link", "hr", "img"}
MOST_BYTES = 3_000_000
SECTIONS = {*("overlays", "localisation", "evidence", "waterfall-section"), *("parameters", "stability", "next")}


# ---------------------------------------------------------------------- made-up answers


def localisation(rng: np.random.Generator, level: float, joints: tuple[str, ...] = robot.JOINTS) -> Localisation:
    shape = (len(joints), len(REGIMES))
    calf = np.array([[30.0 if j.endswith("calf") else 1.0] for j in joints])
    excess = level * calf * rng.lognormal(0.0, 0.7, shape) - 0.02
    samples = rng.integers(30, 4000, shape)
    samples[:, REGIMES.index("actuators off")] = 0
    excess[samples == 0] = math.nan
    p = np.where(samples == 0, math.nan, rng.uniform(0.0, 1.0, shape) ** (1.0 + calf))
    return Localisation(joints, REGIMES, samples, excess, p, np.nan_to_num(p, nan=1.0) < 1e-3)


def overlay(rng: np.random.Generator, episode: str, joints: tuple[str, ...], start: float, n: int = 150) -> Overlay:
    t = start + 0.002 * np.arange(n)
    noise = {"q": 3e-4, "qd": 0.02, "tau_est": 0.1}
    measured, before, after, sd = {}, {}, {}, {}
    for quantity, level in noise.items():
        for k, joint in enumerate(joints):
            truth = 1000.0 * level * np.sin(2 * np.pi * (2.0 + 0.1 * k) * t + k)
            off = level * (60.0 if joint.endswith("calf") else 3.0) * np.cos(9.0 * t + k)
            name = f"{quantity}_{joint}"
            measured[name] = truth + level * rng.standard_normal(n)
            before[name], after[name], sd[name] = truth + off, truth + 0.02 * off, level
    return Overlay(episode, t, measured, before, after, sd)


def candidates() -> tuple[Candidate, ...]:
    several = {"forward": [0.22, 0.23, 0.24, 0.25, 0.26], "backward": [0.2, 0.21, 0.22, 0.23, 0.24]}
    stribeck: dict[str, list[float] | float] = {"strength": [0.3, 0.31], "speed": 0.13}
    return (
        Candidate("kd_scale", CALVES, {"scale": [1.43, 1.44, 1.41, 1.4]}, 6.4, 2.96, 2.5e-4, 2.93,
                  ("kd_scale", "viscous"), "accepted", "removes 84.1% of the excess on held-out windows, p = 0.00025"),
        Candidate("viscous", CALVES, {"damping": [0.21, 0.22, 0.19, 0.2]}, 6.5, 2.95, 2.5e-4, 11.0,
                  ("kd_scale", "viscous"), "alias", "does as well as kd_scale: not distinguishable with these data"),
        Candidate("asymmetric_friction", (*CALVES, "FR_hip"), several, 11.0, 1.7, 0.0031, 5.2, ("asymmetric_friction",),  # type: ignore[arg-type]
                  "rejected", "explains less than kd_scale (excess falls by 71.5%)"),
        Candidate("torque_delay", (), {"delay": []}, 40.1, -0.002, 0.93, 0.4, ("torque_delay",), "rejected",
                  "fits within its tolerance (0.4 of it)"),
        Candidate("coulomb", CALVES[:2], {"bound": [0.417, 0.428]}, 0.31, 1.2, 2.5e-4, 8.6, ("coulomb",), "accepted",
                  "removes 95.2% of the excess on held-out windows, p = 0.00025", stage=2),
        Candidate("stribeck", CALVES[:2], stribeck, 0.9, 1.0, 0.001, 6.2, ("stribeck",), "rejected",
                  "explains less than coulomb (excess falls by 85.9%)", stage=2),
        Candidate("torque_speed_limit", (), {}, math.nan, 0.0, 1.0, 0.0, ("torque_speed_limit",), "not excited",
                  "twice its tolerance would not show"),
    )  # fmt: skip


def named(final: str = "certified") -> tuple[NamedEffect, ...]:
    rng = np.random.default_rng(5)
    scale = {j: 1.421 + 0.011 * k for k, j in enumerate(CALVES)}
    bound = {CALVES[0]: 0.417, CALVES[1]: 0.428}
    return (
        NamedEffect("kd_scale", CALVES, {"scale": scale},
                    {"scale": {j: (v - 0.051, v + 0.049) for j, v in scale.items()}},
                    ("kd_scale", "viscous"), "certified"),
        NamedEffect("coulomb", CALVES[:2], {"bound": bound},
                    {"bound": {j: (v - 0.03, v + 0.02 + 0.01 * rng.random()) for j, v in bound.items()}},
                    ("coulomb",), final),  # type: ignore[arg-type]
        NamedEffect("base_tilt", (), {"roll": {"robot": 0.021}, "pitch": {"robot": -0.0134}},
                    {"roll": {"robot": (0.018, 0.0241)}, "pitch": {"robot": (-0.0151, -0.0119)}},
                    ("base_tilt",), "certified"),
        NamedEffect("viscous", (), {"damping": {}}, {"damping": {}}, ("viscous",), "compensating"),
    )  # fmt: skip


PROVENANCE: dict[str, Any] = {
    "logs": {f"chirp_kp{kp}_kd0.5_0": f"{kp:02x}" * 32 for kp in (20, 35, 50)},
    "versions": {"go1exp": "0.1.0", "mujoco": "4.0.0"},
    "seed": 7,
    "physics_dt": np.float64(0.001),
    "split": {"train": ["chirp_kp20_kd0.5_0"], "select": ["chirp_kp35_kd0.5_0"], "confirm": []},
    "settings": {"adequate": 0.4, "certified": 0.75},
}

FULL: dict[str, Any] = {
    "candidates": candidates(),
    "floors": Floors({"q": 3.1e-4, "qd": 0.021}, {"q": 2.1e-5, "qd": 0.0011}, None),
    "excess": {"null": 56.3, "box": 40.2, "final": 0.312, "confirm": 0.288},
    "closed": 0.9922,
    "not_excited": dict.fromkeys(("foot_friction", "payload"), "squat")
    | {"torque_speed_limit": "steps", "cogging": "slow_ramps"},
    "advice": (
        "These logs cannot tell kd_scale from viscous; record torque_off swings, or two values of kd "
        "(gains=[[20,0.5],[20,1.0]]) to separate them.",
        "These logs cannot tell base_tilt from link_com; record two attitudes of the trunk (hang=[[0,0],[0,0.5]]) "
        "to separate them.",
    ),
    "bootstrap_share": {"kd_scale": 0.95, "coulomb": 0.7, "base_tilt": 0.8},
    "waterfall": (("nominal model", 56.3), ("within tolerances", 40.2), ("kd_scale", 6.4), ("coulomb", 0.312)),
    "box": {
        "strength": {"scale": {j: 1.0 + 0.05 * np.sin(k) for k, j in enumerate(robot.JOINTS)}},
        "link_mass": {"scale": dict.fromkeys(robot.JOINTS, 0.95)},
        "base_tilt": {"roll": {"robot": 0.004}},
    },
    "provenance": PROVENANCE,
    "seconds": 93.4,
}


def answer(verdict: str, **changes: Any) -> GapResult:
    """A realistic answer with this verdict; a bad log has little to say."""
    rng = np.random.default_rng(3)
    usual: dict[str, Any] = {
        "verdict": verdict,
        "sentence": f"This is {verdict}: error 41.2 times the floor (floor 1).",
    }
    if verdict == "bad log":
        usual |= {"warnings": ("day1: q_FR_calf: stuck for 0.9 s", "day1: says no gains (kp, kd)"), "seconds": 0.2}
        return GapResult(**{**usual, **changes})
    usual |= FULL
    usual["before"] = localisation(rng, 3.0)
    usual["after"] = localisation(rng, 0.003 if verdict == "explained" else 0.5)
    if verdict == "explained":
        starts = (("chirp_kp35_kd0.5_0", 1.2), ("steps_kp35_kd0.5_0", 3.4))
        usual["overlays"] = tuple(overlay(rng, episode, robot.JOINTS, start) for episode, start in starts)
    if verdict in ("explained", "partly explained"):
        usual["named"] = named("certified" if verdict == "explained" else "compensating")
        usual["warnings"] = ("Too few episodes to keep some for a last check.",)
    else:
        level = 40.2 if verdict == "unexplained" else -0.013
        why = f"removes only {0.041:.1%} of the excess on held-out windows"
        usual["candidates"] = tuple(
            replace(c, status="rejected", reason=why, excess_after=0.96 * level, log_gain=0.04, stage=1)
            if c.status != "not excited"
            else c
            for c in candidates()
        )
        usual["closed"], usual["bootstrap_share"], usual["advice"] = math.nan, {}, ()
        usual["excess"] = {"null": 1.4 * level, "box": level, "final": level}
        usual["waterfall"] = (("nominal model", 1.4 * level), ("within tolerances", level))
    return GapResult(**{**usual, **changes})


# ---------------------------------------------------------------------- reading pages


class Reader(HTMLParser):
    """Checks that elements nest, and collects ids, attributes and text."""

    def __init__(self, source: str) -> None:
        super().__init__(convert_charrefs=True)
        self.stack: list[str] = []
        self.tags: Counter[str] = Counter()
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.words: list[str] = []
        self.feed(source)
        self.close()
        assert self.stack == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.stack.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.stack, f"</{tag}> closes nothing"
        assert self.stack.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.stack:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    """The page of each verdict."""
    return {verdict: page(answer(verdict)) for verdict in VERDICTS}


def own(value: float) -> str:
    """Three significant digits, by another way than the report's."""
    return np.format_float_positional(float(f"{value:.3g}"), trim="-")


# ---------------------------------------------------------------------- the page


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_page_is_whole_and_loads_nothing(pages: dict[str, str], verdict: str) -> None:
    source = pages[verdict]
    found = Reader(source)
    assert set(found.ids) >= SECTIONS
    assert [i for i, n in Counter(found.ids).items() if n > 1] == []
    assert found.tags["h1"] == 1
    assert found.tags.keys().isdisjoint({"script", "link", "iframe", "object", "embed", "img", "base", "form"})
    assert re.findall(r"https?:|//www|@import|@font-face|javascript:|\bsrc=", source) == []
    inner = [value for _, name, value in found.attributes if name in ("href", "xlink:href", "src", "action")]
    assert all(value.startswith("#") and value[1:] in found.ids for value in inner)
    assert [n for _, n, _ in found.attributes if n.startswith("on")] == []
    for target in re.findall(r"url\(#([^)]*)\)", source):
        assert target in found.ids
    assert len(source.encode()) < MOST_BYTES
    assert verdict in found.text.lower()
    assert answer(verdict).sentence in found.text
    assert all(warning in found.text for warning in answer(verdict).warnings)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_number_of_the_verdict_appears(pages: dict[str, str], verdict: str) -> None:
    result, said = answer(verdict), Reader(pages[verdict]).text
    tokens = set(re.split(r"[\s,;()\[\]]+", said))
    numbers = [1.0 + v for k, v in result.excess.items() if result.named or k != "final"]
    for n in result.named:
        for name, by_joint in n.params.items():
            for joint, value in by_joint.items():
                numbers += [value, *n.interval[name][joint]]
    for c in result.candidates:
        numbers += [v for v in (c.excess_after,) if math.isfinite(v)]
        numbers += [] if c.status == "not excited" else [c.log_gain, c.size_over_tolerance]
    if result.floors:
        numbers += [*result.floors.noise.values(), result.floors.numerical["qd"]]
    assert {own(v) for v in numbers} - tokens == set()
    for n in result.named:
        assert n.effect in tokens
        assert n.status in tokens
        assert set(n.alias_set) <= tokens
        assert set(n.joints) <= tokens
    for c in result.candidates:
        assert c.reason in said
    for log, digest in result.provenance.get("logs", {}).items():
        assert log in said
        assert digest in said
    if result.named:
        for shown in ("99.22 %", "95 %", "N m", "rad", "1.44 ± 0.05", "0.422 ± 0.02", "seed 7"):
            assert shown in said


def test_a_page_copes_with_an_answer_that_says_nothing() -> None:
    for verdict in VERDICTS:
        empty = GapResult(verdict, "")  # type: ignore[arg-type]
        assert set(Reader(page(empty)).ids) >= SECTIONS
        assert text(empty).startswith(verdict.upper())


def test_two_clocks_have_a_card_with_the_figures_of_both() -> None:
    both = {"rate_hz": ((90.0, 91.5), (100.0, 100.0)), "nominal_errors": (0.0211, 0.0133), "errors": (0.0094, 0.0031)}
    both["terms"] = (("coulomb", "armature"), ())
    figures: Any = {name: dict(zip(("recorded", "speeds"), of_each, strict=True)) for name, of_each in both.items()}
    choice = ClockChoice("speeds", True, windows=47, gain=0.52, interval=(0.31, 0.74), p=0.002, **figures)
    explained = answer("explained", overlays=())
    text = Reader(page(replace(explained, clock=choice))).text
    assert "The times from the speeds are taken: in the median of 47 held-out windows" in text
    assert re.search(r"written times\s+90 to 91.5\s+21.1\s+9.4\s+coulomb, armature", text)
    assert re.search(r"times from the speeds\s+100\s+13.3\s+3.1\s+–", text)
    assert "time between rows" not in Reader(page(explained)).text
    alone = ClockChoice("recorded", False, "1 of 4 recordings have no speeds, so there is one clock only")
    said = Reader(page(replace(explained, clock=alone))).text
    assert f"The clocks could not be compared: {alone.reason}. The written times are taken." in said


def test_a_page_copes_with_numbers_that_are_none() -> None:
    full = answer("explained")
    assert full.before is not None
    hollow = replace(
        full.before, excess=np.full_like(full.before.excess, math.nan), flagged=full.before.flagged & False
    )
    window = full.overlays[0]
    silent = {k: np.full_like(v, math.nan) for k, v in window.before.items()}
    cut = replace(window, before=silent, noise=dict.fromkeys(window.noise, math.nan))
    gone = replace(window, t=window.t[:0], measured={}, before={}, after={}, noise={})
    odd = replace(full.named[0], params={"scale": {"FR_calf": math.inf, "FL_calf": math.nan}}, interval={"scale": {}})
    strange = replace(full.named[0], effect="of_another_version", params={"size": {"robot": 2.0}}, interval={})
    changed = replace(
        full,
        before=hollow,
        after=replace(hollow),
        overlays=(cut, gone),
        named=(odd, strange),
        excess={"null": math.inf, "box": math.nan},
        waterfall=(("nominal model", math.nan), ("within tolerances", 2.0), ("odd", -1.5)),
        bootstrap_share={"kd_scale": math.nan},
        closed=math.nan,
    )
    said = Reader(page(changed)).text
    assert "of_another_version" in said
    assert "nan" not in said.lower().split()
    assert "of_another_version" in text(changed)
    json.dumps(changed.as_dict(), allow_nan=False)


def test_names_of_others_stay_text(tmp_path: Path) -> None:
    nasty = "<script>alert('x')</script>&\"$\\frac{1}$"
    full = answer("explained")
    assert full.before is not None
    assert full.after is not None
    joints = (nasty, *robot.JOINTS[1:])
    rng, interval = np.random.default_rng(0), {"scale": {nasty: (1.4, 1.6)}}
    hurt = replace(
        full,
        sentence=f"The fault is {nasty}.",
        before=replace(full.before, joints=joints, regimes=(nasty, *REGIMES[1:])),
        after=replace(full.after, joints=joints, regimes=(nasty, *REGIMES[1:])),
        named=(replace(full.named[0], joints=(nasty,), params={"scale": {nasty: 1.5}}, interval=interval),),
        candidates=(replace(full.candidates[0], joints=(nasty,), reason=nasty, alias_class=("kd_scale", nasty)),),
        overlays=(overlay(rng, nasty, (nasty, "膝_左"), 0.0),),
        bootstrap_share={nasty: 0.5},
        waterfall=((nasty, 4.0), (nasty, 1.0)),
        warnings=(nasty,),
        not_excited={nasty: nasty},
        advice=(nasty, f"record steps; gains=[[1,2]];{nasty}"),
        provenance={nasty: nasty, "logs": {nasty: nasty}},
    )  # fmt: skip
    source = write_report(hurt, tmp_path)[0].read_text(encoding="utf-8")
    found = Reader(source)
    assert found.tags["script"] == 0
    assert "<script" not in source
    assert str(escape(nasty)) in source
    assert found.text.count("alert('x')") > 10
    for todo in words.next_recordings(hurt):
        assert "alert" not in todo.command
        assert shlex.split(todo.command)[:2] == ["go1exp", "record"]
    assert json.loads((tmp_path / "report.json").read_text())["warnings"] == [nasty]


@pytest.mark.parametrize("verdict", ["explained", "no gap", "bad log"])
def test_the_files_are_the_result(tmp_path: Path, verdict: str, pages: dict[str, str]) -> None:
    result = answer(verdict)
    files = write_report(result, tmp_path / "a/b")
    assert files == [tmp_path / "a/b/report.html", tmp_path / "a/b/report.json"]
    assert sorted((tmp_path / "a/b").iterdir()) == files
    assert json.loads(files[1].read_text(encoding="utf-8")) == result.as_dict()
    assert files[0].read_text(encoding="utf-8") == pages[verdict]  # the same twice: no date, no random id


# ---------------------------------------------------------------------- what is in it


def cells_of(row: Row) -> list[Cell]:
    return [cell for cell in row if isinstance(cell, Cell)]


def test_heat_maps_hold_the_tables_cell_by_cell() -> None:
    result = answer("partly explained")
    assert result.before is not None
    assert result.after is not None
    before, after, fall, samples = ([cells_of(row) for row in m.rows] for m in heat_maps(result))
    for j in range(len(robot.JOINTS)):
        for r in range(len(REGIMES)):
            b, a = result.before.excess[j, r], result.after.excess[j, r]
            cells = [m[j][r] for m in (before, after, fall, samples)]
            assert [c.text for c in cells] == [short(v) for v in (b, a, b - a, result.before.samples[j, r])]
            assert (cells[0].marked, cells[1].marked) == (result.before.flagged[j, r], result.after.flagged[j, r])
            assert f"{result.before.samples[j, r]} samples" in cells[0].title
    assert before[2][REGIMES.index("actuators off")].text == NOTHING
    assert sum(c.marked for row in before for c in row) > 3


def test_colours_grow_darker_with_the_excess_and_words_stay_legible() -> None:
    levels = np.array([[0.0, 0.2, 1.0, 5.0, 30.0, 200.0, 999.0, 1000.0]])
    before = Localisation(("a",), REGIMES, np.ones((1, 8)), levels, np.ones((1, 8)), np.zeros((1, 8), dtype=bool))
    result = GapResult("unexplained", "", before=before, after=replace(before, excess=levels[:, ::-1]))
    maps = [cells_of(m.rows[0]) for m in heat_maps(result)]

    def light(colour: str) -> float:
        linear = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in linear]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    assert [c.fill for c in maps[0]] == [c.fill for c in reversed(maps[1])]  # one scale for both
    brightness = [light(c.fill) for c in maps[0]]
    assert brightness == sorted(brightness, reverse=True)
    assert brightness[0] > brightness[-2] + 0.5
    for c in (c for cells in maps for c in cells):
        dark, bright = sorted((light(c.fill), light(c.ink)))
        assert (bright + 0.05) / (dark + 0.05) > 3.5


def test_windows_show_the_worst_joints() -> None:
    window = answer("explained").overlays[0]
    assert set(shown_joints(window)) < set(CALVES)
    parts = {"q_FR_calf": ("q", "FR_calf"), "qd_a": ("qd", "a"), "tau_est_b_c": ("tau_est", "b_c"), "odd": ("", "odd")}
    assert {channel: split_channel(channel) for channel in parts} == parts


def on_its_feet() -> Overlay:
    """A window of a walk: no torques, and the trunk's IMU, which is further off than any joint."""
    window = without(answer("explained").overlays[0], "tau_est")
    curves = {f"imu_{sensor}_{axis}": np.sin(9.0 * window.t) for sensor in ("gyro", "acc") for axis in "xyz"}
    far = {name: values + 100.0 for name, values in curves.items()}
    noise = {**window.noise, **dict.fromkeys(curves, 0.01)}
    changes = {name: getattr(window, name) | those for name, those in (("measured", curves), ("before", far))}
    return replace(window, **changes, after=window.after | curves, noise=noise)


def without(window: Overlay, quantity: str) -> Overlay:
    """Return the window as if nothing had measured this quantity."""
    names = ("measured", "before", "after", "noise")
    kept: dict[str, Any] = {
        n: {c: v for c, v in getattr(window, n).items() if split_channel(c)[0] != quantity} for n in names
    }
    return replace(window, **kept)


def test_a_window_of_a_walk_shows_the_trunk_and_no_empty_panel() -> None:
    window = on_its_feet()
    joints = shown_joints(window)
    assert set(joints) < set(CALVES)
    assert rows_of(window) == {
        **{quantity: [f"{quantity}_{joint}" for joint in joints] for quantity in ("q", "qd")},
        **{quantity: [f"{quantity}_{axis}" for axis in "xyz"] for quantity in ("imu_gyro", "imu_acc")},
    }
    floors = Floors({"imu_acc": 0.2}, {}, None)
    shown = Reader(page(answer("explained", overlays=(window,), floors=floors))).text
    assert "not recorded" not in shown
    assert ", ?" not in shown
    assert "the largest error of the nominal model, and the measurements of the IMU." in shown
    assert [shown.count(axis) for axis in ("imu_gyro, rad/s", "imu_acc, m/s²", "tau_est, N m")] == [1, 1, 0]
    assert "imu_acc m/s² 0.2" in shown


def test_windows_with_and_without_torques_have_the_rows_that_they_have() -> None:
    """Also where only one of the shown joints has a sensor, or the channels are there and hold nothing."""
    full = answer("explained").overlays[0]
    worst, *_ = shown_joints(full)
    nothing = {c: np.full_like(v, math.nan) for c, v in full.measured.items() if c.startswith("tau_est")}
    empty = replace(full, measured=full.measured | nothing)
    one = replace(full, measured=without(full, "tau_est").measured | {f"tau_est_{worst}": np.sin(full.t)})
    assert [[*rows_of(w)] for w in (full, empty, one)] == [["q", "qd", "tau_est"], ["q", "qd"], ["q", "qd", "tau_est"]]
    shown = Reader(page(answer("explained", overlays=(full, empty, one)))).text
    assert shown.count("tau_est, N m") == 2
    assert shown.count("not recorded") == len(shown_joints(one)) - 1
    assert "measurements of the IMU" not in shown
    nobody = replace(full, measured={}, before={}, after={})
    assert "No curves were kept." in Reader(page(answer("explained", overlays=(nobody,)))).text


def test_every_command_is_one_that_record_takes() -> None:
    of_files = ("policy", "playback")  # play what somebody gives them: no effect asks for them
    every = {f"of {name}": name for name in members("excitation") if name not in of_files}
    for result in (answer("explained"), GapResult("not excited", "", not_excited=every)):
        recordings = words.next_recordings(result)
        assert recordings
        for todo in recordings:
            verb = shlex.split(todo.command)
            assert verb[:2] == ["go1exp", "record"]
            container = compose("record", verb[2:])
            for name in container["excitation"]:
                assert bind("excitation", name, {}, name)[1] == []
            skipped = ("robot", "actuator", "effect", "terrain", "backend", "excitation")
            assert parse(RecordSettings, {k: v for k, v in container.items() if k not in skipped}).out
    asked = [todo.command for todo in words.next_recordings(answer("explained"))]
    assert asked[0] == "go1exp record 'excitation=[torque_off]' 'gains=[[20,0.5],[20,1.0]]' out=recordings/apart"
    assert "'hang=[[0,0],[0,0.5]]'" in asked[1]
    assert asked[2:] == [
        "go1exp record 'excitation=[steps,slow_ramps]' out=recordings/next",
        "go1exp record 'excitation=[squat]' out=recordings/ground",
    ]


def test_a_robot_that_record_cannot_move_is_given_designs_of_its_own() -> None:
    result = replace(answer("explained"), provenance={"robot": "my_arm"})
    commands = [todo.command for todo in words.next_recordings(result)]
    assert commands
    for line in commands:
        assert shlex.split(line, comments=True)[:3] == ["go1exp", "gap", "next"], line
    assert "steps, slow_ramps" in commands[2]


def test_what_would_change_the_verdict_holds_its_limits() -> None:
    said = {verdict: " ".join(words.would_change(answer(verdict))) for verdict in VERDICTS}
    assert all(said.values())
    assert "above 1.4" in said["explained"]  # 1 + adequate, as the provenance has it
    assert "1.31" in said["explained"]
    assert "kd_scale from viscous" in said["explained"]
    assert "75 %" in said["partly explained"]
    assert "go1exp record audit" in said["bad log"]
    plain = replace(answer("explained"), provenance={})
    assert "above 1.5" in " ".join(words.would_change(plain))


def test_narrow_cells_hold_any_number() -> None:
    said = [short(v) for v in (0.004, -0.026, 9.96, 412.0, 999.0, 12345.0, 3.2e6, math.nan)]
    assert said == ["0", "-0.03", "10", "412", "1k", "12k", "3.2M", "–"]


def test_the_terminal_gets_a_sentence_and_a_small_table() -> None:
    said = text(answer("explained"))
    lines = said.splitlines()
    assert lines[0] == "EXPLAINED (exit code 10)"
    assert all(len(line) <= 120 for line in lines if "go1exp record" not in line)
    rows = [line for line in lines if line.startswith("  ")]
    assert any(
        all(w in row for w in ("kd_scale or viscous", "calf", "1.44 ± 0.05", "certified", "95 %")) for row in rows
    )
    assert any("bound 0.422 ±" in row and "N m" in row for row in rows)
    assert any(row.split() == ["with", "the", "identified", "effects", "1.31"] for row in rows)
    assert "99.22 % of the excess chi2 is explained." in said
    assert "Warning: Too few episodes" in said
    assert "go1exp record 'excitation=[torque_off]'" in said
    bad = text(answer("bad log"))
    assert "stuck for 0.9 s" in bad
    assert "excess" not in bad


def test_the_terminal_gets_the_table_of_where_it_is_wrong() -> None:
    where = answer("unexplained").before
    assert where is not None
    lines = localisation_text(where).splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in lines[-len(robot.JOINTS) :]}
    assert tuple(rows) == robot.JOINTS
    filled = [r for r, name in enumerate(REGIMES) if name != "actuators off"]
    for j, joint in enumerate(robot.JOINTS):
        said = [short(where.excess[j, r]) + "*" * bool(where.flagged[j, r]) for r in filled]
        assert rows[joint] == said
    assert "actuators" not in " ".join(lines)
    assert all(len(line) <= 120 for line in lines)


@needs_chromium
def test_a_browser_draws_the_page_and_a_phone_all_of_it(tmp_path: Path) -> None:
    result = answer("explained")
    shown = on_a_phone(write_report(result, tmp_path)[0].read_text(encoding="utf-8"), tmp_path)
    assert shown["page"] <= shown["width"] == PHONE
    assert shown["wide"] == []
    assert shown["drawings"] == len(result.overlays) + 4 + 3  # four parameters; waterfall, tolerances, stability
    assert shown["empty"] == 0


# ---------------------------------------------------------------------- the command line


DEMO = sorted(Path("assets/demo/suspended_go1").glob("*.parquet"))


def named_so(path: Path, episode: str, repeat_of: str | None = None) -> Path:
    (recording,) = read_all(str(DEMO[0]))
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, replace(recording, meta=replace(recording.meta, episode=episode, repeat_of=repeat_of)))
    return path


def test_recordings_of_one_name_in_two_folders_are_told_apart(tmp_path: Path) -> None:
    for day in ("day1", "day2"):
        named_so(tmp_path / day / "run_0.parquet", "run_0")
        named_so(tmp_path / day / "again.parquet", f"again_{day}", repeat_of="run_0")
    recordings = read_all([str(tmp_path / "day1"), str(tmp_path / "day2")])
    about = {(r.meta.episode, r.meta.repeat_of) for r in recordings}
    assert about == {
        ("day1/run_0", None), ("again_day1", "day1/run_0"), ("day2/run_0", None), ("again_day2", "day2/run_0"),
    }  # fmt: skip
    alone = read_all(str(tmp_path / "day1"))
    assert {r.meta.episode for r in alone} == {"run_0", "again_day1"}


def test_folders_of_one_name_are_told_apart_by_those_above(tmp_path: Path) -> None:
    places = [str(named_so(tmp_path / a / "logs/run_0.parquet", "run_0").parent) for a in ("left", "right")]
    assert [r.meta.episode for r in read_all(places)] == ["left/logs/run_0", "right/logs/run_0"]


def test_a_recording_given_twice_and_a_copy_are_refused(tmp_path: Path) -> None:
    file = named_so(tmp_path / "run_0.parquet", "run_0")
    with pytest.raises(RecordingError, match=r"run_0.parquet: given twice"):
        read_all([str(tmp_path), str(file)])
    copy = named_so(tmp_path / "run_1.parquet", "run_0")
    with pytest.raises(RecordingError, match=r"run_1.parquet: is a copy of .*run_0.parquet"):
        read_all(str(tmp_path))
    write(copy, slower(read(copy), 1.1))
    assert [r.meta.episode.split("/")[-1] for r in read_all(str(tmp_path))] == ["run_0", "run_1"]


def slower(recording: Recording, factor: float) -> Recording:
    return replace(recording, channels={**recording.channels, "t": factor * recording.t})


def test_times_in_other_units_and_short_logs_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    """The unit is the audit's to tell: here by the speeds, without them by the length of the steps."""
    (recording,) = read_all(str(DEMO[0]))
    short = replace(recording, channels={name: v[:5] for name, v in recording.channels.items()})
    bare = replace(recording, channels={k: v for k, v in recording.channels.items() if not k.startswith("qd_")})
    odd = [slower(r, factor) for factor in (1e3, 1e6) for r in (recording, bare)]
    assert long_enough([recording, *odd, slower(bare, 1e-3), short], 0.37) == [recording]
    milli, asked, micro, asked_micro, small, few = capsys.readouterr().out.splitlines()
    assert "it is in milliseconds, not in seconds" in milli
    assert asked.endswith("Is it in milliseconds?")
    assert "it is in microseconds, not in seconds" in micro
    assert asked_micro.endswith("Is it in microseconds?")
    assert small.endswith("Are its times 1000 times too small, by a wrong unit?")
    assert "5 rows, " in few
    assert few.endswith(" s: too short; windows take 0.37 s")


def test_a_slow_log_whose_speeds_fit_is_left_out_and_not_taken_for_milliseconds(
    capsys: pytest.CaptureFixture[str],
) -> None:
    (recording,) = read_all(str(DEMO[0]))
    t = 0.25 * np.arange(400)
    joints = recording.meta.joints
    q, qd = np.sin(0.5 * t), 0.5 * np.cos(0.5 * t)
    channels = {"t": t, **{f"q_{j}": q for j in joints}, **{f"qd_{j}": qd for j in joints}}
    assert long_enough([replace(recording, channels=channels)], 0.37) == []
    assert capsys.readouterr().out.endswith("a log of joints must step by at most 0.1 s\n")


def test_what_an_earlier_answer_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    for name in ("effect.yaml", "applied.json", "report.html", "mine.txt", "next.csv"):
        (tmp_path / name).write_text("{}")
    assert files.remove_older(tmp_path) == ["effect.yaml", "applied.json", "report.html"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.txt", "next.csv"]


def test_a_bad_log_takes_the_effect_of_an_earlier_answer_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "gap"
    out.mkdir()
    (out / "effect.yaml").write_text("coulomb: {bound: 0.2}\n")
    (recording,) = read_all(str(DEMO[0]))
    still = {k: np.full_like(v, v[0]) if k.startswith("q_") and "target" not in k else v for k, v in
             recording.channels.items()}  # fmt: skip
    write(tmp_path / "frozen.parquet", replace(recording, channels=still))
    assert APP.run([f"logs={tmp_path / 'frozen.parquet'}", f"out={out}"]) == EXIT_CODES["bad log"]
    assert "removed, of the earlier answer" in capsys.readouterr().out
    assert not (out / "effect.yaml").exists()


@pytest.mark.parametrize("certified", [True, False])
def test_the_status_that_is_printed_is_that_of_the_command(
    certified: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only what is certified can fail to hold at training's step."""
    result: GapResult = answer("explained", overlays=())
    names: tuple[NamedEffect, ...] = tuple(
        replace(n, status="certified" if certified else "compensating") for n in result.named
    )
    files.save(replace(result, named=names), tmp_path)
    (tmp_path / "applied.json").write_text(json.dumps({"holds": False}))
    status = APP.run(["stage=report", f"out={tmp_path}"])
    assert status == (DOES_NOT_HOLD if certified else EXIT_CODES["explained"])
    assert f"(exit code {status})" in capsys.readouterr().out


@pytest.mark.parametrize(("word", "hint"), [("nxt", "did you mean 'next'?"), ("chek", "'check'")])
def test_a_stage_that_does_not_exist_is_refused_with_the_nearest(word: str, hint: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(hint)):
        APP.run([f"stage={word}", "logs=x"])
