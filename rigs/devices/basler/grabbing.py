"""The thread that retrieves frames from pylon, and counts every lost one.

Pylon fills a fixed number of buffers and drops frames that find none free, so a dedicated thread
empties them into a bounded queue. If the queue is not read, it fills up, then pylon's buffers do,
and only then are frames lost, which shows as a gap in the camera's frame ids. Where the time of a
frame comes separately, as an event, the thread waits for it.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, fields
from typing import Any

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.host_clock import StallTimer
from sliplab.rigs.devices.basler.frame_time import Stamping
from sliplab.rigs.devices.basler.nodes import DEVICE
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


@dataclass
class GrabCounts:
    """Counts of the frames of one run.

    Attributes:
        grabbed: complete frames in order, delivered or still in the queue.
        failed: incomplete frames.
        skipped: frames missing in the camera's ids, or overwritten in pylon.
        late: frames with a longer delay than `late_s` allows; they are delivered.
        out_of_order: frames after a later one, and duplicates; they are not delivered.
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

    stamping: Stamping
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
                return RigError(
                    DEVICE,
                    f"{what} for {silent_ns / 1e9:.1f} s; check its cable, its power and its "
                    "trigger",
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
                    # time for which this computer was suspended is not silence of the camera
                    self._silent_ns += min(now_ns - asked_ns, POLL_MS * 1_000_000)
                else:
                    empty = 0
                    try:
                        self._add(result, now_ns)
                    finally:
                        result.Release()
                self._deliver(now_ns)
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
        block = int(result.BlockID)
        counted = block if block != NO_ID else int(result.ImageNumber) - 1
        number = counted - (self._settings.first_id if block != NO_ID else 0)
        counts = self._counts
        with self._changed:
            self._received, self._silent_ns = True, 0
            if number <= self._last:
                counts.out_of_order += 1
                return
            missing = number - self._last - 1
            overwritten = int(result.NumberOfSkippedImages)
            # frames overwritten in pylon are missing in the ids too, where there are ids
            counts.skipped += max(missing, overwritten)
            self._last = number
            if not result.GrabSucceeded():
                counts.failed += 1
                return
        sync = 0
        if self._settings.sync_bit is not None:
            sync = int(result.ChunkLineStatusAll.Value) >> self._settings.sync_bit & 1
        stamp = self._stamp(result, now_ns)
        if stamp is not None:
            self._exposures[counted] = stamp
        self._waiting.append(_Waiting(result.Array, number, now_ns, sync))

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

    def _deliver(self, now_ns: int) -> None:
        """Move the frames whose times are known to the queue, in order."""
        settings = self._settings
        while self._waiting:
            frame = self._waiting[0]
            stamp = self._exposures.pop(frame.number + settings.first_id, None)
            if stamp is None and now_ns - frame.host_ns < EVENT_WAIT_S * 1e9:
                return
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
