"""A simulated Go1 that runs in real time as a process of its own, and is spoken to as the real one is."""
