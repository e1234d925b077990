"""Importing this makes ``Go1-v0`` known to Gymnasium: ``gymnasium.make("go1exp.sim.gym:Go1-v0")`` does both."""

from go1exp.sim.env import register

register()
