"""All clocks of one trial on one time line, each by the best means that its rig has.

The reference is the sync box's clock. A device on the wire is fitted to the box's pulses; one that
is not is bounded by what the host knows: when it read a clock, when a message arrived. How a device
was timed is its grade, and it goes wherever the result goes (docs/clocks.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.clocks.clock_bounds import (
    MIN_PAIRS,
    BoundedClock,
    BoundsContradictError,
    fit_bounds,
    fit_messages,
)
from sliplab.analysis.clocks.clocks import (
    UNDISTURBED,
    ClockFit,
    ClockRefused,
    fit_clock,
    fit_numbered,
)
from sliplab.protocols.shown import plural
from sliplab.protocols.timing import (
    WIRED,
    Delay,
    DeviceClock,
    ForceTiming,
    StreamGrade,
    StreamTiming,
    Timing,
)
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.trial import DeviceRecord, StreamRecord, TrialClockMaps
from sliplab.storage.streams import EVENTS_KIND, WRENCH, ClockReads
from sliplab.storage.trials.checksums import DATA, stream_file
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import STREAM_GROUP
from sliplab.storage.trials.recording import Recording

I64 = npt.NDArray[np.int64]
FitBounds = Callable[[I64, I64, I64, float], BoundedClock]

VERSION = 7
"""Version of the fit; results of another version are stale."""
HOST_PPM = 200.0
RESTART_NS = 1_000_000
"""A clock that falls back by more than this restarted or jumped."""
_NONE: I64 = np.empty(0, np.int64)


@dataclass(frozen=True)
class ClockInput:
    """Raw clock data of a device with a stream, ns; empty where there are none.

    Attributes:
        timing: how it is timed; None for the first force sensor, which the rig's timing times.
        pulses: sync pulses on the device's clock; of a frame camera the starts of the exposures
            during which the sync line was high.
        reads: the device's clock as the host read it.
        mid_exposure_ns: of a frame camera: from the start of an exposure to its middle.
        samples: of a sensor: its own and the host's time of each sample.
    """

    timing: StreamTiming | None
    pulses: I64 = field(default_factory=lambda: _NONE)
    reads: ClockReads = field(default_factory=ClockReads.empty)
    mid_exposure_ns: int = 0
    samples: tuple[I64, I64] = _NONE, _NONE


@dataclass(frozen=True)
class SyncStreams:
    """Raw clock data of a trial, ns; empty where there are none.

    Attributes:
        sync_pulses: pulses on the box's clock; event_pulses, arm_pulses: on the devices'.
        exposures: starts of exposures, as the box stamped them.
        frame_ns, frame_number, frame_sync: middle of exposure, counter, level of the sync line.
        pose_ns, pose_host_ns: controller's and host's time of every pose.
        box_reads, frame_camera_reads: clocks read by the host.
        mid_exposure_ns: from the start of an exposure to its middle; None without frames.
        named: of every named stream.
    """

    sync_pulses: I64
    event_pulses: I64
    arm_pulses: I64
    exposures: I64
    frame_ns: I64
    frame_number: I64
    frame_sync: npt.NDArray[np.uint8]
    pose_ns: I64
    pose_host_ns: I64
    box_reads: ClockReads
    frame_camera_reads: ClockReads
    mid_exposure_ns: int | None
    named: dict[str, ClockInput] = field(default_factory=dict)


@dataclass(frozen=True)
class DeviceSync:
    """One device on the time line.

    Attributes:
        grade: how it is timed, see `protocols.timing`.
        map: device ns to the box's ns.
        uncertainty_ns: how far the map may be off within the trial: 95 % where `fit` is there,
            a hard bound otherwise.
        kind: the meaning of the uncertainty, where the clock is that of another device.
    """

    grade: str
    map: ClockMap
    uncertainty_ns: float
    fit: ClockFit | None = None
    bounds: BoundedClock | None = None
    kind: str | None = None

    def record(self) -> DeviceRecord:
        """Return the part of the trial's record."""
        known: dict[str, Any] = {"grade": self.grade}
        if self.kind is not None:
            known["kind"] = self.kind
        elif self.fit is not None:
            known |= {"kind": "95 %", **self.fit.to_json()}
        elif self.bounds is not None:
            known |= {
                "kind": "hard bound",
                "drift_ppm": self.bounds.drift_ppm,
                "drift_error_ppm": self.bounds.drift_error_ppm,
                "pairs": self.bounds.pairs,
            }
        return DeviceRecord(**{**known, "map": self.map, "uncertainty_ns": self.uncertainty_ns})


