"""Evaluation of a policy: command grids, tables, pictures."""
