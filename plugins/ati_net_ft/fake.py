"""An ATI Net F/T sensor on the wire: RDT over UDP and the configuration page, with faults by name.

The driver speaks to it as to a sensor. Its load comes from a callable, so that a simulated scene
may drive it; its sample counter runs by a clock that may drift.
"""

from __future__ import annotations

import http.server
import socket
import threading
import time
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Self
from urllib.parse import parse_qs, urlsplit

import numpy as np

from sliplab.plugins.ati_net_ft import rdt
from sliplab.storage.streams import F64, WrenchChunk

TURN_S = 0.0005
"""Period at which the fake checks for due records."""
JOIN_S = 2.0
COUNTS_PER_N = COUNTS_PER_NM = 1_000_000
OUT_OF_RANGE = rdt.ERROR | 1 << 30
Load = Callable[[int], Sequence[float]]
"""From the clock's time, ns, to Fx Fy Fz (N) and Tx Ty Tz (N m)."""


class SensorFaultKind(Enum):
    """Faults of this fake, by their names in the table (`rigs.core.faults`); some are counted."""

    SILENCE = "device_silent"
    LOSS = "records_lost"
    REORDER = "records_reordered"
    DUPLICATE = "records_duplicated"
    SATURATED = "force_overload"
    RESTART = "clock_restart"
    MALFORMED = "records_malformed"


