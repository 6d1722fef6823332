"""Numbers from a serial port, which is a pseudo terminal, and from sockets."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from sliplab.plugins.record.columns import ColumnsSettings
from sliplab.plugins.record.columns_fake import FakeColumns
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import Source, columns
from sliplab.protocols.errors import InputError
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

ROWS = 60


@contextmanager
def repeated(send: Callable[[int], object]) -> Iterator[None]:
    """Send rows every 5 ms in a thread while the block runs."""
    end = threading.Event()

    def work() -> None:
        index = 0
        while not end.wait(0.005):
            send(index)
            index += 1

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join(10)


def recorded(folder: Path, source: Source, send: Callable[[int], object]) -> Recording:
    """Record until some rows have come."""
    with record([source], folder, "rows") as recorder, repeated(send):
        deadline = time.monotonic() + 30
        with recorder.trial() as trial:
            while trial.rows()[source.name] < ROWS and time.monotonic() < deadline:
                assert not trial.faults
                time.sleep(0.01)
    return TrialStore.open(folder).campaign("rows").recording(trial.id)


def test_lines_of_a_serial_port_are_timed_by_arrival_and_wrong_ones_counted(tmp_path: Path) -> None:
    pytest.importorskip("serial")
    known = {"force": "N", "-": "", "angle": "deg"}
    with closing(FakeColumns(ColumnsSettings(place="-", columns=known))) as line:
        found = recorded(
            tmp_path,
            columns("glove", line.address, known),
            lambda i: line.write(b"junk\n" if i % 10 == 3 else b"%d,x1,%g\n" % (i, i / 2)),
        )
    rows = found.samples("glove")
    np.testing.assert_array_equal(rows["angle"], rows["force"] / 2)
    assert (np.diff(rows["force"]) > 0).all()
    assert found.record.devices["glove"]["counts"]["malformed"] > 0
    assert found.clocks.streams["glove"].grade == "host arrival"


def test_packets_of_a_socket_have_the_device_s_time(tmp_path: Path) -> None:
    server = socket.create_server(("127.0.0.1", 0))
    links: list[socket.socket] = []
    threading.Thread(target=lambda: links.append(server.accept()[0]), daemon=True).start()
    place = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    units = {"clock": "us", "pull": "N"}
    packets = {"struct": "<Qd", "time_column": "clock", "time_unit": "us"}
    source = columns("gauge", place, units, delay_ms=5000, **packets)  # on a busy machine
    origin = time.monotonic_ns() - 5_000_000_000

    def send(index: int) -> None:
        if links:
            links[0].sendall(struct.pack("<Qd", (time.monotonic_ns() - origin) // 1000, index))

    try:
        found = recorded(tmp_path, source, send)
    finally:
        server.close()
        for link in links:
            link.close()
    assert (np.diff(found.samples("gauge")["pull"]) == 1).all()
    clock = found.clocks.streams["gauge"]
    assert clock.grade == "host time"
    first, last = found.record.imported.span_ns
    middle = (first + last) // 2
    assert abs(clock.map.to_reference(middle - origin) - middle) <= clock.uncertainty_ns


def test_datagrams_arrive_here(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        found = recorded(
            tmp_path,
            columns("net", f"udp://127.0.0.1:{port}", {"a": "N"}),
            lambda i: sender.sendto(b"%d\n" % i, ("127.0.0.1", port)),
        )
    assert len(found.samples("net")["a"]) >= ROWS


@pytest.mark.parametrize(
    ("more", "key"),
    [
        ({"struct": "<f"}, "struct"),
        ({"struct": "<zz"}, "struct"),
        ({"time_column": "when"}, "time_column"),
        ({"columns": {"T": "N"}}, "columns"),
    ],
)
def test_a_declaration_that_cannot_be_right_is_refused(more: dict[str, object], key: str) -> None:
    from sliplab.protocols.yaml_file import validate

    given = {"place": "/dev/ttyACM0", "columns": {"a": "N", "b": "N"}, **more}
    with pytest.raises(InputError) as raised:
        validate(ColumnsSettings, given, "streams.yaml")
    assert raised.value.key.startswith(key)
