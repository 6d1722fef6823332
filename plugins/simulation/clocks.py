"""The simulated devices' clocks: each has its own offset and a slightly different rate.

True time is the virtual time of the simulation, in integer nanoseconds since the trial began. Only
simulated devices know it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.fault_book import FaultBook
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.settings import ClockErrors
from sliplab.rigs.core.faults import ClockDrift, ClockJump, ClockRestart, Device
from sliplab.storage.clockmap import ClockMap

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
HOUR_NS = 3_600_000_000_000
JITTER_BLOCK = 4096
_CLOCK_FAULTS: tuple[type[ClockDrift | ClockJump | ClockRestart], ...] = (
    ClockDrift,
    ClockJump,
    ClockRestart,
)


@dataclass(frozen=True)
class ClockMaps:
    """Maps from true time to device time for one trial, ns."""

    arm: ClockMap
    event_camera: ClockMap
    frame_camera: ClockMap
    sync_box_ppb: int
    """Drift of the sync box, which counts from its own start and has no offset."""

    def after(self, past_ns: int) -> ClockMaps:
        """Return the same clocks with the true time `past_ns` as time 0."""
        return replace(
            self,
            arm=shifted(self.arm, past_ns),
            event_camera=shifted(self.event_camera, past_ns),
            frame_camera=shifted(self.frame_camera, past_ns),
        )


def shifted(clock: ClockMap, past_ns: int) -> ClockMap:
    """Return `clock` with the time `past_ns` as time 0."""
    return ClockMap(
        tuple(time - past_ns for time in clock.device_ns), clock.reference_ns, clock.drift
    )


def trial_clocks(settings: ClockErrors, rig_seed: int, trial_seed: int) -> ClockMaps:
    """Draw a trial's clocks: drifts from the rig's seed, offsets from the trial's."""
    drift = generator(rig_seed, "clock drift").uniform(-1.0, 1.0, 4)
    longest = int(settings.offset_h * HOUR_NS)
    offset = generator(trial_seed, "clock offset").integers(0, longest, 3, endpoint=True)
    largest = (settings.arm_ppm, settings.event_camera_ppm, settings.frame_camera_ppm)
    arm, events, frames = (
        ClockMap.line(0, int(start), round(share * ppm * 1000))
        for start, share, ppm in zip(offset, drift, largest, strict=False)
    )
    return ClockMaps(arm, events, frames, round(drift[3] * settings.sync_box_ppm * 1000))


def own_clock(
    settings: ClockErrors, ppm: float, name: str, rig_seed: int, trial_seed: int
) -> ClockMap:
    """Draw the clock of a further device by its name, as `trial_clocks` does those of the first."""
    drift = float(generator(rig_seed, f"clock drift of {name}").uniform(-1.0, 1.0))
    longest = int(settings.offset_h * HOUR_NS)
    offset = generator(trial_seed, f"clock offset of {name}").integers(0, longest, endpoint=True)
    return ClockMap.line(0, int(offset), round(drift * ppm * 1000))


