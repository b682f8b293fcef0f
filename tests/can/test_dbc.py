"""The DBC file of `examples/dbc.py`, as cantools decodes it, is what the program means."""

import cantools
import numpy as np
import pytest

from brokk_min.can.canopen import encoder_raw, node_numbers, valve_frame
from brokk_min.machine import BROKK_170
from examples.dbc import dbc, main


def test_dbc__describes_the_frames_that_the_program_uses():
    database = cantools.database.load_string(dbc(BROKK_170), "dbc", strict=True)
    *encoders, controller = node_numbers(BROKK_170)
    beats = {0x700 + node for node in (*encoders, controller)}
    used = {0x000, 0x080, 0x210, *beats, *(0x180 + node for node in encoders)}
    assert {message.frame_id for message in database.messages} == used
    frame = valve_frame(np.array([80, 0, -80, 20, -60]) / 127, 7, 1)
    decoded = database.decode_message(0x210, frame.tobytes())
    assert decoded.pop("checksum") == frame[6]
    commands = {"u_q1": 80, "u_q2": 0, "u_q3": 175, "u_q4": 20, "u_q5": 195}
    assert decoded == commands | {"counter": 7, "enable": 1}
    raw = int(encoder_raw(BROKK_170, np.full(5, -5))[1])
    assert database.decode_message(0x182, raw.to_bytes(4, "little")) == {"position": raw}
    assert database.decode_message(0x700 + controller, b"\x05") == {"state": 5}


def test_main__refuses_names_that_dbc_files_cannot_tell_apart(tmp_path):
    (tmp_path / "alike.py").write_text(
        "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170 as m\n"
        "a, b, *rest = m.joints\n"
        "ALIKE = replace(m, joints=(replace(a, name='a 1'), replace(b, name='a-1'), *rest))\n"
    )
    with pytest.raises(SystemExit, match=r"^joints: expected names that differ in DBC files"):
        main(str(tmp_path / "a.dbc"), f"{tmp_path}/alike.py:ALIKE")
    assert not (tmp_path / "a.dbc").exists()
