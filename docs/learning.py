"""The learning curves of the policies of `brokk-min reproduce`, as docs/figures/learning.svg.

python docs/learning.py [results]
"""

import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot as plt

from brokk_min.evaluation.rollout import TITLES
from brokk_min.learning.policy import POLICIES

PART = 0.01  # of a curve, over which it is averaged

matplotlib.use("svg")
plt.rcParams.update({"svg.hashsalt": "learning", "svg.fonttype": "none"})


def main(folder: Path) -> None:
    """Read the curves of a folder, and draw them."""
    figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
    for name, file in POLICIES.items():
        curve = np.genfromtxt(folder / f"{file}.csv", delimiter=",", names=True, deletechars="")
        window = np.ones(max(1, round(PART * len(curve)))) / max(1, round(PART * len(curve)))
        columns = curve["global_step"] / 1e6, curve["charts/velocity_error"]
        steps, error = (np.convolve(x, window, "valid")[:: len(window)] for x in columns)
        axes.plot(steps, error, label=TITLES[name])
    axes.set(xscale="log", yscale="log", ylim=(0.02, 0.2))
    axes.set(xlabel="million steps", ylabel="velocity error in training [m/s]")
    axes.legend()
    figure.savefig(Path(__file__).parent / "figures" / "learning.svg", metadata={"Date": None})


if __name__ == "__main__":
    main(Path(*sys.argv[1:] or ["results"]))