@dataclass(frozen=True)
class FaultyClock(ClockMap):
    """Map from true to device time of a clock with additional drift, jumps or restarts.

    The superclass is the undisturbed clock, which times the device's cycles.
    """

    device: Device
    faults: FaultBook

    @overload
    def to_reference(self, times: int) -> int: ...
    @overload
    def to_reference(self, times: npt.NDArray[np.integer[Any]]) -> I64: ...
    def to_reference(self, times: int | npt.NDArray[np.integer[Any]]) -> int | I64:
        """Return the clock's readings at true times, ns: an int or an int64 array of any shape.

        Raises:
            TypeError, OverflowError: as the undisturbed map.
        """
        shown = super().to_reference(times)
        gained = self._drifted_ns(np.asarray(times, np.int64))
        gained += self.jumped_ns(np.asarray(times, np.int64))
        return shown + int(gained) if isinstance(shown, int) else shown + gained

    @overload
    def to_device(self, times: int) -> int: ...
    @overload
    def to_device(self, times: npt.NDArray[np.integer[Any]]) -> I64: ...
    def to_device(self, times: int | npt.NDArray[np.integer[Any]]) -> int | I64:
        """Return the first true time, to the ns, at which the clock shows at least `times`.

        A clock that jumps back shows some times twice; one that jumps forward skips some. A time
        within the trial is preferred to one before it.
        """
        if not isinstance(times, int | np.integer):
            flat = [self._first(int(t)) for t in np.asarray(times).ravel()]
            return np.array(flat, np.int64).reshape(np.shape(times))
        return self._first(int(times))

    def jumped_ns(self, true_ns: I64) -> I64:
        """Return the accumulated jumps at true times, ns, shape of `true_ns`."""
        gained = np.zeros(true_ns.shape, np.int64)
        for due, jump_ns in self._jumps():
            gained += np.where(true_ns >= due, jump_ns, 0)
        return gained

    def _drifted_ns(self, true_ns: I64) -> I64:
        """Return the gain of the clock by additional drift at true times, ns."""
        gained = np.zeros(true_ns.shape, np.int64)
        for fault, due in self._drifts():
            since = np.maximum(true_ns - due, 0)
            gained += ClockMap.line(0, 0, round(fault.ppm * 1000)).to_reference(since) - since
        return gained

    def cycle_ns(self, true_ns: I64) -> I64:
        """Return the true times of the cycles that an undisturbed clock has at `true_ns`.

        A fast clock reaches them earlier. Jumps change a clock's reading, not its rate.
        """
        result = true_ns
        for fault, due in self._drifts():
            after = ClockMap.line(due, due, round(fault.ppm * 1000)).to_device(result)
            result = np.where(result > due, after, result)
        return result

    def pace_ns(self, true_ns: I64) -> I64:
        """Return the true times at which an undisturbed clock has the cycles of `true_ns`.

        The inverse of `cycle_ns`.
        """
        result = true_ns
        for fault, due in reversed(self._drifts()):
            before = ClockMap.line(due, due, round(fault.ppm * 1000)).to_reference(result)
            result = np.where(result > due, before, result)
        return result

    def _drifts(self) -> list[tuple[ClockDrift, int]]:
        spans = self.faults.spans(ClockDrift, target=self.device)
        return [(fault, due) for fault, due, _ in spans]

    def _jumps(self) -> list[tuple[int, int]]:
        """Return the true times of the jumps, increasing, and their sizes, ns."""
        mine = self.faults.spans(ClockJump, ClockRestart, target=self.device)
        jumps: list[tuple[int, int]] = []
        total = 0
        for fault, due, _ in sorted(mine, key=lambda item: item[1]):
            if isinstance(fault, ClockJump):
                jump_ns = round(fault.seconds * 1e9)
            else:
                before = super().to_reference(due) + int(self._drifted_ns(np.array(due, np.int64)))
                jump_ns = -(before + total)
            total += jump_ns
            jumps.append((due, jump_ns))
        return jumps

    def _first(self, shown: int) -> int:
        dues = sorted({due for due, _ in self._jumps()})
        # a clock restarted at 0 repeats readings from long before the trial
        for low, high in zip([0, *dues], [*dues, 1 << 61], strict=True):
            if low < high and self.to_reference(low) <= shown <= self.to_reference(high - 1):
                return self._bisect(shown, low, high)
        low = -(1 << 61)
        for high in [*dues, 1 << 61]:
            if self.to_reference(high - 1) >= shown:
                return self._bisect(shown, low, high)
            low = high
        raise OverflowError(f"the clock never shows {shown} ns")

    def _bisect(self, shown: int, low: int, high: int) -> int:
        """Return the first time in `low` to `high` at which the clock shows at least `shown`.

        Between jumps the clock is monotonic, so bisection finds the time.
        """
        while low < high - 1:
            middle = (low + high - 1) // 2
            if self.to_reference(middle) >= shown:
                high = middle + 1
            else:
                low = middle + 1
        return low


