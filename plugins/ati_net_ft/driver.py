"""Driver of ATI Net F/T sensors.

A thread takes every record with the host's time of its arrival. The sensor's clock is its sample
counter, `ft_sequence`, in nanoseconds at its nominal rate: it continues whether or not records are
lost. A record that comes after a later one is counted and dropped, so that times never fall back,
and so is one whose counter is ahead of the time that has passed. Silence is the time without an
accepted record, whatever else arrives. Every wait is bounded by the settings; what goes wrong is a
`RigError` in the next call.
"""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sliplab.plugins.ati_net_ft import rdt
from sliplab.plugins.ati_net_ft.settings import FILTER_NUMBERS, AtiNetFtSettings
from sliplab.protocols.timing import ForceGrade
from sliplab.rigs.core.capabilities import DeviceHealth, Mounting, RigError
from sliplab.rigs.core.host_clock import OR_BUSY, StallTimer
from sliplab.rigs.core.network import BoundedSocket
from sliplab.storage.streams import Json, WrenchChunk

DEVICE = "force sensor"
TRIES = 3
"""Requests for a first record before the sensor is taken for absent."""
LOOK_S = 0.05
"""The listening thread looks this often whether it shall end."""
JOIN_S = 1.0
BACKLOG = 1 << 20
"""Records buffered for a reader, two minutes at most; older ones are dropped, and counted."""
MISSING = 1 << 12
"""Numbers of missing records that are remembered, for those that come late."""
RECEIVE_BYTES = 1 << 20
"""Kernel's buffer: a host that is busy for some seconds loses nothing."""
_WRAP, _HALF = 1 << 32, 1 << 31


@dataclass
class RecordCounts:
    """Records of one stream, and what became of others."""

    received: int = 0
    lost: int = 0
    """Missing by their numbers, and not come late either."""
    late: int = 0
    """Came after a later one, or twice; dropped."""
    ahead: int = 0
    """Sample counter farther ahead than the time that has passed allows; dropped."""
    malformed: int = 0
    dropped: int = 0
    """Not read in time."""


