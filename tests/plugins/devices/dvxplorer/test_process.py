"""A server that is no event camera gives an error in time, never a hang."""

from __future__ import annotations

import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import SimpleNamespace
from typing import Any

import dv_processing as dv
import numpy as np
import pytest

from sliplab.plugins.devices.dvxplorer import process as event_process
from sliplab.plugins.devices.dvxplorer import source
from sliplab.plugins.devices.dvxplorer.driver import DvxplorerCamera
from sliplab.plugins.devices.dvxplorer.fake_stream import (
    events_header,
    events_packet,
    triggers_header,
)
from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings, NetworkStream, UsbCamera
from sliplab.plugins.devices.dvxplorer.source import find_camera
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.streams import EventChunk
from tests.rigs.waiting import until

pytestmark = pytest.mark.realtime
EVENTS = events_header((640, 480), "somebody")
TRIGGERS = triggers_header("somebody")
ONE = EventChunk(
    np.array([3], np.uint16),
    np.array([4], np.uint16),
    np.array([1], np.uint8),
    np.array([1000], np.int64),
)

WITHIN_S = 30.0
"""Bound of an opening in these tests, s: `event_process.OPEN_S` and time for a busy computer."""


class Port:
    """A port that sends each connection what it is given, and then what `more` holds."""

    def __init__(self, *greetings: bytes | None) -> None:
        self._greetings = greetings
        self._links: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.number: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                link, _ = self._listener.accept()
                greeting = self._greetings[min(len(self._links), len(self._greetings) - 1)]
                self._links.append(link)
                if greeting is None:
                    link.close()
                else:
                    link.sendall(greeting)

    def send(self, data: bytes) -> None:
        """To the connection that came last."""
        self._links[-1].sendall(data)

    def close(self) -> None:
        self._listener.close()
        for link in self._links:
            link.close()


@contextmanager
def ports(events: tuple[bytes | None, ...]) -> Iterator[tuple[Port, DvxplorerSettings]]:
    """An events port that greets like this, and a good triggers port."""
    first, second = Port(*events), Port(TRIGGERS)
    source = NetworkStream(events_port=first.number, triggers_port=second.number)
    try:
        yield first, DvxplorerSettings(source=source)
    finally:
        first.close()
        second.close()


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    ("greeting", "message"),
    [
        (b"", r"127\.0\.0\.1:\d+: no answer within 2 s; .*sends its header on connecting"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", r"not a dv-processing stream: it began with b'HTTP"),
        (EVENTS[:100], "sent only 100 bytes of its header"),
        (struct.pack("<II", 1 << 30, 24) + b"IOHE", "not a dv-processing stream"),
        (EVENTS[:4] + bytes(4) + b"IOHE" + bytes(len(EVENTS) - 12), "AEDAT4"),
        (None, "disconnected after 0 bytes"),
    ],
)
def test_a_port_that_is_no_camera_is_named(greeting: bytes | None, message: str) -> None:
    began = time.monotonic()
    with ports((greeting,)) as (_, settings), pytest.raises(RigError, match=message):
        DvxplorerCamera(settings)
    assert time.monotonic() - began < WITHIN_S


def test_header_that_drips_has_one_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "HEADER_S", 0.5)
    port = Port(b"")

    def drip() -> None:
        with suppress(OSError, IndexError):
            for byte in struct.pack("<II", 1 << 19, 24) + b"IOHE" + bytes(1 << 19):
                port.send(bytes([byte]))
                threading.Event().wait(0.02)

    threading.Timer(0.1, drip).start()
    began = time.monotonic()
    with pytest.raises(RigError, match=r"sent only \d+ bytes of its header"):
        source.check_header("127.0.0.1", port.number)
    assert time.monotonic() - began < 5.0
    port.close()


def test_a_library_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_process, "OPEN_S", 5.0)
    began = time.monotonic()
    # the first connection looks at the header, the second one is the library's
    with (
        ports((EVENTS, b"")) as (_, settings),
        pytest.raises(RigError, match="no answer within 5 s"),
    ):
        DvxplorerCamera(settings)
    assert time.monotonic() - began < WITHIN_S


