"""Sources of a Prophesee camera's data: the maker's library, a stream of bytes, a recording.

The library is Metavision SDK or OpenEB, whose Python modules come with their installers and not
from a package index. It is used by its documented calls, and was never tried here on a camera: the
tests have a stand-in of the module. Streams and recordings go through `sliplab_prophesee.evt`.
"""

from __future__ import annotations

import importlib
import importlib.util
import socket
import threading
import time
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np

from sliplab.rigs.core.capabilities import UNKNOWN, RigError
from sliplab.storage.streams import EventChunk
from sliplab_prophesee import PropheseeSettings
from sliplab_prophesee.evt import (
    I64,
    MOST_HEADER,
    Decoded,
    Decoder,
    FormatFault,
    Header,
)

DEVICE = "event camera"
LIBRARY = "metavision_hal"
ANSWER_S = 2.0
"""Time limit of connecting, and of a header, s."""
WAIT_S = 0.05
"""Longest wait of `read`, s."""
_BLOCK = 1 << 16
_END = b"% end\n"


class Source(Protocol):
    """Where events come from; opened by its constructor, used by one thread after `start`."""

    width: int
    height: int
    name: str
    serial: str

    def start(self) -> None:
        """Begin to send. Raises OSError, FormatFault."""

    def read(self) -> Decoded | None:
        """Return what has come; None after `WAIT_S` without anything.

        Raises:
            OSError, FormatFault: nothing will come any more.
        """

    def stop(self) -> None:
        """End sending."""

    def close(self) -> None:
        """Give everything back; at any time, and more than once."""


def open_source(settings: PropheseeSettings) -> Source:
    """Open what the settings name.

    Raises:
        RigError: it is not there, or no such camera, stream or recording.
    """
    try:
        if settings.source == "stream":
            return StreamSource(settings.host, settings.port)
        if settings.file is not None:
            return FileSource(Path(settings.file))
        return CameraSource(settings.serial)
    except (OSError, FormatFault) as error:
        raise RigError(DEVICE, f"{settings.where}: {error}; check its power and cable") from None


