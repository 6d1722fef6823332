"""The grab thread against results that no emulated camera gives: chunks, disorder, lateness."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.devices.basler.frame_time import FrameStamping
from sliplab.plugins.devices.basler.grabbing import NO_ID, Grab, GrabSettings
from sliplab.rigs.core.capabilities import RigError
from tests.rigs.waiting import until

pytestmark = [pytest.mark.usefixtures("pylon_emulation"), pytest.mark.realtime]
LIMITS: dict[str, Any] = {"period_ns": 10_000_000, "late_ns": 100_000_000, "queue": 100}
LIMITS |= {"mid_exposure_ns": 1000, "first_id": 0, "sync_bit": 2, "first_ns": 0, "stall_ns": 0}
CHUNKS = GrabSettings(stamping=FrameStamping("chunk", "hardware trigger"), **LIMITS)
EXPOSED = FrameStamping("exposure end event", "exposure line")


class Result:
    """A grab result with chunks."""

    def __init__(self, block: int, **changes: Any) -> None:
        self.BlockID, self.ImageNumber, self.NumberOfSkippedImages = block, block + 1, 0
        self.TimeStamp, self.Array = 0, np.full((2, 3), block % 256, np.uint8)
        self.ChunkTimestamp = SimpleNamespace(Value=time.monotonic_ns())
        self.ChunkLineStatusAll = SimpleNamespace(Value=0)
        self.good = True
        vars(self).update(changes)

    def IsValid(self) -> bool:
        return True

    def GrabSucceeded(self) -> bool:
        return self.good

    def Release(self) -> None:
        pass


class Device:
    """A fake camera for the thread that returns prepared results."""

    def __init__(self, *results: Result) -> None:
        self.results, self.error, self.removed = list(results), None, False

    def RetrieveResult(self, timeout_ms: int, handling: Any) -> Any:
        if self.error is not None:
            raise self.error
        return self.results.pop(0) if self.results else None

    def IsCameraDeviceRemoved(self) -> bool:
        return self.removed


@contextmanager
def grabbing(
    device: Device, settings: GrabSettings = CHUNKS, ends: dict[int, int] | None = None
) -> Iterator[Grab]:
    grab = Grab(device, settings, {} if ends is None else ends)
    try:
        yield grab
    finally:
        grab.stop()


def changed(**changes: Any) -> GrabSettings:
    return GrabSettings(**vars(CHUNKS) | changes)


def test_chunks_give_time_and_level_of_the_sync_line() -> None:
    level, other, stamp = (SimpleNamespace(Value=value) for value in (0b0100, 0b1011, 5_000_000))
    first = Result(0, ChunkTimestamp=stamp, ChunkLineStatusAll=level)
    with grabbing(Device(first, Result(1, ChunkLineStatusAll=other))) as grab:
        until(lambda: grab.counts.grabbed == 2)
        first, second = grab.take()
        assert (first.number, first.t_ns, first.sync) == (0, 5_001_000, 1)
        assert (second.number, second.sync) == (1, 0)


def test_a_frame_out_of_order_or_twice_is_counted_and_kept_back() -> None:
    with grabbing(Device(*map(Result, (0, 2, 1, 2, 3)))) as grab:
        until(lambda: grab.counts.grabbed == 3)
        assert [frame.number for frame in grab.take()] == [0, 2, 3]
        counts = grab.counts
        assert (counts.skipped, counts.out_of_order) == (1, 2)


def test_without_block_ids_what_pylon_overwrote_is_counted() -> None:
    first = Result(0, BlockID=NO_ID, ImageNumber=1)
    second = Result(0, BlockID=NO_ID, ImageNumber=2, NumberOfSkippedImages=3)
    with grabbing(Device(first, second)) as grab:
        until(lambda: grab.counts.grabbed == 2)
        assert grab.counts.skipped == 3


def test_a_frame_that_took_longer_than_allowed_is_late_and_handed_on() -> None:
    first = Result(0)
    device = Device(first)
    with grabbing(device) as grab:
        until(lambda: grab.counts.grabbed == 1)
        threading.Event().wait(1.5 * CHUNKS.late_ns / 1e9)
        exposed = SimpleNamespace(Value=first.ChunkTimestamp.Value + 1000)
        device.results.append(Result(1, ChunkTimestamp=exposed))
        until(lambda: grab.counts.grabbed == 2)
        assert grab.counts.late == 1


STAMPED = FrameStamping("grab result", "device time stamps")
GIGE = changed(stamping=STAMPED, first_id=1, late_ns=10**12, sync_bit=None, queue=10**6)


class Gige(Device):
    """A GigE camera that numbers its blocks 1 to 65,535 again and again, 10 ms apart.

    Args:
        frames: numbers of the exposures that arrive, from 0.
        ids: largest block id.
    """

    def __init__(self, frames: Iterable[int], ids: int = 65_535) -> None:
        super().__init__()
        self.frames, self.ids = iter(frames), ids

    def RetrieveResult(self, timeout_ms: int, handling: Any) -> Any:
        frame = next(self.frames, None)
        if frame is None:
            return super().RetrieveResult(timeout_ms, handling)
        return Result(frame % self.ids + 1, TimeStamp=10_000_000 * frame + 1)


def test_block_ids_of_gige_wrap_at_16_bits() -> None:
    frames = [*range(65_000, 66_000), *range(97_000, 97_100), *range(129_000, 131_500)]
    with grabbing(Gige(frames), GIGE) as grab:
        until(lambda: grab.counts.grabbed == len(frames))
        assert grab.counts.lost == 131_500 - len(frames)
        assert [frame.number for frame in grab.take()] == frames


def test_extended_block_ids_do_not_wrap() -> None:
    with grabbing(Gige(range(65_000, 66_000), 2**40), GIGE) as grab:
        until(lambda: grab.counts.grabbed == 1000)
        assert (grab.counts.skipped, grab.counts.out_of_order) == (65_000, 0)
        assert [frame.number for frame in grab.take()] == list(range(65_000, 66_000))


@pytest.mark.parametrize(("last", "first"), [(65_530, 65_540), (65_534, 65_536), (60_000, 80_000)])
def test_frames_lost_across_the_wrap_are_counted(last: int, first: int) -> None:
    numbers = [*range(59_000, last + 1), *range(first, first + 10)]
    with grabbing(Gige(numbers), GIGE) as grab:
        until(lambda: grab.counts.grabbed == len(numbers))
        assert grab.counts.skipped == 59_000 + first - last - 1
        assert [frame.number for frame in grab.take()] == numbers


def test_incomplete_and_repeated_frames_across_the_wrap_are_counted() -> None:
    device = Gige(())
    device.results = [
        Result(block, TimeStamp=10_000_000 * at, good=block != 65_535)
        for at, block in enumerate((65_533, 65_534, 65_535, 1, 65_534, 1, 3), 1)
    ]
    with grabbing(device, GIGE) as grab:
        until(lambda: not device.results and grab.counts.grabbed == 4)
        counts = grab.counts
        assert (counts.failed, counts.out_of_order, counts.skipped) == (1, 2, 65_532 + 1)
        numbers = [frame.number for frame in grab.take()]
        assert numbers == [65_532, 65_533, 65_535, 65_537]


@pytest.mark.parametrize("before", [300, 30_000, 50_000, 65_000])
def test_camera_that_begins_again_is_noticed(before: int) -> None:
    device = Gige(())
    ids = [*range(before - 99, before + 1), *range(1, 200)]
    device.results = [Result(block, TimeStamp=10_000_000 * at) for at, block in enumerate(ids, 1)]
    with grabbing(device, changed(**vars(GIGE) | {"stall_ns": 300_000_000})) as grab:
        until(lambda: grab.fault is not None)
        assert (grab.counts.grabbed, grab.counts.out_of_order) == (100, 199)
        assert re.search(r"no frame for 0.3 s \(\d+ lost or unusable", str(grab.fault))


def test_block_id_far_ahead_is_dropped() -> None:
    with grabbing(Device(*map(Result, (0, 1, 2**40, 2, 3)))) as grab:
        until(lambda: grab.counts.grabbed == 4)
        assert (grab.counts.skipped, grab.counts.out_of_order) == (0, 1)


def test_exposure_ends_are_found_by_block_ids_that_wrap() -> None:
    settings = changed(**vars(GIGE) | {"stamping": EXPOSED})
    ends = {block: 10_000_000 * at for at, block in enumerate((65_534, 65_535, 1, 2), 1)}
    device = Gige(())
    device.results = [Result(block) for block in ends]
    with grabbing(device, settings, dict(ends)) as grab:
        until(lambda: grab.counts.grabbed == 4)
        assert [frame.t_ns for frame in grab.take()] == [end - 1000 for end in ends.values()]


@pytest.mark.parametrize("useless", [{"good": False}, {"BlockID": 1}, {"BlockID": 2**50}])
def test_frames_that_cannot_be_used_are_silence(useless: dict[str, Any]) -> None:
    """However many of them come."""

    class Useless(Device):
        count, on = 1, True

        def RetrieveResult(self, timeout_ms: int, handling: Any) -> Any:
            threading.Event().wait(0.001)
            self.count += 1
            found = super().RetrieveResult(timeout_ms, handling)
            return found or (Result(self.count, **useless) if self.on else None)

    device = Useless(Result(0), Result(1))
    with grabbing(device, changed(stall_ns=300_000_000)) as grab:
        until(lambda: grab.fault is not None)
        assert "no frame for 0.3 s" in str(grab.fault)
        assert grab.counts.grabbed == 2
        device.on = False


def test_a_promised_stamp_that_is_missing_ends_the_run() -> None:
    device = Device(Result(0, ChunkTimestamp=SimpleNamespace(Value=0)))
    with grabbing(device) as grab:
        until(lambda: grab.fault is not None)
        assert "has no time stamp" in str(grab.fault)


def test_a_late_exposure_end_is_waited_for_and_one_that_never_comes_given_up() -> None:
    ends: dict[int, int] = {1: 9_000}
    settings = changed(stamping=EXPOSED, sync_bit=None, late_ns=10**12)
    device = Device(Result(0), Result(1))
    with grabbing(device, settings, ends) as grab:
        until(lambda: grab.counts.grabbed == 1)
        assert grab.counts.unstamped == 1
        assert [frame.t_ns for frame in grab.take()] == [8_000]
        device.results.append(Result(2))
        until(lambda: not device.results)
        ends[2] = 19_000
        until(lambda: grab.counts.grabbed == 2)
        assert [frame.number for frame in grab.take()] == [2]


def test_a_frame_that_still_waits_for_its_time_at_the_end_is_counted() -> None:
    settings = changed(stamping=EXPOSED, sync_bit=None)
    device = Device(Result(0))
    with grabbing(device, settings) as grab:
        until(lambda: not device.results)
        grab.stop()
        assert (grab.counts.unstamped, grab.counts.lost) == (1, 1)


def test_a_full_queue_waits_for_its_reader_and_loses_nothing() -> None:
    with grabbing(Device(*map(Result, range(10))), changed(queue=4)) as grab:
        until(lambda: grab.counts.grabbed == 4)
        got = [frame.number for frame in grab.take()]
        until(lambda: grab.counts.grabbed == 8)
        got += [frame.number for frame in grab.take()]
        until(lambda: grab.counts.grabbed == 10)
        got += [frame.number for frame in grab.take()]
        assert got == list(range(10))


def test_a_pylon_that_hangs_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sliplab.plugins.devices.basler.grabbing.HANG_S", 0.3)
    go = threading.Event()
    device = Device()
    monkeypatch.setattr(device, "RetrieveResult", lambda *_: go.wait(60.0) and None)
    with grabbing(device) as grab:
        until(lambda: grab.fault is not None)
        assert "has not answered" in str(grab.fault)
        go.set()


def test_whatever_pylon_raises_is_a_rigs_error() -> None:
    device = Device()
    with grabbing(device) as grab:
        device.error = RuntimeError("the driver is confused")
        until(lambda: grab.fault is not None)
        assert isinstance(grab.fault, RigError)
        assert "confused" in str(grab.fault)
