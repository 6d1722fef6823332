"""The driver of Prophesee cameras in the example package, on each of its sources, and installed."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from sliplab_prophesee import DRIVER, PropheseeSettings, build, ping
from sliplab_prophesee.driver import Prophesee
from sliplab_prophesee.evt import Decoded, Evt3Encoder, Header

from sliplab.rigs.core.capabilities import EventCamera, RigError
from sliplab.storage.streams import EventChunk, PulseChunk
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from sliplab.testing import conformance
from tests.examples.conftest import Lab, checkout
from tests.rigs.waiting import until

realtime = pytest.mark.realtime
test_driver = realtime(conformance(DRIVER, PropheseeSettings(source="stream")))
SIZE = 64, 48


def some_events(first_us: int = 1_000_000, count: int = 200, step_us: int = 500) -> EventChunk:
    at = np.arange(count)
    return EventChunk(
        (at % SIZE[0]).astype(np.uint16),
        (at % SIZE[1]).astype(np.uint16),
        (at % 2).astype(np.uint8),
        first_us + at.astype(np.int64) * step_us,
    )


def gathered(camera: EventCamera, count: int) -> tuple[EventChunk, list[int]]:
    parts: list[EventChunk] = []
    pulses: list[int] = []

    def enough() -> bool:
        parts.append(camera.read())
        pulses.extend(camera.read_pulses().t_ns.tolist())
        return sum(map(len, parts)) >= count

    until(enough, 5.0)
    return EventChunk.concatenate(parts), pulses


def same(found: EventChunk, sent: EventChunk) -> bool:
    return all(np.array_equal(getattr(found, n), getattr(sent, n)) for n in ("x", "y", "p", "t_us"))


@pytest.fixture
def opened() -> Iterator[Callable[..., Prophesee]]:
    cameras: list[Any] = []

    def make(**settings: Any) -> Prophesee:
        cameras.append(build(PropheseeSettings(**settings)))
        return cameras[-1]  # type: ignore[no-any-return]

    yield make
    for camera in cameras:
        camera.close()


# -- streams -------------------------------------------------------------------------------


@realtime
def test_what_is_no_such_stream_is_refused(opened: Callable[..., Prophesee]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def greet() -> None:
            link, _ = server.accept()
            with link:
                link.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=greet, daemon=True).start()
        with pytest.raises(RigError, match=rf"127.0.0.1:{port}: sends no RAW header"):
            opened(source="stream", port=port)
    with pytest.raises(RigError, match="Connection refused"):
        opened(source="stream", port=port)


@realtime
def test_edges_wait_for_events_of_their_time(opened: Callable[..., Prophesee]) -> None:
    assert DRIVER.fake is not None
    assert DRIVER.reach is not None
    fake = DRIVER.fake(SIZE)
    try:
        settings = DRIVER.reach(PropheseeSettings(), fake.address)
        camera = opened(**settings.model_dump())
        assert (camera.width, camera.height) == SIZE
        assert camera.health().model == "Prophesee stream"
        assert ping(settings) is None
        camera.start()
        sent = some_events()
        edges = PulseChunk(np.array([1_050_000_000, 1_150_000_000], np.int64))
        fake.send(sent, edges)
        found, pulses = gathered(camera, 200)
        assert same(found, sent)
        assert pulses == [1_050_000_000]
        fake.send(some_events(1_100_000), PulseChunk(np.empty(0, np.int64)))
        assert gathered(camera, 200)[1] == [1_150_000_000]
    finally:
        fake.close()


class Stopped:
    """A source that reads the same part again and again, as fast as it is asked."""

    name, serial, width, height = "none", "0", *SIZE

    def __init__(self, found: Decoded) -> None:
        self.found = found

    def start(self) -> None:
        pass

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass

    def read(self) -> Decoded:
        threading.Event().wait(0.01)
        return self.found


NONE = np.empty(0, np.int64)


@realtime
@pytest.mark.parametrize(
    ("events", "edges_us"),
    [(0, NONE), (1, NONE), (0, np.array([1_000_000], np.int64))],
    ids=["nothing", "one event", "one pulse"],
)
def test_parts_whose_times_stop_are_silence(events: int, edges_us: np.ndarray) -> None:
    part = Decoded(some_events(count=events), edges_us, 0 * edges_us, edges_us > 0)
    camera = Prophesee(PropheseeSettings(source="stream", stall_s=0.3), Stopped(part))
    try:
        camera.start()
        with pytest.raises(RigError, match=r"its clock has stopped|silent for 0\.\d s"):
            until(lambda: camera.read() is None, 5.0)
    finally:
        camera.close()


# -- recordings ----------------------------------------------------------------------------


@realtime
def test_a_recording_is_played_as_it_was_made(opened: Any, tmp_path: Path) -> None:
    sent = some_events(count=2000, step_us=500)
    edges = np.array([1_100_000, 1_200_000], np.int64)
    data = Header(3, SIZE, "512").text() + Evt3Encoder().encode(sent, edges, trigger=1)
    (path := tmp_path / "a.raw").write_bytes(data)
    settings = {"source": "file", "file": str(path), "trigger": 1}
    assert ping(PropheseeSettings(**settings)) is None
    camera = opened(**settings)
    assert camera.health().serial == "512"
    for _ in range(2):
        began = time.monotonic()
        camera.start()
        found, pulses = gathered(camera, 600)
        assert time.monotonic() - began > 0.29
        assert same(found, sent[: len(found)])
        assert pulses == [1_100_000_000, 1_200_000_000]
        camera.stop()
    camera.start()
    with pytest.raises(RigError, match="the recording has ended"):
        until(lambda: camera.read() is None, 5.0)


def test_a_file_that_is_no_recording(opened: Callable[..., Prophesee], tmp_path: Path) -> None:
    (path := tmp_path / "a.raw").write_bytes(b"nothing\n")
    with pytest.raises(RigError, match=r"a.raw: has no RAW header"):
        opened(source="file", file=str(path))
    absent = PropheseeSettings(source="file", file=str(tmp_path / "b.raw"))
    assert "no such file" in str(ping(absent))
    with pytest.raises(RigError, match="No such file"):
        build(absent)
    with pytest.raises(ValidationError, match="is needed by source: file"):
        PropheseeSettings(source="file")


# -- the maker's library -------------------------------------------------------------------


def test_a_computer_without_the_library_is_told_in_one_line(opened: Any) -> None:
    said = "needs metavision_hal, which comes with the Metavision SDK or OpenEB: install one of"
    with pytest.raises(RigError, match=said) as raised:
        opened()
    assert "\n" not in str(raised.value)
    assert said in str(ping(PropheseeSettings()))


class Facility:
    """What the maker's `Device` returns for each `get_i_...`; as far as the driver calls it."""

    def __init__(self, device: HalDevice) -> None:
        self.device = device

    def get_width(self) -> int:
        return SIZE[0]

    def get_height(self) -> int:
        return SIZE[1]

    def get_serial(self) -> str:
        return self.device.serial

    def get_sensor_info(self) -> Any:
        return type("SensorInfo", (), {"name_": "IMX636"})()

    def enable(self, channel: int) -> bool:
        self.device.enabled.append(channel)
        return True


