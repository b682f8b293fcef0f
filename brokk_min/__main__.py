"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use.

`brokk-min --tyro-print-completion bash` (or zsh, tcsh) prints a completion for the shell.
"""

import contextlib
import io
import re
import sys
from collections.abc import Callable
from typing import Any

import tyro

from brokk_min import __version__
from brokk_min.cli import evaluation, identification, operating, training
from brokk_min.cli.options import WrongUse
from brokk_min.identification.files import reason

LONGEST = 300  # characters of an error
COMMANDS: dict[str, Callable[..., Any]] = {
    "collect": identification.Collect,
    "fit": identification.Fit,
    "score": identification.Score,
    "inspect": identification.Inspect,
    "preliminary": evaluation.Preliminary,
    "train": training.Train,
    "sweep": training.Sweep,
    "starts": evaluation.Starts,
    "evaluate": evaluation.Evaluate,
    "reproduce": evaluation.Reproduce,
    "family": evaluation.Family,
    "machine": operating.Simulate,
    "drive": operating.Drive,
    "convert": operating.Convert,
    "diagnose": operating.Diagnose,
    "dbc": operating.Dbc,
    "export": operating.Export,
    "play": operating.Play,
    "replay": operating.Replay,
}


def one_line(text: str) -> str:
    """Text without line ends and control characters, of at most 300 characters."""
    text = "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 105]} ... {text[-100:]}"


# What tyro says of a wrong command line, and what we say of it: option, wanted, got.
REFUSALS = {
    r"Expected one of \{(.*?)\}": r"COMMAND: expected one of \1, got none",
    r"Unrecognized options: (.*?); Available subcommands: (.*?);": (
        r"COMMAND: expected one of \2, got \1"
    ),
    r"Unrecognized options: (.*?);.*?you meant: (\S+)": r"expected options such as \2, got \1",
    r"Unrecognized options: (.*?);": r"expected no further words, got \1",
    r"Missing from .*?: (\S+)": r"\1: expected a value, got none",
    r"Missing value for argument '(.*?)'. Expected 1 ": r"\1: expected a value, got none",
    r"Missing value for argument '(.*?)'. Expected (\d+)": r"\1: expected \2 values, got fewer",
    r"invalid choice '(.*?)' for argument '(.*?)'. Expected one of \((.*?),?\)": (
        r"\2: expected one of \3, got \1"
    ),
    r"Error parsing (.*?): .*?(\[.*?\]|'.*?').*?; Argument helptext: \S+ (.*?) [A-Z][a-z]": (
        r"\1: expected \3, got \2"
    ),
}


def usage_error(box: str) -> str:
    """The box of many lines in which tyro refuses a command line, as one line."""
    rows = re.sub(r"\x1b\[[\d;]*m", "", box).splitlines()
    text = " ".join(row.strip("│ ") for row in rows[1:])
    text = re.sub(" *[─╰╯-]{5,} *", "; ", text).strip("; ")
    for pattern, message in REFUSALS.items():
        if match := re.match(pattern, text):
            return match.expand(message)
    return text


def parse(arguments: list[str], commands: dict[str, Callable[..., Any]]) -> Callable[[], None]:
    """The command with its options; WrongUse: others than it has."""
    try:
        with contextlib.redirect_stderr(io.StringIO()) as box:
            command: Callable[[], None] = tyro.extras.subcommand_cli_from_dict(
                commands,
                prog="brokk-min",
                description=__doc__,
                args=arguments,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        name = f"{arguments[0]} " if arguments and arguments[0] in commands else ""
        text = f"{usage_error(box.getvalue())}; see brokk-min {name}--help"
        raise WrongUse(text) from stop
    return command


def main(arguments: list[str] | None = None) -> int:
    """Run one command; errors are one line on stderr."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"brokk_min {__version__}")
        return 0
    learners = {"train": training.Train, "sweep": training.Sweep}
    named = {name: training.with_defaults(one, arguments) for name, one in learners.items()}
    try:
        parse(arguments, COMMANDS | named)()
    except (ValueError, OSError, MemoryError) as error:
        place = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
        out_of_memory = isinstance(error, MemoryError) and not str(error)
        text = "out of memory" if out_of_memory else reason(error)
        print(one_line(f"brokk-min: {place}{text}"), file=sys.stderr)
        return 2 if isinstance(error, WrongUse) else 1
    except KeyboardInterrupt as stop:
        print(f"brokk-min: stopped{stop}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
