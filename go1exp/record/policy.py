"""The excitation ``policy``: not a fixed motion, but a policy in closed loop."""

from __future__ import annotations

from typing import Any

from go1exp.schema.registry import excitation


@excitation("policy", closed_loop=True)
def policy(*_: Any) -> None:
    """A trained policy walks under random commands (needs ``run``)."""
    raise NotImplementedError("a policy is played in closed loop, by go1exp.record.simulate.play_policy")
