"""The driver of ATI Net F/T sensors against one on the wire: what it reads, how each fault ends."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.clocks.clock_bounds import fit_bounds
from sliplab.plugins.ati_net_ft import rdt
from sliplab.plugins.ati_net_ft.driver import AtiNetFt
from sliplab.plugins.ati_net_ft.fake import FakeNetFt, SensorFaultKind
from sliplab.plugins.ati_net_ft.settings import AtiNetFtSettings
from sliplab.rigs.core.capabilities import ForceSensor, RigError
from sliplab.storage.streams import WrenchChunk
from tests.rigs.waiting import fault_of, gather, own_address, until

pytestmark = pytest.mark.realtime

ANSWER_S, SILENCE_S, SLACK_S = 0.2, 0.3, 1.0
Make = Callable[..., tuple[AtiNetFt, FakeNetFt]]


@pytest.fixture
def make() -> Iterator[Make]:
    """Makes sensors and drivers on them, which are closed after the test."""
    with ExitStack() as stack:

        def build(
            connected: bool = True, wire: Any = None, rows: int | None = None, **settings: Any
        ) -> tuple[AtiNetFt, FakeNetFt]:
            """Started, and read from until there are so many rows, if that is a number."""
            fake = stack.enter_context(FakeNetFt(own_address(), **(wire or {})))
            sensor = AtiNetFt(settings_for(fake, **settings))
            stack.callback(sensor.close)
            if connected:
                sensor.connect()
            if rows is not None:
                sensor.start()
                gather(sensor.read, rows)
            return sensor, fake

        yield build


def settings_for(fake: FakeNetFt, **more: Any) -> AtiNetFtSettings:
    return AtiNetFtSettings(
        driver="ati_net_ft",
        host=fake.host,
        port=fake.port,
        web_port=fake.web_port,
        **{"answer_s": ANSWER_S, "silence_s": SILENCE_S, **more},
    )


def test_it_is_a_force_sensor(make: Make) -> None:
    sensor, _ = make(connected=False)
    assert isinstance(sensor, ForceSensor)
    assert sensor.zeroing == "trial"
    assert sensor.mounting.feels == "plate"


def test_records_come_in_newtons_with_the_sensors_own_time(make: Make) -> None:
    load = (0.5, -1.25, 3.0, 0.01, -0.02, 0.03)
    sensor, _ = make(wire={"load": lambda now_ns: load})
    assert len(sensor.read()) == 0
    sensor.start()
    found = gather(sensor.read, 200)
    assert np.allclose(found.force_n, load[:3], atol=1e-6)
    assert np.allclose(found.torque_nm, load[3:], atol=1e-6)
    assert found.t_ns.dtype == np.int64
    # a thousand records a second, seven ticks of 1/7000 s apart
    assert np.all(np.abs(np.diff(found.t_ns) - 1_000_000) <= 150_000)
    assert np.all(np.diff(found.host_ns) >= 0)
    sensor.stop()
    assert sensor.describe()["counts"]["lost"] == 0


def test_its_clock_is_bounded_by_arrivals(make: Make) -> None:
    """A map from counter and arrivals holds what the counter truly ran by."""
    origin = time.monotonic_ns()
    drift = 150e-6

    def clock() -> int:
        return origin + round((time.monotonic_ns() - origin) * (1 + drift))

    sensor, fake = make(wire={"now_ns": clock})
    sensor.start()
    chunk = gather(sensor.read, 800)
    device, host = chunk.t_ns, chunk.host_ns
    longest_ns = 200_000_000  # a busy machine's
    found = fit_bounds(device, host - longest_ns, host, 400.0)
    shown = device[[0, -1]]
    true = origin + np.rint((shown + fake._origin_ns - origin) / (1 + drift)).astype(np.int64)
    off = np.abs(np.asarray(found.map.to_reference(shown)) - true)
    assert np.all(off <= found.uncertainty_ns + 150_000)  # and a tick


def test_units_and_counts_come_from_its_page(make: Make) -> None:
    load = (10.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    sensor, _ = make(wire={"load": lambda now_ns: load, "units": ("lbf", "lbf-in")})
    sensor.start()
    chunk = gather(sensor.read, 5)
    assert chunk.force_n[-1, 0] == pytest.approx(10.0, abs=1e-4)
    assert chunk.torque_nm[-1, 2] == pytest.approx(1.0, abs=1e-5)


def test_given_counts_need_no_page(make: Make) -> None:
    sensor, _ = make(
        wire={"load": lambda now_ns: (1.0,) * 6, "web": False},
        counts_per_n=500_000.0,
        counts_per_nm=1e6,
    )
    sensor.start()
    assert gather(sensor.read, 5).force_n[-1, 0] == pytest.approx(2.0)


def test_rate_and_filter_are_written_and_read_back(make: Make) -> None:
    sensor, fake = make(rate_hz=500, filter_hz=73)
    assert (fake.rate_hz, fake.filter_number) == (500, 4)
    sensor.start()
    found = gather(sensor.read, 50).t_ns
    assert np.median(np.diff(found)) == pytest.approx(2_000_000, abs=150_000)
    described = sensor.describe()
    assert (described["rate_hz"], described["filter_number"]) == (500, 4)
    assert sensor.health().model == "fake Net F/T"


def test_a_rate_that_it_has_not_is_refused_by_name(make: Make) -> None:
    sensor, _ = make(connected=False, rate_hz=600)
    with pytest.raises(RigError, match=r"rate_hz: 600 was not taken, .* comrdtrate = 583"):
        sensor.connect()


def test_bias_of_a_session_is_taken_when_it_connects(make: Make) -> None:
    load = (0.0, 0.0, 2.0, 0.0, 0.0, 0.0)
    sensor, _ = make(wire={"load": lambda now_ns: load}, bias="session")
    sensor.start()
    assert gather(sensor.read, 5).force_n[-1, 2] == pytest.approx(0.0)


def test_lost_records_are_counted(make: Make) -> None:
    sensor, fake = make()
    sensor.start()
    chunks = [gather(sensor.read, 20)]
    fake.inject(SensorFaultKind.LOSS, 7)
    chunks.append(gather(sensor.read, 50))
    assert sensor.counts.lost == 7
    assert np.diff(WrenchChunk.concatenate(chunks).t_ns).max() == pytest.approx(
        8_000_000, abs=150_000
    )


def test_a_late_record_and_a_double_are_dropped_and_counted(make: Make) -> None:
    sensor, fake = make()
    sensor.start()
    chunks = [gather(sensor.read, 20)]
    fake.inject(SensorFaultKind.REORDER, 3)
    chunks.append(gather(sensor.read, 50))
    fake.inject(SensorFaultKind.DUPLICATE, 2)
    chunks.append(gather(sensor.read, 50))
    assert np.all(np.diff(WrenchChunk.concatenate(chunks).t_ns) > 0)
    assert (sensor.counts.late, sensor.counts.lost) == (5, 0)


def test_what_is_no_record_is_counted(make: Make) -> None:
    sensor, fake = make(rows=5)
    fake.inject(SensorFaultKind.MALFORMED, 2)
    gather(sensor.read, 20)
    assert (sensor.counts.malformed, sensor.counts.lost) == (2, 2)


def test_silence_is_a_fault(make: Make) -> None:
    sensor, fake = make(rows=5)
    fake.inject(SensorFaultKind.SILENCE)
    fault = fault_of(sensor.read, SILENCE_S + SLACK_S)
    assert re.search("nothing came for 0.3 s.*is too busy", fault)
    with pytest.raises(RigError, match="nothing came"):
        sensor.read()
    fake.restore()
    sensor.start()
    gather(sensor.read, 5)


def test_a_saturated_sensor_is_a_fault(make: Make) -> None:
    sensor, fake = make(rows=5)
    fake.inject(SensorFaultKind.SATURATED)
    assert "0xC0000000: force or torque out of range" in fault_of(sensor.read, 0.5 + SLACK_S)


def test_a_sensor_that_begins_anew_is_a_fault(make: Make) -> None:
    sensor, fake = make(wire={"ticks": 10**6}, rows=5)
    fake.inject(SensorFaultKind.RESTART)
    assert "it restarted" in fault_of(sensor.read, 0.5 + SLACK_S)


def test_a_sensor_that_is_not_there_is_named_within_its_bound(make: Make) -> None:
    sensor, fake = make(connected=False)
    fake.close()
    begin = time.monotonic()
    with pytest.raises(RigError, match="no answer from its page"):
        sensor.connect()
    assert time.monotonic() - begin < ANSWER_S + SLACK_S


def test_a_page_that_answers_without_records_is_named(make: Make) -> None:
    sensor, fake = make(connected=False)
    fake.inject(SensorFaultKind.SILENCE)
    begin = time.monotonic()
    with pytest.raises(RigError, match=r"no record from .*: none within 0.6 s"):
        sensor.connect()
    assert time.monotonic() - begin < 3 * ANSWER_S + SLACK_S


def test_a_saturated_sensor_does_not_connect(make: Make) -> None:
    sensor, fake = make(connected=False)
    fake.inject(SensorFaultKind.SATURATED)
    with pytest.raises(RigError, match="out of range; take the load off"):
        sensor.connect()


def test_closing_ends_the_stream_and_may_be_repeated(make: Make) -> None:
    sensor, fake = make(rows=5)
    sensor.close()
    sensor.close()
    until(lambda: not fake.streaming, 2.0)
    with pytest.raises(RigError, match="is not connected"):
        sensor.start()


@pytest.mark.parametrize(
    ("page", "said"),
    [
        (b"<netft></netft>", "lacks <cfgcpf>"),
        (b"nothing", "is no configuration page"),
        (b"<!DOCTYPE x><netft/>", "is no configuration page"),
        (
            b"<netft><cfgcpf>1</cfgcpf><cfgcpt>1</cfgcpt><scfgfu>oz</scfgfu></netft>",
            "<scfgfu> is 'oz'; known: N, kN",
        ),
        (b"<netft><cfgcpf>many</cfgcpf><scfgfu>N</scfgfu></netft>", "'many', no number"),
        (b"<netft><cfgcpf>0</cfgcpf><scfgfu>N</scfgfu></netft>", "must be above 0"),
        (b"<netft><comrdte>Disabled</comrdte></netft>", "RDT is switched off"),
    ],
)
def test_a_page_that_is_none_is_named(page: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        rdt.ConfigurationPage.parse(page)


@pytest.mark.parametrize(
    ("status", "said"),
    [
        (0, None),
        (0x80010000, None),
        (0x00010000, None),
        (0x80000005, "status 0x80000005: internal temperature out of range, broken gauge"),
        (0x80000040, "status 0x80000040: see its manual"),
    ],
)
def test_status_words(status: int, said: str | None) -> None:
    assert rdt.status_problem(status) == said


# -- records that cannot be used: fed by hand, on a clock of the test ------------------------------


class Wire:
    """A driver that is given datagrams, a record a millisecond of seven ticks."""

    def __init__(self) -> None:
        self.now_ns = 10**12
        settings = AtiNetFtSettings(host="127.0.0.1", counts_per_n=1e6, counts_per_nm=1e6)
        self.sensor = AtiNetFt(settings, lambda: self.now_ns)
        self.sensor._scale = 1e6, 1e6
        self._last: int | None = None

    def hear(self, data: bytes) -> None:
        self.now_ns += 1_000_000
        with self.sensor._lock:
            self._last = self.sensor._take(data, self.now_ns, self._last)
            self.sensor._check_silence()

    def hear_all(self, numbers: Iterable[int], ahead: int = 0, newtons: float = 0.0) -> None:
        for number in numbers:
            self.hear(record(number + ahead, 7 * number + ahead, newtons))


def record(number: int, ticks: int, newtons: float = 0.0) -> bytes:
    found = np.zeros(1, rdt.RECORD)
    found["rdt"], found["ft"] = number % 2**32, ticks % 2**32
    found["force"][0, 2] = round(newtons * 1e6)
    return found.tobytes()


@pytest.fixture
def wire() -> Wire:
    """A driver that is given datagrams."""
    return Wire()


def test_one_record_far_ahead_is_dropped_and_the_next_ones_are_read(wire: Wire) -> None:
    wire.hear_all(range(600))
    wire.hear(record(600 + 2**30, 7 * 600 + 2**30))
    wire.hear_all(range(601, 2156), newtons=50.0)
    found = wire.sensor.read()
    assert found.force_n[:, 2].max() == 50.0
    assert len(found) == 600 + 1555
    counts = wire.sensor.counts
    assert (counts.ahead, counts.late, counts.lost) == (1, 0, 1)


@pytest.mark.parametrize(
    ("useless", "said"),
    [
        (lambda n: record(n, 7 * n)[:35], "0 late, 0 ahead of their time, 500 malformed"),
        (lambda n: record(n, 7 * n) + b"x", "0 late, 0 ahead of their time, 500 malformed"),
        (lambda n: record(50, 350), "500 late, 0 ahead of their time, 0 malformed"),
        (lambda n: record(n % 90, 7 * (n % 90)), "500 late, 0 ahead of their time, 0 malformed"),
        (lambda n: record(n, 7 * n + 10**6), "0 late, 500 ahead of their time, 0 malformed"),
    ],
    ids=["short", "long", "the same", "older ones", "far ahead"],
)
def test_records_that_cannot_be_used_are_silence(wire: Wire, useless: Any, said: str) -> None:
    wire.hear_all(range(90))
    for number in range(90, 589):
        wire.hear(useless(number))
    wire.sensor.read()
    wire.hear(useless(589))
    with pytest.raises(RigError, match=f"none of 500 datagrams of the last 0.5 s .*{said}"):
        wire.sensor.read()


def test_first_record_far_ahead_ends_in_a_fault(wire: Wire) -> None:
    wire.hear(record(2**30, 2**30))
    wire.hear_all(range(500))
    with pytest.raises(RigError, match="none of 500 datagrams"):
        wire.sensor.read()


def test_records_that_waited_in_a_buffer_are_not_ahead(wire: Wire) -> None:
    wire.hear_all(range(100))
    wire.now_ns += 3_000_000_000  # of these 3 s the first records fitted into the buffer
    for number in range(100, 600):
        wire.now_ns -= 999_000
        wire.hear(record(number, 7 * number))
    wire.hear_all(range(3100, 3200))
    assert len(wire.sensor.read()) == 700
    assert (wire.sensor.counts.ahead, wire.sensor.counts.lost) == (0, 2500)


def test_doubles_do_not_make_lost_records_good(wire: Wire) -> None:
    wire.hear_all([1, 2, 6, 3, 3, 2, 2, 1, 1, 7])
    counts = wire.sensor.counts
    assert (counts.lost, counts.late) == (2, 6)


@pytest.mark.parametrize(("first", "lost"), [(2**32 - 3, 0), (2**32 - 2, 3)])
def test_counters_wrap_at_32_bits(wire: Wire, first: int, lost: int) -> None:
    wire.hear_all([first + n + (lost if n > 2 else 0) for n in range(6)])
    assert (wire.sensor.counts.received, wire.sensor.counts.lost) == (6, lost)
    assert len(wire.sensor.read()) == 6


def test_numbers_of_another_request_are_neither_lost_nor_late(wire: Wire) -> None:
    for ticks, number in enumerate([500, 501, 1, 2, 2**31, 4], 1):
        wire.hear(record(number, 7 * ticks))
    counts = wire.sensor.counts
    assert (counts.received, counts.lost, counts.late) == (6, 0, 0)


def test_page_that_drips_has_one_deadline() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        page = b"HTTP/1.1 200 OK\r\n" * 9
        threading.Thread(target=drip, args=(server, page), daemon=True).start()
        settings = AtiNetFtSettings(
            host="127.0.0.1", web_port=server.getsockname()[1], answer_s=ANSWER_S
        )
        begin = time.monotonic()
        with pytest.raises(RigError, match="no answer from its page"):
            AtiNetFt(settings).connect()
        assert time.monotonic() - begin < ANSWER_S + SLACK_S


def drip(server: socket.socket, data: bytes) -> None:
    """Send a byte every 50 ms to the one who connects."""
    link, _ = server.accept()
    with link, suppress(OSError):
        for byte in data:
            link.sendall(bytes([byte]))
            threading.Event().wait(0.05)


def test_one_count_needs_the_other() -> None:
    with pytest.raises(ValueError, match="must be given where the other one is"):
        AtiNetFtSettings(driver="ati_net_ft", host="x", counts_per_n=1.0)
