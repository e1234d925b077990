"""Termination terms: Snapshot -> ``(N,)`` bool, true where the episode ends in failure.

The time limit is not a term: it truncates, and belongs to ``sim.episode_s``.
"""

from __future__ import annotations

import math
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from go1exp.config.schema.registry import termination
from go1exp.mdp.types import Snapshot


@termination("trunk_contact")
def trunk_contact(s: Snapshot) -> Tensor:
    """Trunk, head or a hip touched the ground during this policy step."""
    assert s.trunk_contact is not None
    return s.trunk_contact


@termination("tilt")
def tilt(s: Snapshot, *, max_angle: Annotated[float, Field(gt=0, lt=math.pi)] = 1.2) -> Tensor:
    """The trunk's z axis is more than ``max_angle`` rad off the vertical."""
    return s.projected_gravity_b[:, 2] > -torch.cos(torch.as_tensor(max_angle))
