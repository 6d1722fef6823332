"""The buffer of a camera's or a sensor's data: which data show that the device runs."""

from __future__ import annotations

import time

import numpy as np
import pytest

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.stream_buffer import StreamBuffer

STALL_S = 0.5


class Clock:
    """A host's clock that the test turns."""

    def __init__(self) -> None:
        self.now_ns = 10**12

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time, "monotonic_ns", clock)
    return clock


def run(buffer: StreamBuffer, clock: Clock, times_ns: list[int]) -> int:
    """Add a part and read, every 50 ms; return how many parts were read."""
    read = 0
    for t_ns in times_ns:
        clock.now_ns += 50_000_000
        buffer.add("a", t_ns, np.array([t_ns], np.int64))
        read += len(buffer.take("a"))
    return read


def test_times_that_advance_are_data(clock: Clock) -> None:
    buffer = StreamBuffer("camera", STALL_S)
    buffer.begin()
    assert run(buffer, clock, [5, 5, *range(5, 40)]) == 37


def test_clock_that_stops_is_a_fault_although_data_come(clock: Clock) -> None:
    buffer = StreamBuffer("camera", STALL_S)
    buffer.begin()
    with pytest.raises(ValueError, match="its clock has stopped at 7"):
        run(buffer, clock, [5, 6] + [7] * 20)


def test_parts_without_times_are_silence(clock: Clock) -> None:
    buffer = StreamBuffer("camera", STALL_S)
    buffer.begin()
    run(buffer, clock, [5, 6])
    for _ in range(10):
        clock.now_ns += 50_000_000
        buffer.add("a", None, np.empty(0, np.int64))
        assert not buffer.take("a")
    clock.now_ns += 100_000_000
    with pytest.raises(RigError, match=r"camera: silent for 0\.\d s.*is too busy"):
        buffer.take("a")
