"""Quality of a recorded trial: clocks fitted, losses counted, motion checked, gates applied.

Runs on the sealed files of a trial before it is committed, so that a bad trial is retaken
while the rig is still in place. The motion is checked from the stored poses, across the path and
along it, so the check is the same for every arm: it finds a controller that slows a move down and
still reports it as done.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.analysis.clocks.synchronise import (
    SyncStreams,
    TrialSync,
    clocks_in,
    streams_of,
    synchronise,
)
from sliplab.analysis.force import STREAM as FORCE
from sliplab.analysis.force import force_figures
from sliplab.analysis.labels.places import handed_over
from sliplab.analysis.labels.rest import offsets
from sliplab.protocols.gates import Gates
from sliplab.protocols.labelling import Labelling
from sliplab.protocols.timing import Timing
from sliplab.storage.kernels import njit
from sliplab.storage.schema.trial import Gate, StreamCounts, StreamRecord, TrialClockMaps
from sliplab.storage.streams import (
    EVENTS_KIND,
    F64,
    FRAMES_KIND,
    I64,
    SCALAR,
    WRENCH,
    Chunk,
    PathSegment,
    ScalarChunk,
    WrenchChunk,
)
from sliplab.storage.trials.checksums import DATA, stream_file
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import TRACKS
from sliplab.storage.trials.recording import Recording

Rows = tuple[tuple[float, float, float], ...]
UNVOUCHED_S = 0.3
"""A recording may begin and end this much before and after the pulses of a clock's fit: the code
may be silent for 16 ticks."""
BURST_US = 10_000
"""The interval in which `gates.event_burst` counts events."""
WINDOW_S = 0.5
"""The shortest interval over which a speed is measured, s."""
ARRIVAL_WINDOW_S = 1.0
"""The same where poses are timed by their arrival: a busy host reads some of them late."""
_SURE_EVENTS = 15.0
_PULSE_NS = 2_000_000
"""A device reports a pulse if it has one so near; ticks are 10 ms apart at 100 Hz."""
_WINDOW_POSES = 5
_NOISE = 0.01
"""Intervals are long enough that the poses' noise changes a speed by this share of it at most."""
_SETTLE_S, _ACCELERATION_MM_S2 = 0.1, 50.0
"""Ramps at either end of a segment, at most a quarter of it each; no speed is measured there."""


@dataclass(frozen=True)
class Motion:
    """The arm's motion in one trial, on its controller's clock.

    Attributes:
        recorded_ns: start and end of the recorded steps.
        moving_ns: start and end of the slide or the retraction, in which the sensor moves.
        path: commanded segments of the recorded steps.
    """

    recorded_ns: tuple[int, int]
    moving_ns: tuple[int, int]
    path: Sequence[PathSegment]


@dataclass(frozen=True)
class Assessment:
    """Clock maps, gates and counts of one attempt; `streams` has the named ones."""

    clocks: TrialClockMaps
    gates: dict[str, Gate]
    counts: StreamCounts
    streams: dict[str, StreamRecord] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """True where every gate is passed."""
        return all(gate.passed for gate in self.gates.values())

    @property
    def causes(self) -> str:
        """The failed gates with their figures, as one text."""
        failed = {name: gate for name, gate in self.gates.items() if not gate.passed}
        return "; ".join(_cause(name, gate) for name, gate in failed.items())


def _cause(name: str, gate: Gate) -> str:
    """Return why one gate was not passed: its figure, or why there is none."""
    value, limit = gate.value, gate.limit
    if value is None or isinstance(value, str):  # why a clock was refused
        return f"{name}: {value}"
    return f"{name}: cannot be told" if value < 0 else f"{name} = {value} (limit {limit})"


def _gate(value: float, limit: float) -> Gate:
    """Apply an upper limit; a negative figure is one that is unknown."""
    return Gate(value=value, limit=limit, passed=0 <= value <= limit)


