"""Draw docs/pipeline.svg, the files and commands of the README: `python docs/pipeline.py`."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

BOXES = [  # what it is, what is in it
    ("machine", "analytic plant\nor your own"),
    ("log.csv", "angles and\ncommands"),
    ("net.npz", "one small net\nper joint"),
    ("policy.npz", "observation\nto valves"),
    ("runs.json", "policy and PIDs,\nsame sequences"),
]
COMMANDS = ["collect", "fit", "train", "evaluate"]
METHOD = ["machine.py\nactuator.py", "", "actuator.py", "env.py, ppo.py", "jacobian.py"]
WIDTH, GAP = 1.55, 0.85


def draw(ax: Axes) -> None:
    """Boxes from left to right, the command on each arrow, the bus below."""
    arrow = {"arrowstyle": "-|>", "color": "0.25", "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0}
    for i, (name, content) in enumerate(BOXES):
        x = i * (WIDTH + GAP)
        color = "#f6e7c8" if i == 0 else "#dbe9f6"
        ax.add_patch(plt.Rectangle((x, 0), WIDTH, 1.1, facecolor=color, edgecolor="0.25"))
        ax.text(x + WIDTH / 2, 0.84, name, ha="center", va="center", weight="bold", size=10)
        ax.text(x + WIDTH / 2, 0.38, content, ha="center", va="center", size=8.5)
        ax.text(x + WIDTH / 2, 1.2, METHOD[i], ha="center", va="bottom", size=8, color="#1f5a94")
    for i, command in enumerate(COMMANDS):
        x = i * (WIDTH + GAP) + WIDTH
        ax.annotate("", (x + GAP, 0.55), (x, 0.55), arrowprops=arrow)
        ax.text(x + GAP / 2, 0.63, command, ha="center", va="bottom", size=9, style="italic")
    start, end = 3 * (WIDTH + GAP) + WIDTH / 2, WIDTH / 2
    ax.plot([start, start, end], [0, -0.55, -0.55], color="0.25", linewidth=1.4)
    ax.annotate("", (end, 0), (end, -0.57), arrowprops=arrow)
    label = "drive: CAN bus, 20 times a second, through the safety gate (hw.py)"
    ax.text((start + end) / 2, -0.47, label, ha="center", va="bottom", size=9, style="italic")


if __name__ == "__main__":
    plt.rcParams["svg.hashsalt"] = "pipeline"  # the same bytes each time
    figure, axes = plt.subplots(figsize=(9.2, 2.2))
    draw(axes)
    axes.set(xlim=(-0.05, 5 * WIDTH + 4 * GAP + 0.05), ylim=(-0.65, 1.65))
    axes.axis("off")
    figure.subplots_adjust(0, 0, 1, 1)
    figure.savefig(Path(__file__).with_suffix(".svg"), metadata={"Date": None})