class Buffered(Facility):
    """A decoder of one kind of event: callbacks with a structured array."""

    def __init__(self, device: HalDevice) -> None:
        super().__init__(device)
        self.callbacks: list[Callable[[Any], None]] = []

    def add_event_buffer_callback(self, callback: Callable[[Any], None]) -> None:
        self.callbacks.append(callback)


class HalDevice:
    """A stand-in of `metavision_hal.Device`: a buffer of events and edges each time one is due."""

    CD = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    EDGE = np.dtype([("p", "<i2"), ("t", "<i8"), ("id", "<i2")])

    def __init__(self, serial: str) -> None:
        self.serial, self.enabled, self.gone = serial, list[int](), False
        self.due: list[tuple[Any, Any]] = []
        self.started = 0
        self.plain, self.cd, self.edges = Facility(self), Buffered(self), Buffered(self)
        self._memory = np.empty(1000, self.CD)

    def __getattr__(self, name: str) -> Any:
        kinds = {
            "get_i_event_cd_decoder": self.cd,
            "get_i_event_ext_trigger_decoder": self.edges,
            "get_i_events_stream": self,
            "get_i_events_stream_decoder": self,
        }
        if not name.startswith("get_i_"):
            raise AttributeError(name)
        return lambda: kinds.get(name, self.plain)

    def start(self) -> None:
        self.started += 1

    def stop(self) -> None:
        self.started -= 1

    def poll_buffer(self) -> int:
        return -1 if self.gone else int(bool(self.due))

    def get_latest_raw_data(self) -> Any:
        return self.due.pop(0)

    def decode(self, raw: Any) -> None:
        events, edges = raw
        part = self._memory[: len(events)]  # used again for the next buffer
        part[:] = events
        for callback in self.cd.callbacks:
            callback(part)
        for callback in self.edges.callbacks:
            callback(edges)


