"""The command line: `brokk-min COMMAND --help`, `--version`. Exits 0 done, 1 failed, 2 wrong use."""

import sys
from collections.abc import Callable
from typing import Any

import tyro

from brokk_min import __version__
from brokk_min.cli import commands, operating
from brokk_min.cli.options import WrongUse

COMMANDS: dict[str, Callable[[], Any]] = {
    "collect": lambda: commands.Collect,
    "fit": lambda: commands.Fit,
    "preliminary": lambda: commands.Preliminary,
    "train": commands.train_command,
    "sweep": commands.sweep_command,
    "starts": lambda: commands.Starts,
    "evaluate": lambda: commands.Evaluate,
    "reproduce": lambda: commands.Reproduce,
    "machine": lambda: operating.Simulate,
    "drive": lambda: operating.Drive,
    "convert": lambda: operating.Convert,
    "export": lambda: operating.Export,
    "play": lambda: operating.Play,
    "replay": lambda: operating.Replay,
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; errors are one line on stderr."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"brokk_min {__version__}")
        return 0
    named = [name for name in COMMANDS if name in arguments[:1]] or list(COMMANDS)
    command = tyro.extras.subcommand_cli_from_dict(
        {name: COMMANDS[name]() for name in named},
        prog="brokk-min",
        description=__doc__,
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    try:
        command.run()
    except WrongUse as error:
        print(f"brokk-min: {error}", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print(f"brokk-min: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("brokk-min: stopped", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
