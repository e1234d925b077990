"""Robots that the gap workflow can compare with recordings."""
