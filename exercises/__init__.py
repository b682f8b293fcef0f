"""Exercises with a verdict, and a bug hunt; see README.md. Run them from the project's root."""

from importlib.util import find_spec

for name in ("hypothesis", "pytest"):
    if find_spec(name) is None:
        raise SystemExit(f"exercises: expected {name}, got none: pip install {name}")
