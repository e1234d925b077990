"""Actuators: position target and joint state -> torque. Importing the package registers every actuator."""

from go1exp.sim.actuator import delay, motors, net  # noqa: F401
