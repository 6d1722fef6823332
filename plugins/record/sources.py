"""What is recorded: the streams of a rig file or a file of streams, and those declared in code."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from sliplab.plugins.record.columns import ColumnsSensor
from sliplab.plugins.record.pushed import PushedStream
from sliplab.plugins.record.shared_clock import SHARED, doubt, now_ns
from sliplab.plugins.record.table import rows
from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.timing import WIRED, Delay, StreamGrade, StreamTiming
from sliplab.protocols.yaml_file import StrictModel, parse_yaml, read_text, rule, validate
from sliplab.rigs.build import driven_stream, taught_frame
from sliplab.rigs.core.device_stream import DeviceStream
from sliplab.rigs.core.driver import ForceSensorDriver, SensorDriver
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.device_section import DeviceSettings
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.stream_settings import (
    NAME,
    RESERVED,
    Stream,
    Streams,
    stream_faults,
)
from sliplab.storage.schema.trial import StreamRecord
from sliplab.storage.streams import (
    CHUNKS,
    CLOCK,
    EVENTS_KIND,
    FRAMES_KIND,
    SCALAR,
    WRENCH,
    Chunk,
    ClockReads,
    EventChunk,
    FrameChunk,
    PulseChunk,
    ScalarChunk,
    Sink,
    StreamKind,
    WrenchChunk,
    chunk_type,
)

HOST, READS, TIMING = "host stamps", "clock readings", "timing"
"""How a stream's times come onto the host's clock: they are of that clock; its clock was read; or
by the timing that its file says."""
_SHORT = re.compile(r"(?:([a-z][a-z0-9_]*)=)?(lsl|usb):(.+)")
FIRST_CAMERAS = (EVENTS_KIND, FRAMES_KIND)
CLOCK_STREAM = "{}_clock"
MOST_DELAY_MS = 10_000.0


class StreamsFile(StrictModel):
    """A file of streams: the section `streams` of a rig file by itself."""

    streams: Streams

    @rule
    def _complete(self) -> Iterable[KeyedError]:
        yield from stream_faults(self.streams, "devices", ("devices",))


class SourceAbout(BaseModel):
    """What a trial's record and its clocks need to know of a stream."""

    record: StreamRecord
    clock: str
    uncertainty_ns: float | None = None
    """Of stamps of the host's clock or of a shared one, where it is stated."""
    doubt: str = ""
    """What is to be said of the clock that it shares, see `plugins.record.shared_clock`."""


