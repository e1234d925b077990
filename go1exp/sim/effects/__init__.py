"""Physical effects that a nominal model does not have. Importing the package registers every effect."""

from go1exp.sim.effects import (  # noqa: F401
    controller,
    delays,
    friction,
    gears,
    ground,
    joints,
    masses,
    motors,
    trunk,
)
