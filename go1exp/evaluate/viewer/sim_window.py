"""The window of ``go1exp sim viewer=web``: the robot's scene and curves, its client and the client's timing."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from types import SimpleNamespace
from typing import cast

import numpy as np
import torch
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot
from numpy.typing import NDArray

from go1exp import robot
from go1exp.base.tensors.rotation import rotate_inverse
from go1exp.deploy.sim_robot.machine import TICK, Body
from go1exp.deploy.sim_robot.server import TRUTH
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.requests import catalogue, lines
from go1exp.evaluate.viewer.session import PUSH_SHOWN_S, SPAN, History, PushMade
from go1exp.evaluate.viewer.sim_process import FORCE, ROW_S, TORQUE, Frame, RobotProcess
from go1exp.evaluate.viewer.walk import Series, Timed, push_arrow, runs_of
from go1exp.evaluate.viewer.window import MESSAGE_LINES, PLAIN, SLOW, LiveWindow, Vec2, paragraph, section
from go1exp.sim.env.camera import Stage
from go1exp.sim.env.core import Go1Core
from go1exp.sim.terrain import build_terrain

LOOK_S = 1.0 / 30.0  # period at which the robot is looked at, s
Array = NDArray[np.float64]
WIDTHS = {"height": 1, "velocity": 3, "torque": 12, "contact": 4}  # columns of the curves
MOST_POINTS = 1000  # most intervals that are drawn: of a faster client the longest of each group


@dataclass(frozen=True)
class Intervals:
    """Times between packets of the last ``history.SPAN`` s."""

    t: list[float]  # times of arrival, 0 for now, s; thinned out
    interval: list[float]  # time since the packet before, ms; of each group the longest
    p50: float  # median of all intervals, ms; NaN without any
    p99: float  # ms
    worst: float  # ms


@dataclass(frozen=True)
class SimView(Timed):
    """Content of the panels."""

    frame: Frame  # the newest one
    velocity: Series  # true forward, left, m/s, and yaw rate, rad/s, in the trunk's frame
    every: Intervals  # intervals of all packets of the client
    # intervals of packets that differ from the one before: the cycles of a client that repeats each command
    new: Intervals
    rate: int  # packets received in the last second
    answers: float  # states sent per second
    known: dict[str, str]  # description of each known effect, by name


class SimShow:
    """Scene and curves of a robot that an external client commands."""

    def __init__(self, link: RobotProcess, body: Body) -> None:
        self._link, self._body = link, body
        self._terrain = build_terrain(body.terrain)
        task = SimpleNamespace(robot=body.robot, sim=SimpleNamespace(physics_dt=TICK), contact=body.contact)
        free = {"qpos": torch.zeros(1, 19, dtype=torch.float64), "qvel": torch.zeros(1, 18, dtype=torch.float64)}
        free["qpos"][0, 3] = 1.0
        self._pose = free["qpos"]
        core = SimpleNamespace(terrain=self._terrain, task=task, backend=SimpleNamespace(**free))
        self._stage = Stage(cast(Go1Core, core))  # reads nothing else of an environment
        self.model, self.data = self._stage.model, self._stage.data
        self._limit = np.maximum(robot.per_joint(body.robot.effort_limit), 1e-9)
        self._history = History(WIDTHS, ROW_S)
        self._packets: deque[tuple[float, float, float]] = deque()
        self._pushes: deque[PushMade] = deque(maxlen=20)
        self._sent: deque[tuple[float, int]] = deque(maxlen=round(1.0 / LOOK_S))
        self._known = lines(catalogue(body.effect, randomize=True)[0])
        self._frame: Frame | None = None
        self._fresh = False

    def ask(self, request: ask.Request) -> None:
        """Send a request of the user."""
        self._link.send(request)

    def tick(self) -> float:
        """Take the robot's newest frame; return the time until the next call, s."""
        frame = self._link.look()
        if frame is not None:
            self._take(frame)
        return LOOK_S

    def _take(self, frame: Frame) -> None:
        history = self._history
        for _ in range(min(frame.first - history.count, round(SPAN / ROW_S))):
            history.add({})  # rows that the robot did not keep: a gap
        history.count += max(0, frame.first - history.count)
        for row in self._rows(frame.rows.astype(float)):
            history.add(row)
        self._packets.extend(map(tuple, frame.packets.tolist()))
        while self._packets and self._packets[0][0] < frame.now - SPAN:
            self._packets.popleft()
        if frame.push.impulse and (not self._pushes or self._pushes[-1].time != frame.push.time):
            self._pushes.append(frame.push)
        self._sent.append((frame.now, frame.states))
        self._frame, self._fresh = frame, True
        self._pose[0] = torch.from_numpy(frame.qpos)
        if self._stage.place(0):  # other ground around the robot: a new model shows it
            self._stage = Stage(self._stage.core)
            self._stage.place(0)
            self.model, self.data = self._stage.model, self._stage.data

    def _rows(self, rows: Array) -> list[dict[str, Array]]:
        """Return the curves' rows of a frame's rows (R, 29)."""
        truth = {name: rows[:, k] for k, name in enumerate(TRUTH)}
        place = np.stack([truth["base_pos_x_w"], truth["base_pos_y_w"]], axis=1)
        below = self._terrain.height_at(np.nan_to_num(place))
        quat = torch.from_numpy(np.stack([truth[f"base_quat_{part}"] for part in "wxyz"], axis=1))
        velocity = torch.from_numpy(np.stack([truth[f"base_lin_vel_{axis}_w"] for axis in "xyz"], axis=1))
        planar = rotate_inverse(quat, velocity).numpy()[:, :2]  # in the trunk's frame
        true = np.column_stack([planar, truth["base_ang_vel_z_b"]])
        torque, contact = np.abs(rows[:, TORQUE]) / self._limit, (rows[:, FORCE] > 0.0).astype(float)
        height = truth["base_pos_z_w"] - below
        together = zip(height, true, torque, contact, strict=True)
        return [dict(zip(WIDTHS, map(np.atleast_1d, row), strict=True)) for row in together]

    def view(self) -> SimView | None:
        """Return the content of the panels; None if nothing has changed."""
        if self._frame is None or not self._fresh:
            return None
        self._fresh = False
        frame, h = self._frame, self._history
        t = h.times().tolist()
        curves = {name: h.series(name).T for name in WIDTHS}
        pushes = [p for p in self._pushes if frame.clock - p.time < SPAN]
        new = pushes and frame.clock - pushes[-1].time < PUSH_SHOWN_S
        arrows = (push_arrow(self.data.qpos[:3].copy(), pushes[-1].impulse, pushes[-1].angle),) if new else ()
        arrived, since, cycle = np.array(self._packets, float).reshape(-1, 3).T
        (begin, before), (end, states) = self._sent[0], self._sent[-1]
        return SimView(
            frame=frame,
            t=t,
            height=curves["height"][0].tolist(),
            velocity=curves["velocity"].tolist(),
            torque=curves["torque"].tolist(),
            contacts=tuple(runs_of(t, column, h.dt) for column in curves["contact"]),
            pushes=[p.time - frame.clock for p in pushes],
            arrows=arrows,
            every=intervals(arrived - frame.now, since),
            new=intervals(arrived - frame.now, cycle),
            rate=int((arrived > frame.now - 1.0).sum()),
            answers=(states - before) / (end - begin) if end > begin else 0.0,
            known=self._known,
        )


