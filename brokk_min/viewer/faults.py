"""The safety gate's faults in words for an operator: what is wrong, and what to do."""

from brokk_min.can.drive_log import Telemetry
from brokk_min.can.safety_gate import Fault, fault_name
from brokk_min.machine import Machine

ADVICE = {
    Fault.ERROR: "The program failed in this tick. If it stays so, end it and read its last line.",
    Fault.FLOODED: "More frames come than the loop can read. Look for the device that sends them.",
    Fault.OTHER_SENDER: "Another program drives this bus. End it, or this one.",
    Fault.LATE: "This computer was too slow for a tick. Close other programs.",
    Fault.OPERATOR_LOST: "Window or gamepad were silent. Plug it in, click into the window.",
    Fault.NEVER_SEEN: "It has not been heard yet. Is it switched on, and on this bus?",
    Fault.HEARTBEAT_LOST: "It has fallen silent. Check its power and its plug.",
    Fault.NOT_OPERATIONAL: "It is not started. Release the switch: then it is started again.",
    Fault.SILENT: "It sent no position in this tick. Check its plug, and how busy the bus is.",
    Fault.MALFORMED: "It sent two positions in a tick, or a damaged one. The bus may be too busy.",
    Fault.OUT_OF_RANGE: "It reads an angle that the joint cannot have. Check zero and sign.",
    Fault.JUMPED: "Its angle jumped. Check that encoder and plug sit tight.",
    Fault.FROZEN: "The valve is open, but the angle stands still. Check pump, valve and encoder.",
    Fault.NO_COMMAND: "The controller gave no command that a valve can take.",
    Fault.STOP: "The program ends, and the valves are closed.",
}


def fault_in_words(machine: Machine, telemetry: Telemetry) -> str:
    """Why the machine is not driven, or empty."""
    code = telemetry.active_fault or telemetry.latched_fault
    if telemetry.driving or not code:
        return ""
    fault = Fault((code - 1) // (machine.n + 1))  # type: ignore[call-arg]
    again = "" if telemetry.active_fault else " Over now: release SPACE, then press it again."
    return f"{fault_name(machine, code)}. {ADVICE[fault]}{again}"
