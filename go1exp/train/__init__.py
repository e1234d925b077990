"""Training: SB3's PPO with a KL-adaptive learning rate, run folders, checkpoints, metrics."""
