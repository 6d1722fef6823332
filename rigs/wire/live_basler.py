"""A Basler camera that looks at a scene which somebody else simulates, tick by tick.

The real driver talks to the real pylon, whose emulated camera is triggered by software once for
every frame that is pushed: buffers, threads, block ids and what gets lost on the way are pylon's
own. Only what the emulation cannot know is put into its results: the picture, the time stamp and
the levels of the lines. It also has the chunk and latch nodes of a camera of today, so that every
grade of `rigs.cameras.stamps` can be tried.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from storage.streams import U8

READY_MS = 5000
"""How long the emulated camera may take until it is ready for the next trigger, ms."""
STOP_S = 10.0
"""How long a stop waits until all is exposed that was pushed, s."""
AHEAD = 500
"""Frames pushed and not exposed yet, at most: five seconds at 100/s."""


class LiveError(RuntimeError):
    """The emulated camera cannot keep up, or has taken no trigger in time."""


@dataclass(frozen=True)
class _Pushed:
    image: U8
    start_ns: int
    lines: int


class LiveBasler:
    """An emulated camera of pypylon that shows what is pushed; give it to `BaslerCamera`.

    Whatever trigger the driver sets, a frame is what `push` makes one: the caller pushes at the
    sync box's ticks. Everything that is not named here is the device's own.

    Args:
        device: an emulated `InstantCamera`, not open yet.
        clock_ns: the camera's clock, which the driver can latch; None: it has no latch.

    Attributes:
        frames_sent: pushed while it grabbed, since it was made.
        unseen: pushed while it did not grab.
        unmatched: sent, and not seen in any result when the run ended. With one of them the
            pictures of that run may be those of other ticks.
    """

    def __init__(self, device: Any, clock_ns: Callable[[], int] | None = None) -> None:
        from pypylon import genicam

        self._device = device
        self._changed = threading.Condition()
        self._ahead: deque[_Pushed] = deque()
        self._pushed: dict[int, _Pushed] = {}
        self._exposing = False
        self._shape = (0, 0)
        self._error: Exception | None = None
        self._feeder: threading.Thread | None = None
        self.frames_sent = self.unseen = self.unmatched = 0
        self._nodes = _chunk_nodes(genicam.RW) | {
            "AcquisitionStop": _Command(genicam.WO, self._end_exposures)
        }
        if clock_ns is not None:
            value = _Node(genicam.RO)

            def latch() -> None:
                value.Value = clock_ns()

            self._nodes |= {
                "TimestampLatch": _Command(genicam.WO, latch),
                "TimestampLatchValue": value,
            }

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    def GetNodeMap(self) -> _NodeMap:
        """The emulation's nodes, and those that it lacks."""
        return _NodeMap(self._device.GetNodeMap(), self._nodes)

    def IsUsb(self) -> bool:
        """It passes for one on USB: ids from 0, and a time stamp in every result."""
        return True

    @property
    def region(self) -> tuple[int, int]:
        """Width and height that the driver has set, px: the pictures' size."""
        return int(self._device.Width.Value), int(self._device.Height.Value)

    @property
    def exposing(self) -> bool:
        """Whether a frame pushed now is seen."""
        return self._exposing

    def StartGrabbing(self, strategy: Any) -> None:
        """Grab as the driver asks, but on pushes."""
        nodes = self._device.GetNodeMap()
        nodes.GetNode("TestImageSelector").Value = "Off"  # drawing one takes longer than the rest
        nodes.GetNode("AcquisitionFrameRateEnable").Value = False
        nodes.GetNode("TriggerSource").Value = "Software"
        nodes.GetNode("TriggerMode").Value = "On"
        self._device.StartGrabbing(strategy)
        self._pushed.clear()
        width, height = self.region  # asked here, for a push must not wait for the device
        self._shape = height, width
        self._error = None
        self._exposing = True
        self._feeder = threading.Thread(target=self._feed, name="live frames", daemon=True)
        self._feeder.start()

    def push(self, image: U8, start_ns: int, lines: int = 0) -> bool:
        """Expose one frame; returns at once.

        Args:
            image: grey, of the region's (height, width); must not change afterwards.
            start_ns: start of the exposure on the camera's clock, ns, more than 0.
            lines: levels of the camera's lines during the exposure, Line1 in bit 0.

        Returns:
            Whether it was exposed; not while the camera does not grab.

        Raises:
            ValueError: a picture of another size.
            LiveError: `AHEAD` frames wait, or a trigger was not taken in time.
        """
        with self._changed:
            if not self._exposing:
                self.unseen += 1
                return False
            if self._error is not None:
                raise LiveError(f"no trigger is taken: {self._error}")
            if image.shape != self._shape:
                raise ValueError(f"a picture of {image.shape} instead of {self._shape}")
            if len(self._ahead) >= AHEAD:
                raise LiveError(f"{AHEAD} frames wait to be exposed; push fewer a second")
            self._ahead.append(_Pushed(image, start_ns, lines))
            self.frames_sent += 1
            self._changed.notify_all()
            return True

    def RetrieveResult(self, timeout_ms: int, handling: Any) -> Any:
        """Pylon's next result, with what was pushed in it."""
        result = self._device.RetrieveResult(timeout_ms, handling)
        if not result.IsValid():
            return result
        pushed = self._pushed.pop(int(result.BlockID), None)
        if pushed is None:
            result.Release()
            raise LiveError("pylon gave a frame that nobody pushed")
        return _Result(result, pushed)

    def StopGrabbing(self) -> None:
        """Stop; what no result had is counted."""
        self._end_exposures()
        self._device.StopGrabbing()
        with self._changed:
            self.unmatched += len(self._pushed) + len(self._ahead)
            self._pushed.clear()
            self._ahead.clear()

    def _end_exposures(self) -> None:
        """In place of the node's own command: what was pushed by now is exposed first."""
        with self._changed:
            self._exposing = False
            self._changed.notify_all()
        if self._feeder is not None:
            self._feeder.join(STOP_S)

    def _feed(self) -> None:
        """One software trigger for every frame, until there are no more of this run."""
        from pypylon import genicam, pylon

        number = 0
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._ahead or not self._exposing)
                    if not self._ahead:
                        return
                self._device.WaitForFrameTriggerReady(
                    READY_MS, pylon.TimeoutHandling_ThrowException
                )
                with self._changed:
                    # known before it can arrive
                    self._pushed[number] = self._ahead.popleft()
                self._device.ExecuteSoftwareTrigger()
                number += 1
        except (genicam.GenericException, IndexError) as error:
            with self._changed:
                self._error = error


