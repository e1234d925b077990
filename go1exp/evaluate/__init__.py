"""Judging a policy: command grids, tables, pictures."""
