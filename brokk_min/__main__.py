"""The command line: `brokk-min COMMAND --help`. Exits 0 done, 1 failed, 2 wrong use."""

import io
import os
import shutil
import signal
import sys
import threading
from typing import Any

# Before NumPy is imported: its BLAS threads, waiting for work, would take the cores from torch's.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ["MPLBACKEND"] = "agg"  # we draw into files; a notebook's would be refused
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

import tyro

from brokk_min import __version__
from brokk_min._files import brief
from brokk_min.cli import evaluation, identification, operating, training
from brokk_min.cli.options import WrongUse, check

COMMANDS: dict[str, Any] = {
    "collect": identification.Collect,
    "inspect": identification.Inspect,
    "fit": identification.Fit,
    "train": training.Train,
    "evaluate": evaluation.Evaluate,
    "reproduce": evaluation.Reproduce,
    "sweep": training.Sweep,
    "machine": operating.Simulate,
    "drive": operating.DriveMachine,
    "play": operating.Play,
    "replay": operating.Replay,
    "export": operating.Export,
}
NARROWEST = 20  # columns of a terminal
LINES = "\n".join(f"  {name:10} {of.__doc__.splitlines()[0]}" for name, of in COMMANDS.items())


def main(arguments: list[str] | None = None) -> int:
    """Run one command; errors are one line on stderr."""
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115, it was closed
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an encoding that lacks a sign of ours
    if shutil.get_terminal_size().columns < NARROWEST:  # help of tyro would never end
        os.environ["COLUMNS"] = str(NARROWEST)
    if threading.current_thread() is threading.main_thread():  # elsewhere Python refuses
        for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
            if signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores the end of a terminal
                signal.signal(number, signal.default_int_handler)  # as Ctrl-C: it tidies up
    name, *options = (sys.argv[1:] if arguments is None else arguments) or [""]
    try:
        if name in ("-h", "--help", "--version"):
            print(f"brokk_min {__version__}" if name == "--version" else f"{__doc__}\n{LINES}")
            sys.stdout.flush()
            return 0
        check(name in COMMANDS, "COMMAND", f"one of {', '.join(COMMANDS)}", repr(name))
        command = tyro.cli(
            COMMANDS[name],
            prog=f"brokk-min {name}",
            args=options,
            default=COMMANDS[name].defaults(options),
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        command.check_numbers()
        command(command.find_machine())
        sys.stdout.flush()
    except BrokenPipeError:  # as of `| head`, which has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, MemoryError, ImportError) as error:
        print(f"brokk-min: {brief(error, longest=10_000)}", file=sys.stderr)
        return 2 if isinstance(error, WrongUse) else 1
    except KeyboardInterrupt:
        print("brokk-min: stopped", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
