"""Exercises with a verdict, and a bug hunt; see README.md. Run them from the project's root."""

import brokk_min  # noqa: F401, before NumPy: it settles how many threads that takes
