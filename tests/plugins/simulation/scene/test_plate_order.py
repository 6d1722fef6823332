"""The falling plate with all of level L3, against an event-located integration."""

import itertools
import math

import numpy as np
import pytest

from benchmarks import contact_error as rough
from sliplab.analysis.labels.change_point import change_point, departure
from sliplab.plugins.simulation.scene.springs import NORMAL_BRANCH, SLIPPED, Springs, Tips
from tests.plugins.simulation.scene.reference import Papilla
from tests.plugins.simulation.scene.steps import MU, fall, slid, times
from tests.plugins.simulation.scene.test_plate import SKIN, G, Hanging, pressed, springs_of

ALL = {"relaxation_share": 0.2, "static_excess": 0.03, "strengthening": 0.01}


class RichHanging(Hanging):
    """Rings of tips with large deflection, relaxation, static friction and friction by speed.

    The state is the plate's height and speed, then each ring's stretch and relaxing branch. A tip
    lets go where its force meets the static cone, then slides at the speed w for which spring,
    branch and damper together give mu N (1 + a ln(1 + w / w0)), and sticks where w falls to zero.
    """

    states = 8

    def __init__(self, springs: Springs, tips: Tips) -> None:
        super().__init__(springs)
        self.which = [int(np.flatnonzero(SKIN.ring == ring)[0]) for ring in (0, 1, 2)]
        self.law = springs.law
        knots = np.full((len(SKIN), 1), MU)
        self.tips = [Papilla(springs, i, knots, 0.0, 0.0) for i in self.which]
        self.branch = tips.state[self.which, NORMAL_BRANCH].copy()

    def column(self, t: float) -> np.ndarray:
        """Force along each unbent papilla, relaxation included; 0: clear of the plate, N."""
        tau, away = self.law.relaxation_s, max(t - self.ramp_s - self.still_s, 0.0)
        fed = self.law.maxwell * self.k_n * self.retract * tau * -math.expm1(-away / tau)
        deep = self.depth - self.retract * away - self.gap
        p = self.k_n * deep + self.branch * math.exp(-t / tau) - fed
        return np.where((deep > 0.0) & (p > 0.0), p, 0.0)

    def still(self, t: float, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Each ring's force if its tips do not slide; normal force; whether it touches."""
        p = self.column(t)
        found = [tip.spring(e, c)[:2] for tip, e, c in zip(self.tips, y[2:5], p, strict=True)]
        spring, normal = np.array(found).T
        return spring + y[5:] - self.k * self.damping_s * y[1], normal, p > 0.0

    def speed(self, ring: int, force: float, normal: float) -> float:
        """Speed at which a tip slides, mm/s."""
        a, weak, damp = self.law.strengthening, self.law.weak_mm_s, self.k[ring] * self.damping_s
        w = 0.0
        for _ in range(100):
            miss = force - damp * w - MU * normal * (1.0 + a * math.log1p(w / weak))
            change = miss / (damp + MU * normal * a / (weak + w))
            w = max(w + change, 0.0)
            if abs(change) <= 1e-14 * w or w == 0.0:
                break
        return w

    def part(self, t: float, y: np.ndarray, slips: np.ndarray):
        """Integrate until a ring lets go or sticks, or the plate lands."""

        def flow(t: float, y: np.ndarray) -> np.ndarray:
            force, normal, there = self.still(t, y)
            w = np.array(
                [
                    self.speed(ring, force[ring], normal[ring])
                    if slips[ring] and there[ring]
                    else 0.0
                    for ring in range(3)
                ]
            )
            pull = np.where(there, force - self.k * self.damping_s * w, 0.0)
            weight = self.mass * G * min(t / self.ramp_s, 1.0)
            rate = -y[1] - w
            branch = self.law.maxwell * self.k * rate - y[5:] / self.law.relaxation_s
            up = (float(self.counts @ pull) - weight) / self.mass * 1e3
            return np.array([y[1], up, *rate, *branch])

        def changes(ring: int):
            def ends(t: float, y: np.ndarray) -> float:
                force, normal, there = (found[ring] for found in self.still(t, y))
                if not there:
                    return -1.0
                if slips[ring]:
                    return float(MU * normal - force)
                return float(force - MU * normal * (1.0 + self.law.static_excess))

            ends.terminal, ends.direction = True, 1  # type: ignore[attr-defined]
            return ends

        kinds = [changes(ring) for ring in range(3)]
        return self.solve(flow, kinds, t, y, atol=1e-12, max_step=0.01)


def test_onsets_with_all_of_l3_are_of_second_order_in_the_step() -> None:
    springs = springs_of(3, **ALL)
    begin = pressed(springs, Hanging.depth)
    true = RichHanging(springs, begin)
    onsets, lands = true.onsets()
    misses, landings = [], []
    for h in (4e-3, 2e-3, 1e-3, 0.5e-3):
        tips, motion, steps = begin.copy(), np.zeros(2), round(2.0 / h)
        rows, t = times(steps, h), np.arange(1, steps + 1) * h
        depth = true.depth - true.retract * np.maximum(t - true.ramp_s - true.still_s, 0.0)
        weight = np.minimum(t / true.ramp_s, 1.0) * true.mass * G
        tips.state[:, SLIPPED] = np.nan
        track, done = fall(springs, tips, motion, depth, true.mass, weight=weight, h=h, t_ns=rows)
        first = [track[np.argmax(slid(track)[:, i] > 0.0), 57 + i] for i in true.which]
        misses.append(np.abs(np.array(first) - onsets))
        landings.append(abs(rows[done] * 1e-9 - lands))
    # 1 ms steps: onsets to 4 us; before steps ended where a tip lets go 9 us, and no order at all
    assert np.all(misses[2] < 4e-6)
    for coarse, fine in itertools.pairwise(misses):
        assert np.all(fine < coarse / 3)
    assert landings == [pytest.approx(0.0, abs=4e-6)] * 4


def narrowest_s() -> float:
    """Width of the interval of a change point that nothing blurs, from frames at 100 Hz."""
    since = np.arange(80) - 40.01
    away = np.maximum(since, 0.0)[:, None] * [12.0, 16.0]
    frame_ns, sigma = np.arange(80) * 10_000_000, np.full(80, 1e-4)
    left = departure(away, sigma, 10)
    assert left is not None
    found = change_point(frame_ns, away, sigma, left, 2_000_000)
    return (found.high_ns - found.low_ns) * 1e-9


@pytest.mark.long
def test_onsets_on_rough_friction_are_off_by_far_less_than_a_label_can_tell() -> None:
    # the draw of 20 with the largest error, which has no order in the step
    springs = rough.springs_of(rough.skin_of(18), 0.05, 0.5, 3, seed=20)
    off = np.abs(rough.fall(springs, 1.0)[0] - rough.fall(springs, rough.FINE_MS)[0])[:-1]
    assert off.max() < 12e-6
    assert np.median(off) < 0.5e-6
    # 95 % of what lies between two neighbours of a single node of the finest grid
    assert narrowest_s() > 0.105e-3
