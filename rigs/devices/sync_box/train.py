"""The train a sync box was told to send, against which each of its reports is checked.

A checksum of eight bits lets one garbled line in 256 through. The train leaves nothing open: which
ticks have a pulse and when they come is known beforehand, so a report that fits is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.protocols.timing import Code
from sliplab.rigs.core.pulse_code import LONGEST_GAP_TICKS, code_bits

_BITS = 1 << 12
"""Bits of the code that are made at first; more when they are needed."""
_FARTHEST_TICKS = 1 << 24
"""A tick further on than this is no tick of a trial: 4 hours at 1,000 Hz."""
_MOST_MISSED = 10_000
"""A jump in the numbers of exposures above this is a garbled line."""


@dataclass
class Losses:
    """What did not reach the host since the last start; all 0 in a good trial."""

    pulses: int = 0
    """Pulses whose report is missing, found by their numbers."""
    exposures: int = 0
    """Exposures whose report is missing, found by their numbers."""
    told_by_box: int = 0
    """Reports that the box itself says it dropped, its buffer being full; among the above."""
    lines: int = 0
    """Lines that were garbled, of whatever kind."""
    unread: int = 0
    """Reports dropped by the host because nobody read them; see `MOST_WAITING` of the driver."""

    def __bool__(self) -> bool:
        return any((self.pulses, self.exposures, self.told_by_box, self.lines, self.unread))


class Bits:
    """A code without an end, made as far as somebody asked."""

    def __init__(self, seed: int, code: Code) -> None:
        self._seed, self._code = seed, code
        self._made = code_bits(seed, _BITS, code)

    def upto(self, ticks: int) -> npt.NDArray[np.uint8]:
        """The bits of the first `ticks` ticks, uint8, and perhaps of more."""
        if ticks > len(self._made):
            self._made = code_bits(self._seed, 2 * ticks, self._code)
        return self._made


class Train:
    """Checks reports, and counts what is missing.

    Args:
        millihertz: rate of the ticks, thousandths of a hertz.
        seed: of the code, see `rigs.core.pulse_code`.
        code: which code.
    """

    def __init__(self, millihertz: int, seed: int, code: Code) -> None:
        self._millihertz, self._bits = millihertz, Bits(seed, code)
        self._next_tick = self._next_exposure = 0
        self._last_exposure_us = 0
        self.first_us: int | None = None
        """Of tick 0 on the box's clock, as the box said; None until it did."""
        self.losses = Losses()

    @property
    def longest_gap_s(self) -> float:
        """The longest time between two pulses, s."""
        return LONGEST_GAP_TICKS * 1000 / self._millihertz

    def tick(self, number: int, bit: int, us: int) -> int | None:
        """A tick's time since tick 0, us, if it has a pulse; None if not.

        Raises:
            ValueError: that is no tick of this train.
        """
        if self.first_us is None or not self._next_tick <= number < _FARTHEST_TICKS:
            raise ValueError(f"tick {number} after {self._next_tick - 1}")
        since_us = us - self.first_us
        due_us = number * 1_000_000_000 // self._millihertz
        if since_us != due_us or bit != self._bits.upto(number + 1)[number]:
            raise ValueError(f"tick {number}: bit {bit}, {since_us} us")
        self._miss_to(number)
        self._next_tick = number + 1
        return since_us if bit else None

    def exposure(self, number: int, us: int, latest_us: int) -> int:
        """An exposure's time since tick 0, us: below 0 if it began before.

        Args:
            latest_us: since tick 0, where it would be yet to come.

        Raises:
            ValueError: that cannot be the next exposure, nor one soon after.
        """
        missed = number - self._next_exposure
        if self.first_us is None or not 0 <= missed <= _MOST_MISSED or us < self._last_exposure_us:
            raise ValueError(f"exposure {number} after {self._next_exposure - 1}")
        if us - self.first_us > latest_us:  # else every later one would come before it
            raise ValueError(f"exposure {number} at {us} us is yet to come")
        self.losses.exposures += missed
        self._next_exposure, self._last_exposure_us = number + 1, us
        return us - self.first_us

    def end(self, ticks: int) -> None:
        """The box says that it stopped after so many ticks: those not reported are missing."""
        if self._next_tick < ticks < _FARTHEST_TICKS:
            self._miss_to(ticks)
            self._next_tick = ticks

    def _miss_to(self, number: int) -> None:
        if number > self._next_tick:
            self.losses.pulses += int(self._bits.upto(number)[self._next_tick : number].sum())
