"""From run folder to robot: export, estimation, the runtime, a simulated robot to try it on."""
