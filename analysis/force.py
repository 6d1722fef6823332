"""Forces on the plate from a recorded force sensor: normal and tangential, on the time line.

Axes are the plate's: x right, y up, z into the plate. A step of the force is dated by the moment at
which it is half over, between two samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sliplab.storage.errors import StoreError
from sliplab.storage.streams import F64, I64
from sliplab.storage.trials.recording import Recording

STREAM = "force"


@dataclass(frozen=True)
class PlateForces:
    """Forces on the plate in time order, n samples.

    Attributes:
        t_ns: time line, (n,) int64.
        force_n: x, y and normal (z) force on the plate, N, (n, 3).
        uncertainty_ns: of a moment against the events': both clocks, and half a sampling period.
        simulated: a mock rig made them.
    """

    t_ns: I64
    force_n: F64
    uncertainty_ns: float
    simulated: bool

    @property
    def normal_n(self) -> F64:
        """Normal force, positive where the sensor presses, (n,)."""
        normal: F64 = self.force_n[:, 2]
        return normal

    @property
    def tangential_n(self) -> F64:
        """Magnitude of the force along the plate, (n,)."""
        return np.hypot(self.force_n[:, 0], self.force_n[:, 1])

    def between(self, start_ns: int, end_ns: int) -> PlateForces:
        """The samples from one moment of the time line to another, both included."""
        part = slice(
            int(np.searchsorted(self.t_ns, start_ns, "left")),
            int(np.searchsorted(self.t_ns, end_ns, "right")),
        )
        return PlateForces(self.t_ns[part], self.force_n[part], self.uncertainty_ns, self.simulated)


def has_forces(recording: Recording, name: str = STREAM) -> bool:
    """Return whether a trial has forces that are known on the plate and on the time line."""
    stream = recording.record.streams.get(name)
    known = stream is not None and stream.to_plate is not None and stream.rows > 1
    return known and name in recording.clocks.devices()


def plate_forces(recording: Recording, name: str = STREAM) -> PlateForces:
    """Read a trial's forces on the plate.

    Raises:
        StoreError: it has none, or neither their axes nor their clock are known.
    """
    found = recording.wrenches(name)
    rows = recording.record.streams[name].to_plate
    if rows is None:
        raise StoreError(f"{recording.folder}: streams.{name}.to_plate: the axes are unknown")
    clock = recording.clock(name)
    both = recording.clocks.against_events_ns(name)
    period = float(np.median(np.diff(found.t_ns))) if len(found) > 1 else 0.0
    return PlateForces(
        np.asarray(clock.to_reference(found.t_ns)),
        found.force_n @ np.asarray(rows, np.float64).T,
        float("nan") if both is None else both + period / 2,
        recording.simulated,
    )


MEAN_NS = 10_000_000
"""Peaks are those of means over this long: one sample's noise is no peak."""
_IN_CONTACT = 0.1
"""Share of the hold's normal force below which no friction is computed."""


def sliding_friction(recording: Recording) -> float:
    """Return friction force over normal force in the last quarter of a slide.

    Raises:
        KeyError: the trial has no slide.
        StoreError: it has no forces on the plate.
    """
    start, end = recording.step("slide")
    mean = plate_forces(recording).between(end - (end - start) // 4, end).force_n.mean(axis=0)
    return float(np.hypot(mean[0], mean[1]) / mean[2])


def force_figures(t_ns: I64, force_n: F64, edges_ns: tuple[int, int, int]) -> dict[str, float]:
    """Return the figures of a trial's forces that are known, N, to a tenth of a millinewton.

    Args:
        t_ns: times on the time line, (n,).
        force_n: forces on the plate, (n, 3).
        edges_ns: start of the recording, start of the slide or retraction, and its end.

    Returns:
        ``normal_peak_n``, the largest normal force in the recording; ``normal_hold_n``, its mean in
        the hold; ``tangential_peak_n``, the largest tangential force in the motion; and
        ``friction_peak``, the largest ratio of the two there.
    """
    start, moving, end = edges_ns
    found: dict[str, float] = {}
    recorded = (t_ns >= start) & (t_ns <= end)
    if np.count_nonzero(recorded) < 2:
        return found
    period = max(float(np.median(np.diff(t_ns[recorded]))), 1.0)
    t_ns, force = t_ns[recorded], moving_mean(force_n[recorded], max(1, round(MEAN_NS / period)))
    normal, tangential = force[:, 2], np.hypot(force[:, 0], force[:, 1])
    found["normal_peak_n"] = float(normal.max())
    held, moves = t_ns < moving, t_ns >= moving
    if held.any():
        found["normal_hold_n"] = float(normal[held].mean())
    if moves.any():
        found["tangential_peak_n"] = float(tangential[moves].max())
        pressed = moves & (normal > _IN_CONTACT * max(found.get("normal_hold_n", 0.0), 0.0))
        pressed &= normal > 0
        if pressed.any():
            found["friction_peak"] = float((tangential[pressed] / normal[pressed]).max())
    return {name: round(value, 4) for name, value in found.items()}


def moving_mean(values: F64, width: int) -> F64:
    """Return means of so many neighbouring rows, shorter at both ends; the shape stays."""
    if width < 2 or len(values) < 2:
        return values
    total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    low = np.maximum(np.arange(len(values)) - width // 2, 0)
    high = np.minimum(np.arange(len(values)) + (width + 1) // 2, len(values))
    counts = (high - low).reshape(-1, *(1 for _ in values.shape[1:]))
    means: F64 = (total[high] - total[low]) / counts
    return means


def step_ns(t_ns: I64, values: F64, half_width: int = 10) -> int:
    """Return the moment at which the largest step of a signal is half over, ns.

    Args:
        t_ns: times of the samples, (n,) int64.
        values: (n,).
        half_width: samples on either side of a step whose means are compared.

    Raises:
        ValueError: there are fewer than 2 `half_width` + 2 samples.
    """
    if len(values) < 2 * half_width + 2:
        raise ValueError(f"{len(values)} samples; at least {2 * half_width + 2} are needed")
    total = np.concatenate([[0.0], np.cumsum(values)])
    mean = (total[half_width:] - total[:-half_width]) / half_width
    # the sample between the two sides may be of either
    rise = mean[half_width + 1 :] - mean[: -half_width - 1]
    first = int(np.argmax(np.abs(rise)))
    before, after = mean[first], mean[first + half_width + 1]
    begin = first + half_width - 2
    part = values[begin : begin + 5]
    beyond = (part - (before + after) / 2) * np.sign(after - before) >= 0
    k = int(np.argmax(beyond)) if beyond.any() else len(part) - 1
    if k == 0 or not beyond.any():
        return int(t_ns[begin + k])
    low, high = part[k - 1], part[k]
    share = ((before + after) / 2 - low) / (high - low)
    step = int(t_ns[begin + k] - t_ns[begin + k - 1])
    return int(t_ns[begin + k - 1]) + round(float(np.clip(share, 0.0, 1.0)) * step)
