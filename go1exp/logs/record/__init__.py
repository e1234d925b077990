"""Recordings of simulated robots: a robot follows a motion or a policy, and a logger with realistic errors records."""
