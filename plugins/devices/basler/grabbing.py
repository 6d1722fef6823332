"""The thread that retrieves frames from pylon, and counts every lost one.

Pylon fills a fixed number of buffers and drops frames that find none free, so a dedicated thread
empties them into a bounded queue. If the queue is not read, it fills up, then pylon's buffers do,
and only then are frames lost, which shows as a gap in the camera's frame ids. Where the time of a
frame comes separately, as an event, the thread waits for it. Silence is the time without a frame
that is delivered: incomplete frames, repeated ones and those without a time do not count.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, fields
from typing import Any

from sliplab.plugins.devices.basler.frame_time import FrameStamping
from sliplab.plugins.devices.basler.nodes import DEVICE
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.host_clock import OR_BUSY, StallTimer
from sliplab.storage.streams import U8

POLL_MS = 100
"""Timeout of each wait in pylon, after which the thread checks its other conditions, ms."""
EVENT_WAIT_S = 0.5
"""Timeout for a frame's exposure-end event, after which the frame is dropped, s."""
HANG_S = 5.0
"""Time after which a call into pylon counts as hung, s."""
STOP_S = 3.0
"""Timeout for a grab to end, s."""
_DRAIN_ROUNDS = 2
"""Consecutive empty polls after which a stopped camera has no more frames."""
NO_ID = (1 << 64) - 1
"""Block id of pylon that means none."""
GIGE_IDS = 65_535
"""Block ids of a GigE camera: 1 to 65,535, then 1 again; more than that, where it extends them."""
FASTER, SPARE = 1.5, 100
"""Largest gap in the ids: a factor of the frames that fit into the time, and an offset."""
MOST_EXPOSURES = 1000
"""Exposure ends that wait for their frame."""


@dataclass
class GrabCounts:
    """Counts of the frames of one run.

    Attributes:
        grabbed: complete frames in order, delivered or still in the queue.
        failed: incomplete frames.
        skipped: frames missing in the camera's ids, or overwritten in pylon.
        late: frames with a longer delay than `late_s` allows; they are delivered.
        out_of_order: frames after a later one, duplicates, and ids that are too far ahead; they are
            not delivered.
        unstamped: frames without a time stamp; they are not delivered.
    """

    grabbed: int = 0
    failed: int = 0
    skipped: int = 0
    late: int = 0
    out_of_order: int = 0
    unstamped: int = 0

    @property
    def lost(self) -> int:
        """Number of frames that were exposed, as far as known, and not delivered."""
        return self.failed + self.skipped + self.out_of_order + self.unstamped

    def copy(self) -> GrabCounts:
        """Return a copy of the current counts."""
        return GrabCounts(*(getattr(self, field.name) for field in fields(self)))


@dataclass(frozen=True)
class Frame:
    """One complete frame. Times in ns, `t_ns` at the middle of its exposure."""

    image: U8
    number: int
    t_ns: int
    host_ns: int
    sync: int


@dataclass
class _Waiting:
    image: U8
    number: int
    host_ns: int
    sync: int
    block: int
    """Id by which an exposure's end names it."""


@dataclass(frozen=True)
class GrabSettings:
    """Settings of the grabbing thread.

    Attributes:
        first_id: block id of a run's first frame: 0 on USB, 1 on GigE.
        period_ns: period of frames in free run or with a fixed trigger rate.
        sync_bit: bit of the sync line in the line status chunk; None where it is not wired.
        queue: capacity of the queue, frames.
        first_ns: timeout for the first frame; 0 for none.
        stall_ns: timeout for each later frame; 0 for none.
    """

    stamping: FrameStamping
    mid_exposure_ns: int
    first_id: int
    period_ns: int
    late_ns: int
    sync_bit: int | None
    queue: int
    first_ns: int
    stall_ns: int


