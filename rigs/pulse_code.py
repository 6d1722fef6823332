"""The pseudo-random code on the sync line: what makes a train of pulses unambiguous.

A regular train looks the same after a shift by one period, so a device that misses its first
pulse would be aligned wrongly by one tick. The bits of a maximal linear-feedback shift register
never repeat a run of 16 within 65,535 ticks (11 minutes at 100 Hz), so any 16 of them say where
in the train one is. The sync box, the frame camera's sync line and the decoder share this file.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

PERIOD = (1 << 16) - 1
"""Ticks until the code comes again."""
TAPS = (16, 14, 13, 11)
"""Of the Fibonacci register x^16 + x^14 + x^13 + x^11 + 1, which is primitive."""

U8 = npt.NDArray[np.uint8]


def code_bits(seed: int, n: int) -> U8:
    """The first `n` bits of the code, shape (n,), uint8 of 0 and 1.

    Bit 0 is the lowest bit of `seed`; each step shifts the register down and feeds the exclusive
    or of its taps in at the top.

    Args:
        seed: state of the register, 1 to 65,535 (0 would stay 0 for ever).
        n: how many bits; they repeat after `PERIOD`.

    Raises:
        ValueError: `seed` outside 1 to 65,535, or `n` negative.
    """
    if not 1 <= seed <= PERIOD:
        raise ValueError(f"seed = {seed}: the register's state must be 1 to {PERIOD}")
    if n < 0:
        raise ValueError(f"n = {n}: must not be negative")
    once = np.zeros(max(n if n < PERIOD else PERIOD, 16), np.uint8)
    once[:16] = (seed >> np.arange(16)) & 1
    done, leap = 16, 1
    while done < len(once):
        # b[k + 16 m] = b[k] ^ b[k + 2 m] ^ b[k + 3 m] ^ b[k + 5 m] for m = 1, and so for every
        # power of two: squaring a polynomial over GF(2) doubles its exponents
        while 32 * leap <= done:
            leap *= 2
        first = done - 16 * leap
        count = min(11 * leap, len(once) - done)
        begin = [first + tap * leap for tap in (0, 2, 3, 5)]
        parts = [once[at : at + count] for at in begin]
        once[done : done + count] = parts[0] ^ parts[1] ^ parts[2] ^ parts[3]
        done += count
    return np.resize(once, n) if n > len(once) else once[:n]
