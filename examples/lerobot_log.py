"""A log for `brokk-min inspect` and `fit` from a LeRobotDataset, version 3: a folder of parquet.

    python examples/lerobot_log.py DATASET log.npz
    brokk-min inspect log.npz --map boom=q_boom:deg,u_boom=u_boom:percent

Angles are `observation.state`, commands `action`, of the joints that meta/info.json names, both in
the dataset's units; `--map` changes them. It needs `pip install pyarrow`.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet

from brokk_min._files import expected, whole_file

ANGLES, COMMANDS = "observation.state", "action"
COLUMNS = [ANGLES, COMMANDS, "timestamp", "episode_index"]


def joint_names(dataset: Path) -> tuple[list[str], list[str]]:
    """Names of angles and commands, or joint_0, joint_1, ...; ValueError: another format."""
    info = json.loads((dataset / "meta" / "info.json").read_text(encoding="utf-8"))
    shapes = [info["features"].get(key, {}).get("shape") for key in (ANGLES, COMMANDS)]
    if not info["codebase_version"].startswith("v3") or not shapes[0] or shapes[0] != shapes[1]:
        got = f"{info['codebase_version']}, {shapes}"
        raise ValueError(f"{dataset}: expected v3, {ANGLES} and {COMMANDS} of one shape, got {got}")
    both = []
    for key in (ANGLES, COMMANDS):
        names = info["features"][key].get("names")
        if isinstance(names, dict):  # {"motors": [...]}, or each name's place
            lists = [value for value in names.values() if isinstance(value, list)]
            names = lists[0] if lists else sorted(names, key=names.get)
        names = names or (both[0] if both else [f"joint_{i}" for i in range(shapes[0][0])])
        both.append([name.removesuffix(".pos") for name in names])
    angles, commands = both
    if sorted({*angles}) != sorted(commands):  # or a name stands twice
        raise ValueError(f"{dataset}: expected {COMMANDS} of {angles}, got {commands}")
    return angles, commands


def main(dataset: str, out: str) -> None:
    """Read all episodes, and write them as one table."""
    with expected(Path(dataset), "a LeRobotDataset with a list of names"):
        names, commands = joint_names(Path(dataset))
    files = sorted(Path(dataset, "data").glob("*/*.parquet"))
    tables = [parquet.read_table(file, columns=COLUMNS).to_pydict() for file in files]
    q, u, time, episode = (np.array([x for t in tables for x in t[key]]) for key in COLUMNS)
    columns = {"run": np.char.add("episode_", episode.astype(str)), "time": time}
    for i, name in enumerate(names):
        columns |= {f"u_{name}": u[:, commands.index(name)], f"q_{name}": q[:, i]}
    with whole_file(Path(out)) as file:
        np.savez_compressed(file, **columns)
    print(f"{out}: {len(np.unique(episode))} episodes of {', '.join(names)}")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.exit(str(error))