class StreamSource:
    """The bytes of a RAW recording over TCP, as they are made."""

    name = "stream"

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), ANSWER_S)
        try:
            header, self._ahead = self._read_header()
            found = Header.parse(header)
        except BaseException:
            self._socket.close()
            raise
        self._decoder = Decoder(found)
        (self.width, self.height), self.serial = found.size, found.serial or UNKNOWN
        self._socket.settimeout(WAIT_S)

    def _read_header(self) -> tuple[bytes, bytes]:
        data, end_s = b"", time.monotonic() + ANSWER_S
        while _END not in data:
            if len(data) > MOST_HEADER or (data and not data.startswith(b"%")):
                raise FormatFault("sends no RAW header")
            self._socket.settimeout(max(end_s - time.monotonic(), 1e-3))
            more = self._socket.recv(_BLOCK)
            if not more:
                raise OSError("the connection is gone")
            data += more
        header, _, rest = data.partition(_END)
        return header, rest

    def start(self) -> None:
        """A stream flows by itself."""

    def read(self) -> Decoded | None:
        """Return what has come."""
        data, self._ahead = self._ahead, b""
        if not data:
            try:
                data = self._socket.recv(_BLOCK)
            except TimeoutError:
                return None
            if not data:
                raise OSError("the connection is gone")
        return self._decoder.decode(data)

    def stop(self) -> None:
        """A stream flows on."""

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class FileSource:
    """A RAW recording, played as fast as it was made, from its beginning at each start."""

    def __init__(self, path: Path) -> None:
        self._file: IO[bytes] = path.open("rb")
        self.name = path.name
        self._never = threading.Event()
        try:
            lines = []
            while (line := self._file.readline(MOST_HEADER)) != _END:
                if not line.startswith(b"%"):
                    raise FormatFault("has no RAW header")
                lines.append(line)
            self._header = Header.parse(b"".join(lines))
        except BaseException:
            self._file.close()
            raise
        (self.width, self.height), self.serial = self._header.size, self._header.serial or UNKNOWN
        self._data_at = self._file.tell()
        self._decoder: Decoder | None = None
        self._held: Decoded | None = None
        self._began_ns = self._first_us = 0

    def start(self) -> None:
        """Begin anew."""
        self._file.seek(self._data_at)
        self._decoder, self._held, self._first_us = Decoder(self._header), None, -1

    def read(self) -> Decoded | None:
        """Return the next part, once it was made."""
        if self._held is None:
            assert self._decoder is not None
            data = self._file.read(_BLOCK // 16)
            if not data:
                raise OSError("the recording has ended")
            self._held = self._decoder.decode(data)
        span_us = _span_us(self._held)
        if span_us is not None:
            if self._first_us < 0:
                self._began_ns, self._first_us = time.monotonic_ns(), span_us[0]
            due_ns = self._began_ns + (span_us[1] - self._first_us) * 1000
            left_s = (due_ns - time.monotonic_ns()) * 1e-9
            if left_s > 0:
                self._never.wait(min(left_s, WAIT_S))
                return None
        found, self._held = self._held, None
        return found

    def stop(self) -> None:
        """Nothing to do: it is played where it is read."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _span_us(found: Decoded) -> tuple[int, int] | None:
    """Return the first and the last time; None without any."""
    known = [times for times in (found.events.t_us, found.trigger_us) if len(times)]
    if not known:
        return None
    return min(int(times[0]) for times in known), max(int(times[-1]) for times in known)


class CameraSource:
    """A camera by the maker's library, which decodes.

    Args:
        serial: of the camera; empty for the first one.

    Raises:
        RigError: the library is not installed.
        OSError: no such camera.
    """

    def __init__(self, serial: str) -> None:
        hal = _library()
        try:
            self._device = hal.DeviceDiscovery.open(serial)
        except RuntimeError as error:  # the library's own exceptions are of this kind
            raise OSError(" ".join(str(error).split())) from None
        if self._device is None:
            raise OSError("no such camera; other programs must not hold it")
        geometry = self._device.get_i_geometry()
        self.width, self.height = int(geometry.get_width()), int(geometry.get_height())
        about = self._device.get_i_hw_identification()
        self.name = str(about.get_sensor_info().name_)
        self.serial = str(about.get_serial())
        self._device.get_i_trigger_in().enable(hal.I_TriggerIn.Channel.MAIN)
        self._stream = self._device.get_i_events_stream()
        self._decoder = self._device.get_i_events_stream_decoder()
        self._events: list[EventChunk] = []
        self._edges: list[Any] = []
        self._device.get_i_event_cd_decoder().add_event_buffer_callback(self._take_events)
        self._device.get_i_event_ext_trigger_decoder().add_event_buffer_callback(self._take_edges)
        self._never = threading.Event()

    def _take_events(self, found: Any) -> None:
        # the library's own memory, which it uses again
        self._events.append(
            EventChunk(
                found["x"].astype(np.uint16),
                found["y"].astype(np.uint16),
                found["p"].astype(np.uint8),
                found["t"].astype(np.int64),
            )
        )

    def _take_edges(self, found: Any) -> None:
        self._edges.append(np.array(found))

    def start(self) -> None:
        """Begin to stream."""
        self._events.clear()
        self._edges.clear()
        self._stream.start()

    def read(self) -> Decoded | None:
        """Return what has come."""
        ready = self._stream.poll_buffer()
        if ready < 0:
            raise OSError("the library says that the camera sends no more")
        if ready == 0:
            self._never.wait(0.001)
            return None
        raw = self._stream.get_latest_raw_data()
        if raw is not None:
            self._decoder.decode(raw)
        events = EventChunk.concatenate(self._events)
        edges = np.concatenate(self._edges) if self._edges else None
        self._events, self._edges = [], []
        if edges is None:
            none: I64 = np.empty(0, np.int64)
            return Decoded(events, none, none, np.empty(0, bool))
        return Decoded(
            events, edges["t"].astype(np.int64), edges["id"].astype(np.int64), edges["p"] == 1
        )

    def stop(self) -> None:
        """End the stream."""
        self._stream.stop()

    def close(self) -> None:
        """Give the camera back: the library closes it when nothing holds it."""
        self._device = self._stream = self._decoder = None


def find_camera(serial: str) -> str | None:
    """Return why a camera cannot be reached; None if the library lists it."""
    try:
        hal = _library()
    except RigError as error:
        return str(error)
    listed = [str(name) for name in hal.DeviceDiscovery.list()]
    if not listed:
        return "the library lists no camera; check its power, its cable and the access rights"
    if serial and not any(serial in name for name in listed):
        return f"no camera {serial}; the library lists {', '.join(listed)}"
    return None


def _library() -> Any:
    if importlib.util.find_spec(LIBRARY) is None:
        raise RigError(
            DEVICE,
            f"needs {LIBRARY}, which comes with the Metavision SDK or OpenEB: install one of them, "
            "or use source: stream",
        )
    return importlib.import_module(LIBRARY)