def assess(
    folder: Path,
    motion: Motion,
    gates: Gates,
    timing: Timing,
    rate_hz: int,
    mid_exposure_ns: int | None,
    with_events: bool = True,
    to_plate: Rows | None = None,
    further: Mapping[str, StreamRecord] | None = None,
    frame_rate_hz: int | None = None,
) -> Assessment:
    """Fit the clocks of a sealed trial and apply the protocol's gates.

    Args:
        timing: how the rig's devices are timed.
        mid_exposure_ns: from a frame's trigger to its time; None without a video.
        with_events: events were recorded.
        to_plate: rows of the matrix from the force sensor's axes to the plate's, if there is one.
        further: what is known of the streams of further devices, by name.
        frame_rate_hz: of a frame camera that runs by itself; None for `rate_hz`, the box's ticks.
    """
    further = further or {}
    clocks = clocks_in(folder, further)
    with StreamReader(folder / DATA) as reader:
        streams = streams_of(reader, mid_exposure_ns, clocks)
        event_us = reader.event_times()
        pose_mm = reader.column("poses/xyz")
        tracks = [reader.column(name) for name in TRACKS if reader.has(name)]
        counted = reader.stream_counts()
        about = {
            name: StreamRecord(kind=kind, rows=0)
            for name, kind in reader.streams().items()
            if name not in further
        }
        if to_plate is not None and FORCE in about:
            about[FORCE] = StreamRecord(kind=WRENCH.name, rows=0, to_plate=to_plate)
        about |= further
        samples = {name: _read_samples(name, stream.kind, reader) for name, stream in about.items()}
    sync = synchronise(streams, timing, rate_hz, with_events=with_events)
    there = {"events": with_events, "arm": True, "frames": mid_exposure_ns is not None}
    devices = [*(name for name, recorded in there.items() if recorded), *sorted(sync.streams)]
    results = _sync_gates(sync, gates, timing, motion.recorded_ns, devices)
    if mid_exposure_ns is not None:
        lost = _frames_lost(streams.frame_number, motion.recorded_ns, frame_rate_hz or rate_hz)
        results["frames_lost"] = _gate(lost, gates.frames_lost)
    if with_events:
        gap_s = _event_gap(event_us, streams.event_pulses, "events", streams, sync, motion, gates)
        results["event_gap_s"] = _gate(gap_s, float(gates.event_gap))
        results["event_burst"] = _gate(_event_burst(event_us), gates.event_burst)
    if gates.hold_slip is not None and tracks:
        slip = _hold_slip_px(streams.frame_ns, tracks, sync, motion.moving_ns[0])
        results["hold_slip_px"] = _gate(slip, float(gates.hold_slip))
    away = path_deviation_mm(streams.pose_ns, pose_mm, motion.path)
    results["path_deviation_mm"] = _gate(away, float(gates.path_deviation))
    off = speed_deviation_percent(streams.pose_ns, streams.pose_host_ns, pose_mm, motion.path)
    results["speed_deviation_percent"] = _gate(off, float(gates.speed_deviation))
    named: dict[str, StreamRecord] = {}
    camera_gates: dict[str, Gate] = {}
    for name, stream in about.items():
        if stream.of_camera:
            with StreamReader(folder / stream_file(name)) as reader:
                named[name], gated = _further_camera(
                    name, stream, reader, streams, sync, motion, gates, rate_hz
                )
            camera_gates |= gated
        else:
            found: dict[str, Any] = {"rows": counted[name]["t"] if name in counted else 0}
            figures = _figures(name, stream, samples[name], sync, motion)
            named[name] = stream.model_copy(update=found | figures)
    results |= _force_gates(named[FORCE].figures if FORCE in named else {}, gates)
    results |= camera_gates
    counts = StreamCounts(
        events=len(event_us),
        frames=len(streams.frame_ns),
        poses=len(streams.pose_ns),
        pulses=len(streams.sync_pulses),
    )
    return Assessment(sync.record(), results, counts, named)


