"""Discs tracked by their events against paths that are known in closed form."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sliplab.analysis.labels import event_tracking
from sliplab.analysis.labels.event_tracking import Discs, EventTracks, find_discs, lost_slices
from sliplab.plugins.simulation.scene.events import EventOptics, MarkerSensor
from sliplab.storage.streams import EventChunk

SIZE = (640, 480)
STEP_NS = 2_000_000
ANGLES = np.arange(6) * np.pi / 3
LAYOUT = np.concatenate([[[0.0, 0.0]], 5.6 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1)])
DOWN = LAYOUT * [1.0, -1.0]
STILL_S, FORTH_S, SPEED = 0.5, 2.0, np.array([3.0, -2.0])
"""Discs rest, then move at (3, -2) px/s for 2 s, rest for 0.5 s and move back for 1 s."""


def path_px(t_s: np.ndarray) -> np.ndarray:
    """Displacement of every disc, (n, 2), columns and rows."""
    forth = np.clip(t_s - STILL_S, 0.0, FORTH_S)
    back = np.clip(t_s - STILL_S - FORTH_S - 0.5, 0.0, 1.0)
    return np.outer(forth - back, SPEED)


@cache
def events(noise_hz: float = 0.01, hot: int = 8, contrast: float = 2.08) -> EventChunk:
    """What the simulated event camera sees of them."""
    optics = EventOptics(noise_hz=noise_hz, hot_pixels=hot, contrast=contrast)
    sensor = MarkerSensor(optics, LAYOUT, 3)
    t_ns = np.arange(0, round((STILL_S + FORTH_S + 1.5) * 1e9) + 1, STEP_NS)
    moved = path_px(t_ns * 1e-9) / (optics.px_per_mm * optics.shift_mm_per_n)
    loads = np.tile(np.stack([-moved[:, 0], moved[:, 1], np.full(len(t_ns), 0.3)], 1), len(LAYOUT))
    sensor.reset(loads[0], 5)
    t, x, y, p = sensor.sense(loads, t_ns)
    return EventChunk(x, y, p, t // 1000)


def rests() -> np.ndarray:
    return DOWN * 14.0 + [0.5 * (SIZE[0] - 1), 0.5 * (SIZE[1] - 1)]


def kept(seen: EventChunk, mask: np.ndarray) -> EventChunk:
    return seen[mask]


EDGES_US = np.arange(0, 4_000_001, 5_000)
SETTLE = slice(100, 160)


def found(seen: EventChunk) -> Discs | None:
    first = (seen.t_us > 500_000) & (seen.t_us < 800_000)
    return find_discs(kept(seen, first), DOWN, SIZE)


def track(seen: EventChunk) -> EventTracks:
    seen = event_tracking.without_hot_pixels(seen, SIZE)
    discs = found(seen)
    assert discs is not None
    return event_tracking.track_discs(seen, EDGES_US, discs, SETTLE)


def errors(tracks: EventTracks) -> np.ndarray:
    """Displacement less the true one, px, (n, m, 2)."""
    true = path_px(EDGES_US[1:] * 1e-6)
    return (tracks.xy - tracks.rests.xy) - true[:, None, :]


HARD = [{}, {"noise_hz": 0.1}, {"hot": 500}, {"contrast": 1.0}]


@pytest.mark.parametrize("case", HARD, ids=str)
def test_discs_are_found_wherever_they_are_and_however_large(case: dict[str, float]) -> None:
    discs = found(event_tracking.without_hot_pixels(events(**case), SIZE))
    assert discs.found.all()
    assert np.abs(discs.xy - rests()).max() < 1.0
    # 1.2 mm, and 0.4 mm/N under 0.3 N, at 14 px/mm
    assert discs.radius == pytest.approx(np.full(7, 18.48), abs=0.6)
    assert discs.px_per_mm == pytest.approx(14.0, rel=0.03)


@pytest.mark.parametrize("case", HARD, ids=str)
def test_displacements_stay_within_the_play_that_thresholds_leave(case: dict[str, float]) -> None:
    tracks = track(events(**case))
    off = errors(tracks)
    assert tracks.contrast == pytest.approx(case.get("contrast", 2.08) / 0.2, rel=0.15)
    forth = slice(140, 500)
    if "contrast" not in case:
        assert np.sqrt((off[forth] ** 2).mean()) < tracks.backlash_px
        assert np.abs(off).max() < 2 * tracks.backlash_px
    # slip is read from the shape, which is far better: play and scale are the same all the way
    t = np.arange(off[forth].shape[0])
    flat = off[forth].reshape(len(t), -1)
    line = np.stack([np.ones(len(t)), t], 1)
    shape = flat - line @ np.linalg.lstsq(line, flat, rcond=None)[0]
    assert np.sqrt((shape**2).mean()) < 0.05
    assert not tracks.lost.any()


def test_a_disc_that_is_not_there_is_not_found() -> None:
    seen = events()
    torn = np.hypot(*(np.stack([seen.x, seen.y], 1) - rests()[4]).T) > 40
    discs = found(kept(seen, torn))
    assert discs.found.tolist() == [True] * 4 + [False] + [True] * 2
    tracks = track(kept(seen, torn))
    assert np.isnan(tracks.xy[:, 4]).all()
    assert np.isfinite(tracks.xy[:, [0, 1, 2, 3, 5, 6]]).all()


def test_noise_is_no_layout() -> None:
    draw = np.random.default_rng(1)
    n = 20_000
    noise = EventChunk(
        draw.integers(0, 640, n).astype(np.uint16),
        draw.integers(0, 480, n).astype(np.uint16),
        draw.integers(0, 2, n).astype(np.uint8),
        np.sort(draw.integers(0, 300_000, n)),
    )
    assert find_discs(noise, DOWN, SIZE) is None
    assert find_discs(kept(noise, noise.t_us < 1000), DOWN, SIZE) is None


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_lost_events_are_noticed_and_the_track_finds_back(share: float) -> None:
    seen = events()
    lost = (seen.t_us > 1_200_000) & (seen.t_us < 1_500_000)
    lost &= np.random.default_rng(2).random(len(seen)) < share
    tracks = track(kept(seen, ~lost))
    # 0.3 s at 3.6 px/s are 1.1 px, of which half or all was not seen
    assert tracks.lost[245:295].all()
    assert not tracks.lost[:220].any()
    assert not tracks.lost[320:].any()
    assert np.abs(errors(tracks)[400:500]).max() < 0.5
    assert tracks.sigma[299].min() > 3 * tracks.sigma[400].max() / 2


def test_a_quiet_camera_at_rest_has_lost_nothing() -> None:
    seen = events(noise_hz=0.0, hot=0)
    discs = Discs(rests(), np.full(7, 18.5), 14.0)
    assert not lost_slices(seen, EDGES_US, discs).any()
