"""The two ways to notice a touch."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.rigs.core.touching import MarkerTouch, RateTouch, count_central
from sliplab.storage.streams import EventChunk

Floats = NDArray[np.float64]
FRAMES = 400
TOUCHED = 250


def way(kind: str, seed: int = 1, noise: float = 0.005) -> Floats:
    """Markers of 19 papillae over 400 frames; the centre touches in frame 250 (or never)."""
    rng = np.random.default_rng(seed)
    layout = rng.uniform(100, 600, (19, 2))
    t = np.arange(FRAMES)
    sway = 0.3 * np.column_stack([np.sin(t / 3), np.cos(t / 4)])
    drift = np.column_stack([0.002 * t, -0.001 * t])
    places = layout + sway[:, None] + drift[:, None] + noise * rng.standard_normal((FRAMES, 19, 2))
    after = np.maximum(t - TOUCHED, 0)
    if kind == "sticks":
        places[TOUCHED:, 0] -= sway[TOUCHED:] - sway[TOUCHED]
    elif kind == "leaves":
        places[:, 0, 0] += 0.02 * after
    elif kind == "drifts":  # the view changes slowly: no touch
        places[:, 0, 0] += 0.003 * t
    elif kind == "appears":
        places[:TOUCHED, 0] = np.nan
    elif kind == "flickers":  # seen now and then, for a frame or two
        places[:, 0] = np.where((t % 10 < 2)[:, None], places[:, 0], np.nan)
    elif kind == "others are lost":
        places[100:, 1:9] = np.nan
    elif kind == "knocked":
        places[TOUCHED:] += [5.0, -3.0]
    elif kind == "one jump":
        places[TOUCHED : TOUCHED + 2, 0] += 4.0
    return places


def noticed(places: Floats, pieces: int) -> int | None:
    watch = MarkerTouch()
    host = np.arange(len(places), dtype=np.int64) * 10_000_000
    for part, when in zip(
        np.array_split(places, pieces), np.array_split(host, pieces), strict=True
    ):
        found = watch.add(part, when)
        if found is not None:
            return found // 10_000_000
    return None


@pytest.mark.parametrize("pieces", [1, 400])
@pytest.mark.parametrize(("kind", "within"), [("sticks", 12), ("leaves", 12), ("appears", 0)])
def test_a_touch_is_noticed_soon_and_never_before(kind: str, within: int, pieces: int) -> None:
    found = noticed(way(kind), pieces)
    assert found is not None
    assert TOUCHED <= found <= TOUCHED + within


@pytest.mark.parametrize(
    "kind", ["nothing", "drifts", "flickers", "others are lost", "knocked", "one jump"]
)
def test_what_is_no_touch_is_not_taken_for_one(kind: str) -> None:
    assert noticed(way(kind), 80) is None


@pytest.mark.parametrize("noise", [0.001, 0.02, 0.2])
def test_noise_alone_is_no_touch(noise: float) -> None:
    assert all(noticed(way("nothing", seed, noise), 1) is None for seed in range(20))


def test_a_rate_is_a_touch_only_above_its_noise() -> None:
    quiet = RateTouch(quiet=1000)  # 100 in 50 ms
    assert not any(quiet.touched(20) for _ in range(200))
    assert not any(quiet.touched(30) for _ in range(200))  # 150: five deviations
    assert any(quiet.touched(45) for _ in range(5))
    silent = RateTouch(quiet=0)
    assert not silent.touched(10)
    assert silent.touched(1)


def test_only_events_near_the_centre_count() -> None:
    x = np.array([320, 349, 350, 320, 100], np.uint16)
    y = np.array([240, 240, 240, 271, 100], np.uint16)
    chunk = EventChunk(x, y, np.ones(5, np.uint8), np.arange(5, dtype=np.int64))
    assert count_central(chunk, (640, 480), None) == 2
    assert count_central(chunk, (640, 480), (100.0, 100.0)) == 1