def test_ctrl_c_ends_an_opening_at_once() -> None:
    code = (
        "import signal, sys; from sliplab.plugins.devices.dvxplorer.driver import DvxplorerCamera; "
        "from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings; "
        # a shell's background job ignores it
        "signal.signal(signal.SIGINT, signal.default_int_handler); print('opening', flush=True); "
        "DvxplorerCamera(DvxplorerSettings.model_validate_json(sys.argv[1]))"
    )
    with ports((EVENTS, b"")) as (port, settings):
        command = [sys.executable, "-c", code, settings.model_dump_json()]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout.readline() == "opening\n"
            end = time.monotonic() + event_process.OPEN_S
            while len(port._links) < 2:  # the library connects, and hangs
                assert time.monotonic() < end
                threading.Event().wait(0.01)
            process.send_signal(signal.SIGINT)
            began = time.monotonic()
            _, said = process.communicate(timeout=60.0)
            assert time.monotonic() - began < event_process.OPEN_S / 2
            assert "KeyboardInterrupt" in said


def garbage(packet: bytes) -> bytes:
    """A packet whose length is right and whose content is no events."""
    return packet[:8] + bytes(reversed(packet[8:]))


@pytest.mark.parametrize("data", [garbage(events_packet(ONE)), struct.pack("<ii", 0, -5) * 9])
def test_bytes_that_are_no_packet_end_the_run_and_not_the_process(data: bytes) -> None:
    with ports((EVENTS,)) as (port, settings):
        camera = DvxplorerCamera(settings)
        try:
            camera.start()
            port.send(events_packet(ONE))
            until(lambda: camera.counts.events == 1)
            port.send(data)
            until(lambda: not camera._thread.is_alive())
            assert camera.read().t_us.tolist() == [1000]
            with pytest.raises(RigError, match=r"(died|has exited).*check the sender"):
                camera.read()
            with pytest.raises(RigError, match="dv-processing"):
                camera.start()
        finally:
            camera.close()


def test_a_packet_that_never_ends_is_silence() -> None:
    with ports((EVENTS,)) as (port, settings):
        camera = DvxplorerCamera(settings.model_copy(update={"stall_s": 0.5}))
        try:
            camera.start()
            port.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            with pytest.raises(RigError, match="sent no event and no pulse"):
                until(lambda: camera.read() is None)
        finally:
            camera.close()


@pytest.mark.parametrize(
    ("serial", "message"),
    [
        (None, "event camera: a DVXplorer was not found; found: none. Check its cable"),
        ("DXA00001", "a DVXplorer with serial number DXA00001 was not found; found: none"),
    ],
)
def test_no_camera_on_usb_is_named(serial: str | None, message: str) -> None:
    if dv.io.camera.discover():
        pytest.skip("a camera is plugged in")
    with pytest.raises(RigError, match=message):
        DvxplorerCamera(DvxplorerSettings(source=UsbCamera(serial=serial)))


def test_the_cameras_that_are_there_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    models = dv.io.camera.CameraModel
    there: list[Any] = [
        SimpleNamespace(cameraModel=models.DAVIS, serialNumber="00000008"),
        SimpleNamespace(cameraModel=models.DVXPLORER, serialNumber="DXA00001"),
        SimpleNamespace(cameraModel=models.DVXPLORER, serialNumber="DXA00002"),
    ]
    all_of_them = "davis 00000008, dvxplorer DXA00001, dvxplorer DXA00002"
    monkeypatch.setattr(dv.io.camera, "discover", lambda: there)
    assert find_camera("DXA00002") is there[2]
    with pytest.raises(RigError, match=f"number DXA9 was not found; found: {all_of_them}"):
        find_camera("DXA9")
    with pytest.raises(RigError, match=f"several: {all_of_them}; select one by source.serial"):
        find_camera(None)
    monkeypatch.setattr(dv.io.camera, "discover", lambda: there[:2])
    assert find_camera(None) is there[1]  # not the first one, which is none
