"""Recordings made comparable with a robot's model, cut into windows, and split into those to fit and to test."""