@dataclass
class Source:
    """A stream that is recorded.

    Attributes:
        clock: `HOST`, `READS`, `TIMING`, or a name of `SHARED`.
        uncertainty_ns: see `SourceAbout`.
        locks: resources of the device for one program at a time, see `rigs.core.driver.Driver`.
        declared: kind of its rows, where its driver declares one.
        fault: why it has ended within the trial; None while it runs.
        rows: that came in this trial.
        used: a recorder has it.
    """

    stream: DeviceStream
    clock: str = TIMING
    uncertainty_ns: float | None = None
    locks: Mapping[str, str] = field(default_factory=dict)
    declared: StreamKind | None = None
    fault: str | None = None
    rows: int = 0
    used: bool = False
    _drained_ns: int = 0

    @property
    def name(self) -> str:
        """The stream's name."""
        return self.stream.name

    @property
    def device(self) -> Any:
        """The device, or what takes a program's rows."""
        return self.stream.device

    @property
    def kind(self) -> StreamKind:
        """The kind of its rows; a device that learns it when it connects has its own `kind`."""
        own = getattr(self.device, "kind", None)
        known = own if isinstance(own, StreamKind) else self.declared
        return known or CHUNKS[self.stream.about.kind].KIND

    @property
    def about(self) -> SourceAbout:
        """What a trial's record says of it."""
        return SourceAbout(
            record=self.stream.about,
            clock=self.clock,
            uncertainty_ns=self.uncertainty_ns,
            doubt=doubt(self.clock),
        )

    def expected(self) -> dict[str, tuple[Chunk, ...]]:
        """Return empty chunks of what may come, by stream; the device is connected."""
        clock = {CLOCK_STREAM.format(self.name): (chunk_type(CLOCK).empty(),)}
        return {self.name: self._chunks()} | (clock if self.clock_is_read else {})

    @property
    def clock_is_read(self) -> bool:
        """Whether readings of its clock are stored; arrivals of events have no other place."""
        pushed = self.clock == HOST and self.stream.about.kind == EVENTS_KIND
        return self.clock == READS or self.clock in SHARED or pushed

    def _chunks(self) -> tuple[Chunk, ...]:
        kind, unit = self.stream.about.kind, self.stream.about.unit or ""
        if kind == EVENTS_KIND:
            return EventChunk.empty(), PulseChunk.empty()
        if kind == FRAMES_KIND:
            return FrameChunk.empty(), ClockReads.empty()
        if kind == WRENCH.name:
            return (WrenchChunk.empty(),)
        if kind == SCALAR.name:
            return (ScalarChunk.empty(unit),)
        return (chunk_type(self.kind).empty(),)

    def start(self) -> None:
        """Start streaming. Raises RigError."""
        self.fault, self.rows = None, 0
        self.stream.start()
        self._drained_ns = time.monotonic_ns()

    def drain(self, sink: Sink, last: bool = False) -> None:
        """Read what has come, and the clock. Raises RigError.

        Args:
            last: stop, and read what was sent before.
        """
        seen = _Newest(sink, self)
        pushed = self.device if isinstance(self.device, PushedStream) else None
        if last and pushed is not None:
            pushed.stop()  # nothing comes between the last read and the end
        self.stream.drain(seen)
        while last and pushed is not None and pushed.waiting:
            self.stream.drain(seen)
        if last:
            self.stream.finish(seen)
        now = time.monotonic_ns()
        if self.clock_is_read:
            sink.add(CLOCK_STREAM.format(self.name), self._clock_reads(seen, now))
        self._drained_ns = now

    def _clock_reads(self, seen: _Newest, now: int) -> Chunk:
        """Return readings of the clock since the last call, a chunk of the kind `CLOCK`."""
        if hasattr(self.device, "clock_reads"):
            own: Chunk = self.device.clock_reads()
            return own
        found: list[tuple[int, int, int, int]] = []
        if seen.newest_ns is not None:
            timing = self.stream.about.timing or StreamTiming()
            error = round(self.uncertainty_ns or 0)
            # events have no time of arrival: they came after the call before
            came = (self._drained_ns, now) if seen.host_ns is None else (seen.host_ns,) * 2
            before = came[0] - round(timing.delay.longest_us * 1000)
            found.append((seen.newest_ns, before - error, came[1] + error, 0))
        if self.clock in SHARED:
            before = time.monotonic_ns()
            t_ns = now_ns(self.clock)
            found.append((t_ns, before, time.monotonic_ns(), 0))
        columns = np.array(found, np.int64).reshape(-1, 4).T
        return rows(CLOCK, "", dict(zip(CLOCK.columns, columns, strict=True)))


class _Newest:
    """A sink that counts a source's rows, and notes the time of its newest, and its arrival's."""

    def __init__(self, sink: Sink, source: Source) -> None:
        self._sink, self._source = sink, source
        self.newest_ns: int | None = None
        self.host_ns: int | None = None

    def add(self, device: str, chunk: Chunk) -> None:
        if not isinstance(chunk, (PulseChunk, ClockReads)):
            self._source.rows += len(chunk)
            if len(chunk):
                unit = 1000 if isinstance(chunk, EventChunk) else 1
                self.newest_ns = int(chunk.times[-1]) * unit
                if (host := chunk.KIND.columns.get("host")) is not None:
                    self.host_ns = int(getattr(chunk, host.field)[-1])
        self._sink.add(device, chunk)


def _are_units(columns: object) -> bool:
    return (
        isinstance(columns, Mapping)
        and bool(columns)
        and all(isinstance(unit, str) for unit in columns.values())
    )


