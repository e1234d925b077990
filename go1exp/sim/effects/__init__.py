"""Physical effects that a nominal model does not have. Importing the package registers every effect."""

from go1exp.sim.effects import controller, gears, ground, joints, masses, motors, trunk  # noqa: F401
