"""What a pilot asks for: the score against closed forms, and verdicts on drawn numbers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from sliplab.plugins.simulation.settings import MockEventCameraSettings, MockSettings, SceneSettings
from sliplab.plugins.twin.effects import EFFECTS, effects_of, lacking, merged
from sliplab.plugins.twin.needs.judging import NEGLIGIBLE, Marked, crps, marked, marks, need
from sliplab.storage.streams import F64
from tests.plugins.twin.test_shown import drawn, events

TRIALS, WORLDS = 6, 8


def world(rng: np.random.Generator, shift: float = 0.0, count: int = WORLDS) -> F64:
    """Two groups of numbers; an effect shifts the first one's, which scatter by 1."""
    found = rng.standard_normal((count, TRIALS, 3))
    return found + np.array([shift, 0.0, 0.0])


def of(values: F64) -> Marked:
    return Marked(values, ("slips", "motion", "motion"))


def test_the_score_of_a_normal_ensemble_is_its_closed_form() -> None:
    # Gneiting and Raftery 2007, equation 21
    rng = np.random.default_rng(1)
    for y in (0.0, 0.7, -2.5):
        exact = y * (2 * norm.cdf(y) - 1) + 2 * norm.pdf(y) - 1 / np.sqrt(np.pi)
        many = crps(rng.standard_normal((200_000, 1)), np.array([y]))
        assert many[0] == pytest.approx(exact, abs=0.01)
        few = crps(rng.standard_normal((4, 200_000)), np.full(200_000, y))
        assert few.mean() == pytest.approx(exact, abs=0.01)  # without bias


def test_the_score_of_two_members_by_hand() -> None:
    assert crps(np.array([0.0, 3.0]), np.array(1.0)) == pytest.approx(1.5 - 1.5)
    assert crps(np.array([2.0, 2.0]), np.array(5.0)) == pytest.approx(3.0)


def test_an_effect_that_is_there_is_asked_for_and_named_by_its_group() -> None:
    rng = np.random.default_rng(2)
    having = world(rng)
    without = having + np.array([5.0, 0.0, 0.0])
    found = need(of(world(rng, count=1)), of(having), of(without))
    assert found.verdict == "asked for"
    assert found.shown_by == "slips"
    assert found.limit == NEGLIGIBLE < found.low < found.loss < found.high
    # a normal forecast that is 5 off has a score of 5 - 1 / sqrt(pi), the right one 1 / sqrt(pi)
    assert found.loss == pytest.approx(5.0 - 2.0 / np.sqrt(np.pi), abs=0.8)


def test_an_effect_that_is_not_there_is_not_asked_for() -> None:
    rng = np.random.default_rng(3)
    having = world(rng, 3.0)
    found = need(of(world(rng, count=1)), of(having), of(having - [3.0, 0.0, 0.0]))
    assert found.verdict == "not asked for"
    assert found.high < 0.0


def test_an_effect_without_consequence_is_not_shown() -> None:
    rng = np.random.default_rng(4)
    having = world(rng)
    found = need(of(world(rng, count=1)), of(having), of(having.copy()))
    assert found.loss == found.low == found.high == 0.0
    assert found.verdict == "not shown"
    # nor is one whose trace is a hundredth of the scatter, even if the twin is biased in its favour
    pilot = world(rng, 0.5, count=1)
    found = need(of(pilot), of(having), of(having - [0.01, 0.0, 0.0]))
    assert found.verdict == "not shown"


@pytest.mark.long
def test_false_calls_of_effects_that_are_not_there() -> None:
    # slight effects are the hard ones: strong ones are far off
    rng = np.random.default_rng(5)
    for shift in (0.1, 0.5, 2.0):
        calls = 0
        for _ in range(200):
            having = world(rng, shift)
            without = having - [shift, 0.0, 0.0]
            calls += need(of(world(rng, count=1)), of(having), of(without)).verdict == "asked for"
        assert calls <= 15, shift  # of 200: 10 expected, 15 in 95 of 100 cases


def test_too_few_trials_or_worlds_are_an_error() -> None:
    few = of(np.zeros((8, 2, 3)))
    with pytest.raises(ValueError, match="2 trials in 8 worlds are too few"):
        need(of(np.zeros((1, 2, 3))), few, few)


def test_marks_of_a_trial() -> None:
    seen = events(
        [-900_000, -900_000, 100_000, 100_000, 100_400],
        [5, 9, 300, 301, 300],
        [5] * 5,
        [1, 0, 1, 1, 1],
    )
    found = marks(drawn(1.0, seen))
    assert found["slips"] == pytest.approx([2.1, 1.1, 4.0])  # the third never did: the end
    assert found["events over time"][0] == pytest.approx(np.log(4.0))
    assert found["events at rest"] == pytest.approx([np.log(2.0), np.log(2.0), 1.0])
    assert found["times of events"] == pytest.approx([0.5, np.log(2.0)])
    assert found["places of events"].shape == (25,)
    assert found["forces"] == pytest.approx([2.5, 2.5, 2.5, 3.0])
    some = marked([[marks(drawn(1.0, seen))] * 2] * 3, {"slips", "forces"})
    assert some.groups == ("slips",) * 3 + ("forces",) * 4
    assert some.values.shape == (3, 2, 7)
    assert "times of events" not in marks(drawn(1.0))


def test_effects_that_a_scene_lacks_are_not_left_out_again() -> None:
    own = MockSettings()
    there = {effect.key for effect in effects_of(own)}
    assert {"steps", "relaxation", "vibration", "noise", "readout", "bending"} < there
    assert {"bandwidth", "negative", "falling"} == {effect.key for effect in lacking(own)}
    assert len(there) + 3 == len(EFFECTS) + 1
    other = MockSettings(
        scene=SceneSettings(step_ms=16),
        event_camera=MockEventCameraSettings(cutoff_hz=300.0, noise_hz=0.0),
    )
    there = {effect.key for effect in effects_of(other)}
    assert "bandwidth" in there
    assert not {"steps", "noise"} & there


def test_settings_are_merged_key_by_key() -> None:
    one, two = {"scene": {"skin": {"seed": 1}, "step_ms": 2}}, {"scene": {"skin": {"radius_mm": 2}}}
    assert merged(one, two) == {"scene": {"skin": {"seed": 1, "radius_mm": 2}, "step_ms": 2}}
    assert merged() == {}
    assert one == {"scene": {"skin": {"seed": 1}, "step_ms": 2}}
