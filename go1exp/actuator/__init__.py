"""Actuators: position target and joint state -> torque. Importing the package registers every actuator."""

from go1exp.actuator import pd

__all__ = ["pd"]
