"""The real dv-processing against a fake in another process: what one sends, the other has."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from typing import Any

import dv_processing as dv
import numpy as np
import pytest

from benchmarks.dvxplorer_server import DvxplorerServer, Sent, arrays, scene
from sliplab.plugins.devices.dvxplorer.driver import DvxplorerCamera
from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings, NetworkStream, UsbCamera
from sliplab.plugins.devices.dvxplorer.source import (
    DvxEventSource,
    check_taken,
    configure,
    in_force,
)
from sliplab.rigs.core.capabilities import EventCamera, RigError
from sliplab.storage.streams import I64, EventChunk
from tests.patching import loose
from tests.rigs.waiting import until

pytestmark = pytest.mark.realtime


def random_events(count: int, every_us: int = 5, seed: int = 3) -> EventChunk:
    rng = np.random.default_rng(seed)
    times = 1_700_000_000_000_000 + np.cumsum(rng.integers(0, 2 * every_us, count))
    return EventChunk(
        rng.integers(0, 640, count).astype(np.uint16),
        rng.integers(0, 480, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
        times.astype(np.int64),
    )


@contextmanager
def listening(server: DvxplorerServer, **changes: Any) -> Iterator[DvxplorerCamera]:
    camera = DvxplorerCamera(server.settings.model_copy(update=changes))
    try:
        yield camera
    finally:
        camera.close()


def all_of(camera: DvxplorerCamera, server: DvxplorerServer) -> tuple[EventChunk, I64, Sent]:
    """Let it send, and read while it comes."""
    chunks, pulses = [], []
    server.go()
    sent = server.finish(60.0)

    def done() -> bool:
        chunks.append(camera.read())
        pulses.append(camera.read_pulses().t_ns)
        counts = camera.counts
        return (counts.events, counts.pulses) == (sent.events, sent.pulses)

    until(done)
    chunks.append(camera.read())
    pulses.append(camera.read_pulses().t_ns)
    return EventChunk.concatenate(chunks), np.concatenate(pulses), sent


def test_nothing_is_lost_and_all_is_exact() -> None:
    chunk = random_events(200_000)
    pulses = np.arange(chunk.t_us[0] + 7, chunk.t_us[-1], 2000)
    source = partial(arrays, chunk, pulses, 2000)
    with DvxplorerServer(source, realtime=False) as server, listening(server) as camera:
        assert isinstance(camera, EventCamera)
        assert (camera.width, camera.height) == (640, 480)
        camera.start()
        came, edges_ns, sent = all_of(camera, server)
        assert (sent.events, sent.pulses) == (len(chunk), len(pulses))
        for name, dtype in (("x", "u2"), ("y", "u2"), ("p", "u1"), ("t_us", "i8")):
            assert getattr(came, name).dtype == dtype
            assert np.array_equal(getattr(came, name), getattr(chunk, name))
        assert np.array_equal(edges_ns, pulses * 1000)
        assert camera.counts.gaps == 0
        camera.stop()
        assert camera.describe()["counts"]["events"] == sent.events


def test_a_scene_in_real_time() -> None:
    source = partial(scene, 0.4)
    expected = list(scene(0.4))
    with DvxplorerServer(source) as server, listening(server) as camera:
        camera.start()
        came, edges_ns, sent = all_of(camera, server)
        assert sent.seconds >= 0.3
        assert np.array_equal(came.t_us, np.concatenate([events.t_us for events, _ in expected]))
        assert np.array_equal(edges_ns, 1000 * np.concatenate([pulse for _, pulse in expected]))
        assert len(came) > 1000


def test_a_stalled_camera_is_noticed_and_may_come_back() -> None:
    chunk = random_events(20_000)
    source = partial(arrays, chunk, np.empty(0, np.int64), 10_000)
    with (
        DvxplorerServer(source, realtime=False, stall_after=2) as server,
        listening(server, stall_s=0.3) as camera,
    ):
        camera.start()
        server.go()
        server.await_stall(20.0)
        before = int(np.count_nonzero(chunk.t_us < chunk.t_us[0] + 20_000))
        until(lambda: camera.counts.events == before)
        got = 0

        def read() -> bool:
            nonlocal got
            got += len(camera.read())
            return False

        with pytest.raises(
            RigError, match=r"sent no event and no pulse for \d\.\d s.* is too busy"
        ):
            until(read)
        assert got == before
        server.resume()
        server.finish(20.0)
        until(lambda: camera.counts.events == len(chunk))


def test_a_cut_connection_is_an_error_after_what_came() -> None:
    chunk = random_events(5000)
    source = partial(arrays, chunk, np.empty(0, np.int64), 10_000)
    with DvxplorerServer(source, realtime=False) as server, listening(server) as camera:
        camera.start()
        server.go()
        server.finish(20.0)
        until(lambda: camera.counts.events == len(chunk))
        server.close()
        until(lambda: not camera._thread.is_alive())
        assert len(camera.read()) == len(chunk)
        with pytest.raises(RigError, match="connection is lost"):
            camera.read()
        with pytest.raises(RigError, match="connection is lost"):
            camera.read_pulses()
        with pytest.raises(RigError, match="connection is lost"):
            camera.start()


def test_nobody_listening_is_named() -> None:
    settings = DvxplorerSettings(source=NetworkStream(events_port=9, triggers_port=10))
    with pytest.raises(RigError, match=r"127\.0\.0\.1:9"):
        DvxplorerCamera(settings)


def test_streams_that_are_mixed_up_are_named() -> None:
    source = partial(arrays, random_events(10), np.empty(0, np.int64), 1000)
    with DvxplorerServer(source) as server:
        mixed = NetworkStream(events_port=server.triggers_port, triggers_port=server.events_port)
        with pytest.raises(RigError, match="sends no events"):
            DvxplorerCamera(DvxplorerSettings(source=mixed))


class Batches:
    """An input that gives what it is told to: for what no real stream would send."""

    def __init__(self) -> None:
        self.events: list[Any] = []
        self.triggers: list[Any] = []

    def getNextEventBatch(self) -> Any:
        return self.events.pop(0) if self.events else None

    def getNextTriggerBatch(self) -> Any:
        return self.triggers.pop(0) if self.triggers else None

    def isRunning(self) -> bool:
        return True


class Endless(Batches):
    """An input that always has the same to give."""

    def __init__(self, make: Callable[[], Any]) -> None:
        super().__init__()
        self._make = make

    def getNextEventBatch(self) -> Any:
        return super().getNextEventBatch() if self.events else self._make()


def store(*times_us: int) -> Any:
    events = dv.EventStore()
    for at in times_us:
        events.push_back(at, 5, 6, True)
    return events


@contextmanager
def fed(given: Batches | None = None, **settings: Any) -> Iterator[tuple[DvxplorerCamera, Batches]]:
    batches = given or Batches()
    source = DvxEventSource(batches, batches, None, (640, 480), "batches")
    camera = DvxplorerCamera(DvxplorerSettings(**settings), source)
    try:
        yield camera, batches
    finally:
        camera.close()


def test_what_came_before_the_start_is_dropped_and_after_the_stop_too() -> None:
    with fed() as (camera, batches):
        batches.events.append(store(1, 2, 3))
        until(lambda: camera.counts.before == 3)
        camera.start()
        batches.events.append(store(4, 5))
        until(lambda: camera.counts.events == 2)
        camera.stop()
        batches.events.append(store(6))
        until(lambda: camera.counts.before == 1)
        assert camera.read().t_us.tolist() == [4, 5]
        assert len(camera.read()) == 0


def test_a_closed_camera_does_not_start() -> None:
    with fed() as (camera, _):
        camera.close()
        with pytest.raises(RigError, match="open it again"):
            camera.start()


def test_gaps_are_counted() -> None:
    with fed(gap_s=0.001) as (camera, batches):
        camera.start()
        batches.events += [store(0, 10, 1011), store(2500)]
        until(lambda: camera.counts.events == 4)
        assert (camera.counts.gaps, camera.counts.longest_gap_us) == (2, 1489)


def test_a_clock_that_falls_back_ends_the_run() -> None:
    with fed() as (camera, batches):
        camera.start()
        batches.events += [store(100, 200), store(150)]
        until(lambda: not batches.events)
        assert camera.read().t_us.tolist() == [100, 200]
        with pytest.raises(RigError, match="jumped back after 200 us"):
            until(lambda: camera.read() is None)


def test_only_rising_edges_are_pulses_and_a_reset_ends_the_run() -> None:
    kinds = dv.TriggerType
    with fed() as (camera, batches):
        camera.start()
        batches.triggers.append(
            [
                dv.Trigger(10, kinds.EXTERNAL_SIGNAL_RISING_EDGE),
                dv.Trigger(15, kinds.EXTERNAL_SIGNAL_FALLING_EDGE),
            ]
        )
        until(lambda: camera.counts.other_triggers == 1)
        assert camera.read_pulses().t_ns.tolist() == [10_000]
        batches.triggers.append([dv.Trigger(0, kinds.TIMESTAMP_RESET)])
        with pytest.raises(RigError, match="was reset"):
            until(lambda: camera.read_pulses() is None)


def test_memory_is_bounded_and_what_does_not_fit_is_counted() -> None:
    with fed(buffer_mb=1.0) as (camera, batches):
        camera.start()
        batch = store(*range(50_000))
        batches.events += [batch, store(60_000, *range(60_001, 90_000)), store(90_001)]
        until(lambda: camera.counts.overflowed == 30_001)
        assert len(camera.read()) == 50_000
        with pytest.raises(RigError, match="not read in time"):
            camera.read()


def test_the_noise_filter_is_off_unless_it_is_asked_for() -> None:
    with fed(noise_filter_us=1000) as (camera, batches):
        camera.start()
        batches.events.append(store(1000))  # nothing near it
        until(lambda: camera.counts.filtered == 1)
        assert camera.counts.events == 0
    assert DvxplorerSettings().noise_filter_us is None


def test_a_camera_is_set_by_names_that_the_library_has() -> None:
    done: dict[str, Any] = {}

    class Recorder:
        def getEventResolution(self) -> tuple[int, int]:
            return 640, 480

        def __getattr__(self, name: str) -> Callable[[Any], None]:
            assert hasattr(dv.io.camera.DVXplorer, name)
            return lambda value: done.update({name: value})

    usb = UsbCamera(contrast_on=12)
    configure(Recorder(), usb)
    assert done["setReadoutFPS"] == dv.io.camera.DVXplorer.ReadoutFPS.CONSTANT_1000
    assert done["setDetectorRisingEdges"] is True
    assert done["setContrastThresholdOn"] == 12
    assert "setContrastThresholdOff" not in done
    readouts = UsbCamera.model_fields["readout"].annotation
    for readout in loose(readouts).__args__:
        configure(Recorder(), UsbCamera(readout=readout))


class Clamping:
    """A DVXplorer that answers by the library's names, with thresholds up to 17."""

    def __init__(self) -> None:
        kinds = dv.io.camera.DVXplorer
        self.values: dict[str, Any] = {
            "SubSampleHorizontal": kinds.SubSample.EVERY_FOURTH,
            "Flatten": kinds.Flatten.ON_ONLY,
            "FlipHorizontal": True,
            "CropArea": (10, 10, 100, 100),
            "ContrastThresholdOn": 3,
            "ContrastThresholdOff": 9,
            "TimestampOffset": timedelta(seconds=2),
        }

    def getEventResolution(self) -> tuple[int, int]:
        return 640, 480

    def setContrastThresholdOn(self, value: int) -> None:
        self.values["ContrastThresholdOn"] = min(value, 17)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        assert hasattr(dv.io.camera.DVXplorer, name)
        if name.startswith("set"):
            return lambda value: self.values.update({name.removeprefix("set"): value})
        return lambda: self.values.get(name.removeprefix("get"))


