"""Speed, each script one JSON; run as `python -m benchmarks.<name>` from the project's root."""

import brokk_min  # noqa: F401, before NumPy: it settles how many threads that takes