def _further_camera(
    name: str,
    about: StreamRecord,
    reader: StreamReader,
    streams: SyncStreams,
    sync: TrialSync,
    motion: Motion,
    gates: Gates,
    rate_hz: int,
) -> tuple[StreamRecord, dict[str, Gate]]:
    """Count what a further camera sent, and apply the gates of losses as to a first one."""
    if about.kind == EVENTS_KIND:
        event_us = reader.event_times()
        pulse_ns = reader.pulses("event_pulses")
        gap_s = _event_gap(event_us, pulse_ns, name, streams, sync, motion, gates)
        found = {
            f"event_gap_{name}_s": _gate(gap_s, float(gates.event_gap)),
            f"event_burst_{name}": _gate(_event_burst(event_us), gates.event_burst),
        }
        return about.model_copy(update={"rows": len(event_us), "pulses": len(pulse_ns)}), found
    numbers = reader.column(f"{FRAMES_KIND}/number")
    lost = _frames_lost(numbers, motion.recorded_ns, about.rate_hz or rate_hz)
    gate = _gate(lost, gates.frames_lost)
    return about.model_copy(update={"rows": len(numbers)}), {f"frames_lost_{name}": gate}


def _read_samples(name: str, kind: str, reader: StreamReader) -> Chunk | None:
    """Return the samples of a named stream, where they have figures."""
    if kind == WRENCH.name:
        return reader.wrenches(name)
    return reader.scalars(name) if kind == SCALAR.name else None


def _figures(
    name: str, about: StreamRecord, found: Chunk | None, sync: TrialSync, motion: Motion
) -> dict[str, dict[str, float]]:
    """Return the figures of a stream's samples as its record has them; empty without any."""
    if isinstance(found, WrenchChunk) and about.to_plate is not None:
        return {"figures": _force_figures(found, about.to_plate, sync, motion, name)}
    if not isinstance(found, ScalarChunk):
        return {}
    values = found.value
    known = (("mean", np.mean), ("min", np.min), ("max", np.max)) if len(values) else ()
    return {"figures": {key: float(f"{of(values):.7g}") for key, of in known}}


def _force_figures(
    wrenches: WrenchChunk, to_plate: Rows, sync: TrialSync, motion: Motion, name: str
) -> dict[str, float]:
    """Return the figures of a trial's forces on the plate; none where a clock is not known."""
    if name not in sync.devices or "arm" not in sync.devices:
        return {}
    on_box = np.asarray(sync.devices[name].map.to_reference(wrenches.t_ns))
    start, moving, end = (
        int(sync.devices["arm"].map.to_reference(t))
        for t in (motion.recorded_ns[0], motion.moving_ns[0], motion.moving_ns[1])
    )
    force = wrenches.force_n @ np.asarray(to_plate, np.float64).T
    return force_figures(on_box, force, (start, moving, end))


def _force_gates(figures: dict[str, float], gates: Gates) -> dict[str, Gate]:
    """Apply the protocol's gates of force; a figure that is not known passes none."""
    found = {}
    if gates.normal_force is not None:
        value = figures.get("normal_peak_n", -1.0)
        found["normal_force_n"] = _gate(value, float(gates.normal_force))
    if gates.hold_force is not None:
        value, limit = figures.get("normal_hold_n", -1.0), float(gates.hold_force)
        found["hold_force_n"] = Gate(value=value, limit=limit, passed=value >= limit)
    return found


def hold_rate(recording: Recording) -> float:
    """Return events per second while the arm held still in contact, recorded part."""
    start, end = recording.step("hold")
    return len(recording.events(start, end)) / ((end - start) / 1e9)


def _sync_gates(
    sync: TrialSync,
    gates: Gates,
    timing: Timing,
    recorded_ns: tuple[int, int],
    devices: Sequence[str],
) -> dict[str, Gate]:
    """Check that every device has a clock map, good for its grade and all of the recording."""
    results = {
        f"sync_uncertainty_{device}_s": sync_gate(device, sync, gates, timing) for device in devices
    }
    results["sync_unvouched_s"] = _gate(_unvouched_s(sync, recorded_ns), UNVOUCHED_S)
    return results


