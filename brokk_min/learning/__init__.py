"""Around PPO: environments, policy files, checkpoints, simulation gradients, sweeps."""
