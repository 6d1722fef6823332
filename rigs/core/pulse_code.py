"""The code on the sync line, which makes a train of pulses unambiguous.

A regular train looks the same after a shift by one period, so a device that misses its first
pulse would be aligned wrongly by one tick. Three codes mark the position within the train; the rig
file sets which one the sync box sends (`protocols.timing.Timing.code`):

* ``lfsr``: bits of a maximal 32-bit linear-feedback shift register. A run of 32 bits repeats after
  4,294,967,295 ticks (497 days at 100 Hz), and every seed starts at another position: two trials
  share no sequence (docs/decisions/clocks.md).
* ``irregular``: pulses at pseudo-random intervals, for a box that generates intervals, not bits.
* ``regular``: pulses at equal intervals after one long gap, the start marker, for a box that can
  do nothing else. Only a device that records the marker can be aligned without ambiguity.

The driver, the fakes and the check of the box's reports use this module; a clock fit needs no code.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.protocols.timing import MARKER_TICKS, Code

SEEDS = (1 << 32) - 2
"""Largest seed of every code; the smallest is 1."""
TAPS = (0, 1, 2, 22)
"""Taps of the Fibonacci register with the primitive polynomial x^32 + x^22 + x^2 + x + 1."""
LONGEST_GAP_TICKS = 32
"""Longest gap between two pulses of any code; firmware with an older code may exceed it."""
SHORTEST_TICKS = 2
"""Shortest interval of the code `irregular`; the longest one has 9."""
REGULAR_TICKS = 2
"""Interval between the later pulses of the code `regular`."""
PULSE_NS = 5_000_000
"""Length of a pulse, at most half a tick, ns; `LONGEST_PULSE` of the firmware (`train.c`)."""

U8 = npt.NDArray[np.uint8]
_WORD = (1 << 32) - 1
_SPREAD = 2_654_435_761
_FIRST_BITS = 1 << 12
"""Number of bits generated at first; more are generated on demand."""


def code_bits(seed: int, n: int, code: Code = "lfsr") -> U8:
    """Return the first `n` bits of a code, one per tick, shape (n,), uint8; 1 is a pulse.

    ``lfsr``: the register starts as `seed` times 2654435761 modulo 2**32, so that small seeds do
    not start with a long gap. Each bit is the lowest of the register, which then shifts right;
    the exclusive or of its taps enters at the top.

    ``irregular``: a pulse on tick 0, then one after each interval in turn. Intervals are drawn by
    a 32-bit xorshift generator, shown here as in the sync box's C code (unsigned, modulo 2**32)::

        uint32_t x = seed * 2654435761u;
        uint32_t interval(void) {           // ticks to the next pulse, 2 to 9
            x ^= x << 13; x ^= x >> 17; x ^= x << 5;
            return 2 + (x >> 29);
        }

    ``regular``: pulses on the ticks 0, 16, 18, 20 and so on, whatever the seed.

    Args:
        seed: 1 to 4,294,967,294 (a register in the state 0 would never leave it).
        n: number of bits.

    Raises:
        ValueError: `seed` outside 1 to 4,294,967,294, or `n` negative.
    """
    if not 1 <= seed <= SEEDS:
        raise ValueError(f"seed = {seed}: must be 1 to {SEEDS}")
    if n < 0:
        raise ValueError(f"n = {n}: must not be negative")
    return {"lfsr": _lfsr, "irregular": _irregular, "regular": _regular}[code](seed, n)


class CodeBits:
    """An endless code, generated on demand."""

    def __init__(self, seed: int, code: Code = "lfsr") -> None:
        self._seed, self._code = seed, code
        self._made = code_bits(seed, _FIRST_BITS, code)

    def upto(self, ticks: int) -> U8:
        """Return the bits of at least the first `ticks` ticks, uint8."""
        if ticks > len(self._made):
            self._made = code_bits(self._seed, 2 * ticks, self._code)
        return self._made


def _lfsr(seed: int, n: int) -> U8:
    bits = np.zeros(max(n, 32), np.uint8)
    bits[:32] = ((seed * _SPREAD & _WORD) >> np.arange(32)) & 1
    done, leap = 32, 1
    while done < len(bits):
        # b[k + 32 m] = b[k] ^ b[k + m] ^ b[k + 2 m] ^ b[k + 22 m] for m = 1, and so for every
        # power of two: squaring a polynomial over GF(2) doubles its exponents
        while 64 * leap <= done:
            leap *= 2
        first = done - 32 * leap
        count = min(10 * leap, len(bits) - done)
        parts = [bits[first + tap * leap : first + tap * leap + count] for tap in TAPS]
        bits[done : done + count] = parts[0] ^ parts[1] ^ parts[2] ^ parts[3]
        done += count
    return bits[:n]


def _irregular(seed: int, n: int) -> U8:
    bits = np.zeros(n, np.uint8)
    state, tick = seed * _SPREAD & _WORD, 0
    pulses = []
    while tick < n:
        pulses.append(tick)
        state ^= state << 13 & _WORD
        state ^= state >> 17
        state ^= state << 5 & _WORD
        tick += SHORTEST_TICKS + (state >> 29)
    bits[pulses] = 1
    return bits


def _regular(seed: int, n: int) -> U8:
    bits = np.zeros(n, np.uint8)
    bits[:1] = 1
    bits[MARKER_TICKS::REGULAR_TICKS] = 1
    return bits
