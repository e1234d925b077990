"""Environments: ``core`` steps N robots at once; ``gym_env`` and ``sb3_env`` are its borders to Gymnasium and SB3."""


def register() -> None:
    """Make ``Go1-v0`` known to Gymnasium. ``import go1exp.sim.gym`` calls it; some versions call entry points.

    There is no time limit to declare: the configuration has its own.
    """
    import gymnasium

    module = "go1exp.sim.env.gym_env"
    if "Go1-v0" not in gymnasium.registry:
        gymnasium.register("Go1-v0", entry_point=f"{module}:Go1Env", vector_entry_point=f"{module}:Go1VectorEnv")
