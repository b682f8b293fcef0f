"""The command line in this process."""

import shlex

from brokk_min.__main__ import main


def run(line, *more):
    """Exit status of a command; tyro leaves by SystemExit on wrong use and help."""
    try:
        return main([*shlex.split(line), *map(str, more)])
    except SystemExit as stop:
        return int(stop.code or 0)
