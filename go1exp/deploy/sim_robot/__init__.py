"""A simulated Go1 that runs in real time as a process of its own; the runtime talks to it as to a real robot."""
