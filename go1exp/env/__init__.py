"""Environments: ``core`` steps N robots at once; ``gym_env`` and ``sb3_env`` are its borders to Gymnasium and SB3."""
