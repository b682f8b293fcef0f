"""Packages that only some commands need (the extras of pyproject.toml), imported when one of these runs."""

from importlib import import_module
from typing import Any


def need(package: str, extra: str) -> Any:
    """A module of a package that comes with an extra of ours.

    ValueError: it is not installed, with the extra that brings it.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise ValueError(
            f"{package}: expected the extra brokk_min[{extra}], got {error}"
        ) from error
