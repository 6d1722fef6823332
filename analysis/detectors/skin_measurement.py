"""What a hold, an unload and short rubs tell the detector by papillae about a skin.

The level is the largest evidence without slip, and at least the detector's own. A level above all
evidence of a hold of T hours lets more than 3.69 / T false alarms an hour through in 2.5 % of holds
at most: the largest value that a Poisson process leaves above itself is exponential.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.alarms import BOUND_OF_NONE
from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.live import LiveDecision, LiveDetector
from sliplab.analysis.detectors.papillae import (
    FEWEST_PLACES,
    LEAST,
    NOISE_DEVIATIONS,
    SEEN_MS,
    Papillae,
    PapillaeSettings,
)
from sliplab.storage.schema.detector import PapillaPlace, Rub
from sliplab.storage.schema.evaluation import AlarmRate
from sliplab.storage.streams import EVENTS_KIND, Chunk, EventChunk, NullSink

NOISE, HOLD, UNLOAD, RUB = "noise", "hold", "unload", "slide"
"""Phases that say something; the first three in this order."""
FEWEST = 3
"""Places of the smallest skin that can be compared with each other."""
HOT_EVENTS = 5
"""Of a cell at rest beyond noise: more than chance gives any of 4,800."""
PART_US = 10_000
"""Events evaluated at once."""
US_PER_HOUR = 3_600_000_000


class SkinError(ValueError):
    """The recording does not show what the detector needs; the text says what would help."""


def fewest_places(papillae: int) -> int:
    """Return how many places must move at once on a skin of so many papillae.

    Half of them, and at most `FEWEST_PLACES`.
    """
    return min(FEWEST_PLACES, max(FEWEST, -(-papillae // 2)))


@dataclass
class _Rubbed:
    """A rub so far; times of decisions on the camera's clock.

    Attributes:
        places: the last ones before the first evidence. most: of them at once.
    """

    begin_us: int | None = None
    t_us: list[int] = field(default_factory=list)
    value: list[float] = field(default_factory=list)
    places: tuple[PapillaPlace, ...] = ()
    most: int = 0


@dataclass(frozen=True)
class MeasuredSkin:
    """Results of `SkinMeasurement`, by the names of `storage.schema.detector`."""

    settings: PapillaeSettings
    cell_px: int
    noise_hz: float
    places: tuple[PapillaPlace, ...]
    level: float
    hold: AlarmRate
    hold_largest: float
    unload_largest: float
    rubs: tuple[Rub, ...]


class SkinMeasurement(NullSink):
    """A sink that evaluates the events of the motion while it is made.

    Args:
        width, height: of the event camera, pixels.
        papillae: of the skin.
    """

    def __init__(self, width: int, height: int, papillae: int) -> None:
        self._size = width, height
        self._papillae = Papillae(
            PapillaeSettings((width, height), fewest_places=fewest_places(papillae))
        )
        self._papillae.begin(width, height)
        cells = len(self._papillae.place_of_cells)
        self._at_rest: npt.NDArray[np.int64] = np.zeros(cells, np.int64)
        self._rest_us: list[int] = []
        self._live: LiveDetector | None = None
        self._phase = ""
        self._held_us = 0
        self._largest = {HOLD: 0.0, UNLOAD: 0.0}
        self._rubs: list[_Rubbed] = []

    def step(self, phase: str) -> None:
        """Note that a step of the motion begins; its events come from now on."""
        if phase == HOLD and self._live is None:
            self._papillae.settings = replace(self._papillae.settings, hot=self._hot())
            self._live = LiveDetector(
                AtLevel(self._papillae, LEAST), width=self._size[0], height=self._size[1]
            )
        if phase == RUB:
            self._rubs.append(_Rubbed())
        self._phase = phase

    def add(self, device: str, chunk: Chunk) -> None:
        """Take events. Raises ClockFellBack, ValueError: as `LiveDetector.push`."""
        if device != EVENTS_KIND or not isinstance(chunk, EventChunk) or not len(chunk):
            return
        if self._live is None:
            cell_px, columns = self._papillae.cell_px, self._papillae.columns
            cell = (chunk.y // cell_px).astype(np.int64) * columns + chunk.x // cell_px
            self._at_rest += np.bincount(cell, minlength=len(self._at_rest))
            self._rest_us += [int(chunk.t_us.min()), int(chunk.t_us.max())]
            return
        events = chunk[np.argsort(chunk.t_us, kind="stable")]
        # in short parts, so that places are those just before the slip, however late a read is
        edges = np.arange(int(events.t_us[0]) + PART_US, int(events.t_us[-1]), PART_US)
        for part in np.split(np.arange(len(events)), np.searchsorted(events.t_us, edges)):
            self._take(self._live.push(events[part]))

    def _take(self, made: Sequence[LiveDecision]) -> None:
        if not made:
            return
        largest = max(decision.value for decision in made)
        if self._phase in self._largest:
            self._largest[self._phase] = max(self._largest[self._phase], largest)
        if self._phase == HOLD:
            self._held_us += sum(decision.end_us - decision.start_us for decision in made)
        if self._phase == RUB:
            rub = self._rubs[-1]
            rub.begin_us = made[0].start_us if rub.begin_us is None else rub.begin_us
            if not max(rub.value, default=0.0) > 0:
                rub.places = self._places() or rub.places
                rub.most = max(rub.most, len(rub.places))
            rub.t_us += [decision.end_us for decision in made]
            rub.value += [decision.value for decision in made]

    def result(self, directions_deg: Sequence[float]) -> MeasuredSkin:
        """Return what was found.

        Args:
            directions_deg: of the rubs, in their order.

        Raises:
            SkinError: the hold was not seen, too few papillae moved in a rub, or no rub was
                detected.
        """
        if self._live is None or not self._held_us:
            raise SkinError("no events came while the arm held still: check the camera's biases")
        if self._live.losses.gaps:
            gap_s = self._live.losses.longest_gap_us / 1e6
            raise SkinError(f"no events came for {gap_s:.1f} s: check the camera and its cable")
        level = max(LEAST, *self._largest.values())
        fewest = self._papillae.settings.fewest_places
        rubs = tuple(
            _rub(direction, rubbed, level)
            for direction, rubbed in zip(directions_deg, self._rubs, strict=True)
        )
        for number, rub in enumerate(rubs, 1):
            if rub.places < fewest:
                raise SkinError(
                    f"{rub.places} places moved at once in rub {number}, at least {fewest} are "
                    "needed: press deeper (--depth), rub faster (--speed), or focus the camera"
                )
        if all(rub.alarm_ms is None for rub in rubs):
            raise SkinError(
                f"no rub has evidence above {level:.3g}, which hold and unload reach: rub faster "
                "(--speed), or press less (--depth), so that tips slide"
            )
        hours = self._held_us / US_PER_HOUR
        hold = AlarmRate(
            alarms=0, hours=hours, value=0.0, low=0.0, high=BOUND_OF_NONE / hours, clusters=1
        )
        return MeasuredSkin(
            settings=self._papillae.settings,
            cell_px=self._papillae.cell_px,
            noise_hz=float(np.median(self._at_rest)) / self._rest_s,
            places=max(
                (
                    rubbed.places
                    for rubbed, rub in zip(self._rubs, rubs, strict=True)
                    if rub.alarm_ms is not None
                ),
                key=len,
            ),
            level=level,
            hold=hold,
            hold_largest=self._largest[HOLD],
            unload_largest=self._largest[UNLOAD],
            rubs=rubs,
        )

    @property
    def _rest_s(self) -> float:
        span_us = max(self._rest_us) - min(self._rest_us) if self._rest_us else 0
        return max(span_us, 1) / 1e6

    def _hot(self) -> tuple[int, ...]:
        noise = float(np.median(self._at_rest))
        # a cell is hot by its rate, however long the rest was
        most = max(noise, 1.0) + 2 * NOISE_DEVIATIONS * np.sqrt(max(noise, 1.0)) + HOT_EVENTS
        return tuple(np.flatnonzero(self._at_rest > most).tolist())

    def _places(self) -> tuple[PapillaPlace, ...]:
        """Return the present places with their rates."""
        place, events = self._papillae.place_of_cells, self._papillae.recent_events
        columns, side = self._papillae.columns, self._papillae.cell_px
        found = []
        for number in range(int(place.max(initial=-1)) + 1):
            cells = np.flatnonzero(place == number)
            found.append(
                PapillaPlace(
                    x_px=round(float((cells % columns).mean() + 0.5) * side, 1),
                    y_px=round(float((cells // columns).mean() + 0.5) * side, 1),
                    cells=len(cells),
                    rate_hz=round(float(events[cells].sum()) * 1000 / SEEN_MS, 1),
                )
            )
        return tuple(found)


def _rub(direction_deg: float, rubbed: _Rubbed, level: float) -> Rub:
    above = [t for t, value in zip(rubbed.t_us, rubbed.value, strict=True) if value > level]
    alarm_ms = None
    if above and rubbed.begin_us is not None:
        alarm_ms = (above[0] - rubbed.begin_us) / 1000
    return Rub(
        direction_deg=direction_deg,
        places=rubbed.most,
        largest=max(rubbed.value, default=0.0),
        alarm_ms=alarm_ms,
    )