@dataclass(frozen=True)
class TrialSync:
    """The clocks of one trial.

    Attributes:
        devices: what is known of ``events``, ``arm`` and ``frames``, and of ``streams``.
        refused: why a device has no clock.
        pieces: of a device whose clock restarted within the trial, each piece by itself, or why
            it could not be fitted; such a device is refused all the same.
        streams: names of the devices that are named streams, as a force sensor is.
    """

    code: str
    devices: dict[str, DeviceSync]
    refused: dict[str, str]
    pieces: dict[str, list[DeviceSync | str]]
    streams: frozenset[str] = frozenset()

    def record(self) -> TrialClockMaps:
        """Return the part of the trial's record."""
        known: dict[str, Any] = {"reference": "sync box", "code": self.code}
        records = {name: device.record() for name, device in self.devices.items()}
        known |= {name: part for name, part in records.items() if name not in self.streams}
        if streams := {name: part for name, part in records.items() if name in self.streams}:
            known["streams"] = streams
        if self.refused:
            known["refused"] = self.refused
        if self.pieces:
            known["pieces"] = {
                name: [part if isinstance(part, str) else part.record() for part in parts]
                for name, parts in self.pieces.items()
            }
        return TrialClockMaps(**known)

    def against_events_ns(self, device: str) -> float | None:
        """Uncertainty of events against another device, both maps together; None if unknown."""
        if device not in self.devices or "events" not in self.devices:
            return None
        return self.devices["events"].uncertainty_ns + self.devices[device].uncertainty_ns


def stream_clocks(
    about: Mapping[str, StreamRecord], opened: Callable[[str | None], StreamReader]
) -> dict[str, ClockInput]:
    """Read the clock data of the named streams, but for those that `timing.rig` times.

    Args:
        about: what the record says of the streams.
        opened: opens the file of a further camera by its name; the trial's own for None.
    """
    found: dict[str, ClockInput] = {}
    for name, stream in about.items():
        if stream.timing is not None:
            with opened(name if stream.of_camera else None) as reader:
                found[name] = _stream_clock(name, stream, reader)
    return found


def _stream_clock(name: str, about: StreamRecord, reader: StreamReader) -> ClockInput:
    if not about.of_camera:
        return ClockInput(about.timing, samples=_samples(name, reader))
    mid_ns = about.mid_exposure_ns or 0
    if about.kind == EVENTS_KIND:
        return ClockInput(about.timing, reader.pulses("event_pulses"))
    lit = reader.column("frames/sync") > 0
    begins = reader.column("frames/t")[lit] - mid_ns
    return ClockInput(about.timing, begins, reader.clock_reads("frame_camera_reads"), mid_ns)


def _samples(name: str, reader: StreamReader) -> tuple[I64, I64]:
    """Return the sensor's and the host's time of each sample of a named stream."""
    own, host = (f"{STREAM_GROUP}/{name}/{part}" for part in ("t", "host"))
    if not reader.has(own):  # nothing came
        return _NONE, _NONE
    return reader.column(own), reader.column(host)


def clocks_in(folder: Path, about: Mapping[str, StreamRecord]) -> dict[str, ClockInput]:
    """Read the clock data of the named streams of a sealed trial; see `stream_clocks`."""
    return stream_clocks(
        about, lambda name: StreamReader(folder / (DATA if name is None else stream_file(name)))
    )


def streams_of(
    reader: StreamReader,
    mid_exposure_ns: int | None,
    named: Mapping[str, ClockInput] | None = None,
) -> SyncStreams:
    """Read the clock data of a trial's file.

    Args:
        named: clock data of its named streams, as far as these have a timing of their own.
    """

    def column(name: str) -> I64:
        return reader.column(name) if reader.has(name) else _NONE

    named = named or {}
    first = {
        name: ClockInput(None, samples=_samples(name, reader))
        for name, kind in reader.streams().items()
        if kind == WRENCH.name and name not in named
    }
    return SyncStreams(
        sync_pulses=column("sync_pulses/t"),
        event_pulses=column("event_pulses/t"),
        arm_pulses=column("arm_pulses/t"),
        exposures=column("exposures/t"),
        frame_ns=column("frames/t"),
        frame_number=column("frames/number"),
        frame_sync=column("frames/sync").astype(np.uint8),
        pose_ns=column("poses/t"),
        pose_host_ns=column("poses/host"),
        box_reads=reader.clock_reads("box_reads"),
        frame_camera_reads=reader.clock_reads("frame_camera_reads"),
        mid_exposure_ns=mid_exposure_ns,
        named={**first, **named},
    )


def synchronise_recording(recording: Recording) -> TrialSync:
    """Fit a stored trial's clocks again, by the timing in its record.

    Raises:
        StoreError: the record holds no timing.
    """
    timing = recording.record.timing
    if timing is None:
        raise StoreError(f"{recording.folder}: timing: is missing; its clocks cannot be fitted")
    named = stream_clocks(recording.record.streams, recording.open)
    with recording.open() as reader:
        streams = streams_of(reader, timing.mid_exposure_ns, named)
    with_events = recording.record.geometry.event_px is not None
    return synchronise(streams, timing.rig, timing.rate_hz, with_events=with_events)


