"""Bytes of the valves, without two's complement (15 minutes).

The valve controller takes one byte for each joint. The paper gives it in Section 3.2: 0 to 127 is
positive, 255 to 128 is negative. Its pairs are 80/175 and 50/205: each sums to 255. 80 counts are
the largest command that the paper sends, 63 % of 127.

A driver can have this byte wrong in two ways. Two's complement (-80 is 176) is one count off. A
middle of 127 would send a byte at rest that opens all valves.

Write both directions, in counts of 127. Two bytes mean that a valve is idle; which?
"""

from collections.abc import Callable

from hypothesis import strategies as st

from brokk_min.machine import decode_pwm, encode_pwm
from exercises.verdict import agree, expect

SOLUTION = "brokk_min/machine.py: encode_pwm, decode_pwm"


def encode(counts: int) -> int:
    """Byte on the bus, 0 .. 255, for a command of -127 .. 127 counts."""
    raise NotImplementedError


def decode(byte: int) -> int:
    """Command in counts, -127 .. 127, for a byte 0 .. 255 on the bus."""
    raise NotImplementedError


def check(encode: Callable[[int], int], decode: Callable[[int], int]) -> None:
    """The paper's pairs, then every count and every byte."""
    expect("encode(80)", encode(80), 80)
    why = "80 and 175 sum to 255. In two's complement they would sum to 256."
    expect("encode(-80)", encode(-80), 175, why)
    expect("decode(205)", decode(205), -50)
    expect("decode(255)", decode(255), 0, "0 and 255 both mean idle.")
    expect("decode(128)", decode(128), -127, "128 is the largest negative command.")
    agree("encode", encode, lambda m: int(encode_pwm(m / 127)), st.tuples(st.integers(-127, 127)))
    agree("decode", decode, lambda b: round(decode_pwm(b) * 127), st.tuples(st.integers(0, 255)))
