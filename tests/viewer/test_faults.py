"""Each fault of the gate has words for an operator."""

import pytest
from helpers_viewer import telemetry

from brokk_min.can.safety_gate import Fault
from brokk_min.machine import BROKK_170
from brokk_min.viewer.faults import fault_in_words


@pytest.mark.parametrize("fault", Fault)
def test_fault_in_words__says_what_is_wrong_and_what_to_do(fault):
    code = 1 + fault * 6 + 2  # of the third of five joints and the valve controller
    text = fault_in_words(BROKK_170, telemetry(active_fault=code, driving=False))
    assert fault.text in text
    assert len(text) > len(fault.text) + 20
    assert len(text) <= 130  # one line of a window
    assert fault_in_words(BROKK_170, telemetry(active_fault=code)) == ""  # it drives
    assert fault_in_words(BROKK_170, telemetry(driving=False)) == ""
    latched = fault_in_words(BROKK_170, telemetry(latched_fault=code, driving=False))
    assert latched == f"{text} Over now: release SPACE, then press it again."