class _Result:
    """A grab result of pylon with the picture, time and levels of a push."""

    def __init__(self, result: Any, pushed: _Pushed) -> None:
        self._result = result
        self.Array = pushed.image
        self.TimeStamp = pushed.start_ns
        self.ChunkTimestamp = _Value(pushed.start_ns)
        self.ChunkLineStatusAll = _Value(pushed.lines)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._result, name)


@dataclass
class _Value:
    Value: int


@dataclass
class _Node:
    """A node that takes any value."""

    access: Any
    Value: Any = 0
    Symbolics: tuple[str, ...] = ()

    def GetAccessMode(self) -> Any:
        """As in GenICam."""
        return self.access


@dataclass
class _Command:
    access: Any
    do: Callable[[], None]

    def GetAccessMode(self) -> Any:
        """As in GenICam."""
        return self.access

    def Execute(self) -> None:
        """As in GenICam."""
        self.do()


def _chunk_nodes(access: Any) -> dict[str, Any]:
    return {
        "ChunkModeActive": _Node(access, False),
        "ChunkSelector": _Node(access, "Timestamp", ("Timestamp", "LineStatusAll")),
        "ChunkEnable": _Node(access, False),
    }


@dataclass(frozen=True)
class _NodeMap:
    real: Any
    own: dict[str, Any]

    def GetNode(self, name: str) -> Any:
        """As in GenICam; None where there is none."""
        return self.own[name] if name in self.own else self.real.GetNode(name)
