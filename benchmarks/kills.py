"""A training that is killed again and again gives the same policy, to the bit, as one that is not.

    python -m benchmarks.kills [--kills 20] [--json F]

Each training is a process of its own, with `--resume` and a checkpoint after each update. SIGKILL
comes within half a second after a checkpoint was written, at a random moment: also while the next
one is written.
"""

from __future__ import annotations

import multiprocessing
import signal
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from benchmarks import write
from brokk_min.__main__ import main as command
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.net_file import save_net
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170

SIZE = "--total-steps 32768 --num-envs 64 --horizon 16 --checkpoint-every 1"


@dataclass
class Options:
    kills: int = 20  # How many.
    json: Path | None = None  # Also write the figures here.


def train(folder: Path, name: str) -> Any:
    """A process that trains, or goes on with training, `name`."""
    files = ["--actuator", str(folder / "net.npz"), "--out", str(folder / name)]
    arguments = ["train", *files, "--resume", *SIZE.split()]
    process = multiprocessing.get_context("fork").Process(target=command, args=(arguments,))
    process.start()
    return process


def changed(process: Any, file: Path) -> bool:
    """Wait until `file` is another one; False: the process ended."""
    before = file.stat().st_ino if file.exists() else 0
    while process.is_alive():
        if file.exists() and file.stat().st_ino != before:
            return True
        time.sleep(0.01)
    return False


def main(options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    kills = ends = 0
    same = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        policy = load_policy(SHIPPED / BROKK_170.name / "policy.npz", BROKK_170)
        save_net(folder / "net.npz", policy.net)
        train(folder, "whole.npz").join()
        whole = (folder / "whole.npz").read_bytes()
        known = {f"{stem}.npz{end}" for stem in ("whole", "killed") for end in ("", ".csv")}
        known |= {"net.npz", "killed.npz.checkpoint"}
        while kills < options.kills or not ends:
            process = train(folder, "killed.npz")
            if kills < options.kills and changed(process, folder / "killed.npz.checkpoint"):
                time.sleep(rng.uniform(0, 0.5))
                process.kill()
            process.join()
            kills += process.exitcode == -signal.SIGKILL
            names = {path.name for path in folder.iterdir() if path.name[0] != "."}
            assert names <= known, f"expected {known}, got {names}"
            if (folder / "killed.npz").exists():
                ends += 1
                same &= (folder / "killed.npz").read_bytes() == whole
                (folder / "killed.npz").unlink()
            print(f"{kills} kills, {ends} ends, all the same: {same}", flush=True)
    result = {"kills": kills, "ends": ends, "same": same}
    if options.json:
        write(result, options.json)
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
