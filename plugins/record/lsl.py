"""Streams of the Lab Streaming Layer (LSL), with the readings of their sender's clock.

A sample has the sender's stamp and the time of its arrival. The sender's clock drifts, and may be
set. liblsl compares it with the host's every two seconds: an offset, and the round trip that bounds
its error. A step between two readings that no drift explains is a jump. It is taken out of the
times `t`; the stamps as sent are in the column `stamp`. What cannot be known of its size or place
is the readings' `error`. Samples wait for the reading after them, so `stop` takes one.
"""

from __future__ import annotations

import ctypes
import re
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from sliplab.plugins.record.table import MOST_NS, rows, table_kind
from sliplab.protocols.later import need
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import SensorDriver, lazy
from sliplab.rigs.core.host_clock import StallTimer
from sliplab.storage.streams import CLOCK, I64, Chunk, Column, Json, StreamKind, chunk_type

DEVICE = "LSL stream"
DRIFT_PPM = 400.0
"""Largest drift between two crystals."""
MOST_WAITING = 2_000_000
"""Samples that wait to be read; more are lost, and counted."""
READ_S, PULL_S, LOOK_S = 3.0, 0.1, 0.1
"""Longest time for a reading of the clock; for a pull; period of looks at the newest reading."""
_HISTORY, _LEAST = 10, 3
"""Readings before a trial that are kept with it; the least that its clock is fitted by."""
_APART_NS = 50_000_000
"""Least time between two readings."""
_SPREADS = 4.0
"""A jump of fewer times the spread of the delays cannot be placed between two samples."""


class LslSettings(DriverSettings):
    """A stream of the Lab Streaming Layer."""

    driver: Literal["lsl"] = "lsl"
    name: str = Field(min_length=1)
    """Its name, as its sender declares it."""
    source_id: str | None = None
    """Of its sender, where several have streams of this name."""
    find_s: float = Field(default=5.0, gt=0, le=60)
    """Time to find it, seconds."""
    stall_s: float = Field(default=10.0, ge=0.1, le=3600)
    """Silence that is a fault, seconds: of a stream with a rate, or of its sender's clock."""


class ClockReading(NamedTuple):
    """A reading of the sender's clock, ns.

    Attributes:
        device_ns: its time. offset_ns: of the host's clock. width_ns: of the interval that is known
            to contain the offset, around it.
    """

    device_ns: int
    offset_ns: int
    width_ns: int

    @property
    def host_ns(self) -> int:
        """The middle of what the host's clock may have been."""
        return self.device_ns + self.offset_ns


@dataclass
class _Held:
    """Samples that wait for a reading of the clock after them."""

    stamp_ns: I64
    host_ns: int
    """Their arrival."""
    values: Any


class JumpRemover:
    """The sender's clock without its jumps.

    Attributes:
        shift_ns: sum of all jumps so far. error_ns: bound of that sum's error, and of misplaced
            samples.
    """

    def __init__(self) -> None:
        self.shift_ns = self.error_ns = 0
        self._first: ClockReading | None = None
        self._last: ClockReading | None = None
        self._drift, self._drift_error = 0.0, DRIFT_PPM * 1e-6
        self._lags: deque[float] = deque(maxlen=1000)

    def begin(self) -> None:
        """Begin a run: times are those of the clock as it is now."""
        self.shift_ns = self.error_ns = 0

    def reading(self, new: ClockReading) -> int:
        """Take a reading; return the clock's jump since the one before, ns, or 0."""
        last, self._last = self._last, new
        if last is None or self._first is None:
            self._first = new
            return 0
        passed = new.host_ns - last.host_ns
        widths = (last.width_ns + new.width_ns) / 2
        step = new.offset_ns - last.offset_ns
        if abs(step) <= widths + DRIFT_PPM * 1e-6 * passed:
            self._learn(new)
            return 0
        self._first = new
        self.error_ns += round(widths + self._drift_error * passed)
        return round(self._drift * passed) - step

    def _learn(self, new: ClockReading) -> None:
        """Estimate the drift by the readings since the last jump."""
        assert self._first is not None
        run = new.device_ns - self._first.device_ns
        if run <= 0:
            return
        error = (new.width_ns + self._first.width_ns) / 2 / run
        if error < self._drift_error:
            self._drift = (new.offset_ns - self._first.offset_ns) / run
            self._drift_error = error

    def times(self, stamp_ns: I64, host_ns: I64, before: ClockReading | None, jump_ns: int) -> I64:
        """Return the times of samples between two readings, without the clock's jump there.

        Args:
            before: the reading before them. jump_ns: as `reading` returned.
        """
        t_ns = stamp_ns - self.shift_ns
        if before is not None:
            lags = (host_ns - stamp_ns - before.offset_ns).astype(np.float64)
            if jump_ns:
                place = self._place(lags, jump_ns)
                t_ns[place:] -= jump_ns
                lags[place:] += jump_ns
            self._lags.extend(lags[-1000:].tolist())
        return t_ns

    def _place(self, lags: Any, jump_ns: int) -> int:
        """Return the first sample behind a jump: that by which delays stay as they were."""
        if not len(lags):
            return 0
        usual = self._lags or deque([0.0])
        middle = float(np.median(usual))
        spread = float(np.median(np.abs(np.array(usual) - middle)))
        off, on = np.abs(lags - middle), np.abs(lags + jump_ns - middle)
        cost = np.concatenate([[0.0], np.cumsum(off)]) + np.concatenate(
            [np.cumsum(on[::-1])[::-1], [0.0]]
        )
        if abs(jump_ns) < _SPREADS * max(spread, 1e5):
            self.error_ns += abs(jump_ns)
        return int(np.argmin(cost))


