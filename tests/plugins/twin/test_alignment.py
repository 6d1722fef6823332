"""Places, times and trends that are wrong: named by the checks, on drawn slides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sliplab.plugins.twin.alignment import (
    event_delay_ms,
    force_delay_ms,
    force_turn_deg,
    frame_delay_ms,
    view_of,
)
from sliplab.plugins.twin.camera_estimates import (
    CONTRAST_TREND,
    NOISE_TREND,
    PICTURE_TURN,
    read_camera,
)
from sliplab.plugins.twin.contact_estimates import read_contact
from sliplab.plugins.twin.contact_slips import find_slips
from sliplab.plugins.twin.document import MisfitCheck
from sliplab.plugins.twin.misfits import misfits
from sliplab.plugins.twin.pilot import Forces, PilotTrial, SlideEvents
from sliplab.plugins.twin.trends import LAG, PULL, RATIO, contact_trends, plain_trend, trend
from sliplab.storage.streams import F64, EventChunk
from tests.plugins.twin.test_camera_estimates import pilot as seen_by_events
from tests.plugins.twin.test_misfits import WAYS, numbers
from tests.plugins.twin.test_misfits import pilot as whole_pilot

Trials = Sequence[PilotTrial]
STIFFNESS_N_PER_MM = 0.05


@cache
def drawn(
    worn: float = 0.0, deeper_mm: float = 0.0, friction: float = 1.0, seed: int = 0
) -> tuple[PilotTrial, ...]:
    """Slides in two directions at right angles, twelve of them."""
    change = {"raised_mm": np.full(19, deeper_mm), "friction": np.full(19, friction)}
    return tuple(whole_pilot(worn=worn, seed=seed, ways=WAYS[:2], **change))


def moved(trials: Trials, shown: Callable[[F64], F64]) -> list[PilotTrial]:
    """Slides whose markers a camera shows in other places."""
    return [replace(trial, tips_mm=shown(trial.tips_mm)) for trial in trials]


def turned(deg: float) -> Callable[[F64], F64]:
    cos, sin = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return lambda tips: tips @ np.array([[cos, sin], [-sin, cos]])


def bent(share: float) -> Callable[[F64], F64]:
    """A lens that moves what is 15 mm from the middle by a share of that."""
    return lambda tips: tips * (1.0 + share * (tips**2).sum(axis=-1, keepdims=True) / 15.0**2)


def late(trials: Trials, seconds: float) -> list[PilotTrial]:
    """Slides whose frames are stamped late."""
    found = []
    for trial in trials:
        stamps = trial.frame_s + seconds
        base = [np.interp(stamps, trial.frame_s, column) for column in trial.base_mm.T]
        found.append(replace(trial, frame_s=stamps, base_mm=np.column_stack(base)))
    return found


def pulled(
    trials: Trials, *, late_s: float = 0.0, turn_deg: float = 0.0, weaker: float = 0.0
) -> list[PilotTrial]:
    """Slides with the forces of equal springs.

    Args:
        weaker: share of the stiffness that is lost from the first slide to the last.
    """
    rng = np.random.default_rng(1)
    found = []
    for number, trial in enumerate(trials):
        t_s = np.arange(-1.0, trial.slide_s, 2e-3)
        rest = trial.tips_mm[trial.frame_s < 0.0].mean(axis=0)
        along = (trial.tips_mm - rest).mean(axis=1) @ trial.slide.direction
        lag = trial.base_mm @ trial.slide.direction - along
        pull = STIFFNESS_N_PER_MM * 19 * np.interp(t_s - late_s, trial.frame_s, lag)
        pull *= 1.0 - weaker * number / (len(trials) - 1)
        force = np.zeros((len(t_s), 3))
        force[:, :2] = turned(turn_deg)(pull[:, None] * trial.slide.direction)
        force[:, 2] = 2.0 * trial.slide.depth_mm
        force += rng.normal(0.0, 0.005, force.shape)
        found.append(replace(trial, forces=Forces(t_s, force)))
    return found


@pytest.fixture(scope="module")
def worlds() -> list[dict[str, float]]:
    return [numbers(pulled(drawn(seed=seed))) for seed in range(1, 21)]


@pytest.fixture(scope="module")
def clean() -> list[PilotTrial]:
    return pulled(drawn())


def called(trials: Trials, worlds: list[dict[str, float]]) -> list[MisfitCheck]:
    found = misfits(numbers(trials), worlds, (), np.empty(0), np.empty((len(worlds), 0)))
    return [check for check in found if check.found]


@pytest.mark.long
def test_a_clean_pilot_has_no_misfit(clean: Trials, worlds: list[dict[str, float]]) -> None:
    assert called(clean, worlds) == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("shown", "title"),
    [
        (turned(6.0), "frame camera turned against the arm's axes"),
        (lambda tips: 1.05 * tips, "scale of the frames unlike the arm's"),
        (lambda tips: tips * [1.03, 1.0], "scale of the frames unlike in two directions"),
        (bent(-0.03), "frames distorted by a lens"),
        (
            lambda tips: tips * (1.0 + 3e-3 * tips[..., [0]]),
            "frame camera tilted against the plate",
        ),
    ],
)
def test_a_camera_that_is_not_aligned_is_named(
    shown: Callable[[F64], F64], title: str, clean: Trials, worlds: list[dict[str, float]]
) -> None:
    found = called(moved(clean, shown), worlds)
    assert title in [check.title for check in found]
    assert all(check.stream == "frames" for check in found if check.title == title)
    assert "scene.friction.kinetic" in found[0].touches
    assert "event_camera.px_per_mm" in found[0].touches
    assert found[0].stream == "frames"


def test_sizes_of_a_camera_that_is_not_aligned() -> None:
    def seen(shown: Callable[[F64], F64]) -> dict[str, float]:
        slips = find_slips(moved(drawn(), shown))
        assert slips is not None
        return vars(view_of(slips))

    assert seen(turned(6.0))["turn_deg"] == pytest.approx(6.0, abs=0.1)
    assert seen(lambda tips: 1.05 * tips)["scale"] == pytest.approx(0.05, abs=0.005)
    assert seen(lambda tips: tips * [1.02, 1.0])["stretch"] == pytest.approx(0.02, abs=0.003)
    found = seen(bent(-0.03))["distortion"]
    assert -0.03 < found < -0.01  # the outermost marker is nearer than 15 mm
    assert seen(bent(0.015))["distortion"] == pytest.approx(-found / 2.0, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("seconds", [0.03, -0.03])
def test_late_frames_are_named(
    seconds: float, clean: Trials, worlds: list[dict[str, float]]
) -> None:
    found = called(late(clean, seconds), worlds)
    assert "frames late or early against the arm's poses" in [check.title for check in found]


def test_delays_have_their_size() -> None:
    def frames(trials: Trials) -> float:
        contact = read_contact(trials)
        assert contact is not None
        return frame_delay_ms(contact.slips, contact.steady)

    assert frames(late(drawn(), 0.02)) - frames(drawn()) == pytest.approx(20.0, abs=3.0)

    def forces(trials: Trials) -> float:
        contact = read_contact(trials)
        assert contact is not None
        return force_delay_ms(contact.slips, contact.growth)

    base = forces(pulled(drawn()))
    assert forces(pulled(drawn(), late_s=0.015)) - base == pytest.approx(15.0, abs=1.5)
    assert np.isnan(forces(drawn()))


@pytest.mark.long
def test_late_and_turned_forces_are_named(worlds: list[dict[str, float]]) -> None:
    (first, *_) = called(pulled(drawn(), late_s=0.02), worlds)
    assert first.title == "forces late or early against the arm's poses"
    (first, *_) = called(pulled(drawn(), turn_deg=8.0), worlds)
    assert first.title == "force sensor turned against the arm's axes"
    slips = find_slips(pulled(drawn(), turn_deg=8.0))
    assert slips is not None
    assert force_turn_deg(slips) == pytest.approx(8.0, abs=0.2)


@pytest.mark.quick(1)
@pytest.mark.parametrize("worn", [0.2, -0.1])
def test_friction_that_drifts_shows_in_lags(worn: float, clean: Trials) -> None:
    contact, plain = read_contact(drawn(worn=worn)), read_contact(clean)
    assert contact is not None
    assert plain is not None
    assert contact_trends(contact.slips, contact.steady)[LAG] > 3.0
    assert contact_trends(plain.slips, plain.steady)[LAG] < 2.0


@pytest.mark.quick(1)
@pytest.mark.parametrize(("weaker", "most"), [(0.0, 3.0), (0.2, np.inf), (-0.1, np.inf)])
def test_stiffness_that_drifts_shows_in_forces_over_lags(weaker: float, most: float) -> None:
    contact = read_contact(pulled(drawn(friction=0.7), weaker=weaker))
    assert contact is not None
    found = contact_trends(contact.slips, contact.steady)
    assert found[LAG] < 3.0
    assert (2.0 if weaker else -1.0) <= found[PULL] < most


def test_an_error_of_depth_zero_is_no_trend() -> None:
    """Slides after another measurement of depth zero are compared with each other alone."""
    first = drawn()
    deeper = drawn(deeper_mm=0.3)
    both = [*first[::2], *(replace(trial, zero_mm=0.1) for trial in deeper[1::2])]

    def lag_trend(trials: Trials) -> float:
        contact = read_contact(trials)
        assert contact is not None
        return contact_trends(contact.slips, contact.steady)[LAG]

    one_zero = [replace(trial, zero_mm=0.0) for trial in both]
    assert lag_trend(both) < 2.8 < 3.2 < lag_trend(one_zero)


def test_a_trend_needs_eight_values_and_ignores_what_they_depend_on() -> None:
    order, none = np.linspace(0.0, 1.0, 20), np.empty((20, 0))
    noise = np.random.default_rng(3).normal(0.0, 0.01, 20)
    assert trend(noise, order, none) < 3.0
    assert trend(noise - 0.1 * order, order, none) > 5.0
    other = np.tile([0.0, 1.0], 10)[:, None]
    assert trend(noise + 5.0 * other[:, 0] - 0.1 * order, order, other) > 5.0
    assert np.isnan(trend(noise[:7], order[:7], none[:7]))
    assert np.isnan(plain_trend([np.nan] * 20))
    assert np.isnan(list(contact_trends(*no_forces()).values())[1:]).all()
    assert set(contact_trends(*no_forces())) == {LAG, PULL, RATIO}


def no_forces():  # type: ignore[no-untyped-def]
    contact = read_contact(drawn())
    assert contact is not None
    return contact.slips, contact.steady


# -- events ------------------------------------------------------------------------------------


def rolled(trials: Trials, deg: float) -> list[PilotTrial]:
    """Slides whose event camera is turned: here, whose arm goes another way."""
    turn = turned(deg)
    return [
        replace(it, slide=replace(it.slide, direction=turn(it.slide.direction))) for it in trials
    ]


@pytest.mark.long
def test_a_turned_event_picture_has_its_size() -> None:
    _, plain = read_camera(seen_by_events())
    assert plain[PICTURE_TURN] == pytest.approx(0.0, abs=0.2)
    _, found = read_camera(rolled(seen_by_events(), -5.0))
    assert found[PICTURE_TURN] == pytest.approx(5.0, abs=0.2)


@pytest.mark.long
def test_noise_and_contrast_that_drift_show() -> None:
    _, plain = read_camera(seen_by_events())
    assert plain[NOISE_TREND] < 3.0
    assert plain[CONTRAST_TREND] < 3.0
    fading = []
    for number, trial in enumerate(seen_by_events()):
        assert trial.camera is not None
        events = trial.camera.events
        kept = np.random.default_rng(number).random(len(events)) > 0.04 * number
        columns = (column[kept] for column in (events.x, events.y, events.p, events.t_us))
        fading.append(replace(trial, camera=replace(trial.camera, events=EventChunk(*columns))))
    _, found = read_camera(fading)
    assert found[NOISE_TREND] > 4.0
    assert found[CONTRAST_TREND] > 4.0


@pytest.mark.parametrize("seconds", [0.0, 0.015, -0.01])
def test_frames_that_are_late_against_events_have_their_delay(seconds: float) -> None:
    """Markers fire evenly until their tips slip."""
    trials = drawn()
    slips = find_slips(trials)
    assert slips is not None
    places = trials[0].tips_mm[0]
    rests = np.full((19, 8), np.nan)
    rests[:, 0], rests[:, 1], rests[:, 2] = 200 + 10 * places[:, 0], 200 - 10 * places[:, 1], 12.0
    made = []
    for i, trial in enumerate(trials):
        rng = np.random.default_rng(i)
        parts = []
        for j, until in enumerate(slips.slipped_s[i]):
            t = np.sort(rng.uniform(0.0, until, rng.poisson(400 * until)))
            parts.append((t, np.full(len(t), rests[j, 0]), np.full(len(t), rests[j, 1])))
        t, x, y = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(t)
        events = EventChunk(
            x[order].astype(np.uint16),
            y[order].astype(np.uint16),
            np.ones(len(t), np.int8),
            np.round(1e6 * t[order]).astype(np.int64),
        )
        made.append(replace(trial, camera=SlideEvents(events, (400, 400))))
    found = event_delay_ms(late(made, seconds), rests)
    assert found == pytest.approx(-1e3 * seconds, abs=2.0)
    assert np.isnan(event_delay_ms(drawn(), rests))
