"""The simulated robot: physics, actuators, effects, terrain, environment."""