def _is_size(px: object) -> bool:
    return (
        isinstance(px, (tuple, list))
        and len(px) == 2
        and all(isinstance(n, (int, np.integer)) and type(n) is not bool and n > 0 for n in px)
    )


def push(
    name: str,
    columns: Mapping[str, str] | None = None,
    *,
    events_px: tuple[int, int] | None = None,
    frames_px: tuple[int, int] | None = None,
    clock: str = "host",
    uncertainty_ms: float | None = None,
    delay_ms: float = 50.0,
) -> Source:
    """Declare a stream that the program pushes by `RecordedTrial.push`.

    Args:
        name: of the stream; ``events`` and ``frames`` are those that the analysis works on.
        columns: of numbers: the unit of each column by its name.
        events_px, frames_px: columns and rows of a camera, in place of columns.
        clock: ``host``: times are of ``time.monotonic_ns()``; ``own``: of a clock of its own, which
            is bounded by the times at which rows are pushed; ``ptp`` or ``utc``: of TAI or UTC,
            which the host has too, by PTP or NTP: refused where the times of pushing contradict it.
        uncertainty_ms: bound of the error of times of the host's clock, None where it is unknown;
            of ``ptp`` and ``utc`` it must be stated.
        delay_ms: longest time from a row's time to its push; of times of the host's clock any.

    Raises:
        InputError: an argument.
    """
    given = [each for each in (columns, events_px, frames_px) if each is not None]
    if len(given) != 1:
        raise InputError(name, "columns", None, "give columns, events_px or frames_px, one of them")
    if columns is not None and not _are_units(columns):
        right = 'must name the unit of each column: {"width": "mm"}'
        raise InputError(name, "columns", columns, right)
    for key, px in (("events_px", events_px), ("frames_px", frames_px)):
        if px is not None and not _is_size(px):
            raise InputError(name, key, px, "must be columns and rows, whole numbers above 0")
    if clock not in {"host", "own", *SHARED}:
        raise InputError(name, "clock", clock, "must be host, own, ptp or utc")
    if uncertainty_ms is not None and not is_bound(uncertainty_ms):
        right = "must be a finite number of milliseconds, not negative"
        raise InputError(name, "uncertainty_ms", uncertainty_ms, right)
    if clock in SHARED and uncertainty_ms is None:
        raise InputError(name, "uncertainty_ms", None, f"is needed with clock={clock!r}")
    if not (is_bound(delay_ms) and 0 < delay_ms <= MOST_DELAY_MS):
        right = f"must be a number of milliseconds, above 0 and up to {MOST_DELAY_MS:g}"
        raise InputError(name, "delay_ms", delay_ms, right)
    kind = None if columns is not None else EVENTS_KIND if events_px else FRAMES_KIND
    _check_name(name, kind)
    px = events_px or frames_px
    size = None if px is None else (int(px[0]), int(px[1]))
    device = PushedStream(name, columns, kind, size, clock == "host")
    told: dict[str, Any] = {"kind": kind or (device.kind.name if device.kind else ""), "rows": 0}
    if size is not None:
        told["size_px"] = size
    if device.unit:
        told["unit"] = device.unit
    if kind == FRAMES_KIND:
        told["mid_exposure_ns"] = 0
    if clock != "host":
        grade: StreamGrade = "host arrival" if kind == FRAMES_KIND else "host time"
        delay = Delay(shortest_us=0, longest_us=1000 * delay_ms)
        told["timing"] = StreamTiming(grade=grade, delay=delay)
    if clock == "own":
        how = READS if kind == EVENTS_KIND else TIMING
    else:
        how = clock if clock in SHARED else HOST
    error = None if uncertainty_ms is None else uncertainty_ms * 1e6
    return Source(DeviceStream(name, device, StreamRecord(**told)), how, error)