class Grab:
    """One run of a camera, from start to stop.

    Args:
        device: a grabbing `InstantCamera` of pypylon, or an object that behaves like one.
        exposures: exposure ends by block id, ns, filled by the camera's events.
    """

    def __init__(self, device: Any, settings: GrabSettings, exposures: dict[int, int]) -> None:
        self._device, self._settings, self._exposures = device, settings, exposures
        self._ready: deque[Frame] = deque()
        self._waiting: deque[_Waiting] = deque()
        self._changed = threading.Condition()
        self._counts = GrabCounts()
        self._fault: RigError | None = None
        self._last = -1
        self._last_block: int | None = None
        self._last_seen = (0, 0)
        """Device's stamp and arrival of the last frame, ns."""
        self._shortest_ns: int | None = None
        self._latest_ns: int | None = None
        self._before: tuple[int, int] | None = None
        self._asked_ns = time.monotonic_ns()
        self._stall = StallTimer()
        self._silent_ns = 0
        self._received = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="frame camera", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> GrabCounts:
        """Frame counts so far."""
        with self._changed:
            return self._counts.copy()

    @property
    def fault(self) -> RigError | None:
        """Return the error after which no more frames will come, if any."""
        with self._changed:
            if self._fault is not None or self._stopping.is_set():
                return self._fault
            silent_ns = self._silent_ns
            hung_s = self._stall.waited_s(self._asked_ns)
            limit = self._settings.stall_ns if self._received else self._settings.first_ns
            if hung_s > HANG_S:
                return RigError(DEVICE, f"pylon has not answered for {hung_s:.1f} s")
            if limit and silent_ns > limit:
                what = "no frame" if self._received else "no frame since the start,"
                useless = self._counts.lost
                but = f" ({useless} lost or unusable since the start)" if useless else ""
                return RigError(
                    DEVICE,
                    f"{what} for {silent_ns / 1e9:.1f} s{but}; check its cable, its power and its "
                    f"trigger{OR_BUSY}",
                )
            return None

    def take(self) -> list[Frame]:
        """Remove and return all frames that are ready."""
        with self._changed:
            frames = list(self._ready)
            self._ready.clear()
            self._changed.notify_all()
            return frames

    def stop(self) -> None:
        """End the run after retrieving the frames in pylon. Returns within `STOP_S`.

        Raises:
            RigError: the thread does not end.
        """
        self._stopping.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join(STOP_S)
        if self._thread.is_alive():
            raise RigError(DEVICE, f"grabbing has not ended within {STOP_S:g} s")

    def forget_device(self) -> None:
        """Drop the reference to a closed device. A thread that has not ended keeps it."""
        if not self._thread.is_alive():
            self._device = None

    def _run(self) -> None:
        from pypylon import pylon

        empty, looked_ns, wait = 0, 0, pylon.TimeoutHandling_Return
        try:
            while self._waiting or empty < _DRAIN_ROUNDS or not self._stopping.is_set():
                if not self._room():
                    continue
                asked_ns = self._asked_ns = time.monotonic_ns()
                result = self._device.RetrieveResult(POLL_MS, wait)
                now_ns = time.monotonic_ns()
                if result is None or not result.IsValid():
                    empty += 1
                else:
                    empty = 0
                    try:
                        self._add(result, now_ns)
                    finally:
                        result.Release()
                self._deliver(now_ns, asked_ns)
                # not at every frame: each call into pylon releases the interpreter lock, and a busy
                # interpreter is slow to return it
                if now_ns - looked_ns > POLL_MS * 1_000_000:
                    looked_ns = now_ns
                    self._check_device()
        except RigError as error:
            self._fail(error)
        except Exception as error:
            gone = self._device.IsCameraDeviceRemoved()
            what = "the camera was unplugged" if gone else f"grabbing failed: {error}"
            self._fail(RigError(DEVICE, what))

    def _room(self) -> bool:
        """Wait until the queue has room, and return whether it has; always true once stopping."""
        with self._changed:
            if len(self._ready) < self._settings.queue or self._stopping.is_set():
                return True
            self._changed.wait(POLL_MS / 1000)
            self._asked_ns = time.monotonic_ns()
            self._check_device()
            return len(self._ready) < self._settings.queue

    def _check_device(self) -> None:
        if self._device.IsCameraDeviceRemoved():
            raise RigError(DEVICE, "the camera was unplugged; plug it in and open it again")

    def _fail(self, error: RigError) -> None:
        with self._changed:
            self._fault = error

    def _add(self, result: Any, now_ns: int) -> None:
        """Count one grab result, and queue it if it is a frame."""
        good = bool(result.GrabSucceeded())
        stamp = self._stamp(result, now_ns) if good else None
        block = int(result.BlockID)
        if block == NO_ID:
            block = int(result.ImageNumber) - 1 + self._settings.first_id
        counts = self._counts
        with self._changed:
            if not self._received:
                self._received, self._silent_ns = True, 0
            step = self._step(block, stamp, now_ns)
            if step <= 0:
                counts.out_of_order += 1
                return
            overwritten = int(result.NumberOfSkippedImages)
            # frames overwritten in pylon are missing in the ids too, where there are ids
            counts.skipped += max(step - 1, overwritten)
            self._last += step
            self._last_block, self._last_seen = block, (stamp or self._last_seen[0], now_ns)
            if not good:
                counts.failed += 1
                return
        sync = 0
        if self._settings.sync_bit is not None:
            sync = int(result.ChunkLineStatusAll.Value) >> self._settings.sync_bit & 1
        if stamp is not None:
            self._exposures[block] = stamp
        self._waiting.append(_Waiting(result.Array, self._last, now_ns, sync, block))

    def _step(self, block: int, stamp: int | None, now_ns: int) -> int:
        """Return by how many frames a block is after the last one; 0 or less if it is not.

        A gap for which the time since the last frame is too short is none: the camera began again,
        or the id is invalid.
        """
        last, settings = self._last_block, self._settings
        if last is None:
            return block - settings.first_id + 1
        step = block - last
        if settings.first_id == 1 and max(block, last) <= GIGE_IDS:  # USB counts in 64 bits
            half = GIGE_IDS // 2
            step = (step + half) % GIGE_IDS - half
        # frames that waited in pylon's buffers come in a burst: the camera's stamps are better
        stamp_ns, arrival_ns = self._last_seen
        passed_ns = settings.queue * settings.period_ns
        if stamp and stamp_ns and settings.stamping.means != "host arrival":
            passed_ns = stamp - stamp_ns
        passed_ns = max(passed_ns, now_ns - arrival_ns)
        if settings.period_ns and step - 1 > FASTER * passed_ns / settings.period_ns + SPARE:
            return 0
        return step

    def _stamp(self, result: Any, now_ns: int) -> int | None:
        """Return the frame's own stamp, ns; None where it comes as an event."""
        means = self._settings.stamping.means
        if means == "exposure end event":
            return None
        if means == "host arrival":
            return now_ns
        stamp = int(result.ChunkTimestamp.Value if means == "chunk" else result.TimeStamp)
        if stamp == 0:
            raise RigError(DEVICE, f"its {means} has no time stamp, though the camera offers one")
        return stamp

    def _deliver(self, now_ns: int, asked_ns: int) -> None:
        """Move the frames whose times are known to the queue, in order.

        Args:
            asked_ns: since when frames were waited for.
        """
        settings, before = self._settings, self._counts.grabbed
        while self._waiting:
            frame = self._waiting[0]
            stamp = self._exposures.pop(frame.block, None)
            if stamp is None and now_ns - frame.host_ns < EVENT_WAIT_S * 1e9:
                break
            self._waiting.popleft()
            with self._changed:
                if stamp is None:
                    self._counts.unstamped += 1
                    continue
                middle = settings.stamping.middle_ns(stamp, settings.mid_exposure_ns)
                if self._latest_ns is not None and middle < self._latest_ns:
                    back_s = (self._latest_ns - middle) / 1e9
                    raise RigError(
                        DEVICE, f"its clock jumped back by {back_s:.3f} s; begin a new trial"
                    )
                self._latest_ns = middle
                self._counts.grabbed += 1
                self._counts.late += self._is_late(frame, stamp)
                self._ready.append(
                    Frame(frame.image, frame.number, middle, frame.host_ns, frame.sync)
                )
        for block in list(self._exposures)[:-MOST_EXPOSURES]:  # of frames that never came
            self._exposures.pop(block, None)
        with self._changed:
            if self._counts.grabbed > before:
                self._silent_ns = 0
            else:
                # time for which this computer was suspended is not silence of the camera
                passed_ns = time.monotonic_ns() - asked_ns
                self._silent_ns += min(passed_ns, POLL_MS * 1_000_000)

    def _is_late(self, frame: _Waiting, stamp_ns: int) -> bool:
        """Return whether a frame's delay exceeds the shortest one of this run by too much."""
        if self._settings.stamping.means == "host arrival":
            before, self._before = self._before, (frame.number, frame.host_ns)
            if before is None or not self._settings.period_ns:
                return False
            due = before[1] + (frame.number - before[0]) * self._settings.period_ns
            return frame.host_ns - due > self._settings.late_ns
        took = frame.host_ns - stamp_ns
        if self._shortest_ns is None or took < self._shortest_ns:
            self._shortest_ns = took
        return took - self._shortest_ns > self._settings.late_ns
