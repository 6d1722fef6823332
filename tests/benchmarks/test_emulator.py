"""The frame-based rival makes the same events as the analytic way, to within its frames."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.emulator import FRAME_NS, emulate
from rigs.scene.events import EventOptics, MarkerSensor

OPTICS = replace(EventOptics(), width=160, height=120, noise_hz=0.0, hot_pixels=0, readout_hz=0.0)
LAYOUT = np.array([[-2.5, 0.0], [2.0, 1.0]])


def circling(px_per_s: float, milliseconds: int) -> tuple[np.ndarray, np.ndarray]:
    t_ns = np.arange(milliseconds + 1, dtype=np.int64) * FRAME_NS
    turn = px_per_s / 8.0 * t_ns[:, None] * 1e-9 + np.array([0.0, 1.0])
    loads = np.zeros((len(t_ns), 2, 3))
    loads[:, :, 0], loads[:, :, 1] = 8.0 / 63.0 * np.cos(turn), 8.0 / 63.0 * np.sin(turn)
    return loads.reshape(len(t_ns), -1), t_ns


@pytest.mark.parametrize("px_per_s", [20.0, 80.0])
def test_both_ways_give_the_same_events(px_per_s: float) -> None:
    optics = replace(OPTICS, refractory_us=0.0)
    loads, t_ns = circling(px_per_s, 800)
    sensor = MarkerSensor(optics, LAYOUT, 3)
    sensor.reset(loads[0], 1)
    exact = sensor.sense(loads, t_ns)
    path = sensor.path(loads).transpose(2, 0, 1)
    drawn = emulate(path, optics, sensor.threshold)
    assert len(drawn[0]) == pytest.approx(len(exact[0]), rel=0.01)
    assert len(exact[0]) > 3000
    # the k-th event of a pixel, where both ways give it the same polarities
    late, same = [], 0
    for pixel in range(0, 160 * 120, 7):
        ours, theirs = (
            (each[1] == pixel % 160) & (each[2] == pixel // 160) for each in (exact, drawn)
        )
        if np.array_equal(exact[3][ours], drawn[3][theirs]):
            late.append(drawn[0][theirs] - exact[0][ours])
            same += len(late[-1])
    apart = np.abs(np.concatenate(late))
    assert same > 0.95 * len(exact[0]) / 7
    assert apart.max() <= FRAME_NS
    assert np.median(apart) < 0.02 * FRAME_NS


def test_what_stands_still_fires_nothing() -> None:
    path = np.repeat(np.array([[[50.3, 60.1, 17.0], [110.7, 44.4, 16.0]]]), 20, axis=0)
    assert len(emulate(path, OPTICS, np.full((120, 160), 0.2))[0]) == 0


def test_the_dead_time_is_kept() -> None:
    loads, _ = circling(400.0, 200)
    sensor = MarkerSensor(OPTICS, LAYOUT, 3)
    t_ns, x, y, _ = emulate(sensor.path(loads).transpose(2, 0, 1), OPTICS, sensor.threshold)
    pixel = y.astype(np.int64) * 160 + x
    order = np.lexsort((t_ns, pixel))
    gaps = np.diff(t_ns[order])[np.diff(pixel[order]) == 0]
    assert len(gaps) > 1000
    assert gaps.min() >= 500_000