class LslStream:
    """A `Sensor`: a stream of LSL; it is found when it is connected."""

    def __init__(self, settings: LslSettings) -> None:
        self._settings = settings
        self.kind: StreamKind = table_kind({"value": ""})
        self._lock = threading.Lock()
        self._inlet: Any = None
        self._info: Any = None
        self._thread: threading.Thread | None = None
        self._end = threading.Event()
        self._fault: str | None = None
        self._running = False
        self._jumps = JumpRemover()
        self._history: deque[ClockReading] = deque(maxlen=_HISTORY)
        self._reset()

    def _reset(self) -> None:
        self._jumps.begin()
        self._held: list[_Held] = []
        self._ready: list[tuple[Any, ...]] = []
        self._reads: list[tuple[int, int, int, int]] = []
        self._waiting = self.lost = self.malformed = self.received = 0
        self._last_t: int | None = None
        self._moved_ns = self._stated_ns = 0  # by which stamps that fell back were changed
        self._last_read: list[tuple[int, int, int, int]] = []
        self._silence, self._unread_clock = StallTimer(), StallTimer()

    def connect(self) -> None:
        """Find the stream, and take a first reading of its clock. Raises RigError."""
        need("pylsl")
        import pylsl

        settings = self._settings
        found = pylsl.resolve_byprop("name", settings.name, timeout=settings.find_s)
        if settings.source_id is not None:
            found = [info for info in found if info.source_id() == settings.source_id]
        if len(found) != 1:
            ids = ", ".join(sorted(info.source_id() for info in found))
            text = f"{len(found)} streams are named so: say source_id, one of {ids}"
            missing = f"no stream of this name within {settings.find_s:g} s; is its sender running?"
            raise RigError(f"{DEVICE} {settings.name}", text if found else missing)
        self._info = found[0]
        if self._info.channel_format() == pylsl.cf_string:
            raise RigError(f"{DEVICE} {settings.name}", "sends text; only numbers can be recorded")
        try:
            self._inlet = pylsl.StreamInlet(self._info, max_buflen=360, as_numpy=True)
            self.kind = _kind(self._inlet.info(settings.find_s))
            self._inlet.open_stream(settings.find_s)
            self._history.append(self._read_clock(self._inlet))
            self._jumps.reading(self._history[-1])
        except (TimeoutError, RuntimeError) as error:
            raise RigError(f"{DEVICE} {settings.name}", f"cannot be opened: {error}") from None
        self._thread = threading.Thread(target=self._receive, name="LSL", daemon=True)
        self._thread.start()

    def start(self) -> None:
        """Start streaming; earlier samples are discarded."""
        with self._lock:
            self._reset()
            for reading in self._history:
                self._note(reading)
            self._running = True

    def stop(self) -> None:
        """Stop streaming; take a reading of the clock after the last sample."""
        with self._lock:
            was, self._running = self._running, False
        if not was or self._fault is not None:
            return
        import pylsl

        # without a reading the clock is not known behind the one before
        with suppress(TimeoutError, RuntimeError):
            for _ in range(max(1, _LEAST - len(self._history))):
                reading = self._read_clock(pylsl.StreamInlet(self._info))  # which reads at once
                with self._lock:
                    self._take(reading)
        with self._lock:
            self._release(None, None, 0)

    def read(self) -> Chunk:
        """Return the samples since the last call, as far as the clock was read after them.

        Raises:
            RigError: the stream is lost.
        """
        with self._lock:
            parts, self._ready = self._ready, []
            self._waiting -= sum(len(part[0]) for part in parts)
            fault = None if parts else self._fault or (self._silent() if self._running else None)
        if fault is not None:
            raise RigError(f"{DEVICE} {self._settings.name}", fault)
        if not parts:
            return chunk_type(self.kind).empty()
        t_ns, host, stamp, values = map(np.concatenate, zip(*parts, strict=True))
        first = t_ns[0] if self._last_t is None else self._last_t
        ordered = np.maximum.accumulate(np.maximum(t_ns, first))
        self._moved_ns = max(self._moved_ns, int((ordered - t_ns).max()))
        t_ns, self._last_t = ordered, int(ordered[-1])
        columns = (t_ns, host, stamp, *np.ascontiguousarray(values.T))
        return rows(self.kind, "", dict(zip(self.kind.columns, columns, strict=True)))

    def _silent(self) -> str | None:
        """Return for how long nothing has come, where that is a fault."""
        limit_s, quiet_s = self._settings.stall_s, self._silence.waited_s(self.received)
        if self._info.nominal_srate() > 0 and quiet_s > limit_s:
            return f"sent nothing for {quiet_s:.1f} s; look at its sender"
        # the sender of marks may be silent, but answers when its clock is read
        quiet_s = self._unread_clock.waited_s(self._history[-1].device_ns)
        if quiet_s > limit_s + READ_S:
            return f"its clock could not be read for {quiet_s:.1f} s; look at its sender"
        return None

    def clock_reads(self) -> Chunk:
        """Return the readings of the clock since the last call; their times are without jumps."""
        with self._lock:
            reads, self._reads = self._reads, []
        if not reads and self._moved_ns > self._stated_ns:  # no reading may come that could say so
            reads = self._last_read
        self._last_read, self._stated_ns = reads[-1:] or self._last_read, self._moved_ns
        columns = np.array(reads, np.int64).reshape(-1, 4).T
        columns[3] += self._moved_ns
        return rows(CLOCK, "", dict(zip(CLOCK.columns, columns, strict=True)))

    def describe(self) -> Json:
        """Return what the sender says of itself, and counts."""
        about = {"name": self._settings.name}
        if self._info is not None:
            about |= {"source_id": self._info.source_id(), "host": self._info.hostname()}
        jumps = {"shift_ns": self._jumps.shift_ns, "error_ns": self._jumps.error_ns}
        return {
            **about,
            "clock_jumps": jumps,
            "counts": {"lost": self.lost, "malformed": self.malformed},
        }

    def close(self) -> None:
        """Close the connection."""
        self._end.set()
        if self._thread is not None:
            self._thread.join(5.0)
        self._inlet = None

    def _receive(self) -> None:

        looked = 0.0
        while not self._end.is_set():
            try:
                values, stamps = self._inlet.pull_chunk(
                    timeout=PULL_S, max_samples=4096, min_samples=1
                )
                host_ns = time.monotonic_ns()
                if time.monotonic() - looked > LOOK_S:
                    looked = time.monotonic()
                    reading = self._read_clock(self._inlet)
                else:
                    reading = None
            except (TimeoutError, RuntimeError) as error:
                with self._lock:
                    self._release(None, None, 0)
                    self._fault = f"is lost: {error}"
                return
            with self._lock:
                if len(stamps) and self._running:
                    self._hold(np.asarray(stamps), host_ns, values)
                if reading is not None:
                    self._take(reading)

    def _hold(self, stamps: Any, host_ns: int, values: Any) -> None:
        self.received += len(stamps)
        if not (good := np.abs(stamps) < MOST_NS / 1e9).all():  # which NaN is not
            self.malformed += int((~good).sum())
            stamps, values = stamps[good], np.asarray(values)[good]
        if self._waiting + len(stamps) > MOST_WAITING:
            self.lost += len(stamps)
            return
        self._waiting += len(stamps)
        stamp_ns = np.rint(stamps * 1e9).astype(np.int64)
        self._held.append(_Held(stamp_ns, host_ns, np.asarray(values, np.float64)))

    def _take(self, reading: ClockReading) -> None:
        """Take a reading, and release the samples before it."""
        before = self._history[-1]
        if reading.host_ns < before.host_ns + _APART_NS:
            return
        jump = self._jumps.reading(reading)
        if jump:
            self._history.clear()
        self._history.append(reading)
        self._release(before, reading, jump)
        self._note(reading)

    def _note(self, reading: ClockReading) -> None:
        """Keep a reading for `clock_reads`."""
        half = (reading.width_ns + 1) // 2
        t_ns, host_ns = reading.device_ns - self._jumps.shift_ns, reading.host_ns
        self._reads.append((t_ns, host_ns - half, host_ns + half, self._jumps.error_ns))

    def _release(self, before: ClockReading | None, after: ClockReading | None, jump: int) -> None:
        """Release samples that came before a reading; all without one."""
        last = np.iinfo(np.int64).max if after is None else after.host_ns
        held = [each for each in self._held if each.host_ns <= last]
        self._held = self._held[len(held) :]
        if held:
            stamp = np.concatenate([each.stamp_ns for each in held])
            host = np.concatenate([np.full(len(each.stamp_ns), each.host_ns) for each in held])
            t_ns = self._jumps.times(stamp, host, before, jump)
            self._ready.append((t_ns, host, stamp, np.concatenate([each.values for each in held])))
        self._jumps.shift_ns += jump

    def _read_clock(self, inlet: Any) -> ClockReading:
        """Return the newest reading of the sender's clock; the first one takes 0.7 s."""
        import pylsl

        offset, remote, width = ctypes.c_double(), ctypes.c_double(), ctypes.c_double()
        error = ctypes.c_int()
        offset.value = _library().lsl_time_correction_ex(
            inlet.obj, ctypes.byref(remote), ctypes.byref(width), READ_S, ctypes.byref(error)
        )
        pylsl.util.handle_error(error)
        return ClockReading(*(round(each.value * 1e9) for each in (remote, offset, width)))


