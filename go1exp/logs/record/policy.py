"""The excitations ``policy`` and ``mpc``: not fixed motions, but walks in closed loop."""

from __future__ import annotations

from typing import Any

import go1exp.logs.record.playback  # noqa: F401  (registers an excitation: what is recorded and is no motion of its own)
from go1exp.config.schema.registry import excitation


@excitation("policy", closed_loop=True)
def policy(*_: Any) -> None:
    """A trained policy walks under random commands (needs ``run``)."""
    raise NotImplementedError("a policy is played in closed loop, by go1exp.logs.record.simulate.play_policy")


@excitation("mpc", closed_loop=True)
def mpc(*_: Any) -> None:
    """A model predictive controller walks under random commands, by position targets alone; needs no policy."""
    raise NotImplementedError("a controller is played in closed loop, by go1exp.logs.record.simulate.play_policy")