def is_bound(value: object) -> bool:
    """Return whether a value is a finite number, not negative."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    return 0 <= float(value) < float("inf")


def usb_camera(
    name: str, device: str, size_px: tuple[int, int], rate_hz: float = 30.0, **settings: Any
) -> Source:
    """Declare a USB camera, or a stream that OpenCV opens.

    Args:
        device: path of the camera, or a URL. settings: see docs/cameras.md.

    Raises:
        InputError: a setting. RigError: it cannot be opened.
    """
    width, height = size_px
    about = {
        "kind": FRAMES_KIND,
        "scale_px_per_mm": 1.0,
        "region_px": [width, height],
        "rate_hz": rate_hz,
        "timing": {"grade": "host arrival"},
        "device": {
            "driver": "uvc",
            "device": device,
            "width_px": width,
            "height_px": height,
            "rate_hz": rate_hz,
            **settings,
        },
    }
    return declared(name, about)


def columns(
    name: str, place: str, units: Mapping[str, str], delay_ms: float = 50.0, **settings: Any
) -> Source:
    """Declare a stream of numbers from a serial port or a socket.

    Args:
        place: ``/dev/ttyACM0``, ``tcp://HOST:PORT`` or ``udp://HOST:PORT``.
        units: of each column by its name, in their order.
        delay_ms: longest time from a reading to its arrival here.
        settings: see `plugins.record.columns.ColumnsSettings`.

    Raises:
        InputError: a setting.
    """
    grade = "host arrival" if settings.get("time_column") is None else "host time"
    about = {"driver": "columns", "place": place, "columns": dict(units), **settings}
    timing = {"grade": grade, "delay": {"shortest_us": 0, "longest_us": delay_ms * 1000}}
    return declared(name, {"kind": "table", "timing": timing, "device": about})


def lsl(stream: str, name: str | None = None, **settings: Any) -> Source:
    """Declare a stream of the Lab Streaming Layer.

    Args:
        stream: its name there. name: in the store; made of that by default.
        settings: `source_id` where several senders have it, `find_s` to wait longer.

    Raises:
        InputError: a setting.
    """
    name = name or re.sub(r"[^a-z0-9_]+", "_", stream.lower()).strip("_")[:24]
    about = {"driver": "lsl", "name": stream, **settings}
    return declared(name, {"kind": "table", "timing": {"grade": "host time"}, "device": about})


def declared(name: str, about: Mapping[str, Any]) -> Source:
    """Return a stream as a rig file declares it below `streams`. Raises InputError, RigError."""
    known = name if name not in FIRST_CAMERAS else "camera"
    file = validate(StreamsFile, {"streams": {known: dict(about)}}, name)
    return _driven(name, file.streams[known], PlateFrame.taught(_FLAT))


_FLAT = ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (0.0, 100.0, 0.0))
"""Axes of a plate that nobody taught: forces stay in those of the sensor."""


def opened(streams: Iterable[str | Path | Source], undo: ExitStack) -> list[Source]:
    """Return the streams of files and of code; cameras are open, nothing is connected.

    Args:
        undo: closes them again.

    Raises:
        InputError: a file or a name. RigError: a device.
    """
    found: list[Source] = []
    for each in streams:
        for source in [each] if isinstance(each, Source) else _of_text(str(each)):
            if source.used:
                right = "is being recorded already; declare another stream"
                raise InputError("streams", "", source.name, right)
            source.used = True
            undo.callback(setattr, source, "used", False)
            undo.callback(source.stream.close)
            if source.name in {other.name for other in found}:
                raise InputError("streams", "", source.name, "is the name of two streams")
            found.append(source)
    if not found:
        raise InputError("streams", "", None, "names no stream")
    for source in found:
        clock = CLOCK_STREAM.format(source.name)
        if source.clock_is_read and clock in {other.name for other in found}:
            text = f"is the name of the readings of the clock of {source.name}; choose another one"
            raise InputError("streams", "", clock, text)
    return found


def _of_text(text: str) -> Iterator[Source]:
    """Yield the streams of a file, or the one that a short form names."""
    if short := _SHORT.fullmatch(text):
        name, kind, place = short.groups()
        if kind == "lsl":
            yield lsl(place, name)
            return
        device, _, size = place.partition("@")
        width, x, height = (size or "1280x720").partition("x")
        if not (x and width.isdecimal() and height.isdecimal()):
            raise InputError("STREAMS", "", text, "must be usb:DEVICE or usb:DEVICE@WIDTHxHEIGHT")
        yield usb_camera(name or FRAMES_KIND, device, (int(width), int(height)))
        return
    path = Path(text)
    if path.name == text and not path.suffix and not path.exists():
        right = "must be a rig file, a file of streams, lsl:NAME or usb:DEVICE@WIDTHxHEIGHT"
        raise InputError("STREAMS", "", text, right)
    data = parse_yaml(read_text(path, "file of streams"), path)
    if "driver" in data or "extends" in data or "devices" in data:
        yield from _of_rig(path)
        return
    file = validate(StreamsFile, data, path)
    for name, stream in file.streams.items():
        yield _driven(name, stream, PlateFrame.taught(_FLAT))


def _of_rig(path: Path) -> Iterator[Source]:
    """Yield cameras and further streams of a rig file; neither arm nor gripper."""
    rig, _ = load_rig_file(path)
    devices = rig.devices
    if rig.driver != "devices" or devices is None:
        raise InputError(path, "driver", rig.driver, "must be devices: only those can be recorded")
    if "events" in rig.cameras:
        driver = devices.event_camera_driver
        camera = driver.build(devices.event_camera)
        size = camera.width, camera.height
        about = StreamRecord(kind=EVENTS_KIND, rows=0, size_px=size, timing=StreamTiming())
        stream = DeviceStream(EVENTS_KIND, camera, about)
        yield Source(stream, READS, locks=driver.locks(devices.event_camera))
    if "frames" in rig.cameras:
        yield _first_frames(path, rig, devices)
    for name, settings in rig.streams.items():
        yield _driven(name, settings, taught_frame(rig))


def _first_frames(path: Path, rig: RigFile, devices: DeviceSettings) -> Source:
    """Open the first frame camera of a rig file, which has to run by itself."""
    grade = rig.timing.frames
    if grade in WIRED:
        text = "needs the sync box; without an arm write host arrival or device time stamps"
        raise InputError(path, "timing.frames", grade, text)
    driver, spec = devices.frame_camera_driver, rig.frame_camera
    camera = driver.build(devices.frame_camera, spec.scale_px_per_mm)
    size = spec.width_px, spec.height_px
    camera.set_region(*size)
    clock = rig.timing.frame_camera.model_dump() | {"grade": grade}
    about = StreamRecord(
        kind=FRAMES_KIND,
        rows=0,
        size_px=size,
        px_per_mm=spec.scale_px_per_mm,
        mid_exposure_ns=camera.mid_exposure_ns,
        timing=StreamTiming(**clock, delay=rig.timing.frame_delay),
    )
    stream = DeviceStream(FRAMES_KIND, camera, about)
    return Source(stream, locks=driver.locks(devices.frame_camera))


def _driven(name: str, stream: Stream, plate: PlateFrame) -> Source:
    driver = stream.driver
    assert driver is not None
    if isinstance(driver, ForceSensorDriver) and driver.of_arm:
        raise InputError(name, "driver", driver.name, "measures through an arm, which is not there")
    made = driven_stream(name, stream, None, plate)  # type: ignore[arg-type]
    if isinstance(made.device, ColumnsSensor):
        made.device.keeps_rows = True
    by_reads = stream.kind == EVENTS_KIND or hasattr(made.device, "clock_reads")
    locks = driver.locks(stream.device)
    declared = driver.stream if isinstance(driver, SensorDriver) else None
    if (shared := getattr(stream.device, "shared_clock", None)) is not None:
        stated_ms: float = getattr(stream.device, "uncertainty_ms", 0.0)
        return Source(made, shared, stated_ms * 1e6, locks, declared)
    return Source(made, READS if by_reads else TIMING, None, locks, declared)


def _check_name(name: str, kind: str | None) -> None:
    if not NAME.fullmatch(name):
        raise InputError("streams", "", name, f"a stream's name must match {NAME.pattern}")
    if name in RESERVED and name != kind:
        raise InputError("streams", "", name, "is the name of another stream; choose another one")