def intervals(at: Array, since: Array) -> Intervals:
    """Return what is drawn of packets that came at ``at`` (P,), s, ``since`` (P,) s after others; NaNs are left out."""
    known = np.isfinite(since)
    all_ms = 1e3 * since[known]
    p50, p99, worst = np.percentile(all_ms, (50, 99, 100)) if len(all_ms) else (np.nan,) * 3
    t, drawn = longest(at[known], all_ms, MOST_POINTS)
    return Intervals(t.tolist(), drawn.tolist(), float(p50), float(p99), float(worst))


def longest(t: Array, values: Array, most: int) -> tuple[Array, Array]:
    """Return at most ``most`` points (T,) of a curve: of each group of neighbours the one with the largest value."""
    every = -(-len(t) // most)
    if every <= 1:
        return t, values
    starts = range(0, len(t), every)
    chosen = np.array([k + int(np.argmax(values[k : k + every])) for k in starts])
    return t[chosen], values[chosen]


PACKETS = 150.0  # height of the plot of intervals, pixels
LEAST_MS = 5.0  # the axis of the intervals reaches at least as far, ms
BEHIND_S = 0.001  # time behind real time from which the panel reports it, s


class SimWindow(LiveWindow):
    """Panels of a robot that an external client commands."""

    def left(self) -> None:
        """Draw the panels."""
        view: SimView = self.view
        frame = view.frame
        if imgui.Button("Reset"):
            self.ask(ask.Reset())
        imgui.SetItemTooltip("to its initial state (Backspace); its client is not informed")
        imgui.SameLine()
        _, self.follow = imgui.Checkbox("follow", self.follow)
        imgui.SameLine()
        imgui.TextUnformatted(f"{frame.clock:.1f} s")
        paragraph(frame.posture)
        behind = f"{1e3 * frame.slipped:.0f} ms behind real time" if frame.slipped > BEHIND_S else ""
        imgui.TextColored(SLOW, behind)
        paragraph(frame.message, MESSAGE_LINES)
        if section("Client"):
            self._client(view)
        if section("Push"):
            self.push_panel()
        if section("Effects", is_open=False):
            self.effects_panel(frame.sizes, view.known)

    def _client(self, view: SimView) -> None:
        frame = view.frame
        if frame.peer is None:
            paragraph("no client yet")
        else:
            paragraph(frame.peer if frame.connected else f"no client; last: {frame.peer}")
        rows = [("packets in, last 1 s", f"{view.rate}"), ("states out, per s", f"{view.answers:.0f}")]
        for label, times in (("interval", view.every), ("new command", view.new)):
            spread = ((name, getattr(times, name)) for name in ("p50", "p99", "worst"))
            rows += [(f"{label} {name}, ms", "-" if math.isnan(v) else f"{v:.2f}") for name, v in spread]
        rows += [("lost by the network", f"{frame.lost}"), ("rejected", f"{sum(frame.refused.values())}")]
        rows += [(f"  {why}", f"{count}") for why, count in frame.refused.items()]
        if not imgui.BeginTable("packets", 2, int(imgui.TableFlags.SizingStretchProp)):
            return
        for row in rows:
            imgui.TableNextRow()
            for text in row:
                imgui.TableNextColumn()
                imgui.TextUnformatted(text)
        imgui.EndTable()

    def right(self) -> None:
        """Draw the curves."""
        view: SimView = self.view
        if section("Client's timing: every packet, new commands"):
            self._intervals(view)
        if section("True velocity"):
            lines = list(zip(("forward m/s", "left m/s", "yaw rad/s"), view.velocity, strict=True))
            self.plot("##velocity", "", lines, (-1.5, 1.5))
        self.body_curves()

    def _intervals(self, view: SimView) -> None:
        if not implot.BeginPlot("##intervals", Vec2(-1.0, PACKETS), PLAIN | int(implot.Flags.NoTitle)):
            return
        implot.SetupAxes("", "ms", 0, 0)
        implot.SetupAxisLimits(int(implot.Axis.X1), -SPAN, 0.0, int(implot.Cond.Always))
        top = 1.1 * max([LEAST_MS, *view.every.interval, *view.new.interval])
        implot.SetupAxisLimits(int(implot.Axis.Y1), 0.0, top, int(implot.Cond.Always))
        outside = int(implot.LegendFlags.Horizontal) | int(implot.LegendFlags.Outside)
        implot.SetupLegend(int(implot.Location.North), outside)
        for name, times in (("every packet", view.every), ("new command", view.new)):
            if times.t:
                implot.PlotScatter(name, times.t, times.interval)
        implot.EndPlot()
