"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use."""

import os
import sys
from importlib import import_module

# Before NumPy is imported: its BLAS threads, waiting for work, would take the cores from torch's.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from brokk_min import __version__

COMMANDS = {  # module and class in `cli`, and what the command does
    "collect": ("identification", "Collect", "record a machine under excitation"),
    "inspect": ("identification", "Inspect", "what a log tells; with --net, errors of nets on it"),
    "fit": ("identification", "Fit", "fit one net per joint to logs, and score them"),
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


def help_text() -> str:
    """All commands, a line each."""
    rows = (f"  {name:10} {text}" for name, (_, _, text) in COMMANDS.items())
    return "\n".join([__doc__ or "", *rows, "", "`--version` prints the version."])


def one_line(error: BaseException) -> str:
    """What went wrong, in one line."""
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror.lower()}"
    return " ".join(str(error).split()) or type(error).__name__


def main(arguments: list[str] | None = None) -> int:
    """Run one command; errors are one line on stderr."""
    arguments = sys.argv[1:] if arguments is None else arguments
    name = arguments[0] if arguments else ""
    if name in ("-h", "--help", "--version"):
        print(f"brokk_min {__version__}" if name == "--version" else help_text())
        return 0
    if name not in COMMANDS:
        print(f"brokk-min: expected one of {', '.join(COMMANDS)}, got {name!r}", file=sys.stderr)
        return 2
    module, command, _ = COMMANDS[name]
    try:
        options = getattr(import_module(f"brokk_min.cli.{module}"), command).variant(arguments)
        flags = (tyro.conf.FlagCreatePairsOff,)
        tyro.cli(options, prog=f"brokk-min {name}", args=arguments[1:], config=flags)()
    except (ValueError, OSError, MemoryError) as error:
        print(f"brokk-min: {one_line(error)}", file=sys.stderr)
        return 2 if type(error).__name__ == "WrongUse" else 1
    except KeyboardInterrupt as stop:
        print(f"brokk-min: stopped{stop}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
