"""Sealed benchmark of ``go1exp gap``: logs with a hidden effect, and a script that scores what was said about them.

Nothing in here uses the solver, its effects or its simulator: a mistake that both sides share would stay unseen.
"""