def gated_as(grade: str, timing: Timing) -> str:
    """Return the grade whose gate a clock has to pass."""
    return {"trigger input": "digital input", "arm clock": timing.arm}.get(grade, grade)


def sync_gate(device: str, sync: TrialSync, gates: Gates, timing: Timing) -> Gate:
    """Apply the protocol's gate of a device's grade to the uncertainty of its clock, s."""
    known = sync.devices.get(device)
    if known is None:
        return Gate(value=sync.refused[device], limit=None, passed=False)
    # a latency is a difference: the uncertainty of both maps enters, where there are events
    both = sync.against_events_ns(device) if device != "events" else known.uncertainty_ns
    value = (known.uncertainty_ns if both is None else both) / 1e9
    limit = gates.sync_uncertainty.limit_s(gated_as(known.grade, timing))
    return Gate(value=value, limit=limit, grade=known.grade, passed=value <= limit)


def _unvouched_s(sync: TrialSync, recorded_ns: tuple[int, int]) -> float:
    """Return how long the recording extends, at either end, beyond the pulses of a clock's fit, s.

    -1 where the arm's clock is not known.
    """
    if "arm" not in sync.devices:
        return -1.0
    start, end = (int(sync.devices["arm"].map.to_reference(t)) for t in recorded_ns)
    beyond = 0
    for device in sync.devices.values():
        if device.fit is not None:
            first = device.map.to_reference(device.fit.first_ns)
            last = device.map.to_reference(device.fit.last_ns)
            beyond = max(beyond, first - start, end - last)
    return beyond / 1e9


def _frames_lost(numbers: I64, recorded_ns: tuple[int, int], rate_hz: float) -> int:
    """Count frames missing between the first and the last, and against the recorded time."""
    start, end = recorded_ns
    expected = int((end - start) / 1e9 * rate_hz)
    if not len(numbers):
        return expected
    gaps = int(numbers[-1]) + 1 - len(numbers)
    return max(gaps, expected - 1 - len(numbers), 0)


def _event_gap(
    event_us: I64,
    pulse_ns: I64,
    camera: str,
    streams: SyncStreams,
    sync: TrialSync,
    motion: Motion,
    gates: Gates,
) -> float:
    """Return the longest silence of an event camera while the arm moved in contact, seconds.

    -1 when it is unknown, because a clock has no map or there are no events.

    Args:
        pulse_ns: sync pulses that the camera reported, on its clock.
    """
    if camera not in sync.devices or "arm" not in sync.devices or not len(event_us):
        return -1.0
    arm, events = (sync.devices[name].map for name in ("arm", camera))
    hold, start, end = (
        int(events.to_device(int(arm.to_reference(t)))) // 1000
        for t in (motion.recorded_ns[0], *motion.moving_ns)
    )
    sent_ns = np.asarray(events.to_device(streams.sync_pulses))
    return longest_silence_s(
        event_us, (hold, start, end), missing_pulses(sent_ns, pulse_ns), float(gates.event_gap)
    )


def missing_pulses(sent_ns: I64, reported_ns: I64) -> I64:
    """Return the pulses that a device does not report, of those sent to it, on its clock, ns."""
    if not len(reported_ns):
        return sent_ns
    reported = np.sort(reported_ns)
    after = np.clip(np.searchsorted(reported, sent_ns), 1, len(reported) - 1)
    nearest = np.minimum(abs(sent_ns - reported[after - 1]), abs(reported[after] - sent_ns))
    return sent_ns[nearest > _PULSE_NS]


