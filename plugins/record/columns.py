"""Numbers from a serial port or a socket, by a declaration of their columns.

    glove:
      kind: table
      device: {driver: columns, place: /dev/ttyACM0, columns: {force: N, angle: deg}}

Lines of numbers with a separator, or packets of a fixed `struct` layout. Rows are timed by their
arrival, or by a column with the device's time, whose clock is bounded by the arrivals.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np
from pydantic import Field

from sliplab.plugins.record.table import MOST_NS, rows, table_kind
from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.later import need
from sliplab.protocols.timing import StreamGrade
from sliplab.protocols.yaml_file import rule
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import SensorDriver, lazy
from sliplab.rigs.core.network import serial_port
from sliplab.rigs.core.stream_buffer import StreamBuffer
from sliplab.storage.streams import Chunk, Json

DEVICE = "columns"
OPEN_S, WAIT_S = 5.0, 0.2
_MOST_LINE = 1 << 16
"""Bytes without an end of line that are no lines."""
UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}


class ColumnsSettings(DriverSettings):
    """Numbers from a serial port or a socket."""

    driver: Literal["columns"] = "columns"
    place: str = Field(min_length=1)
    """A serial port, such as `/dev/ttyACM0`; `tcp://HOST:PORT` of a server; or `udp://HOST:PORT`
    at which datagrams arrive here, such as `udp://0.0.0.0:5000`."""
    baud: int = Field(default=115_200, ge=50, le=12_000_000)
    columns: dict[str, str] = Field(min_length=1, max_length=60)
    """Unit of each column, by its name, in their order; the name `-` skips a column."""
    separator: str = Field(default=",", max_length=4)
    """Between the numbers of a line; a space is any white space."""
    struct: str | None = Field(default=None, max_length=200)
    """Layout of a packet, as Python's `struct` writes it, such as `<Iff`, in place of lines."""
    time_column: str | None = None
    """Column with the device's time; without it rows are timed by their arrival."""
    time_unit: Literal["s", "ms", "us", "ns"] = "ms"
    shared_clock: Literal["ptp", "utc"] | None = None
    """Clock of the time column where the host has it too: TAI by PTP, or UTC. `sliplab record`
    uses it; a rig times such rows by their arrival."""
    uncertainty_ms: float | None = Field(default=None, gt=0, le=1000)
    """Bound of the error of a shared clock's times, of device and host together, milliseconds."""
    start: str = ""
    """Text that is sent when the connection opens, such as `START\\n`."""
    stall_s: float = Field(default=5.0, ge=0.1, le=3600)
    """Silence that is a fault, seconds."""

    @property
    def stored(self) -> dict[str, str]:
        """Units of the columns that are stored, by name."""
        return {
            name: unit for name, unit in self.columns.items() if name not in {"-", self.time_column}
        }

    @rule
    def _clock_is_stated(self) -> ColumnsSettings:
        if self.shared_clock is not None and None in (self.time_column, self.uncertainty_ms):
            text = "needs time_column and uncertainty_ms"
            raise KeyedError(".shared_clock", self.shared_clock, text)
        return self

    @rule
    def _columns_fit(self) -> ColumnsSettings:
        if self.time_column is not None and self.time_column not in self.columns:
            raise KeyedError(".time_column", self.time_column, "is not among the columns")
        try:
            table_kind(self.stored)
        except InputError as error:
            raise KeyedError(".columns", error.value, error.expected) from None
        if self.struct is not None:
            try:
                values = len(struct.unpack(self.struct, bytes(struct.calcsize(self.struct))))
            except struct.error as error:
                raise KeyedError(".struct", self.struct, f"is no layout: {error}") from None
            if values != len(self.columns):
                text = f"has {values} values, and there are {len(self.columns)} columns"
                raise KeyedError(".struct", self.struct, text)
        return self


