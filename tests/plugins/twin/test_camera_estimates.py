"""Estimates of an event camera against events that are made from known numbers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.camera_estimates import NAMES, camera_estimates
from sliplab.plugins.twin.event_times import (
    INTERVALS_US,
    count_intervals,
    dead_time_us,
    find_scans,
)
from sliplab.plugins.twin.pilot import Forces, PilotTrial, SlideEvents, SlideMotion
from sliplab.plugins.twin.pilots import simulate_pilot
from sliplab.plugins.twin.rims import CONTRAST, EDGE, HIDDEN, fit_rims
from sliplab.protocols import load_plan
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.streams import EventChunk

SIZE = (400, 320)
HOLD_S, SLIDE_S = -2.0, 4.0
ANGLES = np.arange(6) * np.pi / 3
LAYOUT = np.concatenate([[[0.0, 0.0]], 5.6 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1)])
PX_PER_MM, RADIUS_MM, SHIFT, GROWTH = 13.0, 1.3, 4.0, 0.5
EDGE_PX, C, THRESHOLD, MISMATCH = 0.9, 2.0, 0.22, 0.12
NOISE_HZ, LEAK = 0.2, 0.4
"""Of the discs and the camera that most tests make events of."""


def chunk(t_us: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> EventChunk:
    """Events in order of time."""
    order = np.argsort(t_us, kind="stable")
    return EventChunk(
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        p[order].astype(np.uint8),
        t_us[order].astype(np.int64),
    )


def nothing() -> EventChunk:
    return chunk(*(np.empty(0) for _ in range(4)))


def trial(
    events: EventChunk | None, size: tuple[int, int] = SIZE, depth: float = 3.0, angle: float = 0.0
) -> PilotTrial:
    """A slide of 4 s at 1 mm/s after a hold of 2 s, its tips at rest."""
    frame_s = np.arange(HOLD_S, SLIDE_S, 0.01)
    way = np.array([np.cos(angle), np.sin(angle)])
    return PilotTrial(
        "t",
        SlideMotion(depth, 1.0, way),
        HOLD_S,
        SLIDE_S,
        frame_s,
        np.broadcast_to(LAYOUT, (len(frame_s), *LAYOUT.shape)),
        np.outer(np.clip(frame_s, 0.0, None), way),
        None if events is None else SlideEvents(events, size),
    )


def noise(
    rng: np.random.Generator, hot: int = 5, hot_hz: float = 12.0, size: tuple[int, int] = SIZE
) -> EventChunk:
    """Poisson noise of known rates over hold and slide, and hot pixels in the first row."""
    width, height = size
    span = SLIDE_S - HOLD_S
    parts = []
    for rate, p in ((0.5 * NOISE_HZ * (1 + LEAK), 1), (0.5 * NOISE_HZ * (1 - LEAK), 0)):
        n = rng.poisson(rate * span * width * height)
        parts.append((rng.integers(0, width, n), rng.integers(0, height, n), np.full(n, p)))
    n = rng.poisson(hot_hz * span * hot)
    parts.append((3 * rng.integers(0, hot, n), np.zeros(n, int), np.ones(n, int)))
    x, y, p = (np.concatenate(column) for column in zip(*parts, strict=True))
    return chunk(rng.uniform(HOLD_S, SLIDE_S, len(x)) * 1e6, x, y, p)


def level(size: tuple[int, int], centres: np.ndarray, radius: float) -> np.ndarray:
    """Log intensity of discs with logistic edges."""
    x, y = np.arange(size[0]), np.arange(size[1])[:, None]
    return sum(
        C / (1.0 + np.exp((np.hypot(x - column, y - row) - radius) / EDGE_PX))
        for column, row in centres
    )


def thresholds(size: tuple[int, int] = SIZE) -> np.ndarray:
    drawn = np.random.default_rng(1).standard_normal(size[::-1])
    return THRESHOLD * (1.0 + MISMATCH * np.clip(drawn, -3.0, 3.0))


def counts(before: np.ndarray, after: np.ndarray, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Whole thresholds by which the level of each pixel has changed."""
    return np.trunc((after - before) / thresholds(size)).astype(np.int32)


