"""Sweeps: a folder with an index of jobs, and launchers that run them. Knows run folders, and nothing of robots."""
