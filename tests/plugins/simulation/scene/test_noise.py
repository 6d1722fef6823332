"""Noise of the event camera: its rates against Poisson's law, its place and its repeatability."""

import math

import numpy as np
import pytest

from sliplab.plugins.simulation.scene.events import EventOptics, Events, MarkerSensor
from sliplab.plugins.simulation.scene.noise import (
    BIN_NS,
    BRIGHT_SHARE,
    NoiseRates,
    brightness,
    candidates,
    hot_places,
)

STILL = {"readout_hz": 0.0, "refractory_us": 0.0}


def still(
    optics: EventOptics, seconds: int, seed: int = 4, rig: int = 1, layout: np.ndarray | None = None
) -> Events:
    """Events while every marker stands still: noise alone."""
    places = np.zeros((1, 2)) if layout is None else layout
    sensor = MarkerSensor(optics, places, rig)
    t_ns = np.arange(0, seconds * 1000 + 1, 32, dtype=np.int64) * 1_000_000
    loads = np.zeros((len(t_ns), 3 * len(places)))
    sensor.reset(loads[0], seed)
    return sensor.sense(loads, t_ns)


def span_s(seconds: int) -> float:
    """The seconds that `still` really takes: whole blocks of 32 ms."""
    return seconds * 1000 // 32 * 0.032


def expect(count: int, mean: float) -> None:
    """A Poisson count lies within 4.5 standard deviations of its mean."""
    assert abs(count - mean) < 4.5 * math.sqrt(mean) + 1


def test_dark_pixels_have_their_rate_and_their_share_of_leakage() -> None:
    optics = EventOptics(noise_hz=0.1, leak_share=0.3, hot_pixels=0, radius_mm=0.01, **STILL)
    t_ns, x, y, p = still(optics, 4)
    mean = 0.1 * 640 * 480 * span_s(4)
    expect(len(t_ns), mean)
    expect(int((p == 1).sum()), mean * (0.3 + 0.35))
    expect(int((p == 0).sum()), mean * 0.35)
    for half in (x < 320, y < 240, t_ns < 0.5e9 * span_s(4)):
        expect(int(half.sum()), 0.5 * mean)
    assert np.all(np.diff(t_ns) >= 0)


@pytest.mark.parametrize("leak_share", [0.0, 0.5, 1.0])
def test_pixels_on_a_marker_have_a_quarter_of_the_shot_noise(leak_share: float) -> None:
    """Hu, Liu and Delbruck 2021: leakage does not depend on intensity, shot noise falls with it."""
    optics = EventOptics(
        width=256,
        height=256,
        noise_hz=2.0,
        leak_share=leak_share,
        hot_pixels=0,
        radius_mm=6.0,
        **STILL,
    )
    _, x, y, p = still(optics, 8)
    gap = np.hypot(x - 127.5, y - 127.5) - 14.0 * 6.0
    rows, columns = np.mgrid[:256, :256]
    gaps = np.hypot(columns - 127.5, rows - 127.5) - 14.0 * 6.0
    for inside, share in ((-4.0, BRIGHT_SHARE), (4.0, 1.0)):
        here = gap < inside if inside < 0 else gap > inside
        pixels = (gaps < inside).sum() if inside < 0 else (gaps > inside).sum()
        full = 2.0 * pixels * span_s(8)
        shot = full * (1 - leak_share) * share
        expect(int((here & (p == 0)).sum()), 0.5 * shot)
        expect(int((here & (p == 1)).sum()), full * leak_share + 0.5 * shot)


def test_brightness_is_linear_in_intensity() -> None:
    discs = np.array([[50.0, 50.0, 20.0], [150.0, 50.0, 20.0]])
    assert brightness(50, 50, discs, 2.08, 0.8) == 1.0
    assert brightness(150, 65, discs, 2.08, 0.8) == 1.0
    assert brightness(100, 50, discs, 2.08, 0.8) == 0.0
    # on the rim the log intensity is half the contrast
    middle = (math.exp(1.04) - 1) / (math.exp(2.08) - 1)
    assert brightness(70, 50, discs, 2.08, 0.8) == pytest.approx(middle, rel=1e-12)


def test_noise_follows_a_marker_that_moves() -> None:
    """A pixel that a marker leaves is dark again: the marker's place decides, block by block."""
    optics = EventOptics(
        width=128,
        height=128,
        noise_hz=50.0,
        leak_share=0.0,
        hot_pixels=0,
        radius_mm=2.0,
        threshold=9.0,
        threshold_sigma=0.0,
        **STILL,
    )
    sensor = MarkerSensor(optics, np.zeros((1, 2)), 1)
    t_ns = np.arange(0, 4001, 32, dtype=np.int64) * 1_000_000
    loads = np.zeros((len(t_ns), 3))
    loads[:, 0] = np.where(t_ns < 2_000_000_000, 0.5, -0.5)  # 31.5 px to the left, then right
    sensor.reset(loads[0], 9)
    when, x, y, _ = sensor.sense(loads, t_ns)
    left = np.hypot(x - 32.0, y - 63.5) < 20
    before = when < 1_984_000_000
    pixels = int((np.hypot(*np.mgrid[-32:96, -63.5:64.5]) < 20).sum())
    expect(int((left & before).sum()), 50.0 * pixels * 1.984 * BRIGHT_SHARE)
    after = when > 2_016_000_000
    expect(int((left & after).sum()), 50.0 * pixels * (t_ns[-1] * 1e-9 - 2.016))


