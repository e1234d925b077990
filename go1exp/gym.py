"""Importing this makes ``Go1-v0`` known to Gymnasium: ``gymnasium.make("go1exp.gym:Go1-v0")`` does both."""

from go1exp.env import register

register()