def centres(size: tuple[int, int] = SIZE) -> np.ndarray:
    return LAYOUT * [PX_PER_MM, -PX_PER_MM] + [0.5 * (size[0] - 1), 0.5 * (size[1] - 1)]


def swept(angle: float, depth: float, rng: np.random.Generator) -> PilotTrial:
    """Discs that move by a force of 0.25 N each in 2 s, pressed by `depth` / 10 N each."""
    way = np.array([np.cos(angle), np.sin(angle)])
    pulled, pressed = 0.25, 0.1 * depth
    radius = PX_PER_MM * (RADIUS_MM + GROWTH * pressed)
    before = level(SIZE, centres(), radius)
    parts = []
    seen = np.zeros(SIZE[::-1], np.int32)
    for step in range(1, 13):
        moved = PX_PER_MM * SHIFT * pulled * step / 12 * way * [-1.0, 1.0]
        now = counts(before, level(SIZE, centres() + moved, radius))
        y, x = np.nonzero(now - seen)
        more = (now - seen)[y, x]
        y, x, p = (np.repeat(a, np.abs(more)) for a in (y, x, more > 0))
        parts.append((rng.uniform(step - 1, step, len(x)) * 2e6 / 12, x, y, p))
        seen = now
    events = EventChunk.concatenate(
        [chunk(*map(np.concatenate, zip(*parts, strict=True))), noise(rng)]
    )
    made = trial(chunk(events.t_us, events.x, events.y, events.p), depth=depth, angle=angle)
    t_s = np.arange(HOLD_S, SLIDE_S, 0.001)
    force = np.zeros((len(t_s), 3))
    force[:, :2] = len(LAYOUT) * pulled * np.clip(t_s / 2.0, 0.0, 1.0)[:, None] * way
    force[:, 2] = len(LAYOUT) * pressed
    return replace(made, forces=Forces(t_s, force))


@cache
def pilot() -> tuple[PilotTrial, ...]:
    rng = np.random.default_rng(2)
    return tuple(
        swept(angle, depth, rng) for angle in np.radians([0, 90, 180, 270]) for depth in (2.4, 3.4)
    )


@cache
def estimated() -> dict[str, float]:
    return camera_estimates(pilot())


@pytest.mark.long
def test_discs_that_sweep_give_all_numbers_of_the_picture() -> None:
    found = estimated()
    assert found["px_per_mm"] == pytest.approx(PX_PER_MM, rel=0.002)
    assert found["marker_radius_mm"] == pytest.approx(RADIUS_MM, rel=0.01)
    assert found["image_shift_mm_per_n"] == pytest.approx(SHIFT, rel=0.01)
    assert found["image_shift_px"] == pytest.approx(PX_PER_MM * SHIFT * 0.25, rel=0.01)
    assert found["image_growth_mm_per_n"] == pytest.approx(GROWTH, rel=0.1)
    assert found["edge_px"] == pytest.approx(EDGE_PX, rel=0.05)
    for name in ("contrast_in_thresholds", "on_thresholds", "off_thresholds"):
        assert found[name] == pytest.approx(C / THRESHOLD, rel=0.04)
    assert found["threshold_mismatch"] == pytest.approx(MISMATCH, rel=0.15)
    assert found["noise_hz"] == pytest.approx(NOISE_HZ, rel=0.02)
    assert found["leak_share"] == pytest.approx(LEAK, rel=0.03)
    assert found["hot_pixels"] == 5
    assert found["hot_hz"] == pytest.approx(12.0, rel=0.1)
    # its events have times of their own
    assert np.isnan(found["readout_hz"])
    assert np.isnan(found["scan_us"])


