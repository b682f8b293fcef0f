"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use."""

import io
import os
import sys
from importlib import import_module
from typing import Any

# Before NumPy is imported: its BLAS threads, waiting for work, would take the cores from torch's.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ["MPLBACKEND"] = "agg"  # we draw into files; a notebook's would be refused

import tyro

from brokk_min import __version__
from brokk_min._files import brief

COMMANDS = {  # module and class in `cli`, and what the command does
    "collect": ("identification", "Collect", "record a machine under excitation"),
    "inspect": ("identification", "Inspect", "what a log tells; with --net, errors of nets on it"),
    "fit": ("identification", "Fit", "fit nets of each joint to logs, and score them"),
    "train": ("training", "Train", "train a policy on the nets"),
    "evaluate": ("evaluation", "Evaluate", "policies and baselines on the same sequences"),
    "reproduce": ("evaluation", "Reproduce", "the whole chain, the paper's figures, one report"),
    "sweep": ("training", "Sweep", "train and evaluate many seeds side by side"),
    "machine": ("operating", "Simulate", "a simulated machine on a CAN bus"),
    "drive": ("operating", "Drive", "drive a machine on a CAN bus"),
    "play": ("operating", "Play", "drive with keyboard or gamepad in a window"),
    "replay": ("operating", "Replay", "make a film of a drive from its log"),
    "export": ("operating", "Export", "write a policy as ONNX"),
}
LINES = "\n".join(f"  {name:10} {text}" for name, (_, _, text) in COMMANDS.items())
HELP = f"{__doc__}\n{LINES}\n\n`--version` prints the version."


def main(arguments: list[str] | None = None) -> int:
    """Run one command; errors are one line on stderr."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an encoding that lacks a sign of ours
    arguments = sys.argv[1:] if arguments is None else arguments
    name = arguments[0] if arguments else ""
    if name in ("-h", "--help", "--version"):
        print(f"brokk_min {__version__}" if name == "--version" else HELP)
        return 0
    if name not in COMMANDS:
        print(f"brokk-min: expected one of {', '.join(COMMANDS)}, got {name!r}", file=sys.stderr)
        return 2
    module, function, _ = COMMANDS[name]
    options: Any = {"prog": f"brokk-min {name}", "config": (tyro.conf.FlagCreatePairsOff,)}
    try:
        command = getattr(import_module(f"brokk_min.cli.{module}"), function)
        tyro.cli(command, args=arguments[1:], default=command.defaults(arguments), **options)()
    except (ValueError, OSError, MemoryError, ImportError) as error:
        print(f"brokk-min: {brief(error, longest=10_000)}", file=sys.stderr)
        return 2 if type(error).__name__ == "WrongUse" else 1
    except KeyboardInterrupt:
        print("brokk-min: stopped", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
