"""Keys of the page: where it listens, and what it shows, of ``play``, ``sim`` and ``gap view``, without a browser."""

from __future__ import annotations

import socket
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco.studio")

from go1exp.cli.app import app_of
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.export.build import build
from go1exp.evaluate import video
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer import sim_process, web
from go1exp.evaluate.viewer.page_server import FIRST_PORT, listening
from go1exp.evaluate.viewer.replay import ReplayShow
from go1exp.evaluate.viewer.sim_window import SimShow
from go1exp.evaluate.viewer.walk import WalkShow
from go1exp.gap import files
from go1exp.logs.recording import write
from tests.small_run import trained
from tests.test_viewer import answer, qpos, recording

ELSEWHERE = "127.0.0.2"
"""Another address of this machine alone."""


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[tuple[str, int], Any]]:
    """Where pages were opened, and what they show; each takes its port, and is closed at once."""
    pages: list[tuple[tuple[str, int], Any]] = []

    def run(show: Any, windows: list[Any], *, title: str, host: str, port: int, pad: Any = None) -> None:
        assert title.startswith("go1exp")
        assert len(windows) == 1
        with closing(listening(host, port)) as sock:
            pages.append((sock.getsockname()[:2], show))

    monkeypatch.setattr(web, "run", run)
    return pages


def free_port() -> int:
    with closing(socket.socket()) as sock:
        sock.bind((ELSEWHERE, 0))
        return int(sock.getsockname()[1])


def page(name: str, overrides: list[str], opened: list[tuple[tuple[str, int], Any]]) -> Any:
    """Open a page where ``host`` and ``port`` say, and where they do not; return what the first one shows."""
    port = free_port()
    app_of(name).task(compose(name, [*overrides, f"host={ELSEWHERE}", f"port={port}"]))
    app_of(name).task(compose(name, overrides))
    (chosen, show), (usual, _) = opened
    assert chosen == (ELSEWHERE, port)
    assert usual[0] == "127.0.0.1"
    assert FIRST_PORT <= usual[1] < FIRST_PORT + 20
    return show


def test_gap_view_listens_where_it_is_told_and_shows_the_answer(tmp_path: Path, opened: list[Any]) -> None:
    files.save(answer(), tmp_path / "gap")
    show = page("gap", ["stage=view", f"out={tmp_path / 'gap'}"], opened)
    assert isinstance(show, ReplayShow)
    assert [piece.title for piece in show.player.story.pieces] == ["a, 2.00 s", "b, 2.00 s"]


def test_a_recording_is_shown_where_it_is_told(tmp_path: Path, opened: list[Any]) -> None:
    file = tmp_path / "walk.parquet"
    write(file, recording())
    show = page("play", [f"log={file}"], opened)
    assert isinstance(show, ReplayShow)
    assert show.player.story.kind == "log"


def test_sim_listens_for_the_page_where_it_is_told(monkeypatch: pytest.MonkeyPatch, opened: list[Any]) -> None:
    def process(groups: Any, tile: Any, config: Any, address: tuple[str, int], *rest: Any) -> Any:
        return SimpleNamespace(address=address, close=lambda: None, send=lambda wish: None, look=lambda: None)

    monkeypatch.setattr(sim_process, "RobotProcess", process)
    show = page("sim", ["viewer=web"], opened)
    assert isinstance(show, SimShow)


def test_a_bundle_walks_on_the_page_and_hands_over(
    tmp_path: Path, opened: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    trained(tmp_path / "run", "terrain=flat")
    (tmp_path / "mine.zip").write_bytes(build(tmp_path / "run", seconds=0.1))
    show = page("play", ["bundle=mine.zip", "viewer=web", "velocity=[0.3,0,0]"], opened)
    assert isinstance(show, WalkShow)
    session = show.session
    assert session.label == "mine"
    assert session.command == (0.3, 0.0, 0.0)
    before = qpos(session)
    for _ in range(5):
        show.tick()
    assert session.time == pytest.approx(5 * session.dt)
    assert np.isfinite(qpos(session)).all()
    assert not np.array_equal(qpos(session), before)
    for label in ("clock", "mine"):  # to a policy of the package and back, while it walks
        show.ask(ask.SelectPolicy(label))
        assert (session.label, session.message) == (label, "")
        show.tick()


@pytest.mark.parametrize("viewer", ["clip", "web"])
def test_the_first_tile_is_the_named_one_or_one_that_shows_the_ground(
    viewer: str, tmp_path: Path, opened: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    trained(tmp_path / "run", "terrain=flat")
    filmed: list[Any] = []

    def record(core: Any, *_: Any, **__: Any) -> Any:
        filmed.append(core)
        return iter([])

    monkeypatch.setattr(video, "record", record)
    monkeypatch.setattr(video, "write_gif", lambda *_: None)
    monkeypatch.setattr(video, "write_strip", lambda *_: None)

    def begun(*overrides: str) -> tuple[int, str]:
        words = [f"run={tmp_path / 'run'}", f"viewer={viewer}", f"out={tmp_path / 'a.gif'}", *overrides]
        app_of("play").task(compose("play", words))
        core = filmed[-1] if viewer == "clip" else opened[-1][1].session.core
        core.reset()
        row, column = int(core.level[0]), int(core.tile_column[0])
        assert np.allclose(core.spawn[0], core.terrain.tile_origins[row, column], atol=1e-6)
        return row, core.terrain.tile_types[column]

    assert begun("terrain=steps", "tile=[3,13]") == (3, "stairs_down")
    assert begun("terrain=steps") == (4, "stairs_up")
    for tile, said in (("[10,0]", "10 rows and 20 columns"), ("[0,20]", "counted from 0")):
        with pytest.raises(ConfigError, match=said):
            begun("terrain=steps", f"tile={tile}")
    with pytest.raises(ConfigError, match="needs graded ground"):
        begun("tile=[0,0]")
