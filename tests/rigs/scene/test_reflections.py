"""Reflections add light that stands still, by the trial's seed, and never more than they may."""

import numpy as np
import pytest

from sliplab.rigs.scene.frames import FrameOptics, PlateView
from sliplab.rigs.scene.reflections import Reflections, draw_reflections

NOTHING = np.empty((2, 0, 2))


def test_they_belong_to_the_trial_and_are_soft() -> None:
    some = Reflections(count=6, level=20.0)
    light = draw_reflections(some, 400, 300, 20.0, seed=5).astype(int)
    assert light.shape == (300, 400)
    assert 10 <= light.max() <= 20
    assert light.min() == 0
    # soft: a Gaussian of 7 px or more rises by at most 0.61 / 7 of its height a pixel, six overlap
    assert np.abs(np.diff(light, axis=0)).max() <= 6
    assert np.array_equal(light, draw_reflections(some, 400, 300, 20.0, seed=5))
    assert not np.array_equal(light, draw_reflections(some, 400, 300, 20.0, seed=6))


@pytest.mark.parametrize("reflections", [Reflections(), Reflections(count=3, level=0.0)])
def test_switched_off_they_change_nothing(reflections: Reflections) -> None:
    plain, with_none = (np.empty((2, 200, 200), np.uint8) for _ in range(2))
    tips = np.zeros((2, 1, 2))
    PlateView(FrameOptics(), 200, 200).draw(plain, tips, None, np.arange(2), 1)
    optics = FrameOptics(reflections=reflections)
    PlateView(optics, 200, 200).draw(with_none, tips, None, np.arange(2), 1)
    assert np.array_equal(plain, with_none)


def test_every_picture_of_a_trial_shows_the_same_ones_and_white_stays_white() -> None:
    optics = FrameOptics(reflections=Reflections(count=8, level=90.0), noise=0.0)
    images = np.empty((2, 300, 300), np.uint8)
    view = PlateView(optics, 300, 300)
    view.draw(images, NOTHING, None, np.arange(2), 1)
    assert np.array_equal(images[0], images[1])
    assert images.max() > 25 + 40
    view.draw(images, np.zeros((2, 1, 2)), None, np.arange(2), 1)
    assert images.max() <= 255
    assert images[0, 150, 150] >= 200
