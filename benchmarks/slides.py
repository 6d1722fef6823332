"""One slide of the kinematic grid on the simulated rig, without frames: what several time.

Simulated, like everything that comes out of it.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from benchmarks.measure import SEED
from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.rigs.core.capabilities import Segment
from sliplab.storage.streams import F64, I64, EventChunk

DEPTH_MM, SPEED_MM_S, LENGTH_MM = 2.8, 1.0, 15.0
HOLD_S, CHUNK_S = 2.0, 0.1


def press(devices: MockDevices, length_mm: float, finer: int = 1) -> None:
    """Begin a trial: press at one end of the slide and let the skin settle.

    `finer`: divides the step of the contact.
    """
    devices.arm.connect()
    devices.begin_trial(SEED)
    devices.world.physics.step_ns //= finer
    _go(devices, -length_mm / 2, -5.0, 20.0)
    _go(devices, -length_mm / 2, DEPTH_MM, 2.0)
    devices.clock.wait(1.0)
    devices.world.advance()


def loads_of_slide(
    settings: MockSettings, length_mm: float, speed_mm_s: float = SPEED_MM_S, finer: int = 1
) -> tuple[I64, F64]:
    """Times (ns) and forces on every tip at every row of a hold and slide, (m,) and (m, 3 n)."""
    devices = build_mock(settings)
    press(devices, length_mm, finer)
    stored = devices.world.keep_loads()
    hold_and_slide(devices, length_mm, events=False, speed_mm_s=speed_mm_s)
    t_ns, loads = stored.between(stored.begin_ns, stored.end_ns)
    return t_ns.copy(), loads.copy()


def hold_and_slide(
    devices: MockDevices, length_mm: float, events: bool = True, speed_mm_s: float = SPEED_MM_S
) -> EventChunk:
    """The recorded part of a trial: two seconds of hold, and the slide."""
    parts: list[EventChunk] = []
    if events:
        devices.events.start()
    devices.sync.start(100.0, 4321)
    left = round((HOLD_S + length_mm / speed_mm_s) / CHUNK_S)
    for chunk in range(left):
        if chunk == round(HOLD_S / CHUNK_S):
            target = devices.world.plane.pose(length_mm / 2, 0.0, DEPTH_MM)
            devices.arm.start([Segment(target, speed_mm_s)])
        devices.clock.wait(CHUNK_S)
        parts.append(devices.events.read() if events else _nothing(devices))
    devices.events.stop()
    parts.append(devices.events.read())
    devices.sync.stop()
    return EventChunk.concatenate(parts)


@cache
def slide_events(length_mm: float = LENGTH_MM) -> EventChunk:
    """The events of one trial, default noise."""
    devices = build_mock(MockSettings(seed=SEED))
    press(devices, length_mm)
    return hold_and_slide(devices, length_mm)


def many_events(count: int) -> EventChunk:
    """`count` events: one trial after another, as often as it takes."""
    one = slide_events(LENGTH_MM if count > 100_000 else 1.0)
    times = -(-count // len(one))
    period = int(one.t_us[-1] - one.t_us[0]) + 1
    rounds = np.repeat(np.arange(times, dtype=np.int64) * period, len(one))
    return EventChunk(
        np.tile(one.x, times)[:count],
        np.tile(one.y, times)[:count],
        np.tile(one.p, times)[:count],
        (np.tile(one.t_us, times) + rounds)[:count],
    )


def _go(devices: MockDevices, x_mm: float, depth_mm: float, speed: float) -> None:
    devices.arm.start([Segment(devices.world.plane.pose(x_mm, 0.0, depth_mm), speed)])
    while not devices.arm.progress().done:
        devices.clock.wait(0.02)


def _nothing(devices: MockDevices) -> EventChunk:
    devices.world.advance()
    return EventChunk.empty()
