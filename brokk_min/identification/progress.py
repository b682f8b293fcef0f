"""Progress of what takes long: on a terminal at once, elsewhere (a file, a pipe) once a minute."""

import sys
from typing import Any

from tqdm import tqdm

MINUTE = 60.0  # s


def progress(*iterable: Any, **options: Any) -> Any:
    """`tqdm.tqdm`, a bar on stderr; off a terminal none in the first minute, then one a minute."""
    wait = 0.0 if sys.stderr.isatty() else MINUTE
    options |= {"delay": wait, "mininterval": max(0.1, wait)}
    return tqdm(*iterable, **options)