class ColumnsSensor:
    """A `Sensor` that reads rows of numbers in a thread.

    Attributes:
        keeps_rows: rows whose times fall back are read, too; a fit refuses their clock. If not,
            they are a fault.
    """

    def __init__(self, settings: ColumnsSettings) -> None:
        self._settings = settings
        self.keeps_rows = settings.shared_clock is not None
        self.kind = table_kind(settings.stored)
        self._buffer = StreamBuffer(f"{DEVICE} {settings.place}", settings.stall_s, 256.0)
        self._read: Callable[[], bytes] = bytes
        self._close: Callable[[], None] = lambda: None
        self._thread: threading.Thread | None = None
        self._end = threading.Event()
        self._datagrams = settings.place.startswith("udp:")  # which are whole rows
        self.received = self.malformed = 0

    def connect(self) -> None:
        """Open the port or socket. Raises RigError."""
        settings = self._settings
        try:
            self._read, self._close = _open(settings)
        except (OSError, ValueError) as error:
            raise RigError(f"{DEVICE} {settings.place}", f"cannot be opened: {error}") from None
        self._thread = threading.Thread(target=self._receive, name="columns", daemon=True)
        self._thread.start()

    def start(self) -> None:
        """Start streaming; earlier rows are discarded."""
        self.received = self.malformed = 0
        self._buffer.begin()

    def read(self) -> Chunk:
        """Return the rows since the last call. Raises RigError."""
        parts = self._buffer.take("rows")
        names = self.kind.columns
        if not parts:
            return rows(self.kind, "", dict.fromkeys(names, ()))
        return rows(
            self.kind, "", {name: np.concatenate([part[name] for part in parts]) for name in names}
        )

    def stop(self) -> None:
        """Stop streaming; what has come can still be read."""
        self._buffer.end()

    def close(self) -> None:
        """Close the connection."""
        self._end.set()
        with suppress(Exception):
            self._close()
        if self._thread is not None:
            self._thread.join(OPEN_S)

    def describe(self) -> Json:
        """Return counts of this run."""
        return {"counts": {"received": self.received, "malformed": self.malformed}}

    def _receive(self) -> None:
        left = b""
        try:
            while not self._end.is_set():
                if not (data := self._read()):
                    continue
                host_ns = time.monotonic_ns()
                found, left = self._parse(left + data)
                if found:
                    self._add(np.array(found, np.float64), host_ns)
        except (OSError, ValueError, TypeError) as error:
            if not self._end.is_set():  # not closed meanwhile
                self._buffer.fail(str(error) or type(error).__name__)

    def _add(self, values: Any, host_ns: int) -> None:
        settings = self._settings
        times: Any = None
        if settings.time_column is not None:
            index = list(settings.columns).index(settings.time_column)
            times = np.rint(values[:, index] * UNITS[settings.time_unit])
            good = np.abs(times) < MOST_NS  # which NaN is not
            self.malformed += int((~good).sum())
            times, values = times[good].astype(np.int64), values[good]
        by_name = dict(zip(settings.columns, values.T, strict=True))
        host = np.full(len(values), host_ns)
        t_ns = host if times is None else times
        part = {"t": t_ns, "host": host, **{name: by_name[name] for name in settings.stored}}
        self.received += len(values)
        order = host if self.keeps_rows else t_ns
        self._buffer.add("rows", part, order, values.nbytes)

    def _parse(self, data: bytes) -> tuple[list[Any], bytes]:
        """Return the whole rows in some bytes, and what is left of them."""
        settings = self._settings
        if settings.struct is not None:
            size = struct.calcsize(settings.struct)
            whole = len(data) // size * size
            if self._datagrams and whole != len(data):  # the next one does not continue this one
                self.malformed += max(whole // size, 1)
                return [], b""
            return list(struct.iter_unpack(settings.struct, data[:whole])), data[whole:]
        lines = data.split(b"\n")
        if self._datagrams:
            lines.append(b"")
        found = []
        separator = None if settings.separator.isspace() else settings.separator
        for line in lines[:-1]:
            if not line.strip():
                continue
            cells = line.decode("ascii", "replace").strip().split(separator)
            try:
                values = [
                    0.0 if name == "-" else float(cell)
                    for name, cell in zip(settings.columns, cells, strict=True)
                ]
            except ValueError:
                self.malformed += 1
                continue
            found.append(values)
        if len(lines[-1]) > _MOST_LINE:
            raise ValueError(f"{_MOST_LINE} bytes without an end of line: is the baud rate right?")
        return found, lines[-1]


def _open(settings: ColumnsSettings) -> tuple[Callable[[], bytes], Callable[[], None]]:
    """Open a port or socket; return how to read what has come, within `WAIT_S`, and to close it."""
    place = urlsplit(settings.place)
    if place.scheme not in {"tcp", "udp"}:
        need("serial")
        import serial

        port = serial.Serial(settings.place, settings.baud, timeout=WAIT_S, exclusive=True)
        port.write(settings.start.encode())
        return lambda: port.read(max(1, port.in_waiting)), port.close
    if place.hostname is None or place.port is None:
        raise ValueError("must be tcp://HOST:PORT or udp://HOST:PORT")
    if place.scheme == "tcp":
        link = socket.create_connection((place.hostname, place.port), OPEN_S)
        link.sendall(settings.start.encode())
    else:
        link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        link.bind((place.hostname, place.port))
    link.settimeout(WAIT_S)

    def read() -> bytes:
        try:
            data = link.recv(1 << 16)
        except TimeoutError:
            return b""
        if not data and place.scheme == "tcp":
            raise OSError("the connection was closed at the other end")
        return data

    return read, link.close


def grade(settings: ColumnsSettings) -> StreamGrade:
    """Return how rows are timed."""
    return "host arrival" if settings.time_column is None else "host time"


def why_unreachable(settings: ColumnsSettings) -> str | None:
    """Return why a port or socket cannot be opened; None if it can."""
    if "://" not in settings.place:
        return serial_port(settings.place)
    try:
        _, close = _open(settings)
    except (OSError, ValueError) as error:
        return f"{settings.place} cannot be opened: {error}"
    close()
    return None


DRIVER = SensorDriver(
    name="columns",
    title="numbers from a serial port or socket",
    settings=ColumnsSettings,
    address=lambda settings: settings.place,
    ping=why_unreachable,
    locks=lambda settings: {f"columns-{settings.place}": f"the port {settings.place}"},
    build=ColumnsSensor,
    stream=table_kind({"value": ""}),
    grade=grade,
    fake=lazy("sliplab.plugins.record.columns_fake:FakeColumns"),
    reach=lambda settings, address: settings.model_copy(update={"place": address}),
)
