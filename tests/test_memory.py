"""What does not fit into memory is refused before anything is played, by the key that asks for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from go1exp import memory
from go1exp.cli.play import APP as PLAY
from go1exp.cli.plugins import begin
from go1exp.compose import compose
from go1exp.evaluate import video
from go1exp.schema.registry import ConfigError


# ---------------------------------------------------------------------- go1exp play


def test_a_gif_that_does_not_fit_is_refused_by_its_key_and_a_film_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a GIF every picture is kept until it is written; of a film none is."""
    monkeypatch.setattr(memory, "free", lambda: 25 * video.GIF_BYTES * 40)
    monkeypatch.setattr(video, "record", lambda *anything, **options: iter(()))
    clip = ["policy=trot", "viewer=clip", "seconds=50", "fps=25"]
    with pytest.raises(ConfigError, match=r"^seconds = 50: a GIF .* 40 s at most would fit; an \.mp4 of any length"):
        PLAY.task(begin("play", compose("play", [*clip, f"out={tmp_path / 'clip.gif'}"])))
    with pytest.raises(ValueError, match="at least one frame"):  # none came, and the length was not in the way
        PLAY.task(begin("play", compose("play", [*clip, f"out={tmp_path / 'clip.mp4'}"])))
