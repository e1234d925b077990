"""Settings of the group ``schedule``: values that change during a training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import ConfigDict, Field

from go1exp.config.schema.registry import STRICT, NonNegative

Count = Annotated[int, Field(ge=1, le=1000)]
Value = float | tuple[float, float]


@dataclass(frozen=True)
class Trigger:
    """A training metric that starts a ramp.

    Attributes:
        measure: metric of the training's log, such as gait/trot_error; none of eval/ and time/.
        below: the ramp starts when the metric's mean is at most this.
        above: or when it is at least this.
        iterations: iterations over which the mean is taken.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    measure: str
    below: float | None = None
    above: float | None = None
    iterations: Count = 5

    def __post_init__(self) -> None:
        """Check that there is one threshold."""
        if (self.below is None) == (self.above is None):
            raise ValueError("measure: needs one of below and above")

    def satisfied_by(self, mean: float) -> bool:
        """Return whether the ramp starts at this mean of the metric."""
        return mean <= self.below if self.below is not None else mean >= (self.above or 0.0)


@dataclass(frozen=True)
class Ramp:
    """One setting that moves linearly from one value to another while a policy is trained.

    Attributes:
        set: key of the setting, such as reward.touchdown_speed.weight, actuator.command or contact.time_constant.
        from: value before the ramp.
        to: value after it.
        start: steps of all robots together after which the ramp starts; 0 without when.
        over: steps of all robots together that the ramp takes; 0 is a jump.
        when: start at a metric's threshold instead, {measure, below or above, iterations}.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    path: Annotated[str, Field(alias="set")]
    first: Annotated[Value, Field(alias="from")]
    last: Annotated[Value, Field(alias="to")]
    over: NonNegative
    start: NonNegative | None = None
    when: Trigger | None = None

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.start is not None and self.when is not None:
            raise ValueError("when: start has no meaning beside it; give one of the two")
        if isinstance(self.first, tuple) != isinstance(self.last, tuple):
            raise ValueError("to: must have as many numbers as from")

    def value(self, steps_since_start: float) -> Value:
        """Return the value some steps after the ramp's start; negative before it."""
        if steps_since_start < 0.0:
            return self.first
        if steps_since_start >= self.over:
            return self.last
        share = steps_since_start / self.over
        if isinstance(self.first, tuple) and isinstance(self.last, tuple):
            low, high = (a + share * (b - a) for a, b in zip(self.first, self.last, strict=True))
            return low, high
        assert isinstance(self.first, float)
        assert isinstance(self.last, float)
        return self.first + share * (self.last - self.first)