@pytest.mark.long
def test_pixels_that_are_busy_in_the_slide_alone_are_not_hot() -> None:
    """As where the rim of a disc passes that was not found in its place."""
    x, y = np.divmod(np.arange(400), 20)
    found = []
    for made in pilot():
        assert made.camera is not None
        t_us = np.linspace(5e5 * made.slide_s, 9e5 * made.slide_s, 400).astype(np.int64)
        passed = EventChunk(
            x.astype(np.uint16), (y + 1).astype(np.uint16), np.ones(400, np.int8), t_us
        )
        both = EventChunk.concatenate([made.camera.events, *[passed] * 6])
        order = np.argsort(both.t_us, kind="stable")
        events = both[order]
        found.append(replace(made, camera=replace(made.camera, events=events)))
    before, after = estimated(), camera_estimates(found)
    assert after["hot_pixels"] == before["hot_pixels"] == 5
    assert after["hot_hz"] == before["hot_hz"]
    assert after["noise_hz"] == pytest.approx(before["noise_hz"], rel=0.01)


def test_a_disc_is_fitted_to_whole_counts() -> None:
    """Each parameter lies within five of its standard deviations, hot pixels or not."""
    size, place = (120, 100), np.array([[50.3, 48.7]])
    place_1 = np.array([[59.8, 44.7]])
    true = np.array([50.3, 48.7, 18.4, 9.5, -4.0, 0.6, EDGE_PX, C / THRESHOLD])
    image = counts(level(size, place, 18.4), level(size, place_1, 19.0), size)
    image[40:44, 52] = HIDDEN
    start = true + np.array([1.0, -1.0, 1.0, -1.0, 1.0, -0.6, -0.2, 2.0])
    fit = fit_rims(image, 0.0, start[None], shape=True)
    bias = np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.02, 0.03, 0.02 * true[CONTRAST]])
    assert (np.abs(fit.discs[0] - true) < 5.0 * fit.sigma[0] + bias).all()
    assert (fit.sigma[0, :7] < 0.1).all()
    given = fit_rims(image, 0.0, np.where(np.arange(8) >= EDGE, true, start)[None], shape=False)
    assert (given.discs[0, EDGE:] == true[EDGE:]).all()


@pytest.mark.parametrize("start", [np.full(8, np.nan), np.array([9.0, 9, 5, 1, 0, 0, 1, 10])])
def test_no_disc_is_fitted_where_there_is_none(start: np.ndarray) -> None:
    fit = fit_rims(np.zeros((20, 20), np.int32), 0.0, start[None], shape=True)
    assert np.isnan(fit.discs).all()
    assert not fit.full.any()


def scanned(
    rng: np.random.Generator, period_us: float, scan_us: float, width: int = 640, n: int = 30_000
) -> EventChunk:
    """Random events that are read by scans."""
    x = rng.integers(0, width, n)
    begin = np.ceil(np.sort(rng.uniform(0.0, 5e6, n)) / period_us) * period_us + 123.4
    t_us = np.floor(begin + x * (scan_us / width))
    return chunk(t_us, x, rng.integers(0, 480, n), np.ones(n))


@pytest.mark.parametrize(
    ("hz", "scan_us", "width"),
    [
        (5000.0, 192.0, 640),
        (3846.2, 150.0, 640),
        (6499.0, 153.0, 640),
        (1000.0, 900.0, 346),
        (9900.0, 60.0, 1280),
        (5000.0, 0.0, 640),
    ],
)
def test_scans_of_a_read_out(hz: float, scan_us: float, width: int) -> None:
    found = find_scans(scanned(np.random.default_rng(3), 1e6 / hz, scan_us, width), width)
    assert found is not None
    assert found.period_us == pytest.approx(1e6 / hz, rel=1e-4)
    assert found.scan_us == pytest.approx(scan_us, abs=2.0)


def test_no_scans_are_found_where_every_event_has_its_own_time() -> None:
    rng = np.random.default_rng(4)
    n = 30_000
    events = chunk(
        rng.uniform(0.0, 5e6, n), rng.integers(0, 640, n), rng.integers(0, 480, n), np.ones(n)
    )
    assert find_scans(events, 640) is None
    assert find_scans(nothing(), 640) is None


