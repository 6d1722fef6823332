"""One papilla in continuous time, by an adaptive integrator with located events.

Shares nothing with the contact solver but the constants of a papilla. A tip that sticks has no
speed; it lets go where its force meets the static cone. A tip that slides moves along its force
at the speed w for which |f| = mu N (1 + strengthening ln(1 + w / weak)), and sticks where w falls
to zero. Without strengthening w is what keeps |f| = mu N.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from sliplab.plugins.simulation.scene.friction import KNOT_MM
from sliplab.plugins.simulation.scene.springs import NORMAL_BRANCH, Springs, Tips
from tests.patching import put

RTOL, ATOL = 1e-11, 1e-13


class Leg(NamedTuple):
    """A smooth part of the way of the base: seconds, and place and velocity over time."""

    begin_s: float
    end_s: float
    place: Callable[[float], np.ndarray]
    speed: Callable[[float], np.ndarray]


def straight_legs(corners: Sequence[tuple[float, float]], speed_mm_s: float) -> list[Leg]:
    """Legs at one speed from corner to corner."""
    legs, begin = [], 0.0
    for a, b in itertools.pairwise(corners):
        start, way = np.array(a, float), np.array(b, float) - np.array(a, float)
        end = begin + float(np.hypot(*way)) / speed_mm_s
        v = way / (end - begin)
        legs.append(
            Leg(begin, end, lambda t, p=start, v=v, t0=begin: p + v * (t - t0), lambda t, v=v: v)
        )
        begin = end
    return legs


@dataclass
class Papilla:
    """The constants of one tip, and its law."""

    springs: Springs
    i: int
    knots: np.ndarray
    deep: float
    """Indentation, mm."""
    branch: float
    """Force in the relaxing branch along the papilla when the way begins, N."""
    grip: Callable[[float], tuple[float, float]] = field(init=False)

    def __post_init__(self) -> None:
        row = self.springs.table[self.i]
        _, _, _, self.k_n, self.k_b, self.soft, self.k_t, self.shorter = (float(v) for v in row)
        knots = self.knots[self.i]
        if len(knots) == 1:
            self.grip = lambda path: (float(knots[0]), 0.0)
            return
        slopes = (np.roll(knots, -1) - np.roll(knots, 1)) / (2 * KNOT_MM)
        cubic = CubicHermiteSpline(
            np.arange(len(knots) + 1) * KNOT_MM,
            np.append(knots, knots[0]),
            np.append(slopes, slopes[0]),
        )
        slope, period = cubic.derivative(), len(knots) * KNOT_MM
        self.grip = lambda path: (float(cubic(path % period)), float(slope(path % period)))

    def pressed(self, t: float) -> tuple[float, float]:
        """Force along the unbent papilla, N, and its rate."""
        law = self.springs.law
        q = self.branch * math.exp(-t / law.relaxation_s)
        return self.k_n * self.deep + q, -q / law.relaxation_s

    def spring(self, stretch: float, p: float) -> tuple[float, float, float, float, float, float]:
        """T, N, and their slopes over stretch and over p."""
        b = stretch / (1 + self.soft * self.k_b)
        for _ in range(60):
            normal = p - self.k_n * self.shorter * b * b
            t = b * (self.k_b - 2 * self.shorter * normal)
            t_b = self.k_b - 2 * self.shorter * normal + 4 * self.shorter**2 * self.k_n * b * b
            change = (b + self.soft * t - stretch) / (1 + self.soft * t_b)
            b -= change
            if abs(change) <= 1e-15 * abs(b):
                break
        b_e = 1 / (1 + self.soft * t_b)
        t_p = -2 * self.shorter * b
        b_p = -self.soft * t_p * b_e
        bend = -2 * self.k_n * self.shorter * b
        return t, normal, t_b * b_e, bend * b_e, t_p + t_b * b_p, 1 + bend * b_p


@dataclass
class Answer:
    """Forces (k, 2), places (k, 2), ways (k,) at the times asked for, and when the tip let go."""

    force: np.ndarray
    place: np.ndarray
    path: np.ndarray
    slips: list[float]


class _Law:
    """Rates of the state e (2), q (2), way."""

    def __init__(self, tip: Papilla) -> None:
        self.tip, self.law = tip, tip.springs.law
        self.m = self.law.maxwell * tip.k_t
        self.rich = self.law.strengthening > 0.0

    def force(self, t: float, y: np.ndarray) -> tuple[np.ndarray, float]:
        """Tangential and normal force, N."""
        stretch = math.hypot(y[0], y[1])
        spring, normal, t_e, *_ = self.tip.spring(stretch, self.tip.pressed(t)[0])
        return (spring / stretch if stretch > 0 else t_e) * y[:2] + y[2:4], normal

    def speed(self, t: float, y: np.ndarray, v: np.ndarray) -> tuple[float, np.ndarray]:
        """Speed of sliding, mm/s, and its direction."""
        f, normal = self.force(t, y)
        size = math.hypot(f[0], f[1])
        along = f / size
        mu, mu_slope = self.tip.grip(y[4])
        if self.rich:
            over = (size / (mu * normal) - 1) / self.law.strengthening
            return self.law.weak_mm_s * math.expm1(min(over, 60.0)), along
        p, p_rate = self.tip.pressed(t)
        stretch = math.hypot(y[0], y[1])
        spring, _, t_e, n_e, t_p, n_p = self.tip.spring(stretch, p)
        unit, secant = y[:2] / stretch, spring / stretch

        def rate(de: np.ndarray) -> float:
            """Rate of |f| - mu N, the friction's own change along the way left out."""
            radial = float(unit @ de)
            df = secant * (de - radial * unit) + (t_e * radial + t_p * p_rate) * unit
            df = df + self.m * de - y[2:4] / self.law.relaxation_s
            return float(along @ df) - mu * (n_e * radial + n_p * p_rate)

        still = rate(v)
        return still / (still - rate(v - along) + mu_slope * normal), along

    def excess(self, t: float, y: np.ndarray, times: float) -> float:
        """Force beyond a multiple of friction at rest, N."""
        f, normal = self.force(t, y)
        return math.hypot(f[0], f[1]) - times * self.tip.grip(y[4])[0] * normal

    def part(self, leg: Leg, t: float, y: np.ndarray, sliding: bool):
        """Integrate until the leg ends or the tip changes between sticking and sliding."""

        def flow(t: float, y: np.ndarray) -> np.ndarray:
            v = leg.speed(t)
            w, along = self.speed(t, y, v) if sliding else (0.0, np.zeros(2))
            de = v - w * along
            return np.concatenate([de, self.m * de - y[2:4] / self.law.relaxation_s, [w]])

        def ends(t: float, y: np.ndarray) -> float:
            if not sliding:
                return self.excess(t, y, 1 + self.law.static_excess)
            return -self.excess(t, y, 1.0) if self.rich else -self.speed(t, y, leg.speed(t))[0]

        ends.terminal, ends.direction = True, 1  # type: ignore[attr-defined]
        return solve_ivp(
            flow,
            (t, leg.end_s),
            y,
            method="DOP853",
            rtol=RTOL,
            atol=ATOL,
            events=ends,
            dense_output=True,
            max_step=0.05,
        )

    def drop(self, t: float, y: np.ndarray) -> np.ndarray:
        """Slip in no time from the static cone onto the kinetic one."""

        def flow(_: float, y: np.ndarray) -> np.ndarray:
            f, _ = self.force(t, y)
            along = f / math.hypot(f[0], f[1])
            return np.concatenate([-along, -self.m * along, [1.0]])

        def ends(_: float, y: np.ndarray) -> float:
            return self.excess(t, y, 1.0)

        put(ends, "terminal", True)
        found = solve_ivp(flow, (0, 5), y, method="DOP853", rtol=RTOL, atol=ATOL, events=ends)
        return found.y[:, -1]