@pytest.fixture
def hal(monkeypatch: pytest.MonkeyPatch) -> dict[str, HalDevice]:
    """A computer with the library and one camera."""
    devices = {"0512": HalDevice("0512")}

    class Discovery:
        @staticmethod
        def list() -> list[str]:
            return [f"Prophesee:hal_plugin_prophesee:{serial}" for serial in devices]

        @staticmethod
        def open(serial: str) -> HalDevice | None:
            return devices.get(serial or next(iter(devices), ""))

    module: Any = ModuleType("metavision_hal")
    module.DeviceDiscovery = Discovery
    module.I_TriggerIn = type("I_TriggerIn", (), {"Channel": type("Channel", (), {"MAIN": 0})})
    module.__spec__ = type(sys.__spec__)("metavision_hal", None)
    monkeypatch.setitem(sys.modules, "metavision_hal", module)
    return devices


def buffer(events: EventChunk, *edges: tuple[int, int, int]) -> tuple[Any, Any]:
    rows = np.empty(len(events), HalDevice.CD)
    rows["x"], rows["y"], rows["p"], rows["t"] = events.x, events.y, events.p, events.t_us
    return rows, np.array(list(edges), HalDevice.EDGE)


@realtime
def test_a_camera_is_read_by_the_makers_library(hal: dict[str, HalDevice], opened: Any) -> None:
    device = hal["0512"]
    assert ping(PropheseeSettings(serial="0512")) is None
    assert "no camera 77; the library lists Prophesee" in str(ping(PropheseeSettings(serial="77")))
    camera = opened()
    health = camera.health()
    assert (health.model, health.serial) == ("Prophesee IMX636", "0512")
    assert (camera.width, camera.height) == SIZE
    assert device.enabled == [0]
    first, second = some_events(), some_events(1_200_000)
    for _ in range(2):  # its times begin anew with each start
        camera.start()
        device.due += [
            buffer(first, (1, 1_010_000, 0), (0, 1_015_000, 0)),
            buffer(second, (1, 1_020_000, 5)),
        ]
        found, pulses = gathered(camera, 400)
        assert same(found, EventChunk.concatenate([first, second]))
        assert pulses == [1_010_000_000]  # neither the falling edge nor another input's
        camera.stop()
        assert device.started == 0
    camera.start()
    device.gone = True
    with pytest.raises(RigError, match="the camera sends no more"):
        until(lambda: camera.read() is None, 3.0)


def test_a_camera_that_is_absent_is_a_fault(hal: dict[str, HalDevice], opened: Any) -> None:
    with pytest.raises(RigError, match="camera 77: no such camera"):
        opened(serial="77")
    hal.clear()
    assert "the library lists no camera" in str(ping(PropheseeSettings()))


# -- installed -----------------------------------------------------------------------------


@realtime
@pytest.mark.long  # test_lab_plugin.py installs a package and runs a campaign every time
@pytest.mark.xdist_group("scene")
def test_the_package_runs_a_campaign(tmp_path: Path) -> None:
    before = checkout()
    sliplab = Lab(tmp_path, "prophesee")
    on = ("protocol.yaml", "--rig", "rig.yaml", "--store", "store")
    listed, checked, taken, _, labelled = sliplab(
        ("rigs", "--drivers"),
        ("check", *on),
        ("collect", *on, "--trials", "1"),
        ("sync", "store"),
        ("label", "store"),
    )
    drivers = {found["name"]: found for found in listed["drivers"]}
    assert drivers["prophesee"]["package"] == "sliplab-prophesee 0.1.0"
    assert drivers["prophesee"]["simulated_on_loopback"]
    assert all(check["passed"] for check in checked["checks"]), checked["checks"]
    assert (taken["planned"], taken["committed"]) == (4, 1)
    assert taken["simulated"] is True
    assert labelled["done"] == 1
    store = TrialStore.open(sliplab.folder / "store")
    assert verify(store) == []
    for recording in store.campaign("prophesee").recordings():
        with recording.open() as reader:
            pulses = len(reader.pulses("event_pulses"))
            sent = len(reader.pulses("sync_pulses"))
        assert pulses == sent > 50
        assert recording.record.counts.events > 10_000
    assert checkout() == before
