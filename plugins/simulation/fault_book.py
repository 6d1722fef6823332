"""The faults of a trial and their times, in one object that all simulated devices query.

Every fault has one true time, however the devices divide time into calls. Its effect is implemented
where it occurs: with the pulses, the clocks, the frames, the arm. Their kinds are declared
in `rigs/core/faults.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.skin import Skin
from sliplab.rigs.core.faults import (
    AnyFault,
    ArmProtectiveStop,
    ArmRamp,
    BaseFault,
    Device,
    DeviceGone,
    EventGap,
    EventStall,
    MainsLight,
    PapillaSticky,
    PapillaTorn,
    PlateSpot,
    SkinWear,
)

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
F = TypeVar("F", bound=BaseFault)

NEVER = 1 << 62
"""True time that no trial reaches, ns."""
_GRID_NS = 1_000_000
_RESOLUTION_NS = 1_000
_PM = 1e9
"""Picometres per millimetre; integer sums do not depend on how a path is divided."""


class FaultBook:
    """The faults of one trial, and those that have occurred.

    Attributes:
        recording_ns: true time at which the sync box first started; None until then.
    """

    def __init__(self, faults: Sequence[AnyFault], trial: int) -> None:
        # no faults before the first trial begins
        self._faults = [fault for fault in faults if trial and fault.trial in {None, trial}]
        self._happened: set[int] = set()
        self._travels: dict[int, _Travel] = {}
        self.recording_ns: int | None = None

    def of(self, *kinds: type[F], target: str | None = None) -> list[F]:
        """Return the trial's faults of some kinds, by kind; only those of `target` if given."""
        return [
            fault
            for kind in kinds
            for fault in self._faults
            if isinstance(fault, kind) and target in {None, fault.target}
        ]

    def due_ns(self, fault: BaseFault) -> int | None:
        """Return the true time of `fault`; None while its recording has not begun.

        A fault without a time is active from the trial's start.
        """
        since, at_s = getattr(fault, "since", "trial"), getattr(fault, "at_s", 0.0)
        origin = 0 if since == "trial" else self.recording_ns
        return None if origin is None else origin + round(at_s * 1e9)

    def spans(self, *kinds: type[F], target: str | None = None) -> list[tuple[F, int, int]]:
        """Return the faults as `of` does that have a known time, with true begin and end, ns.

        The end is `NEVER` for a permanent fault.
        """
        found = []
        for fault in self.of(*kinds, target=target):
            begin = self.due_ns(fault)
            if begin is not None:
                seconds = getattr(fault, "seconds", None)
                found.append((fault, begin, NEVER if seconds is None else begin + _ns(seconds)))
        return found

    def active(self, kind: type[F], now_ns: int, target: str | None = None) -> bool:
        """Return whether a fault of a kind lasts at a true time."""
        return any(begin <= now_ns < end for _, begin, end in self.spans(kind, target=target))

    # -- the arm ---------------------------------------------------------------------------

    def arm_halt(
        self, begin_ns: int, end_ns: int, places: Callable[[I64], F64]
    ) -> tuple[int, bool] | None:
        """Return the first stop of the arm by a fault in `begin_ns` to `end_ns`; one per fault.

        Args:
            places: maps true times (n,) to tool positions (n, 3), mm, on the known path.

        Returns:
            the true time, and True for a protective stop; an arm that is disconnected stops too,
            but may move again.
        """
        found: list[tuple[int, bool, int]] = []
        for index, fault in enumerate(self._faults):
            if index in self._happened:
                continue
            if isinstance(fault, ArmProtectiveStop):
                due = self._stop_due(index, fault, end_ns, places)
            elif isinstance(fault, DeviceGone) and fault.device == "arm":
                due = self.due_ns(fault)
            else:
                continue
            if due is not None and due <= end_ns:
                found.append((max(due, begin_ns), isinstance(fault, ArmProtectiveStop), index))
        if not found:
            return None
        at_ns, protective, _ = min(found, key=lambda item: (item[0], not item[1]))
        self._happened |= {index for due, _, index in found if due == at_ns}
        return at_ns, protective

    def _stop_due(
        self, index: int, fault: ArmProtectiveStop, end_ns: int, places: Callable[[I64], F64]
    ) -> int | None:
        if fault.at_mm is None:
            return self.due_ns(fault)
        origin = 0 if fault.since == "trial" else self.recording_ns
        if origin is None or end_ns <= origin:
            return None
        travel = self._travels.setdefault(index, _Travel(origin, fault.at_mm))
        return travel.reached_ns(end_ns, places)

    # -- the event camera ------------------------------------------------------------------

    def flicker(self) -> tuple[float, float, int] | None:
        """Return the light's amplitude over its mean, its frequency (Hz), and when it begins, ns.

        None if it is steady, or while its recording has not begun.
        """
        for light, begin, _ in self.spans(MainsLight):
            return light.share, light.hz, begin
        return None

    def gaps_ns(self) -> list[tuple[int, int]]:
        """Return the true intervals in which the event camera loses its data."""
        gaps = self.spans(EventGap) + self.spans(DeviceGone, target="event_camera")
        return [(begin, end) for _, begin, end in gaps]

    def sent_until_ns(self, now_ns: int) -> int:
        """Return the true time up to which the event camera has sent its data."""
        stalls = [begin for _, begin, end in self.spans(EventStall) if begin <= now_ns < end]
        return min(stalls, default=now_ns)

    # -- whole trials ----------------------------------------------------------------------

    def grips(self, skin: Skin, slid_mm: F64) -> Skin:
        """Return `skin` with the friction of papillae that are sticky or worn in this trial.

        Args:
            slid_mm: path of each tip in earlier trials, (n,).
        """
        sticky, wear = self.of(PapillaSticky), self.of(SkinWear)
        if not sticky and not wear:
            return skin
        friction = skin.friction_factor.copy()
        for fault in sticky:
            friction[fault.papilla] *= fault.factor
        for worn in wear:
            friction *= np.exp(worn.per_m * 1e-3 * slid_mm)
        return replace(skin, friction_factor=friction)

    def spots(self) -> F64:
        """Return the spots on the plate: x, y and radius in mm, factor of friction, (k, 4)."""
        rows = [[*spot.centre_mm, spot.radius_mm, spot.factor] for spot in self.of(PlateSpot)]
        return np.array(rows, np.float64).reshape(-1, 4)

    def ramp_mm_s2(self) -> float:
        """Return the arm's acceleration in contact; infinite for an arm without ramps."""
        return min((fault.mm_s2 for fault in self.of(ArmRamp)), default=math.inf)

    # -- the skin --------------------------------------------------------------------------

    def torn(self) -> list[tuple[int, int]]:
        """Return the papillae that tear off, and the true times, ns."""
        return [(fault.papilla, begin) for fault, begin, _ in self.spans(PapillaTorn)]

    # -- any device ------------------------------------------------------------------------

    def lost_power_ns(self, device: Device, since_ns: int) -> int:
        """Return the first power loss of `device` from `since_ns` on; `NEVER` if there is none."""
        times = [begin for _, begin, _ in self.spans(DeviceGone, target=device)]
        return min((begin for begin in times if begin >= since_ns), default=NEVER)


