"""Settings of ``go1exp compare``."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from go1exp.config.schema.settings import settings


@settings
class CompareSettings:
    """``conf/compare.yaml`` without the groups.

    Attributes:
        subjects: two or more, each a shipped policy, a run folder or a bundle (.zip); with @100hz at that rate, with
            @estimated or @exact velocity. All others are compared with the first.
        same_robot: all on the robot of the first: its drives, effects, contact, randomisation and falls; false takes
            each one's own.
        seed: seed of everything random, the same for all.
        physics_dt: another physics step, s; null keeps that of training.
        folder: for compare.html, compare.json and the rows.
    """

    subjects: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=2)]
    same_robot: bool
    seed: Annotated[int, Field(ge=0)]
    physics_dt: Annotated[float, Field(gt=0, le=0.02)] | None
    folder: Annotated[str, Field(min_length=1)]

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if len(set(self.subjects)) < len(self.subjects):
            raise ValueError(f"subjects = {list(self.subjects)}: each only once")