def test_what_was_left_in_the_camera_is_written_and_read_back() -> None:
    camera = Clamping()
    configure(camera, UsbCamera(contrast_on=12))
    found = in_force(camera)
    assert found["CropArea"] == [0, 0, 640, 480]
    assert found["SubSampleHorizontal"] == "every pixel"
    assert (found["Flatten"], found["FlipHorizontal"]) == ("none", False)
    assert (found["ContrastThresholdOn"], found["ContrastThresholdOff"]) == (12, 9)
    assert (found["ReadoutFPS"], found["TimeInterval"]) == ("constant 1000", 2000)
    assert found["TimestampOffset"] == 2_000_000
    assert json.loads(json.dumps(found)) == found
    check_taken(found, UsbCamera(contrast_on=12))


def test_a_threshold_that_the_camera_does_not_take_is_refused() -> None:
    camera, usb = Clamping(), UsbCamera(contrast_on=40)
    configure(camera, usb)
    with pytest.raises(RigError, match=r"source.contrast_on = 40: the camera set 17"):
        check_taken(in_force(camera), usb)


@pytest.mark.parametrize("times_us", [(), (100, 100)], ids=["no event", "a clock that stopped"])
def test_batches_that_show_no_life_are_silence(times_us: tuple[int, ...]) -> None:
    with fed(Endless(lambda: store(*times_us)), stall_s=0.3) as (camera, _):
        camera.start()
        with pytest.raises(RigError, match="its clock has stopped for"):
            until(lambda: camera.read() is None)


def test_repeated_and_other_triggers_are_silence() -> None:
    rising, other = dv.Trigger(7, dv.TriggerType(1)), dv.Trigger(9, dv.TriggerType(2))
    with fed(stall_s=0.3) as (camera, batches):
        camera.start()
        batches.triggers = [[rising], *[[rising, other]] * 100_000]
        with pytest.raises(RigError, match="its clock has stopped for"):
            until(lambda: camera.read() is None)
        batches.triggers = []
        assert camera.counts.pulses == 1
        assert camera.counts.other_triggers > 2


def test_event_outside_of_the_sensor_is_a_fault() -> None:
    outside = dv.EventStore()
    outside.push_back(10, 640, 6, True)
    with fed() as (camera, batches):
        camera.start()
        batches.events = [store(5), outside]
        until(lambda: not batches.events)
        assert len(camera.read()) == 1
        with pytest.raises(RigError, match="an event outside of its 640 x 480 px"):
            until(lambda: camera.read() is None)
