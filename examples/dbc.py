"""The frames of a machine's bus as a DBC file, which other tools of a CAN bus read.

    python examples/dbc.py [OUT.dbc] [MACHINE or FILE.py:NAME]

A position is the raw count of an encoder: q = sign (count - zero) `encoder_step`, unwrapped.
It needs cantools (`pip install cantools`).
"""

import re
import sys
from pathlib import Path

from cantools.database import Database, Message
from cantools.database.can import Node, Signal

from brokk_min.can import canopen
from brokk_min.cli.options import Command
from brokk_min.machine import Machine, require


def identifier(name: str) -> str:
    """A name in letters, digits and underscores, as DBC files have them."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def signal(name: str, start: int, length: int = 8, unit: str | None = None) -> Signal:
    """An unsigned, little-endian signal."""
    return Signal(identifier(name), start, length, unit=unit)


def dbc(machine: Machine) -> str:
    """The text of a DBC file: valve frame, SYNC, NMT, positions and heartbeats."""
    canopen.check_bus(machine)
    nodes = [*(identifier(f"encoder_{name}") for name in machine.names), "valve_controller"]
    require(len(set(nodes)) > machine.n, "joints", "names that differ in DBC files", machine.names)
    valves = [signal(f"u_{name}", 8 * i) for i, name in enumerate(machine.names)]  # PWM bytes
    valves += [signal("counter", 40), signal("checksum", 48), signal("enable", 56)]
    messages = [
        Message(canopen.NMT, "NMT", 2, [signal("command", 0), signal("node", 8)]),
        Message(canopen.SYNC, "SYNC", 0, []),
        Message(machine.valve_frame_id, "valves", 8, valves, senders=["brokk_min"]),
    ]
    for name, node in zip(nodes, canopen.node_numbers(machine)):
        position, state = signal("position", 0, 32, "counts"), signal("state", 0)
        if name != nodes[-1]:
            messages.append(Message(canopen.TPDO1 + node, name, 4, [position], senders=[name]))
        beat = canopen.HEARTBEAT + node
        messages.append(Message(beat, f"heartbeat_{name}", 1, [state], senders=[name]))
    senders = [Node(name) for name in ("brokk_min", *nodes)]
    return Database(messages, senders).as_dbc_string()


def main(out: str = "bus.dbc", machine: str = "brokk170") -> None:
    """Write the DBC file of a machine."""
    try:
        text = dbc(Command(machine=machine).find_machine())
    except ValueError as error:
        sys.exit(str(error))
    Path(out).write_text(text, newline="")


if __name__ == "__main__":
    main(*sys.argv[1:])