def with_faults(clocks: ClockMaps, faults: FaultBook) -> ClockMaps:
    """Return the clocks with the trial's clock faults applied."""
    if not faults.of(*_CLOCK_FAULTS):
        return clocks
    return replace(
        clocks,
        arm=faulty(clocks.arm, "arm", faults),
        event_camera=faulty(clocks.event_camera, "event_camera", faults),
        frame_camera=faulty(clocks.frame_camera, "frame_camera", faults),
    )


def faulty(clock: ClockMap, device: Device, faults: FaultBook) -> ClockMap:
    """Return `clock` with the trial's faults applied."""
    if not faults.of(*_CLOCK_FAULTS, target=device):
        return clock
    return FaultyClock(clock.device_ns, clock.reference_ns, clock.drift, device, faults)


def undisturbed(clock: ClockMap) -> ClockMap:
    """Return `clock` without its faults, which times the device's cycles."""
    if type(clock) is ClockMap:
        return clock
    return ClockMap(clock.device_ns, clock.reference_ns, clock.drift)


class HighestStamp:
    """Makes the time stamps of a stream non-decreasing.

    Every consumer of event streams relies on this. Until a clock that jumped back has caught up,
    events keep their order and carry the highest stamp so far; the sync pulses show the jump, so
    such a trial is not accepted.
    """

    def __init__(self) -> None:
        self._highest = -(1 << 62)

    def of(self, stamps: I64) -> I64:
        """Return stamps (n,) that do not decrease, also from one call to the next."""
        if len(stamps):
            stamps = np.maximum(np.maximum.accumulate(stamps), self._highest)
            self._highest = int(stamps[-1])
        return stamps


class Noise:
    """Normal random numbers of numbered instants, independent of how they are requested."""

    def __init__(self, seed: int, purpose: str, width: int) -> None:
        self._seed, self._purpose, self._width = seed, purpose, width
        self._blocks: dict[int, F64] = {}

    def of(self, numbers: I64) -> F64:
        """Standard normal, clipped at four, for instants `numbers` (not negative), (n, width)."""
        if not len(numbers):
            return np.empty((0, self._width))
        first, last = int(numbers.min()) // JITTER_BLOCK, int(numbers.max()) // JITTER_BLOCK
        if first == last:
            # indexing by an array makes a copy
            return self._block(first)[numbers - first * JITTER_BLOCK]
        result = np.empty((len(numbers), self._width))
        block, inside = np.divmod(numbers, JITTER_BLOCK)
        for index in range(first, last + 1):
            here = block == index
            result[here] = self._block(index)[inside[here]]
        return result

    def _block(self, index: int) -> F64:
        if index not in self._blocks:
            if len(self._blocks) > 1:
                self._blocks.pop(min(self._blocks))
            rng = generator(self._seed, self._purpose, index)
            draw = rng.standard_normal((JITTER_BLOCK, self._width))
            self._blocks[index] = np.clip(draw, -4.0, 4.0)
        return self._blocks[index]


class Jitter:
    """Random offsets of numbered instants."""

    def __init__(self, seed: int, purpose: str, sigma_us: float) -> None:
        self._noise, self._sigma_ns = Noise(seed, purpose, 1), sigma_us * 1000

    def ns(self, numbers: I64) -> I64:
        """Offsets of the instants `numbers` (not negative), clipped at four sigma, (n,)."""
        if self._sigma_ns == 0.0:
            return np.zeros(len(numbers), np.int64)
        return np.rint(self._noise.of(numbers)[:, 0] * self._sigma_ns).astype(np.int64)


class Lateness:
    """Delays of messages beyond the shortest one: half-normal, clipped at four sigma."""

    def __init__(self, seed: int, purpose: str, longest_us: float) -> None:
        self._jitter = Jitter(seed, purpose, longest_us / 4)

    def ns(self, numbers: I64) -> I64:
        """Delays of the messages `numbers` (not negative), 0 to the longest, shape (n,)."""
        return np.abs(self._jitter.ns(numbers))
