"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use."""

import sys
from collections.abc import Callable
from typing import Any

import tyro

from brokk_min import __version__
from brokk_min.cli import commands, operating
from brokk_min.cli.options import WrongUse

LONGEST = 300  # characters of an error
COMMANDS: dict[str, Callable[..., Any]] = {
    "collect": commands.Collect,
    "fit": commands.Fit,
    "preliminary": commands.Preliminary,
    "train": commands.Train,
    "sweep": commands.Sweep,
    "starts": commands.Starts,
    "evaluate": commands.Evaluate,
    "reproduce": commands.Reproduce,
    "machine": operating.Simulate,
    "drive": operating.Drive,
    "convert": operating.Convert,
    "export": operating.Export,
    "play": operating.Play,
    "replay": operating.Replay,
}


def one_line(text: str) -> str:
    """Text without line ends and control characters, of at most 300 characters."""
    text = "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 105]} ... {text[-100:]}"


def main(arguments: list[str] | None = None) -> int:
    """Run one command; errors are one line on stderr."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"brokk_min {__version__}")
        return 0
    paper = {"train": commands.PaperTrain, "sweep": commands.PaperSweep}
    command = tyro.extras.subcommand_cli_from_dict(
        COMMANDS | paper if "--paper" in arguments else COMMANDS,
        prog="brokk-min",
        description=__doc__,
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    try:
        command()
    except WrongUse as error:
        print(one_line(f"brokk-min: {error}"), file=sys.stderr)
        return 2
    except (ValueError, OSError, MemoryError) as error:
        print(one_line(f"brokk-min: {error or 'out of memory'}"), file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("brokk-min: stopped", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