def longest_silence_s(
    event_us: I64, hold_start_end_us: tuple[int, int, int], missing_ns: I64, limit_s: float
) -> float:
    """Return the longest silence of an event camera from a motion's start to its end, seconds.

    A quiet camera is silent for longer than the limit by itself. So a silence above the limit
    counts only if the camera should have sent something in it: a sync pulse that is missing, or
    at least 15 events at its rate in the hold, of which none comes with a probability of 3e-7.

    Args:
        event_us: (n,) times of events, ascending.
        hold_start_end_us: begin of the recorded hold, and start and end of the motion.
        missing_ns: (k,) sync pulses that the camera did not report.
        limit_s: longest silence that passes.
    """
    hold, start, end = hold_start_end_us
    held, first, last = np.searchsorted(event_us, (hold, start, end))
    rate_hz = (first - held) / max((start - hold) * 1e-6, 1e-6)
    edges = np.concatenate([[start], event_us[first:last], [end]])
    silence_s = np.diff(edges) / 1e6
    known = np.searchsorted(np.sort(missing_ns) // 1000, edges)
    lost = (silence_s * rate_hz >= _SURE_EVENTS) | (np.diff(known) > 0)
    counted = silence_s[(silence_s <= limit_s) | lost]
    return float(counted.max()) if len(counted) else 0.0


def _hold_slip_px(frame_ns: I64, tracks: list[Any], sync: TrialSync, moving_ns: int) -> float:
    """Return the largest distance that a marker moved in the recorded hold, px.

    -1 when it is unknown, because a clock has no map or no marker was seen at both ends.

    Args:
        tracks: markers (n, m, 2), and perhaps the plate's marker (n, 2), px.
        moving_ns: when the hold is over, on the arm's clock.
    """
    if "frames" not in sync.devices or "arm" not in sync.devices:
        return -1.0
    times = np.asarray(sync.devices["frames"].map.to_reference(frame_ns))
    start_ns = int(sync.devices["arm"].map.to_reference(moving_ns))
    held = times < start_ns
    if not held.any():
        return -1.0
    markers, plate = (*(column[held].astype(np.float64) for column in tracks), None)[:2]
    places = handed_over(markers, plate)
    moved = offsets(places, times[held], start_ns, Labelling().reference_ms).hold_slip_px
    return float(np.nanmax(moved)) if np.isfinite(moved).any() else -1.0


@njit(cache=True, nogil=True)
def _event_burst(event_us: I64) -> int:
    """Count the most events in any 10 ms that begin with an event."""
    most, end = 0, 0
    for begin in range(len(event_us)):
        while end < len(event_us) and event_us[end] < event_us[begin] + BURST_US:
            end += 1
        most = max(most, end - begin)
    return most


def path_deviation_mm(pose_ns: I64, pose_mm: F64, path: Sequence[PathSegment]) -> float:
    """Return the largest distance of the tool from its commanded path, mm, to a micrometre.

    Only across the path: along it an arm may be early or late while it accelerates. -1 without
    poses in some segment, or when the arm's clock cannot be trusted.
    """
    worst = 0.0
    for segment in path:
        if segment.end_ns <= segment.start_ns:
            continue
        inside = (pose_ns >= segment.start_ns) & (pose_ns <= segment.end_ns)
        if not inside.any():
            return -1.0
        begin = np.asarray(segment.begin_mm)
        along = np.asarray(segment.end_mm) - begin
        from_begin = pose_mm[inside] - begin
        length_2 = float(along @ along)
        share = np.zeros(len(from_begin)) if length_2 == 0 else from_begin @ along / length_2
        across: F64 = from_begin - np.clip(share, 0.0, 1.0)[:, None] * along
        worst = max(worst, float(np.max(np.linalg.norm(across, axis=1))))
    return round(worst, 3)


def speed_deviation_percent(
    pose_ns: I64, host_ns: I64, pose_mm: F64, path: Sequence[PathSegment]
) -> float:
    """Return the largest deviation of the speed along the path, percent, to a tenth.

    Measured in overlapping intervals of `WINDOW_S` or longer, as the noise of the poses demands,
    without the ramps at either end of a segment. -1 where it is unknown: too few poses, or a clock
    that cannot be trusted.

    Args:
        pose_ns: controller's time of every pose, (n,).
        host_ns: when each reached the host, (n,); equal to `pose_ns` where that is all there is.
        pose_mm: tool centre points in the arm's base frame, (n, 3).
    """
    worst = 0.0
    for segment in path:
        begin = np.asarray(segment.begin_mm)
        along = np.asarray(segment.end_mm) - begin
        length = float(np.linalg.norm(along))
        if length == 0.0:
            continue
        inside = (pose_ns >= segment.start_ns) & (pose_ns <= segment.end_ns)
        t_s = (pose_ns[inside] - segment.start_ns) / 1e9
        if len(t_s) < 2 or np.any(np.diff(t_s) < 0):
            return -1.0
        gone_mm = (pose_mm[inside] - begin) @ (along / length)
        part = _at_speed(gone_mm, length, segment.speed_mm_s)
        arrival = np.array_equal(pose_ns[inside], host_ns[inside])
        shortest_s = ARRIVAL_WINDOW_S if arrival else WINDOW_S
        speeds = _speeds(t_s[part], gone_mm[part], segment.speed_mm_s, shortest_s)
        if not len(speeds) or not np.all(np.isfinite(speeds)):
            return -1.0
        worst = max(worst, float(np.max(np.abs(speeds / segment.speed_mm_s - 1.0))))
    return round(100.0 * worst, 1)


def _at_speed(gone_mm: F64, length: float, speed: float) -> slice:
    """Return the poses of a segment without its ramps, and one more on either side."""
    edge = min(speed * _SETTLE_S + speed**2 / (2 * _ACCELERATION_MM_S2), length / 4)
    begun, not_over = gone_mm >= edge, gone_mm <= length - edge
    first = int(np.argmax(begun)) if begun.any() else len(gone_mm)
    last = len(gone_mm) - 1 - int(np.argmax(not_over[::-1]))
    return slice(max(first - 1, 0), last + 2)


def _speeds(t_s: F64, gone_mm: F64, speed: float, shortest_s: float) -> F64:
    """Return slopes of position over time in overlapping intervals, mm/s; empty without any."""
    seconds = float(t_s[-1] - t_s[0]) if len(t_s) > 1 else 0.0
    if seconds <= 0.0:
        return np.empty(0)
    rate = len(t_s) / seconds
    noise = _noise_mm(t_s, gone_mm) / (_NOISE * speed)
    # the slope of n points over T scatters by noise * sqrt(12 / n) / T, and n is rate * T
    shortest_s = max(shortest_s, float(np.cbrt(12 * noise**2 / rate)), _WINDOW_POSES / rate)
    intervals = max(1, int(seconds / shortest_s))
    width = seconds / intervals
    begins = np.linspace(t_s[0], t_s[-1] - width, 2 * intervals - 1)
    # it includes the poses before and after, so that no gap between poses is missed
    firsts = np.maximum(np.searchsorted(t_s, begins, "right") - 1, 0)
    ends = np.searchsorted(t_s, begins + width, "left") + 1
    slopes = [
        _slope(t_s[first:end], gone_mm[first:end])
        for first, end in zip(firsts.tolist(), ends.tolist(), strict=True)
    ]
    return np.array(slopes)


def _slope(t_s: F64, gone_mm: F64) -> float:
    """Return the least-squares slope through poses; infinite where all have one time."""
    from_middle = t_s - t_s.mean()
    spread = float(from_middle @ from_middle)
    return float(from_middle @ gone_mm) / spread if spread > 0.0 else np.inf


def _noise_mm(t_s: F64, gone_mm: F64) -> float:
    """Return the standard deviation of poses about the line between their neighbours, mm."""
    if len(t_s) < 3:
        return 0.0
    between = t_s[2:] - t_s[:-2]
    share = np.divide(t_s[1:-1] - t_s[:-2], between, np.full(len(between), 0.5), where=between > 0)
    off = gone_mm[1:-1] - ((1 - share) * gone_mm[:-2] + share * gone_mm[2:])
    return float(1.4826 * np.median(np.abs(off)) / np.sqrt(1.5))