class _Travel:
    """Path length of the tool since a given time, on a fixed grid of true time."""

    def __init__(self, origin_ns: int, target_mm: float) -> None:
        self._cell_ns, self._travelled, self._target = origin_ns, 0, round(target_mm * _PM)

    def reached_ns(self, end_ns: int, places: Callable[[I64], F64]) -> int | None:
        """Return the time at which the target is reached; None if that is after `end_ns`."""
        first = self._cell_ns - self._cell_ns % _GRID_NS + _GRID_NS
        inner = np.arange(first, end_ns, _GRID_NS, dtype=np.int64)
        edges = np.concatenate([[self._cell_ns], inner, [end_ns]]).astype(np.int64)
        step_mm = np.linalg.norm(np.diff(places(edges), axis=0), axis=1)
        total = self._travelled + np.cumsum(np.rint(step_mm * _PM).astype(np.int64))
        over = np.flatnonzero(total >= self._target)
        if len(over):
            cell = int(over[0])
            before = self._travelled if cell == 0 else int(total[cell - 1])
            low, high = edges[cell : cell + 2].tolist()
            return _first_beyond(low, high, (self._target - before) / _PM, places)
        if len(inner):  # the last, partial cell is measured again from its start
            self._travelled, self._cell_ns = int(total[-2]), int(inner[-1])
        return None


def _first_beyond(
    low_ns: int, high_ns: int, distance_mm: float, places: Callable[[I64], F64]
) -> int:
    """Return the first time, to a microsecond, at which the tool is `distance_mm` from its start.

    Within a cell of the grid the path is practically straight, so bisection finds the time; it runs
    on a fixed grid, so that the result does not depend on where the cell was cut off.
    """
    origin, base = places(np.array([low_ns], np.int64))[0], low_ns
    steps_low, steps_high = 0, -(-(high_ns - low_ns) // _RESOLUTION_NS)
    while steps_high - steps_low > 1:
        middle = (steps_low + steps_high) // 2
        here = places(np.array([base + middle * _RESOLUTION_NS], np.int64))[0]
        if float(np.linalg.norm(here - origin)) >= distance_mm:
            steps_high = middle
        else:
            steps_low = middle
    return base + steps_high * _RESOLUTION_NS


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
