"""Any detector on a running stream: its evidence above a level is slip."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.alarms import Level
from sliplab.analysis.detectors.detector import (
    NOTHING_US,
    Detector,
    DetectorError,
    Evidence,
    JudgedWindow,
    StreamDetector,
    checked,
)
from sliplab.analysis.metrics.classification import GROSS, INCIPIENT, NO_SLIP
from sliplab.protocols.errors import InputError
from sliplab.storage.streams import EventChunk

WARM_UP_US = 1_000_000
ALL_SLIPPED = 0.97
"""Share of the tips from which slip is gross: no tip of 30 sticks."""
STILL_GROSS = 0.8
"""Share below which it is incipient again, so that a few doubtful tips do not change it."""

I8 = npt.NDArray[np.int8]
F64 = npt.NDArray[np.float64]


class AtLevel(StreamDetector):
    """A detector with its level. Evidence above it is gross slip by the detector's own class alone.

    Where the detector knows the share of slipped tips, slip lasts from an alarm until no tip slips,
    and is gross once all of them do. Before an alarm the share is 0.

    The detector is given events in order: those that are older than what it has been given are left
    out, and those at the newest moment wait, as others of that moment may follow.

    Args:
        level: that the evidence must exceed.
        set_by: the promise that set it; None where none did.
    """

    def __init__(self, detector: Detector, level: float, set_by: Level | None = None) -> None:
        self.detector, self.set_by = detector, set_by
        self.level: float = level

    def begin(self, width: int, height: int) -> None:
        """See `Detector`. Raises DetectorError."""
        self._size, self._number = (width, height), 0
        self.resume(0)

    def warm_up(self, width: int, height: int) -> None:
        """Push a second without events. Raises InputError: that is slip at this level."""
        self.begin(width, height)
        quiet = self.push(EventChunk.empty(), WARM_UP_US).value.max(initial=-np.inf)
        # one that nothing bounds is infinite; a positive one may be meant, to try an alarm
        if -np.inf < self.level < min(quiet, 0):
            text = f"must be higher: without an event its evidence is {quiet:g} already"
            raise InputError("detect", "level", self.level, text)

    def resume(self, at_us: int) -> None:
        """Begin a new scene. Raises DetectorError."""
        self._from_us = self._settled_us = self._window_us = at_us
        self._held = EventChunk.empty()
        self._events = 0
        self._slipping, self._gross, self._share = False, False, 0.0
        self._last_us: int | None = None
        with _failures():
            self.detector.begin(*self._size)

    @property
    def settled_us(self) -> int:
        """The moment up to which the detector has been given everything."""
        return self._settled_us if self._settled_us > self._from_us else NOTHING_US

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `StreamDetector`. Raises DetectorError."""
        before_us = self._settled_us
        late = events.t_us < before_us
        held = events[~late] if late.any() else events
        held = EventChunk.concatenate([self._held, held]) if len(self._held) else held
        if (held.t_us[1:] < held.t_us[:-1]).any():
            held = held[np.argsort(held.t_us, kind="stable")]
        cut = int(np.searchsorted(held.t_us, until_us))
        given, self._held = held[:cut], held[cut:]
        if until_us <= before_us:
            return Evidence.of([], [])
        self._settled_us = until_us
        start_us = self._from_us
        moved = replace(given, t_us=given.t_us - start_us)
        with _failures():
            given_back = self.detector.push(moved, until_us - start_us)
            found = checked(given_back, before_us - start_us, until_us - start_us)
        label, slipped = self._classes(found)
        t_us = found.t_us + start_us
        windows = self._windows(given, t_us.tolist())
        return Evidence(t_us, found.value, label, windows, slipped)

    def close(self) -> None:
        """See `Detector`."""
        self.detector.close()

    def _classes(self, found: Evidence) -> tuple[I8, F64 | None]:
        """Return the class of each evidence, and the share of slipped tips since the alarm."""
        slip = np.where(found.label == GROSS, GROSS, INCIPIENT)
        label = np.where(found.value > self.level, slip, NO_SLIP).astype(np.int8)
        if found.slipped is None:
            return label, None
        slipped = found.slipped.copy()
        for k, share in enumerate(slipped.tolist()):
            if label[k] != NO_SLIP:
                self._slipping = True
            elif math.isnan(share) or share == 0 < self._share:  # tips are followed a little later
                self._slipping = False
            self._share = share
            self._gross = share >= (STILL_GROSS if self._gross else ALL_SLIPPED)
            if self._slipping and share > 0:
                label[k] = GROSS if self._gross else INCIPIENT
            elif share > 0:
                slipped[k] = 0.0
        return label, slipped

    def _windows(self, given: EventChunk, ends_us: list[int]) -> tuple[JudgedWindow, ...]:
        """Return the spans between answers, and count the events of the one that is open."""
        made, begin = [], 0
        for end_us in ends_us:
            self._count(given, begin, end := int(np.searchsorted(given.t_us, end_us)))
            made.append(JudgedWindow(self._number, self._window_us, self._events, self._last_us))
            begin, self._window_us, self._number = end, end_us, self._number + 1
            self._events, self._last_us = 0, None
        self._count(given, begin, len(given))
        return tuple(made)

    def _count(self, given: EventChunk, begin: int, end: int) -> None:
        self._events += end - begin
        if end > begin:
            self._last_us = int(given.t_us[end - 1])


@contextmanager
def _failures() -> Iterator[None]:
    """Raise DetectorError for whatever another package's code raises, an exit, too."""
    try:
        yield
    except DetectorError:
        raise
    except (Exception, SystemExit) as error:
        raise DetectorError(f"{type(error).__name__}: {error}") from error
