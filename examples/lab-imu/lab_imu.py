"""A kind of stream that SlipLab does not know, in one file: an inertial sensor on the arm.

Give a rig the sensor before it takes trials: `rig.further += (imu_stream(Imu(rig.clock)),)`. The
stream is then recorded, timed, verified, shown and exported like any other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sliplab.protocols.timing import StreamTiming
from sliplab.rigs.core.capabilities import Clock
from sliplab.rigs.core.device_stream import DeviceStream
from sliplab.storage.schema.trial import StreamRecord
from sliplab.storage.streams import F64, I64, SCALAR, Chunk, Column, StreamKind

PERIOD_NS = 10_000_000
IMU = StreamKind(
    "imu",
    {
        "t": SCALAR.columns["t"],
        "host": SCALAR.columns["host"],
        "acceleration": Column("acceleration", "float64", (3,), "m/s2 along the sensor's axes"),
        "temperature": Column("temperature", "float32", (), "degC"),
    },
)


@dataclass(frozen=True)
class ImuChunk(Chunk):
    """Samples of an inertial sensor, n of them."""

    KIND = IMU

    t_ns: I64
    host_ns: I64
    acceleration: F64
    temperature: F64


class Imu:
    """A pretended sensor that is still: a sample each 10 ms, timed by its arrival."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._next_ns = clock, 0

    def connect(self) -> None:
        """Open the connection."""

    def start(self) -> None:
        """Start streaming."""
        self._next_ns = self._clock.now_ns()

    def read(self) -> ImuChunk:
        """Samples since the last call."""
        t_ns = np.arange(self._next_ns, self._clock.now_ns(), PERIOD_NS, dtype=np.int64)
        self._next_ns += len(t_ns) * PERIOD_NS
        still = np.tile([0.0, 0.0, 9.81], (len(t_ns), 1))
        return ImuChunk(t_ns, t_ns, still, np.full(len(t_ns), 21.5, np.float32))

    def stop(self) -> None:
        """Stop streaming."""

    def close(self) -> None:
        """Close the connection."""


def imu_stream(sensor: Imu, name: str = "imu") -> DeviceStream:
    """Return the sensor as a rig's device, timed by the arrival of its samples."""
    timing = StreamTiming(grade="host arrival", delay={"shortest_us": 0, "longest_us": 2000})
    return DeviceStream(name, sensor, StreamRecord(kind=IMU.name, rows=0, timing=timing))
