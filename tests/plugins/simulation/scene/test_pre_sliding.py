"""Creep below the limit, stick-slip and curved plates, against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.one_slide import SlideRun, run_slide
from sliplab.plugins.simulation.scene.springs import SHORTER, Springs
from tests.plugins.simulation.scene.steps import (
    MU,
    RICH,
    at,
    fall,
    ideal_skin,
    places,
    pressed,
    run,
    springs_of,
)

DEPTH_MM, V = 1.2, 1.0
CREEP_MM_S, SHARE = 0.3, 0.05
EXCESS, STRENGTHENING, WEAK, LEAST = 0.1, 0.01, 0.1, 2.0


def linear(**options: float) -> Springs:
    """Springs whose stiffness does not change with their bend."""
    springs = springs_of(ideal_skin(), 3, **options)
    table = springs.table.copy()
    table[:, SHORTER] = 0.0
    return replace(springs, table=table)


def creeping(t_s: np.ndarray, stiffness: float, limit_n: float) -> np.ndarray:
    """Force of a tip that creeps while its base moves at V, N: the integral of a logistic speed."""
    a, b = (stiffness * speed / (SHARE * limit_n) for speed in (V, CREEP_MM_S))
    y = np.exp(1 / SHARE - a * t_s) + b / a * (1 - np.exp(-a * t_s))
    return limit_n * (1 - SHARE * np.log(y))


@pytest.mark.parametrize("step_mm", [0.032, 0.002])
def test_a_tip_creeps_as_the_closed_form_says_at_any_step(step_mm: float) -> None:
    springs = linear(creep_mm_s=CREEP_MM_S, creep_share=SHARE)
    found = run_slide(springs, DEPTH_MM, V, length_mm=4.0, step_mm=step_mm)
    limit_n = MU * found.loads[0, 2]
    force = creeping(found.t_ns * 1e-9, springs.tangential[0], limit_n)
    assert found.loads[:, 0] == pytest.approx(np.minimum(force, limit_n), abs=1e-14)
    t_s = np.linspace(2.0, 3.5, 100_000)
    onset_s = t_s[np.argmax(creeping(t_s, springs.tangential[0], limit_n) >= limit_n)]
    assert found.slipped_s[0] == pytest.approx(onset_s, abs=5e-4)


def test_a_tip_that_creeps_faster_than_its_base_never_lets_go() -> None:
    springs = linear(creep_mm_s=2.0 * V, creep_share=SHARE)
    found = run_slide(springs, DEPTH_MM, V, length_mm=6.0, step_mm=0.016)
    assert np.isnan(found.slipped_s[0])
    # steady: the speed of creep is that of the base
    steady_n = MU * found.loads[0, 2] * (1 - SHARE * math.log(2.0))
    assert found.loads[-1, 0] == pytest.approx(steady_n, rel=1e-9)


def test_onsets_under_creep_are_of_second_order_in_the_step_with_the_whole_law() -> None:
    springs = springs_of(ideal_skin(), 3, creep_mm_s=CREEP_MM_S, **RICH)

    def onsets(step_mm: float) -> np.ndarray:
        return run_slide(springs, 2.8, V, length_mm=2.4, step_mm=step_mm).slipped_s

    fine = onsets(0.00025)
    off = [np.nanmax(np.abs(onsets(step_mm) - fine)) for step_mm in (0.016, 0.008, 0.004, 0.002)]
    assert np.all(np.log2(np.array(off[:-1]) / off[1:]) > 1.5)
    assert off[-1] < 1e-5  # s


def test_creep_without_force_is_none_and_a_held_plate_sinks_slowly() -> None:
    springs = springs_of(ideal_skin(), 3, creep_mm_s=CREEP_MM_S, creep_share=SHARE, damping_s=0.01)
    tips = pressed(springs)
    track, _ = run(springs, tips.copy(), at(0, 0, 2.8, 500))
    assert places(track)[-1] == pytest.approx(places(track)[0], abs=1e-6)
    hung, _ = fall(springs, tips, np.zeros(2), np.full(2000, 2.8), 0.05)
    steps = np.diff(hung[1000:, -1])
    assert np.all(steps <= 0.0)
    assert -0.05 < hung[-1, -1] - hung[1000, -1] < 0.0


def period(step_mm: float) -> tuple[SlideRun, Springs, np.ndarray]:
    """A slide with stick-slip, and when the centre lets go, s."""
    springs = linear(
        static_excess=EXCESS, strengthening=STRENGTHENING, weak_mm_s=WEAK, least_mm_s=LEAST
    )
    found = run_slide(springs, DEPTH_MM, V, length_mm=6.0, step_mm=step_mm)
    slips = found.track[:, 3 * len(springs.table)] - found.began_s
    return found, springs, np.unique(slips[slips > 0.0])


def test_stick_slip_has_the_period_of_a_block_on_a_spring() -> None:
    errors = []
    for step_mm in (0.004, 0.001, 0.00025):
        found, springs, slips = period(step_mm)
        kinetic_n, k = MU * found.loads[0, 2], springs.tangential[0]
        least, most = math.log(1 + LEAST / WEAK), EXCESS / STRENGTHENING

        def slides(x: float) -> float:
            # of dx / (WEAK e^x - V - WEAK), x = ln(1 + speed / WEAK)
            return (math.log(WEAK * math.exp(x) - V - WEAK) - x) / (V + WEAK)

        sticks_s = kinetic_n * (EXCESS - STRENGTHENING * least) / (k * V)
        slides_s = STRENGTHENING * kinetic_n / k * (slides(most) - slides(least))
        assert len(slips) > 10
        errors.append(abs(np.diff(slips).mean() / (sticks_s + slides_s) - 1.0))
    # of first order: the tip sticks from the end of the step on
    assert errors[0] < 0.03
    assert errors[1] < 0.004
    assert errors[2] < 0.002


def test_a_tip_that_is_driven_faster_than_the_least_speed_slides_steadily() -> None:
    springs = linear(
        static_excess=EXCESS, strengthening=STRENGTHENING, weak_mm_s=WEAK, least_mm_s=0.5 * V
    )
    found = run_slide(springs, DEPTH_MM, V, length_mm=6.0, step_mm=0.004)
    steady_n = MU * found.loads[0, 2] * (1 + STRENGTHENING * math.log(1 + V / WEAK))
    assert found.loads[-500:, 0] == pytest.approx(steady_n, rel=1e-6)


def test_a_curved_plate_presses_each_tip_by_its_place() -> None:
    flat, curved = linear(), linear(curvature=1 / 500)
    (_, even), (_, load) = (run(it, pressed(it), at(2.0, 1.0, 2.8)) for it in (flat, curved))
    away = flat.layout + np.array([2.0, 1.0])
    sag_mm = 0.5 * (away**2).sum(axis=1) / 500
    assert even[0, :, 2] - load[0, :, 2] == pytest.approx(flat.normal * sag_mm, rel=1e-9)
