"""The frames of a machine's bus as a DBC file, which other tools of a CAN bus read."""

import re
from collections.abc import Iterator

from brokk_min.can import canopen
from brokk_min.machine import PWM_MAX, Machine

SENDER = "brokk_min"
HEAD = 'VERSION ""\n\nNS_ :\n\nBS_:\n\n'
PWM = f'CM_ "PWM bytes u: m for m = 0..{PWM_MAX}, 255 - |m| for m < 0";'


def dbc(machine: Machine) -> str:
    """The text of a DBC file: valve frames, SYNC, NMT, positions and heartbeats.

    A position is the raw count of an encoder; q = sign (count - zero) `encoder_step`, unwrapped.
    ValueError: a machine that does not fit the bus.
    """
    canopen.check_bus(machine)
    nodes = [*(f"encoder_{name}" for name in _names(machine)), "valve_controller"]
    parts = [f"{HEAD}BU_: {' '.join([SENDER, *nodes])}", *_messages(machine, nodes), PWM]
    return "\n\n".join(parts) + "\n"


def _names(machine: Machine) -> list[str]:
    """Names of the joints as a DBC file may have them."""
    return [re.sub(r"\W", "_", name) for name in machine.names]


def _messages(machine: Machine, nodes: list[str]) -> Iterator[str]:
    yield _message(canopen.NMT, "NMT", 2, SENDER, [_signal("command", 0), _signal("node", 8)])
    yield _message(canopen.SYNC, "SYNC", 0, SENDER, [])
    for k, can_id in enumerate(canopen.valve_frame_ids(machine)):
        first = k * canopen.JOINTS_A_FRAME
        names = _names(machine)[first : first + canopen.JOINTS_A_FRAME]
        bytes_ = [_signal(f"u_{name}", 8 * i) for i, name in enumerate(names)]
        bytes_ += [_signal("counter", 40), _signal("checksum", 48), _signal("enable", 56, high=1)]
        yield _message(can_id, f"valves_{k + 1}" if k else "valves", 8, SENDER, bytes_)
    numbered = list(zip(nodes, canopen.node_numbers(machine)))
    position = _signal("position", 0, 32, 2**canopen.POSITION_BITS - 1, "counts")
    for name, node in numbered[:-1]:
        yield _message(canopen.TPDO1 + node, name, 4, name, [position])
    state = _signal("state", 0, high=127)
    for name, node in numbered:
        yield _message(canopen.HEARTBEAT + node, f"heartbeat_{name}", 1, name, [state])


def _message(can_id: int, name: str, size: int, sender: str, signals: list[str]) -> str:
    return "\n".join([f"BO_ {can_id} {name}: {size} {sender}", *signals])


def _signal(name: str, start: int, bits: int = 8, high: int = 255, unit: str = "") -> str:
    """An unsigned, little-endian signal; a PWM byte is m, or 255 - |m| for negative m."""
    return f' SG_ {name} : {start}|{bits}@1+ (1,0) [0|{high}] "{unit}" Vector__XXX'
