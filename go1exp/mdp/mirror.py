"""The mirror image of columns of numbers across the robot's sagittal (x-z) plane: which column, with which sign.

The dynamics are symmetric: if a robot observes o and acts a, its image observes M o and acts M a. An observation
declares its M where it is registered, ``@observation("foot_loads", size=4, mirror=mirror.LEGS)``; the M of actions
is ``ACTION``. Order of legs, joints and their signs are those of ``robot.py``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.base.tensors.memory import constant, constant_like
from go1exp.config.schema.registry import Term

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Mirror:
    """Column k of the image is ``signs[k]`` times column ``columns[k]``.

    Attributes:
        columns: a permutation of 0 to K - 1.
        signs: 1.0 or -1.0 each, (K,).

    Raises:
        ValueError: if it is none, or the image of the image is not what was there before.
    """

    columns: tuple[int, ...]
    signs: tuple[float, ...]

    def __post_init__(self) -> None:
        if sorted(self.columns) != list(range(len(self.signs))) or any(abs(sign) != 1.0 for sign in self.signs):
            raise ValueError(f"{self}: columns must be a permutation of 0 to K - 1, and signs K times 1.0 or -1.0")
        pairs = enumerate(self.columns)
        if any(self.columns[k] != i or self.signs[k] != self.signs[i] for i, k in pairs):
            raise ValueError(f"{self}: the image of the image must be what was there before")

    def __call__(self, values: Tensor) -> Tensor:
        """Return the image of ``values`` (..., K), by gathers and products alone, which a GPU can capture."""
        columns = constant(self.columns, torch.int64, values.device)
        return values.index_select(-1, columns) * constant_like(self.signs, values)

    def repeated(self, times: int) -> Mirror:
        """Return the mirror of that many such rows one after the other: frames of a history."""
        return side_by_side([self] * times)


def side_by_side(mirrors: Iterable[Mirror]) -> Mirror:
    """Return the mirror of several blocks of columns one after the other."""
    columns: list[int] = []
    signs: list[float] = []
    for mirror in mirrors:
        columns += [len(signs) + column for column in mirror.columns]
        signs += mirror.signs
    return Mirror(tuple(columns), tuple(signs))


def unchanged(size: int) -> Mirror:
    """Return the mirror of ``size`` numbers without a side, the same in a mirror: a height, a mass."""
    return Mirror(tuple(range(size)), (1.0,) * size)


def grid(rows: int, columns: int) -> Mirror:
    """Return the mirror of heights on a grid in the trunk's heading: ``rows`` along x, each of ``columns`` along y.

    Column j of a row lies opposite column ``columns`` - 1 - j.
    """
    row = tuple(range(columns - 1, -1, -1))
    return Mirror(row, (1.0,) * columns).repeated(rows)


POLAR = Mirror((0, 1, 2), (1.0, -1.0, 1.0))
"""A vector of the trunk frame (position, velocity, acceleration, force, gravity): y changes sign."""

AXIAL = Mirror((0, 1, 2), (-1.0, 1.0, -1.0))
"""A pseudovector of the trunk frame (angular velocity, torque): x and z change sign."""

COMMAND = Mirror((0, 1, 2), (1.0, -1.0, -1.0))
"""Commanded velocity x, y and yaw rate."""

JOINTS = Mirror(robot.MIRROR_JOINTS, robot.MIRROR_JOINT_SIGNS)
"""Of each joint its angle, speed, acceleration, torque or target; also about the nominal stance, which is symmetric."""

ACTION = JOINTS
"""The policy's output: ``mdp/derived.py`` adds it, times one scale, to the nominal stance."""

LEGS = Mirror(robot.MIRROR_LEGS, (1.0,) * robot.NUM_LEGS)
"""One number of each leg without direction: the foot's force, height or contact."""

CLOCK = Mirror((0, 1), (-1.0, -1.0))
"""Sine and cosine of a gait clock: left and right swap roles, and are half a turn apart."""


def problems(group: str, terms: Iterable[Term]) -> list[str]:
    """Return what is wrong with the mirrors of the observation terms in a group, a line for each."""
    lines = []
    for term in terms:
        mirror, size, where = term.entry.traits.get("mirror"), term.entry.traits.get("size"), term.entry.place
        if not isinstance(mirror, Mirror):
            lines.append(
                f"ppo.symmetry = True: {group}.{term.key} does not say what its mirror image is; add mirror= to "
                f"@observation in {where}, as docs/extending.md shows, or use ppo.symmetry=false"
            )
        elif len(mirror.signs) != size:
            lines.append(
                f"ppo.symmetry = True: {group}.{term.key} has {size} columns and a mirror of {len(mirror.signs)} "
                f"({where})"
            )
    return lines