def train(rng: np.random.Generator, dead_us: float, rate_hz: float, seconds: float) -> np.ndarray:
    """Times of a pixel that is dead after each of its events, us."""
    gaps = dead_us + rng.exponential(1e6 / rate_hz, round(2 * seconds * rate_hz))
    t_us = np.cumsum(gaps)
    return t_us[t_us < seconds * 1e6]


@pytest.mark.parametrize("dead_us", [300.0, 500.0, 650.0, 2100.0])
@pytest.mark.parametrize("period_us", [None, 200.0, 153.8])
def test_dead_time_of_a_pixel(dead_us: float, period_us: float | None) -> None:
    rng, rate_hz = np.random.default_rng(5), 50.0
    counts_us, last = np.zeros(INTERVALS_US, np.int64), np.empty((1, 8), np.int64)
    t_us, x = [], []
    for column in range(8):
        times = train(rng, dead_us, rate_hz, 60.0)
        if period_us is not None:
            times = np.ceil(times / period_us) * period_us
        t_us.append(np.floor(times))
        x.append(np.full(len(times), column))
    seen = chunk(
        np.concatenate(t_us),
        np.concatenate(x),
        np.zeros(sum(map(len, x))),
        np.ones(sum(map(len, x))),
    )
    count_intervals(seen.t_us, seen.x, seen.y, np.ones((1, 8), np.bool_), last, counts_us)
    found = dead_time_us(counts_us, rate_hz, period_us)
    assert found == pytest.approx(dead_us, abs=5.0 if period_us is None else 25.0)


def test_too_few_intervals_tell_no_dead_time() -> None:
    assert np.isnan(dead_time_us(np.zeros(INTERVALS_US, np.int64), 10.0, 200.0))


@pytest.mark.parametrize(
    "trials",
    [[], [trial(None)], [trial(nothing())], [trial(None), trial(nothing())]],
    ids=["no trial", "no camera", "no event", "neither"],
)
def test_nothing_is_estimated_from_nothing(trials: list[PilotTrial]) -> None:
    found = camera_estimates(trials)
    assert tuple(found) == NAMES
    assert np.isnan(list(found.values())).all()


def only(made: PilotTrial, kept: np.ndarray) -> PilotTrial:
    """A trial with some of its events."""
    assert made.camera is not None
    seen = made.camera.events
    events = seen[kept]
    return replace(made, camera=SlideEvents(events, made.camera.size_px))


def test_positive_events_alone_give_noise_and_no_discs() -> None:
    """All of the noise is leakage then."""
    trials = [only(made, made.camera.events.p > 0) for made in pilot() if made.camera is not None]
    found = camera_estimates(trials)
    assert found["leak_share"] == pytest.approx(1.0)
    assert np.isnan(found["image_growth_mm_per_n"])
    assert np.isfinite(found["noise_hz"])


def test_without_a_hold_noise_comes_from_the_slide() -> None:
    trials = [replace(made, hold_s=0.0) for made in pilot()]
    trials = [
        only(made, made.camera.events.t_us >= 0) for made in trials if made.camera is not None
    ]
    found = camera_estimates(trials)
    assert found["noise_hz"] == pytest.approx(NOISE_HZ, rel=0.02)
    assert np.isnan(found["hold_events_per_s"])
    assert found["px_per_mm"] == pytest.approx(PX_PER_MM, rel=0.002)


def test_discs_that_are_not_found_and_no_hold_leave_nothing_to_measure_noise_by() -> None:
    made = replace(trial(noise(np.random.default_rng(8))), hold_s=0.0)
    found = camera_estimates([made])
    assert np.isnan(
        [found[name] for name in ("noise_hz", "leak_share", "hot_hz", "px_per_mm")]
    ).all()


def test_a_trial_of_another_camera_is_left_out() -> None:
    other = trial(noise(np.random.default_rng(9), size=(346, 260)), (346, 260))
    assert camera_estimates([*pilot()[:2], other]) == camera_estimates(pilot()[:2])