def synchronise(
    streams: SyncStreams, timing: Timing, rate_hz: float, *, with_events: bool = True
) -> TrialSync:
    """Fit every device of a trial by the means that its rig has.

    Args:
        rate_hz: ticks of the box a second.
        with_events: an event camera was recorded.
    """
    found = TrialSync(timing.code, {}, {}, {}, frozenset(streams.named))
    pulses = _Pulses(streams.sync_pulses, timing, rate_hz, found)
    if with_events:
        how = _timing(timing.event_camera, "trigger input")
        camera = ClockInput(how, streams.event_pulses)
        _try(found, "events", partial(_stream, pulses, "events", camera, streams))
    if timing.arm == "digital input":
        stamps, arm = streams.arm_pulses, timing.arm_controller
        _try(found, "arm", lambda: pulses.fit("arm", stamps, arm, timing.arm))
    else:
        _try(found, "arm", lambda: _arm_by_host(streams, timing))
    if streams.mid_exposure_ns is not None:
        begins = streams.frame_ns - streams.mid_exposure_ns
        if timing.frames == "exposure line":
            _try(found, "frames", lambda: _by_exposures(begins, streams, timing))
        else:
            how = _timing(timing.frame_camera, timing.frames)
            camera = ClockInput(
                how.model_copy(update={"delay": timing.frame_delay}),
                begins[streams.frame_sync > 0],
                streams.frame_camera_reads,
                streams.mid_exposure_ns,
            )
            _try(found, "frames", partial(_stream, pulses, "frames", camera, streams))
    for name, clock in streams.named.items():
        _try(found, name, partial(_stream, pulses, name, clock, streams))
    return found


def _timing(clock: DeviceClock, grade: StreamGrade) -> StreamTiming:
    """Return the timing of a first camera as that of any device with a stream."""
    return StreamTiming(**clock.model_dump(), grade=grade)


def _stream(pulses: _Pulses, name: str, device: ClockInput, streams: SyncStreams) -> DeviceSync:
    """Fit the clock of a device with a stream by the means of its grade."""
    timing = pulses.timing
    how = device.timing or timing.force or ForceTiming()
    if how.grade in WIRED:
        return pulses.fit(name, device.pulses, how, how.grade)
    if how.grade == "arm clock" or how.grade == "host time":
        return _by_samples(pulses.found, name, device.samples, how, streams, timing)
    if how.grade == "device time stamps":
        what = f"readings of the clock of {name}"
        bounded = _bounded(device.reads, how.drift_ppm + HOST_PPM, what)
        return _through_host(bounded, streams, timing, how.grade)
    return _by_arrival(how.delay, device.mid_exposure_ns, how.grade, streams, timing)


def _try(found: TrialSync, name: str, fit: Callable[[], DeviceSync]) -> None:
    try:
        found.devices[name] = fit()
    except (ClockRefused, BoundsContradictError) as error:
        found.refused[name] = str(error)


