"""Around PPO: environments, policy files, checkpoints, sweeps."""