def follow(tip: Papilla, legs: Sequence[Leg], at_s: np.ndarray) -> Answer:
    """The tip from rest under its base, along the legs."""
    law = _Law(tip)
    state, sliding, slips = np.zeros(5), False, []
    out = np.empty((len(at_s), 5))
    for leg in legs:
        t = leg.begin_s
        if sliding and not law.rich and law.speed(t, state, leg.speed(t))[0] < -1e-9:
            sliding = False
        while t < leg.end_s:
            found = law.part(leg, t, state, sliding)
            asked = (at_s > t) & (at_s <= min(leg.end_s, found.t[-1]))
            for k in np.flatnonzero(asked):
                y = found.sol(at_s[k])
                force, _ = law.force(at_s[k], y)
                out[k] = np.concatenate([force, leg.place(at_s[k]) - y[:2], y[4:]])
            t, state = float(found.t[-1]), found.y[:, -1]
            if found.status == 1:
                sliding = not sliding
            if found.status == 1 and sliding:
                slips.append(t)
                if not law.rich and law.law.static_excess > 0.0:
                    state = law.drop(t, state)
    return Answer(out[:, :2], out[:, 2:4], out[:, 4], slips)


def papilla(springs: Springs, tips: Tips, knots: np.ndarray, i: int, depth: float) -> Papilla:
    """Tip `i` of tips that were pressed straight in."""
    deep = depth - float(springs.gap[i])
    return Papilla(springs, i, knots, deep, float(tips.state[i, NORMAL_BRANCH]))


def rows_of(
    legs: Sequence[Leg], depth: float, h: float, parts: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Times (s) and sensor (x, y, depth) at the ends of steps.

    Args:
        h: about as long is a step of which each is cut into `parts`; legs hold whole steps.
    """
    times, sensor = [], []
    for leg in legs:
        count = max(round((leg.end_s - leg.begin_s) / h), 1) * parts
        for t in np.linspace(leg.begin_s, leg.end_s, count + 1)[1:]:
            times.append(t)
            sensor.append([*leg.place(t), depth])
    return np.array(times), np.array(sensor)
