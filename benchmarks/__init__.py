"""Speed and ablations; run them as `python -m benchmarks.<name>` from the project's root."""

import json
import os
import re
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: small products wait for threads

from brokk_min._files import SHIPPED
from brokk_min.machine import BROKK_170

POLICY = SHIPPED / BROKK_170.name / "policy.npz"  # ours; it holds the nets of the driven joints


def write(result: object, path: Path | None) -> None:
    """Print a result, and write it to a file."""
    text = json.dumps(result, indent=1)
    print(text)
    if path:
        path.write_text(text + "\n")


def memory(process: int | str = "self") -> float:
    """Resident memory of a process [MB] (Linux)."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(re.findall(r"VmRSS:\s+(\d+)", status)[0]) / 1e3
