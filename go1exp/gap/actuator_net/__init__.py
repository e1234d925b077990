"""Actuator nets: the torque of an actuator under a command, learnt from recordings. ``fitting.fit`` is the entry."""
