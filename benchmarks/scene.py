"""What simulating costs: contact, events and pictures, on one core.

`ns_per_event` has noise, sorting and the pixels' reset in it, for a slide at 1 mm/s, whose markers
hardly move; `ns_per_event_busy` is the same where every marker moves at about 200 px/s.
"""

from __future__ import annotations

import numpy as np

from benchmarks.measure import RUNS, SEED, Figures, alternate, one_core, peak_mb, rate, spread
from benchmarks.slides import LENGTH_MM, hold_and_slide, press, seconds
from rigs.mock.devices import build_mock
from rigs.mock.settings import MockSettings
from rigs.scene.events import EventOptics, MarkerSensor
from rigs.scene.frames import FrameOptics, PlateView
from storage.streams import F64


def measure(length_mm: float = LENGTH_MM, frames: int = 200, runs: int = RUNS) -> Figures:
    """One slide with and without events, its events alone, and frames of 512 x 512 pixels."""
    settings = MockSettings(seed=SEED)
    devices = build_mock(settings)
    loads = _loads(length_mm)
    optics = EventOptics(**settings.event_camera.model_dump())
    sensor = MarkerSensor(optics, devices.world.skin.layout_mm, SEED)
    step_ns = devices.world.step_ns
    busy = loads[:2000].copy()
    busy[:, ::3] = 0.1 * np.sin(2 * np.pi * 5.0 * 1e-9 * step_ns * np.arange(len(busy)))[:, None]

    def tracks() -> None:
        press(devices, length_mm)
        hold_and_slide(devices, length_mm)

    def contact() -> None:
        press(devices, length_mm)
        hold_and_slide(devices, length_mm, events=False)

    def sense(loads: F64) -> int:
        sensor.reset(loads[0], SEED)
        # in chunks of about a tenth of a second, as a rig reads
        return sum(
            len(sensor.sense(loads[first : first + 97], first, step_ns)[0])
            for first in range(0, len(loads) - 1, 96)
        )

    view = PlateView(FrameOptics(px_per_mm=12.0), 512, 512)
    places = np.linspace(-3.0, 3.0, frames)[:, None, None] * np.array([1.0, 0.2])
    tips = devices.world.skin.layout_mm[None] + places
    images = np.empty((10, 512, 512), np.uint8)

    def draw() -> None:
        for first in range(0, frames, len(images)):
            part = tips[first : first + len(images)]
            number = np.arange(first, first + len(part), dtype=np.int64)
            view.draw(images[: len(part)], part, None, number, SEED)

    with one_core():
        taken = alternate(
            runs, tracks=tracks, contact=contact, sense=lambda: sense(loads),
            busy=lambda: sense(busy), draw=draw,
        )  # fmt: skip
    count, many = sense(loads), sense(busy)
    # both begin with the press, so its time counts on both sides
    simulated = seconds(length_mm) + _before_s(length_mm)
    return {
        **rate("tracks_x_realtime", simulated, taken["tracks"]),
        **rate("contact_x_realtime", simulated, taken["contact"]),
        **spread("ns_per_event", [value * 1e9 / count for value in taken["sense"]]),
        **spread("ns_per_event_busy", [value * 1e9 / many for value in taken["busy"]]),
        "events_per_slide": float(count),
        **spread("frame_ms_512", [value * 1e3 / frames for value in taken["draw"]]),
        "peak_mb": peak_mb(),
    }


def _before_s(length_mm: float) -> float:
    """Simulated time of a trial before its recording."""
    devices = build_mock(MockSettings(seed=SEED))
    press(devices, length_mm)
    press(devices, length_mm)  # as in every run but the first: from where the last one ended
    return devices.world.now_ns * 1e-9


def _loads(length_mm: float) -> F64:
    """Forces on every tip at every step of one slide."""
    devices = build_mock(MockSettings(seed=SEED))
    press(devices, length_mm)
    kept = devices.world.keep_loads()
    hold_and_slide(devices, length_mm, events=False)
    return kept.rows(kept.base, kept.end).copy()
