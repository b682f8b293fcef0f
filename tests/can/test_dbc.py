"""The DBC file of `examples/dbc.py`, as cantools decodes it, is what the program means."""

import cantools
import numpy as np
import pytest

from brokk_min.can import canopen
from brokk_min.can.canopen import encoder_raw, used_ids, valve_frames
from brokk_min.machine import BROKK_170
from examples.dbc import dbc
from examples.seven_joints import SEVEN_JOINTS


@pytest.mark.parametrize("machine", [BROKK_170, SEVEN_JOINTS], ids=lambda m: m.name)
def test_dbc__describes_the_frames_that_the_program_uses(machine):
    database = cantools.database.load_string(dbc(machine), "dbc", strict=True)
    unused = {canopen.SDO_ANSWER + node for node in range(128)}
    unused.add(canopen.TPDO1 + machine.controller_node)
    assert {message.frame_id for message in database.messages} == set(used_ids(machine)) - unused
    command = np.arange(machine.n) * 20 - 60
    expected = {f"u_{n}": m if m >= 0 else 255 + m for n, m in zip(machine.names, command)}
    for k, frame in enumerate(valve_frames(command, 7, 1)):
        decoded = database.decode_message(machine.valve_frame_id + k, frame.tobytes())
        assert (decoded.pop("counter"), decoded.pop("enable")) == (7, 1)
        assert decoded.pop("checksum") == frame[6]
        assert decoded == {u: expected.pop(u) for u in decoded}
    assert not expected
    raw = int(encoder_raw(machine, np.full(machine.n, -5))[1])
    node = machine.joints[1].encoder_node
    position = database.decode_message(canopen.TPDO1 + node, raw.to_bytes(4, "little"))
    assert position == {"position": raw}
    heartbeat = canopen.HEARTBEAT + machine.controller_node
    assert database.decode_message(heartbeat, b"\x05") == {"state": 5}