class FakeNetFt:
    """A sensor to read at `host`; a context manager: its threads end with it.

    Args:
        host: a loopback address that nothing else uses.
        load: the load that it measures; zero if left out.
        rate_hz: records a second, as set on its page.
        now_ns: the clock that its counter runs by.
        ticks: initial value of the 32-bit sample counter.
        units: of force and torque, as its page names them.
        fed: it sends what `send` is given instead, when it is given.

    Attributes:
        port, web_port: where it listens.
    """

    def __init__(
        self,
        host: str,
        load: Load = lambda now_ns: (0.0,) * 6,
        *,
        rate_hz: int = 1000,
        tick_hz: int = 7000,
        now_ns: Callable[[], int] = time.monotonic_ns,
        ticks: int = 0,
        units: tuple[str, str] = ("N", "N-m"),
        web: bool = True,
        fed: bool = False,
    ) -> None:
        self.host, self._load, self._now_ns = host, load, now_ns
        self.rate_hz, self._tick_hz, self._first_ticks = rate_hz, tick_hz, ticks
        self._units, self.filter_number = units, 0
        self._fed, self._last = fed, (0, np.zeros(6))
        self._overloaded = False
        self._origin_ns = now_ns()
        self._bias = np.zeros(6)
        self._left: dict[SensorFaultKind, int] = {}
        self._held: bytes | None = None
        self._to: tuple[str, int] | None = None
        self._number = self._most = 0
        self._due_ns = 0
        self._lock = threading.RLock()
        self._ending = threading.Event()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 0))
        self._socket.settimeout(TURN_S)
        self.port = int(self._socket.getsockname()[1])
        self._threads = [threading.Thread(target=self._work, name="fake net ft", daemon=True)]
        self._web = http.server.ThreadingHTTPServer((host, 0), _page_of(self)) if web else None
        self.web_port = int(self._web.server_address[1]) if self._web else 9
        if self._web is not None:
            serve = threading.Thread(target=self._web.serve_forever, args=(0.02,), daemon=True)
            self._threads.append(serve)
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the threads and give the ports back; to the host it has lost its power."""
        self._ending.set()
        if self._web is not None:
            self._web.shutdown()
            self._web.server_close()
            self._web = None
        for thread in self._threads:
            thread.join(JOIN_S)
        self._socket.close()

    @property
    def address(self) -> tuple[int, int]:
        """Its ports: of RDT and of the page."""
        return self.port, self.web_port

    @property
    def wraps_ns(self) -> tuple[int, ...]:
        """Times of a scene's clock at which the 32-bit sample counter wraps, ns."""
        return (2**32 * 1_000_000_000 // self._tick_hz,)

    def send(self, chunk: WrenchChunk) -> None:
        """Send samples of a scene, stamped by the scene's clock of this sensor."""
        with self._lock:
            loads = np.column_stack([chunk.force_n, chunk.torque_nm])
            for at_ns, load in zip(chunk.t_ns.tolist(), loads, strict=True):
                self._last = at_ns * self._tick_hz // 1_000_000_000, load
                if self._to is not None:
                    self._number += 1
                    self._send(*self._last)

    def overload(self) -> None:
        """Report that the load is out of range from now on."""
        with self._lock:
            self._overloaded = True
            if self._to is not None:
                self._send(*self._last)

    def silence(self) -> None:
        """Send nothing from now on."""
        self.inject(SensorFaultKind.SILENCE)

    @property
    def streaming(self) -> bool:
        """True while records are sent."""
        return self._to is not None

    def inject(self, kind: SensorFaultKind, count: int = 1) -> None:
        """Inject a fault now, in so many records; silence lasts."""
        with self._lock:
            if kind is SensorFaultKind.RESTART:
                self._origin_ns, self._first_ticks = self._now_ns(), 0
            else:
                self._left[kind] = count

    def restore(self) -> None:
        """Put everything right."""
        with self._lock:
            self._left.clear()

    def page(self) -> bytes:
        """Return the configuration page."""
        force, torque = self._units
        parts = {
            "runstat": "0x00000000",
            "prodname": "fake Net F/T",
            "setserial": "FT00000",
            "setfwver": "2.0",
            "setuserfilter": self.filter_number,
            "cfgcpf": COUNTS_PER_N,
            "cfgcpt": COUNTS_PER_NM,
            "scfgfu": force,
            "scfgtu": torque,
            "comrdte": "Enabled",
            "comrdtrate": self.rate_hz,
        }
        body = "".join(f"<{name}>{value}</{name}>" for name, value in parts.items())
        return f'<?xml version="1.0"?><netft>{body}</netft>'.encode()

    def write(self, path: str) -> None:
        """Set what a request to `comm.cgi` or `setting.cgi` asks for; other values stay."""
        asked = parse_qs(urlsplit(path).query)
        with self._lock:
            if "comrdtrate" in asked:
                fraction = max(round(self._tick_hz / int(asked["comrdtrate"][0])), 1)
                self.rate_hz = round(self._tick_hz / fraction)
            if "setuserfilter" in asked and int(asked["setuserfilter"][0]) <= 12:
                self.filter_number = int(asked["setuserfilter"][0])

    # -- the stream ------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._ending.is_set():
            try:
                data, sender = self._socket.recvfrom(64)
            except (TimeoutError, ConnectionError):
                data, sender = b"", ("", 0)
            except OSError:
                return
            with self._lock:
                if len(data) == rdt.REQUEST.size:
                    self._obey(data, sender)
                self._send_due()

    def _obey(self, data: bytes, sender: tuple[str, int]) -> None:
        header, command, count = rdt.REQUEST.unpack(data)
        if header != rdt.HEADER:
            return
        if command == rdt.STREAM:
            self._to, self._number, self._most = sender, 0, count
            self._due_ns = self._now_ns()
        elif command == rdt.SET_BIAS:
            load = self._last[1] if self._fed else self._load(self._now_ns())
            self._bias = np.array(load, np.float64)
        elif command == rdt.STOP:
            self._to = None

    def _send_due(self) -> None:
        if self._fed:
            if self._to is not None and self._most:
                self._number += 1
                self._send(*self._last)
                self._to = None
            return
        period_ns = 1_000_000_000 // self.rate_hz
        while self._to is not None and self._due_ns <= self._now_ns():
            at_ns, self._due_ns = self._due_ns, self._due_ns + period_ns
            self._number += 1
            passed = (at_ns - self._origin_ns) * self._tick_hz // 1_000_000_000
            self._send(self._first_ticks + passed, self._load(at_ns))
            if self._most and self._number == self._most:
                self._to = None

    def _happens(self, kind: SensorFaultKind) -> bool:
        left = self._left.get(kind, 0)
        if left:
            self._left[kind] = left - 1
        return left > 0

    def _send(self, ticks: int, felt: Sequence[float] | F64) -> None:
        if self._left.get(SensorFaultKind.SILENCE):
            return
        record = np.zeros(1, rdt.RECORD)
        record["rdt"], record["ft"] = self._number % 2**32, ticks % 2**32
        load = np.asarray(felt, np.float64) - self._bias
        force = rdt.NEWTONS.get(self._units[0], 1.0)
        torque = rdt.NEWTON_METRES.get(self._units[1], 1.0)
        record["force"] = np.rint(load[:3] / force * COUNTS_PER_N)
        record["torque"] = np.rint(load[3:] / torque * COUNTS_PER_NM)
        if self._overloaded or self._happens(SensorFaultKind.SATURATED):
            record["status"] = OUT_OF_RANGE
        data = record.tobytes()
        if self._happens(SensorFaultKind.LOSS):
            return
        if self._held is None and self._happens(SensorFaultKind.REORDER):
            self._held = data
            return
        sent = [data] if self._held is None else [data, self._held]
        self._held = None
        if self._happens(SensorFaultKind.DUPLICATE):
            sent.append(data)
        if self._happens(SensorFaultKind.MALFORMED):
            sent = [data[:20]]
        for one in sent:
            assert self._to is not None
            self._socket.sendto(one, self._to)


def _page_of(sensor: FakeNetFt) -> type[http.server.BaseHTTPRequestHandler]:
    """Return the handler of a sensor's page."""

    class SensorHandler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            written = self.path.startswith(("/comm.cgi", "/setting.cgi"))
            if written:
                sensor.write(self.path)
            found = written or self.path.startswith(f"/{rdt.PAGE}")
            body = sensor.page() if found else b""
            self.send_response(200 if found else 404)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: object) -> None:
            """Suppress log messages."""

    return SensorHandler
