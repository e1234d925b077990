"""Actuators: position target and joint state -> torque. Importing the package registers every actuator."""

from go1exp.sim.actuator import dc_motor, delay, net, pd, voltage

__all__ = ["dc_motor", "delay", "net", "pd", "voltage"]