class AtiNetFt:
    """An ATI Net F/T sensor; a `ForceSensor` of `rigs.core.capabilities`.

    Args:
        now_ns: the host's monotonic clock.
    """

    grade: ForceGrade = "host time"

    def __init__(
        self, settings: AtiNetFtSettings, now_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._settings, self._now_ns = settings, now_ns
        self.mounting = Mounting(
            "plate", settings.mounting_rotvec_deg, "plate" if settings.mounted == "plate" else "arm"
        )
        self.zeroing = settings.bias
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._lock = threading.Lock()
        self._waiting: deque[tuple[bytes, int]] = deque(maxlen=BACKLOG)
        self._page: rdt.ConfigurationPage | None = None
        self._scale = (1.0, 1.0)
        self._fault: str | None = None
        self._ticks: int | None = None
        """Sample counter of the last record, unwrapped."""
        self._number: int | None = None
        self._forget()

    def _forget(self) -> None:
        """Begin a stream: nothing is known of its records."""
        self.counts, self._fault = RecordCounts(), None
        self._number = self._ticks = None
        self._missing: deque[int] = deque(maxlen=MISSING)
        self._passed = self._rejected = 0
        self._least_ns: int | None = None
        """Shortest delay of a record against the first one's."""
        self._silence = StallTimer(self._now_ns, LOOK_S)

    def connect(self) -> None:
        """Read and write the sensor's settings, and see that a record comes.

        Takes at most `TRIES` + 5 times `answer_s`.

        Raises:
            RigError: no answer, no calibration, a setting that was not taken, or an error status.
        """
        self.close()
        settings = self._settings
        self._fault = self._ticks = None
        if settings.reads_page:
            self._page = self._configure()
        page = self._page
        self._scale = (
            settings.counts_per_n or (page.counts_per_n if page else 1.0),
            settings.counts_per_nm or (page.counts_per_nm if page else 1.0),
        )
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
            self._socket.connect((settings.host, settings.port))
            self._socket.settimeout(LOOK_S)
            self._greet()
        except OSError as error:
            self.close()
            raise self._absent(error) from None
        except BaseException:
            self.close()
            raise
        if self.zeroing == "session":
            self.zero()

    def start(self) -> None:
        """Begin to stream; earlier records are dropped.

        Raises:
            RigError: it is not connected, or cannot be sent to.
        """
        self._halt()
        with self._lock:
            self._waiting.clear()
            self._forget()
        self._drain()
        self._send(rdt.STREAM)
        self._ending.clear()
        self._thread = threading.Thread(target=self._listen, name="net ft", daemon=True)
        self._thread.start()

    def read(self) -> WrenchChunk:
        """Forces and torques since the last call, newtons and newton metres.

        Raises:
            RigError: the sensor fell silent, restarted, or says that it cannot be trusted.
        """
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
            fault = self._fault
        if fault is not None:
            raise RigError(DEVICE, fault)
        if not taken:
            return WrenchChunk.empty()
        found = rdt.records(b"".join(data for data, _ in taken))
        ticks = self._unwrap(found["ft"].astype(np.int64))
        return WrenchChunk(
            ticks * 1_000_000_000 // self._settings.tick_hz,
            np.array([host_ns for _, host_ns in taken], np.int64),
            found["force"] / self._scale[0],
            found["torque"] / self._scale[1],
        )

    def zero(self) -> None:
        """Take the present load for zero from now on (the sensor's own bias)."""
        self._send(rdt.SET_BIAS)

    def stop(self) -> None:
        """Stop streaming; received records can still be read."""
        self._halt()

    def close(self) -> None:
        """Stop, and give the port back; safe to call more than once."""
        with contextlib.suppress(RigError):
            self._halt()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def health(self) -> DeviceHealth:
        """Return what the sensor's page says of it.

        Raises:
            RigError: the page does not answer.
        """
        page = self._page or self._read_page()
        return DeviceHealth(
            device=DEVICE,
            model=page.product or "unknown",
            serial=page.serial or "unknown",
            firmware=page.firmware or "unknown",
            temperature_c=None,
            clock=f"its sample counter, {self._settings.tick_hz} a second",
            notes=(f"{page.rate_hz or 'unknown'} records a second",),
        )

    def describe(self) -> Json:
        """Return calibration, settings and losses of the stream that was read last."""
        page = self._page
        return {
            "counts": vars(self.counts).copy(),
            "counts_per_n": self._scale[0],
            "counts_per_nm": self._scale[1],
            "rate_hz": page.rate_hz if page else self._settings.rate_hz,
            "filter_number": page.filter_number if page else None,
            "tick_hz": self._settings.tick_hz,
            "bias": self._settings.bias,
            "serial": page.serial if page else "",
        }

    # -- the web page ----------------------------------------------------------------------

    def _configure(self) -> rdt.ConfigurationPage:
        """Write rate and filter, and read the page, which must show the written values."""
        settings = self._settings
        if settings.rate_hz is not None:
            self._get(f"{rdt.RATE_PAGE}{settings.rate_hz}")
        number = None if settings.filter_hz is None else FILTER_NUMBERS[settings.filter_hz]
        if number is not None:
            self._get(f"{rdt.FILTER_PAGE}{number}")
        page = self._read_page()
        for name, key, asked, found in (
            ("rate_hz", "comrdtrate", settings.rate_hz, page.rate_hz),
            ("filter_hz", "setuserfilter", number, page.filter_number),
        ):
            if asked is not None and found != asked:
                raise RigError(
                    DEVICE,
                    f"{name}: {getattr(settings, name)} was not taken, its page says {key} = "
                    f"{found} instead of {asked}; give a value that it has",
                )
        return page

    def _read_page(self) -> rdt.ConfigurationPage:
        text = self._get(rdt.PAGE)
        try:
            return rdt.ConfigurationPage.parse(text)
        except ValueError as error:
            raise RigError(
                DEVICE, f"http://{self._settings.host}:{self._settings.web_port}/{rdt.PAGE} {error}"
            ) from None

    def _get(self, path: str) -> bytes:
        settings = self._settings
        link = http.client.HTTPConnection(settings.host, settings.web_port)
        try:
            link.sock = BoundedSocket.open(settings.host, settings.web_port, settings.answer_s)
            link.request("GET", f"/{path}")
            answer = link.getresponse()
            body = answer.read(1 << 20)
            if answer.status >= 400:
                raise OSError(f"status {answer.status} for /{path}")
        except (OSError, http.client.HTTPException) as error:
            raise RigError(
                DEVICE,
                f"no answer from its page on {settings.host}:{settings.web_port}: {error}; check "
                "its power, its network and its address, or give counts_per_n and counts_per_nm",
            ) from None
        finally:
            link.close()
        return body

    # -- the stream ------------------------------------------------------------------------

    def _send(self, command: int, count: int = 0) -> None:
        if self._socket is None:
            raise RigError(DEVICE, "is not connected; connect it first")
        try:
            self._socket.send(rdt.request(command, count))
        except OSError as error:
            raise self._absent(error) from None

    def _absent(self, error: OSError | str) -> RigError:
        return RigError(
            DEVICE,
            f"no record from {self._settings.host}:{self._settings.port}: {error}; check its "
            "power, its network and its address, and that no other program reads it",
        )

    def _greet(self) -> None:
        """Check that one record without an error arrives."""
        assert self._socket is not None
        self._send(rdt.STOP)
        for _ in range(TRIES):
            self._send(rdt.STREAM, 1)
            end = time.monotonic() + self._settings.answer_s
            while time.monotonic() < end:
                try:
                    data = self._socket.recv(2048)
                except TimeoutError:
                    continue
                if len(data) == rdt.RECORD.itemsize:
                    problem = rdt.status_problem(rdt.SEQUENCES.unpack_from(data)[2])
                    if problem is not None:
                        raise RigError(DEVICE, f"{problem}; take the load off, or see to it")
                    return
        raise self._absent(f"none within {TRIES * self._settings.answer_s:g} s")

    def _drain(self) -> None:
        """Discard records from before the stream, at most those in the kernel's buffer."""
        if self._socket is None:
            return
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):
            for _ in range(RECEIVE_BYTES):
                self._socket.recv(2048)
        self._socket.settimeout(LOOK_S)

    def _halt(self) -> None:
        """End the stream and the thread."""
        thread, self._thread = self._thread, None
        if thread is None:
            if self._socket is None:
                return
        else:
            self._ending.set()
            thread.join(JOIN_S)
        self._send(rdt.STOP)

    def _listen(self) -> None:
        """The thread: every record, until the stream ends or cannot be believed."""
        link = self._socket
        assert link is not None
        last: int | None = None
        try:
            while not self._ending.is_set():
                try:
                    data: bytes | None = link.recv(2048)
                except TimeoutError:
                    data = None
                with self._lock:
                    if data is not None:
                        last = self._take(data, self._now_ns(), last)
                    self._check_silence()
                    if self._fault is not None:
                        return
        except Exception as error:  # a thread that dies must not look like a silent sensor
            self._fail(f"its stream ended: {error}")

    def _check_silence(self) -> None:
        """Note a fault if no record was accepted for too long; a host that was suspended waits."""
        silence_s = self._settings.silence_s
        if self._fault is not None or self._silence.waited_s(self.counts.received) < silence_s:
            return
        counts = self.counts
        self._fault = (
            f"none of {self._rejected} datagrams of the last {silence_s:g} s could be used (since "
            f"the start {counts.late} late, {counts.ahead} ahead of their time, "
            f"{counts.malformed} malformed): it restarted, or another program reads it; start the "
            "trial again"
            if self._rejected
            else f"nothing came for {silence_s:g} s; check its power and its cable, and that no "
            f"other program reads it{OR_BUSY}"
        )

    def _take(self, data: bytes, host_ns: int, last: int | None) -> int | None:
        """Take one datagram; returns the sample counter of the newest record that was accepted."""
        counts = self.counts
        self._rejected += 1
        if len(data) != rdt.RECORD.itemsize:
            counts.malformed += 1
            return last
        number, ticks, status = rdt.SEQUENCES.unpack_from(data)
        problem = rdt.status_problem(status)
        if problem is not None:
            self._fault = self._fault or f"{problem}; take the load off, or see to it"
            return last
        step = 1 if self._number is None else _signed(number - self._number)
        gone = 1 if last is None else _signed(ticks - last)
        if step <= 0 and gone <= 0:
            counts.late += 1
            if number in self._missing:
                self._missing.remove(number)
                counts.lost -= 1
            return last
        if gone <= 0:
            self._fault = self._fault or (
                "its sample counter stopped or fell back: it restarted; start the trial again"
            )
            return last
        if last is None:
            self._passed, self._least_ns = 0, None
        elif self._is_ahead(self._passed + gone, host_ns):
            counts.ahead += 1
            return last
        else:
            self._passed += gone
        delay_ns = self._delay_ns(self._passed, host_ns)
        self._least_ns = delay_ns if self._least_ns is None else min(self._least_ns, delay_ns)
        if 1 < step <= gone:  # else the numbers of another request began
            counts.lost += step - 1
            first = number - min(step - 1, MISSING)
            self._missing.extend(one % _WRAP for one in range(first, number))
        counts.received += 1
        counts.dropped += len(self._waiting) == BACKLOG
        self._number, self._rejected = number, 0
        self._waiting.append((data, host_ns))
        return int(ticks)

    def _delay_ns(self, passed: int, host_ns: int) -> int:
        """Delay of a record, against an unknown constant, ns."""
        return host_ns - passed * 1_000_000_000 // self._settings.tick_hz

    def _is_ahead(self, passed: int, host_ns: int) -> bool:
        """Return whether a record came before the time that its sample counter says.

        The one that came fastest is the measure: what waited in a buffer may come in a burst.
        """
        least_ns, slack_ns = self._least_ns, self._settings.silence_s * 1e9
        return least_ns is not None and self._delay_ns(passed, host_ns) < least_ns - slack_ns

    def _fail(self, fault: str) -> None:
        with self._lock:
            self._fault = self._fault or fault

    def _unwrap(self, ticks: np.ndarray) -> np.ndarray:
        """Unwrap readings (n,) of the 32-bit counter."""
        first = int(ticks[0]) if self._ticks is None else self._ticks
        steps = np.diff(ticks, prepend=first % _WRAP)
        steps = (steps + _HALF) % _WRAP - _HALF
        found = first + np.cumsum(steps)
        self._ticks = int(found[-1])
        return found


def _signed(difference: int) -> int:
    """Return a difference of two 32-bit counters as a number of either sign."""
    return (difference + _HALF) % _WRAP - _HALF
