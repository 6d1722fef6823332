"""A kind of stream that SlipLab does not know, in one file: an inertial sensor on the arm.

A rig file, simulated or not, names it under `streams` as
`wrist: {kind: imu, device: {driver: lab_imu}}`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sliplab.rigs.core.capabilities import Clock
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import SensorDriver
from sliplab.rigs.core.host_clock import HostClock
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

    stop = close = connect

    def start(self) -> None:
        """Start streaming."""
        self._next_ns = self._clock.now_ns()

    def read(self) -> ImuChunk:
        """Samples since the last call."""
        t_ns = np.arange(self._next_ns, self._clock.now_ns(), PERIOD_NS, dtype=np.int64)
        self._next_ns += len(t_ns) * PERIOD_NS
        still = np.tile([0.0, 0.0, 9.81], (len(t_ns), 1))
        return ImuChunk(t_ns, t_ns, still, np.full(len(t_ns), 21.5, np.float32))


class ImuSettings(DriverSettings):
    driver: Literal["lab_imu"] = "lab_imu"


DRIVER = SensorDriver(
    name="lab_imu",
    title="an inertial sensor",
    settings=ImuSettings,
    ping=lambda settings: None,
    build=lambda settings: Imu(HostClock()),
    simulate=lambda settings, clock: Imu(clock),
    stream=IMU,
)
