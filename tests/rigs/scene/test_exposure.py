"""What an exposure sees is the mean over it: against integrals of known motions."""

import numpy as np
import pytest
from scipy.integrate import quad

from sliplab.rigs.scene.exposure import Exposures, expose, moved

PX_PER_MM = 20.0
EXPOSURE_NS = 2_000_000


def seen(x_mm, mid_ns: list[int], plate_mm=None) -> Exposures:  # type: ignore[no-untyped-def]
    """Two tips, of which the second stands; places given as functions of the time in ms."""

    def look(t_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ms = t_ns / 1e6
        places = np.zeros((len(ms), 2, 2))
        places[:, 0, 0] = x_mm(ms)
        places[:, 1] = 5.0
        return places, np.zeros(len(ms)) if plate_mm is None else plate_mm(ms)

    return expose(look, np.array(mid_ns, np.int64), EXPOSURE_NS, PX_PER_MM)


MOTIONS = {
    "slow slide": lambda ms: 1.6e-3 * ms,
    "fast slide": lambda ms: 0.7 * ms,
    "fall": lambda ms: 0.5 * 9.81e-3 * ms**2,
    "kink": lambda ms: 0.06 * np.maximum(ms - 9.4, 0.0),
    "late kink": lambda ms: 0.3 * np.maximum(ms - 10.93, 0.0),
    "small kink": lambda ms: 0.004 * np.maximum(ms - 9.7, 0.0),
    "there and back": lambda ms: 0.05 * np.abs(ms - 10.2),
    "standing": lambda ms: 0.0 * ms,
}


@pytest.mark.parametrize("name", MOTIONS)
def test_the_mean_is_the_mean_over_the_exposure(name: str) -> None:
    motion = MOTIONS[name]
    found = seen(motion, [10_000_000])
    corners = [9.4, 9.7, 10.2, 10.93]
    mean = quad(motion, 9.0, 11.0, points=corners, epsabs=1e-12)[0] / 2.0
    assert abs(found.tips_mm[0, 0, 0] - mean) * PX_PER_MM < 0.003
    assert found.tips_mm[0, 1].tolist() == [5.0, 5.0]


def test_only_what_moves_a_tenth_of_a_pixel_has_a_way() -> None:
    # at 1.6 mm/s 0.064 px in 2 ms; at 3 mm/s 0.12 px
    assert not seen(lambda ms: 1.6e-3 * ms, [10_000_000, 20_000_000]).ways
    found = seen(lambda ms: np.where(ms < 15, 0.0, 3e-3 * (ms - 15)), [10_000_000, 20_000_000])
    assert list(found.ways) == [1]
    assert len(found.ways[1].tips_mm) == 32
    path = PX_PER_MM * found.ways[1].tips_mm
    assert moved(path).tolist() == [True, False]


def test_a_falling_plate_alone_is_a_way_too() -> None:
    found = seen(MOTIONS["standing"], [10_000_000], lambda ms: -0.5 * ms)
    assert found.plate_mm[0] == pytest.approx(-5.0, abs=1e-9)
    # 20 px in steps of a quarter
    assert len(found.ways[0].plate_mm) == 80
    assert not moved(PX_PER_MM * found.ways[0].tips_mm).any()


def test_no_frames_are_no_exposures() -> None:
    found = seen(MOTIONS["fall"], [])
    assert found.tips_mm.shape == (0, 2, 2)
    assert not found.ways


@pytest.mark.parametrize("name", MOTIONS)
def test_exposures_seen_together_are_those_seen_one_by_one(name: str) -> None:
    mids = [5_000_000, 8_000_000, 10_000_000, 13_000_000, 40_000_000]
    together = seen(MOTIONS[name], mids, lambda ms: -0.01 * ms)
    for index, mid in enumerate(mids):
        alone = seen(MOTIONS[name], [mid], lambda ms: -0.01 * ms)
        assert np.array_equal(together.tips_mm[index], alone.tips_mm[0])
        assert together.plate_mm[index] == alone.plate_mm[0]
        assert (index in together.ways) == (0 in alone.ways)
        if index in together.ways:
            assert np.array_equal(together.ways[index].tips_mm, alone.ways[0].tips_mm)
