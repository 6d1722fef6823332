"""Is this trial good enough to keep? Clocks fitted, losses counted, gates applied.

Runs on the sealed files of a trial that is not committed yet, so that a doubtful trial is taken
again while the rig still stands there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from sliplab.analysis.clocks.synchronise import TrialSync, streams_of, synchronise
from sliplab.analysis.labels.places import handed_over
from sliplab.analysis.labels.rest import offsets
from sliplab.flows.collecting.path_check import path_deviation_mm, speed_deviation_percent
from sliplab.protocols.conditions import Gates
from sliplab.protocols.settings import Labelling
from sliplab.protocols.timing import Timing
from sliplab.rigs.core.rig import TrialRun
from sliplab.storage.schema.trial import Clocks, Counts, Gate
from sliplab.storage.streams import I64, StepTimes
from sliplab.storage.trials.columns import TRACKS
from sliplab.storage.trials.hdf5 import StreamReader
from sliplab.storage.trials.writer import DATA

UNVOUCHED_S = 0.3
"""A recording may begin and end this much before and after the pulses on which a clock's fit
stands: the code may be silent for 16 ticks."""
BURST_US = 10_000
"""The stretch in which `gates.event_burst` counts events."""


@dataclass(frozen=True)
class Assessment:
    """Clock maps, gates and counts of one attempt."""

    clocks: Clocks
    gates: dict[str, Gate]
    counts: Counts

    @property
    def passed(self) -> bool:
        """Whether every gate is passed."""
        return all(gate.passed for gate in self.gates.values())

    @property
    def causes(self) -> str:
        """The failed gates in words."""
        failed = {name: gate for name, gate in self.gates.items() if not gate.passed}
        return "; ".join(_cause(name, gate) for name, gate in failed.items())


def _cause(name: str, gate: Gate) -> str:
    """Why one gate was not passed: its figure, or why there is none."""
    value, limit = gate.value, gate.limit
    if value is None or isinstance(value, str):  # why a clock was refused
        return f"{name}: {value}"
    return f"{name}: cannot be told" if value < 0 else f"{name} = {value} (limit {limit})"


def _gate(value: float, limit: float) -> Gate:
    """A gate with an upper limit; a negative figure is one that is unknown."""
    return Gate(value=value, limit=limit, passed=0 <= value <= limit)


def assess(
    folder: Path,
    run: TrialRun,
    gates: Gates,
    timing: Timing,
    rate_hz: int,
    mid_exposure_ns: int | None,
) -> Assessment:
    """Fit the clocks of a sealed trial and hold it against the protocol's gates.

    Args:
        timing: how the rig's devices are timed.
        mid_exposure_ns: from a frame's trigger to its time; None without a video.
    """
    with StreamReader(folder / DATA) as reader:
        streams = streams_of(reader, mid_exposure_ns)
        event_us = reader.event_times()
        pose_mm = reader.column("poses/xyz")
        tracks = [reader.column(name) for name in TRACKS if reader.has(name)]
    sync = synchronise(streams, timing, rate_hz)
    results = _sync_gates(sync, gates, run, mid_exposure_ns is not None)
    if mid_exposure_ns is not None:
        lost = _frames_lost(streams.frame_number, run, rate_hz)
        results["frames_lost"] = _gate(lost, gates.frames_lost)
    results["event_gap_s"] = _gate(_event_gap(event_us, sync, run), float(gates.event_gap))
    results["event_burst"] = _gate(_event_burst(event_us), gates.event_burst)
    if gates.hold_slip is not None and tracks:
        slip = _hold_slip_px(streams.frame_ns, tracks, sync, run)
        results["hold_slip_px"] = _gate(slip, float(gates.hold_slip))
    away = path_deviation_mm(streams.pose_ns, pose_mm, run.ways)
    results["path_deviation_mm"] = _gate(away, float(gates.path_deviation))
    off = speed_deviation_percent(streams.pose_ns, streams.pose_host_ns, pose_mm, run.ways)
    results["speed_deviation_percent"] = _gate(off, float(gates.speed_deviation))
    counts = Counts(
        events=len(event_us),
        frames=len(streams.frame_ns),
        poses=len(streams.pose_ns),
        pulses=len(streams.sync_pulses),
    )
    return Assessment(sync.record(), results, counts)


def _sync_gates(sync: TrialSync, gates: Gates, run: TrialRun, video: bool) -> dict[str, Gate]:
    """Every device has a clock map, good enough for its grade and for all of the recording."""
    limits = gates.sync_uncertainty
    results: dict[str, Gate] = {}
    for device in ("events", "arm", "frames")[: 3 if video else 2]:
        name = f"sync_uncertainty_{device}_s"
        known = sync.devices.get(device)
        if known is None:
            results[name] = Gate(value=sync.refused[device], limit=None, passed=False)
            continue
        grade = "digital input" if device == "events" else known.grade
        # a latency is a difference: both maps count
        both = sync.against_events_ns(device) if device != "events" else known.uncertainty_ns
        value = (known.uncertainty_ns if both is None else both) / 1e9
        limit = limits.limit_s(grade)
        results[name] = Gate(value=value, limit=limit, grade=known.grade, passed=value <= limit)
    results["sync_unvouched_s"] = _gate(_unvouched_s(sync, run), UNVOUCHED_S)
    return results


def _unvouched_s(sync: TrialSync, run: TrialRun) -> float:
    """How long, at either end, the recording goes on beyond the pulses of a clock's fit, s.

    -1 where the arm's clock is not known.
    """
    if "arm" not in sync.devices:
        return -1.0
    start, end = (int(sync.devices["arm"].map.to_reference(t)) for t in run.recorded_ns)
    beyond = 0
    for device in sync.devices.values():
        if device.fit is not None:
            first = device.map.to_reference(device.fit.first_ns)
            last = device.map.to_reference(device.fit.last_ns)
            beyond = max(beyond, first - start, end - last)
    return beyond / 1e9


def _frames_lost(numbers: I64, run: TrialRun, rate_hz: int) -> int:
    """Frames missing between the first and the last, and against the recorded time."""
    start, end = run.recorded_ns
    expected = int((end - start) / 1e9 * rate_hz)
    if not len(numbers):
        return expected
    gaps = int(numbers[-1]) + 1 - len(numbers)
    return max(gaps, expected - 1 - len(numbers), 0)


def _event_gap(event_us: I64, sync: TrialSync, run: TrialRun) -> float:
    """Longest silence of the event camera while the arm moved in contact, seconds.

    -1 when it cannot be told, because a clock has no map or there are no events.
    """
    if "events" not in sync.devices or "arm" not in sync.devices or not len(event_us):
        return -1.0
    moving = _moving(run)
    arm, events = (sync.devices[name].map for name in ("arm", "events"))
    start, end = (
        int(events.to_device(int(arm.to_reference(t)))) // 1000
        for t in (moving.start_ns, moving.end_ns)
    )
    inside = event_us[np.searchsorted(event_us, start) : np.searchsorted(event_us, end, "right")]
    edges = np.concatenate([[start], inside, [end]])
    return float(np.max(np.diff(edges))) / 1e6


def _moving(run: TrialRun) -> StepTimes:
    """The slide or the retraction."""
    return next(step for step, _ in run.steps if step.phase in {"slide", "retract"})


def _hold_slip_px(frame_ns: I64, tracks: list[Any], sync: TrialSync, run: TrialRun) -> float:
    """Largest distance that a marker moved in the recorded hold, px.

    -1 when it cannot be told, because a clock has no map or no marker was seen at both ends.

    Args:
        tracks: markers (n, m, 2), and perhaps the plate's marker (n, 2), px.
    """
    if "frames" not in sync.devices or "arm" not in sync.devices:
        return -1.0
    times = np.asarray(sync.devices["frames"].map.to_reference(frame_ns))
    start_ns = int(sync.devices["arm"].map.to_reference(_moving(run).start_ns))
    held = times < start_ns
    if not held.any():
        return -1.0
    markers, plate = (*(column[held].astype(np.float64) for column in tracks), None)[:2]
    places = handed_over(markers, plate)
    moved = offsets(places, times[held], start_ns, Labelling().reference_ms).hold_slip_px
    return float(np.nanmax(moved)) if np.isfinite(moved).any() else -1.0


@njit(cache=True, nogil=True)
def _event_burst(event_us):  # type: ignore[no-untyped-def]
    """Most events in any 10 ms that begin with an event."""
    most, end = 0, 0
    for begin in range(len(event_us)):
        while end < len(event_us) and event_us[end] < event_us[begin] + BURST_US:
            end += 1
        most = max(most, end - begin)
    return most