def test_hot_pixels_are_the_rigs_and_fire_at_their_rate() -> None:
    optics = EventOptics(noise_hz=0.0, hot_pixels=5, hot_hz=40.0, **STILL)
    _, x, y, p = still(optics, 10, seed=4)
    hot = sorted(set(zip(x.tolist(), y.tolist(), strict=True)))
    assert len(hot) == 5
    assert np.all(p == 1)
    for px, py in hot:
        expect(int(((x == px) & (y == py)).sum()), 40.0 * span_s(10))
    _, u, v, _ = still(optics, 10, seed=5)
    assert sorted(set(zip(u.tolist(), v.tolist(), strict=True))) == hot
    _, u, v, _ = still(optics, 10, seed=4, rig=2)
    assert sorted(set(zip(u.tolist(), v.tolist(), strict=True))) != hot
    assert len(np.unique(hot_places(64, 64, 4096, 3))) == 64 * 64


def test_times_between_noise_events_are_exponential() -> None:
    """Kolmogorov and Smirnov's distance of the gaps from 1 - exp(-rate t), over several bins."""
    rates = NoiseRates(64, 64, 1.0, 0.5, 0.0, np.empty(0, np.int64))
    t_ns = np.concatenate([candidates(rates, 3, index)[0] for index in range(6)])
    assert np.all(np.diff(t_ns) >= 0)
    gaps = np.sort(np.diff(t_ns)) * 1e-9
    law = 1 - np.exp(-4096.0 * gaps)
    ranks = np.arange(1, len(gaps) + 1) / len(gaps)
    assert np.abs(law - ranks).max() < 1.95 / math.sqrt(len(gaps))  # 1 in 1000


def test_counts_vary_as_poissons_do() -> None:
    rates = NoiseRates(64, 64, 0.1, 0.5, 0.0, np.empty(0, np.int64))
    counts = np.array([len(candidates(rates, 3, index)[0]) for index in range(400)])
    assert counts.mean() == pytest.approx(409.6, abs=4 * math.sqrt(409.6 / 400))
    assert counts.var() == pytest.approx(409.6, rel=4 * math.sqrt(2 / 400))


def test_without_noise_there_is_none_and_nothing_is_drawn() -> None:
    optics = EventOptics(noise_hz=0.0, hot_pixels=0, **STILL)
    assert len(still(optics, 3)[0]) == 0
    rates = NoiseRates(64, 64, 0.0, 0.5, 0.0, np.empty(0, np.int64))
    assert rates.hot_share == 0.0
    t_ns, place, lot = candidates(rates, 1, 0)
    assert len(t_ns) == len(place) == len(lot) == 0


def test_noise_belongs_to_its_seed_and_to_its_second() -> None:
    optics = EventOptics(noise_hz=0.05, **STILL)
    first, again, other = (still(optics, 3, seed) for seed in (4, 4, 5))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0][:100], other[0][:100])
    rates = NoiseRates(640, 480, 0.05, 0.5, 10.0, hot_places(640, 480, 8, 1))
    for index in (0, 7, 5000):
        t_ns, place, lot = candidates(rates, 4, index)
        assert t_ns.min() >= index * BIN_NS
        assert t_ns.max() < (index + 1) * BIN_NS
        assert ((place >> 12) < 640).all()
        assert ((place & 4095) < 480).all()
        assert lot.min() >= 0.0
        assert lot.max() < 1.0


def test_a_pixels_dead_time_holds_for_noise_too() -> None:
    optics = EventOptics(
        width=64, height=64, noise_hz=100.0, hot_pixels=0, readout_hz=0.0, refractory_us=500.0
    )
    t_ns, x, y, _ = still(optics, 2)
    pixel = y.astype(np.int64) * 64 + x
    order = np.lexsort((t_ns, pixel))
    gaps = np.diff(t_ns[order])[np.diff(pixel[order]) == 0]
    assert len(gaps) > 10_000
    assert gaps.min() >= 500_000
    # what is left of a Poisson process of rate r with a dead time d is r / (1 + r d)
    dark = 100.0 / (1 + 100.0 * 5e-4)
    away = np.hypot(x - 31.5, y - 31.5) > 16.8 + 4
    rows, columns = np.mgrid[:64, :64]
    pixels = int((np.hypot(columns - 31.5, rows - 31.5) > 16.8 + 4).sum())
    expect(int(away.sum()), dark * pixels * span_s(2))