def _library() -> Any:
    """Return liblsl; pylsl does not declare the call that also returns the uncertainty."""
    from pylsl.lib import lib

    call = lib.lsl_time_correction_ex
    double, integer = ctypes.POINTER(ctypes.c_double), ctypes.POINTER(ctypes.c_int)
    call.restype = ctypes.c_double
    call.argtypes = [ctypes.c_void_p, double, double, ctypes.c_double, integer]
    return lib


def _kind(info: Any) -> StreamKind:
    """Return the kind of a stream: its channels by their labels, if it names them."""
    labels = info.get_channel_labels() or []
    units = info.get_channel_units() or []
    names: list[str] = []
    for index in range(info.channel_count()):
        label = str(labels[index]) if index < len(labels) and labels[index] else ""
        name = re.sub(r"[^a-z0-9_]+", "_", label.lower()).strip("_")[:28]
        if not re.match(r"[a-z]", name) or name in {"t", "host", "stamp", *names}:
            name = f"channel_{index + 1}"
        names.append(name)
    known = dict.fromkeys(names, "")
    for name, unit in zip(names, units, strict=False):
        known[name] = str(unit or "")
    kind = table_kind(known)
    stamp = Column("stamp", "int64", (), "ns of the sender's clock, as sent")
    columns = dict(list(kind.columns.items())[:2]) | {"stamp": stamp}
    return StreamKind(kind.name, columns | dict(list(kind.columns.items())[2:]))


def why_unreachable(settings: LslSettings) -> str | None:
    """Return why a stream cannot be found; None if it can."""
    import pylsl

    found = pylsl.resolve_byprop("name", settings.name, timeout=settings.find_s)
    return None if found else f"no LSL stream is named {settings.name}; is its sender running?"


DRIVER = SensorDriver(
    name="lsl",
    title="Lab Streaming Layer",
    settings=LslSettings,
    libraries=("pylsl",),
    address=lambda settings: settings.name,
    ping=why_unreachable,
    build=LslStream,
    stream=table_kind({"value": ""}),
    grade=lambda settings: "host time",
    fake=lazy("sliplab.plugins.record.lsl_fake:FakeLsl"),
    reach=lambda settings, address: settings.model_copy(update=address),
)
