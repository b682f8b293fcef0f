"""Speed, each script one JSON; run as `python -m benchmarks.<name>` from the project's root."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import brokk_min  # noqa: F401, before NumPy: it settles how many threads that takes
from brokk_min.identification.files import SHIPPED
from brokk_min.machine import BROKK_170

POLICY = SHIPPED / BROKK_170.name / "policy.npz"  # of ours; it holds the nets of the driven joints


def write(result: object, path: Path | None) -> None:
    """Print a result, and write it to a file."""
    text = json.dumps(result, indent=1)
    print(text)
    if path:
        path.write_text(text + "\n")


def new_policy(net: Any, task: Any, critic: bool, steps: int, seed: int = 0) -> Any:
    """A policy trained on nets, by gradients or with a critic, each with its own settings."""
    from brokk_min.learning.checkpoint import train_policy  # torch is slow to import
    from brokk_min.learning.episodes import GRADIENT_LEARNER
    from brokk_min.ppo import PPOConfig

    settings = {} if critic else GRADIENT_LEARNER
    config = PPOConfig(**{**settings, "total_steps": steps, "threads": 1})
    with TemporaryDirectory() as folder:
        file = Path(folder) / "policy.npz"
        return train_policy(BROKK_170, net, task, config, seed, file, critic)
