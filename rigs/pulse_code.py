"""The code on the sync line: what makes a train of pulses unambiguous.

A regular train looks the same after a shift by one period, so a device that misses its first
pulse would be aligned wrongly by one tick. Three codes say where in the train one is; which one a
sync box sends is told by the rig file (`protocols.timing.Timing.code`):

* ``lfsr``: bits of a maximal linear-feedback shift register. A run of 16 never comes again within
  65,535 ticks (11 minutes at 100 Hz), so any 16 of them say where in the train one is.
* ``irregular``: pulses at pseudo-random intervals, for a box that times pulses and knows no bits.
* ``regular``: pulses at equal intervals after one long silence, the start marker, for a box that
  can do nothing else. Only who sees the marker knows where he is.

The sync box, the frame camera's sync line and the decoder share this file.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocols.timing import MARKER_TICKS, Code

SEEDS = (1 << 16) - 1
"""Seeds are 1 to this, whatever the code."""
PERIOD = SEEDS
"""Ticks until the code `lfsr` comes again; the others do not."""
TAPS = (16, 14, 13, 11)
"""Of the Fibonacci register x^16 + x^14 + x^13 + x^11 + 1, which is primitive."""
SHORTEST_TICKS, LONGEST_TICKS = 2, 9
"""Intervals of the code `irregular`."""
REGULAR_TICKS = 2
"""Between all later pulses of the code `regular`."""

U8 = npt.NDArray[np.uint8]
_WORD = (1 << 32) - 1
_SPREAD = 2_654_435_761


def code_bits(seed: int, n: int, code: Code = "lfsr") -> U8:
    """The first `n` bits of a code, one a tick, shape (n,), uint8: 1 is a pulse on that tick.

    ``lfsr``: bit 0 is the lowest bit of `seed`; each step shifts the register down and feeds the
    exclusive or of its taps in at the top. The bits repeat after `PERIOD`.

    ``irregular``: a pulse on tick 0, then one after each interval in turn. Intervals are drawn by
    a xorshift generator of 32 bits, here as a sync box has it in C (all unsigned, modulo 2**32)::

        uint32_t x = seed * 2654435761u;
        uint32_t interval(void) {           // ticks to the next pulse, 2 to 9
            x ^= x << 13; x ^= x >> 17; x ^= x << 5;
            return 2 + (x >> 29);
        }

    ``regular``: pulses on the ticks 0, 16, 18, 20 and so on, whatever the seed.

    Args:
        seed: 1 to 65,535 (a register in the state 0 would stay there for ever).
        n: how many bits; any number, a trial may be longer than `PERIOD`.

    Raises:
        ValueError: `seed` outside 1 to 65,535, or `n` negative.
    """
    if not 1 <= seed <= SEEDS:
        raise ValueError(f"seed = {seed}: must be 1 to {SEEDS}")
    if n < 0:
        raise ValueError(f"n = {n}: must not be negative")
    return {"lfsr": _lfsr, "irregular": _irregular, "regular": _regular}[code](seed, n)


def _lfsr(seed: int, n: int) -> U8:
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