def test_noise_alone_is_measured_in_the_hold() -> None:
    """A picture of another size, no discs, no forces and no frames."""
    rng, size = np.random.default_rng(6), (346, 260)
    frames = replace(
        trial(noise(rng, hot=3, size=size), size),
        frame_s=np.empty(0),
        tips_mm=np.empty((0, 7, 2)),
        base_mm=np.empty((0, 2)),
    )
    found = camera_estimates([frames])
    assert found["noise_hz"] == pytest.approx(NOISE_HZ, rel=0.03)
    assert found["leak_share"] == pytest.approx(LEAK, rel=0.05)
    assert found["hot_pixels"] == 3
    assert np.isnan(found["px_per_mm"])


def test_without_forces_only_products_are_known() -> None:
    found = camera_estimates([replace(made, forces=None) for made in pilot()])
    assert np.isnan(found["image_shift_mm_per_n"])
    assert np.isnan(found["image_growth_mm_per_n"])
    assert found["image_shift_px"] == pytest.approx(PX_PER_MM * SHIFT * 0.25, rel=0.01)
    assert found["image_growth_px_per_mm"] == pytest.approx(PX_PER_MM * GROWTH * 0.1, rel=0.1)


def test_a_marker_that_was_never_seen_is_left_out() -> None:
    """The force on all papillae says nothing of the other discs' motion then."""
    hidden = np.array([0, 0, 0, 1, 0, 0, 0], np.bool_)[:, None]
    trials = [replace(made, tips_mm=np.where(hidden, np.nan, made.tips_mm)) for made in pilot()]
    found = camera_estimates(trials)
    assert found["px_per_mm"] == pytest.approx(PX_PER_MM, rel=0.002)
    assert found["edge_px"] == pytest.approx(EDGE_PX, rel=0.05)
    assert found["noise_hz"] == pytest.approx(NOISE_HZ, rel=0.03)
    assert np.isnan(found["image_shift_mm_per_n"])
    assert np.isnan(found["image_growth_mm_per_n"])


def test_markers_that_are_seen_in_some_frames_only_are_enough() -> None:
    trials = []
    for index, made in enumerate(pilot()):
        tips = made.tips_mm.copy()
        tips[: 3 + index, index % 7] = np.nan
        trials.append(replace(made, tips_mm=tips))
    whole, found = estimated(), camera_estimates(trials)
    assert found == pytest.approx(whole, nan_ok=True)


@pytest.mark.long
def test_estimates_of_a_simulated_rig(root: Path) -> None:
    """Four slides of each depth, one world, the numbers of its rig file."""
    rig, _ = load_rig_file(root / "rigs" / "mock_force.yaml")
    rig = changed(rig.model_copy(update={"poll": 1.0}), {"seed": 7})
    plan = load_plan(root / "protocols" / "pilot.yaml")
    trials = [t for t in plan.trials if plan.describe(t)["speed"].startswith("1.6")]
    found = camera_estimates(simulate_pilot(rig, plan, trials, 3))
    camera = scene_of(rig).event_camera
    for name, value, within in (
        ("px_per_mm", camera.px_per_mm, 0.01),
        ("marker_radius_mm", camera.radius_mm, 0.02),
        ("image_shift_mm_per_n", camera.shift_mm_per_n, 0.03),
        ("image_growth_mm_per_n", camera.growth_mm_per_n, 0.1),
        ("edge_px", camera.edge_px, 0.1),
        ("contrast_in_thresholds", camera.contrast / camera.threshold, 0.05),
        ("threshold_mismatch", camera.threshold_sigma / camera.threshold, 0.1),
        ("refractory_us", camera.refractory_us, 0.25),
        ("noise_hz", camera.noise_hz, 0.02),
        ("leak_share", camera.leak_share, 0.03),
        ("hot_pixels", camera.hot_pixels, 0.0),
        ("hot_hz", camera.hot_hz, 0.05),
        ("readout_hz", camera.readout_hz, 1e-4),
        ("scan_us", camera.scan_us, 0.01),
    ):
        assert found[name] == pytest.approx(value, rel=within), name