def split_at_restarts(times_ns: I64, back_ns: int) -> list[slice]:
    """Stretches of times that came in order, cut where the clock falls back by `back_ns`.

    After a restart nothing that was known of a clock holds: each stretch is fitted by itself.
    """
    cuts = np.flatnonzero(np.diff(times_ns) < -back_ns) + 1
    edges = [0, *cuts.tolist(), int(times_ns.size)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


@dataclass(frozen=True)
class _Pulses:
    """Devices that see the box's pulses."""

    reference: I64
    timing: Timing
    rate_hz: float
    found: TrialSync

    def fit(self, name: str, stamps: I64, clock: DeviceClock, grade: str) -> DeviceSync:
        stretches = split_at_restarts(stamps, RESTART_NS)
        if len(stretches) > 1:
            self.found.pieces[name] = [
                self._piece(stamps[part], clock, grade) for part in stretches
            ]
            raise ClockRefused(
                "residuals",
                f"its clock fell back by more than {RESTART_NS / 1e6:g} ms, "
                f"{plural(len(stretches) - 1, 'time')} during the trial: the device restarted, or "
                f"its clock was set; {UNDISTURBED}",
            )
        return self._fit(stamps, clock, grade)

    def _piece(self, stamps: I64, clock: DeviceClock, grade: str) -> DeviceSync | str:
        try:
            return self._fit(stamps, clock, grade)
        except ClockRefused as refusal:
            return str(refusal)

    def _fit(self, stamps: I64, clock: DeviceClock, grade: str) -> DeviceSync:
        fit = fit_clock(
            stamps,
            self.reference,
            **_limits(clock, self.timing),
            in_order=True,
            start_marker_ns=self.timing.start_marker_ns(self.rate_hz),
        )
        return DeviceSync(grade, fit.map, fit.uncertainty_ns, fit)


def _limits(clock: DeviceClock, timing: Timing) -> dict[str, Any]:
    """Properties of a device's clock that a fit needs."""
    return {
        "jitter_ns": clock.jitter_us * 1e3,
        "max_drift_ppm": clock.drift_ppm + timing.sync_box.drift_ppm,
        "resolution_ns": clock.resolution_us * 1e3,
        "rounding": clock.rounding,
    }


def _by_exposures(begins: I64, streams: SyncStreams, timing: Timing) -> DeviceSync:
    """The camera runs by itself; the box stamped every exposure."""
    fit = fit_numbered(
        begins,
        streams.frame_number,
        streams.exposures,
        **_limits(timing.frame_camera, timing),
        reference_resolution_ns=timing.sync_box.resolution_us * 1e3,
    )
    return DeviceSync(timing.frames, fit.map, fit.uncertainty_ns, fit)


def _arm_by_host(streams: SyncStreams, timing: Timing) -> DeviceSync:
    """Bound a pose's time: it was sent before it arrived, at most by its transmission time."""
    bounded = _bounded(
        _sent(streams.pose_ns, streams.pose_host_ns, timing.pose_delay),
        timing.arm_controller.drift_ppm + HOST_PPM,
        "poses",
        fit_messages,
    )
    return _through_host(bounded, streams, timing, timing.arm)


def _by_samples(
    found: TrialSync,
    name: str,
    samples: tuple[I64, I64],
    how: ForceTiming | StreamTiming,
    streams: SyncStreams,
    timing: Timing,
) -> DeviceSync:
    """The clock of a sensor: the arm's, or bounded by the arrivals of its samples.

    Args:
        samples: the sensor's and the host's time of each, ns.
    """
    if how.grade == "arm clock":
        if "arm" not in found.devices:
            raise BoundsContradictError("the arm's clock stamps it, and that one was refused")
        arm = found.devices["arm"]
        kind = "hard bound" if arm.fit is None else "95 %"
        return DeviceSync(how.grade, arm.map, arm.uncertainty_ns, kind=kind)
    device, host = samples
    if np.any(np.diff(device) < 0):
        raise ClockRefused("residuals", f"its clock fell back during the trial; {UNDISTURBED}")
    sent = _sent(device, host, how.delay)
    bounded = _bounded(sent, how.drift_ppm + HOST_PPM, name, fit_messages)
    return _through_host(bounded, streams, timing, how.grade)


def _sent(device_ns: I64, arrived_ns: I64, delay: Delay) -> ClockReads:
    """Bounds of messages' times by the host's clock: they arrived after their delay."""
    return ClockReads(
        device_ns,
        arrived_ns - round(delay.longest_us * 1000),
        arrived_ns - round(delay.shortest_us * 1000),
    )


def _by_arrival(
    delay: Delay, before_ns: int, grade: str, streams: SyncStreams, timing: Timing
) -> DeviceSync:
    """The host's time of arrival is the device's clock; data are `before_ns` and a delay older."""
    box = _box(streams, timing)
    earlier = round(500 * (delay.shortest_us + delay.longest_us)) + before_ns
    to_box = ClockMap.line(earlier, 0).then(box.map.inverse)
    spread = 500 * (delay.longest_us - delay.shortest_us)
    return DeviceSync(grade, to_box, spread + box.uncertainty_ns, None, box)


def _through_host(
    bounded: BoundedClock, streams: SyncStreams, timing: Timing, grade: str
) -> DeviceSync:
    box = _box(streams, timing)
    to_box = bounded.map.then(box.map.inverse)
    return DeviceSync(grade, to_box, bounded.uncertainty_ns + box.uncertainty_ns, None, bounded)


def _box(streams: SyncStreams, timing: Timing) -> BoundedClock:
    """The box's clock on the host's."""
    drift = timing.sync_box.drift_ppm + HOST_PPM
    return _bounded(streams.box_reads, drift, "readings of the sync box's clock")


def _bounded(
    reads: ClockReads, drift_ppm: float, name: str, fit: FitBounds = fit_bounds
) -> BoundedClock:
    if reads.device_ns.size < MIN_PAIRS:
        raise BoundsContradictError(
            f"{reads.device_ns.size} {name}; at least {MIN_PAIRS} are needed: record for longer, "
            "and check that the device answers"
        )
    try:
        return fit(reads.device_ns, reads.before_ns, reads.after_ns, drift_ppm)
    except BoundsContradictError as error:
        raise BoundsContradictError(f"{name}: {error}") from None
