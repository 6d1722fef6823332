"""A reference for latencies: Page's test on the marker that slips first, its event rates known.

It knows which tip slips, and the rates of events around its marker, each millisecond, with the slip
and without it. Both are means over `DRAWN` simulations of the camera; without the slip the tip goes
on to be loaded as before. Events are taken as Poisson. The observer sums the logarithm of the
likelihood ratio, as Page's test does, and is certain at ``ln(steps between false alarms)``: its
mean time to a false alarm is then at least as long (Lorden 1971, theorem 2).

It is no lower bound. It expects the slip at any moment and sees one marker; a detector that sees
all of them, and knows that slip comes while they move, can be certain earlier. Lorden's bound makes
its level higher than the asked rate needs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sliplab.plugins.bench.scenes import SceneDraw, take
from sliplab.plugins.simulation.identity import Identity
from sliplab.plugins.simulation.scene.events import MarkerSensor
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.storage.streams import F64, I64

STEP_NS = 1_000_000
BEFORE, AFTER = 100, 250
"""Steps before and after the slip."""
SLOPE_NS = 30_000_000
"""Time before the slip in which the loading is measured that continues without it."""
DRAWN = 8
SMOOTHED = 5
"""Steps over which rates are means, the slip's step a border."""
RIM_PX = 6.0
"""Pixels beyond a marker's radius that still show its edge."""


class _Loads:
    """The forces of all tips in a trial: times ns, (m,), and rows of x, y and normal, (m, 3 n)."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        world.at_begin(self._begin)

    def _begin(self) -> None:
        self.table = self._world.keep_loads("limit")


def waits_ms(drawn: SceneDraw, asked: Sequence[float]) -> list[float]:
    """Return the milliseconds from the first slip until the observer is certain.

    Args:
        asked: false alarms an hour.

    Returns:
        one for each of `asked`, whole steps; infinite: not within `AFTER` steps.

    Raises:
        RigError: nothing slips in the scene.
    """
    loads: list[_Loads] = []
    taken = take(drawn, lambda world: loads.append(_Loads(world)))
    world, truth = taken.devices.world, taken.truth
    onsets = truth["slip_per_papilla_ns"]
    first_ns, tip = min((t, tip) for tip, t in enumerate(onsets) if t is not None)
    slip_ns = int(taken.devices.sync.clock.to_device(first_ns))
    t_ns, with_slip = loads[0].table.between(
        slip_ns - BEFORE * STEP_NS, slip_ns + (AFTER + 1) * STEP_NS
    )
    own = Identity("event_camera", world.settings.event_camera)
    sensor = MarkerSensor(own.settings, world.skin.layout_mm, own.fabrication_seed(world))
    column, row, radius = sensor.path(with_slip)[tip, :, np.searchsorted(t_ns, slip_ns)]

    def counted(rows: F64, seed: int) -> F64:
        """Return the events around the marker by polarity and step, (2, BEFORE + AFTER)."""
        sensor.reset(rows[0], seed)
        at_ns, x, y, p = sensor.sense(rows, t_ns)
        near = np.hypot(x - column, y - row) < radius + RIM_PX
        step = (at_ns[near] - slip_ns) // STEP_NS + BEFORE
        shape = (2, BEFORE + AFTER)
        return np.histogram2d(p[near], step, shape, ((0, 2), (0, shape[1])))[0]

    def rates(rows: F64) -> F64:
        return _rates([counted(rows, world.seed + k) for k in range(1, DRAWN + 1)])

    slid, stuck = rates(with_slip), rates(without_slip(t_ns, with_slip, tip, slip_ns))
    after = slice(BEFORE, None)
    seen = counted(with_slip, world.seed)
    return certain_after(seen[:, after], slid[:, after], stuck[:, after], asked)


def certain_after(seen: F64, slid: F64, stuck: F64, asked: Sequence[float]) -> list[float]:
    """Return the steps from a slip until the log likelihood ratio reaches each level; or infinity.

    Args:
        seen: events of each kind and step, (k, m). slid, stuck: expected ones, above 0, (k, m).
        asked: false alarms an hour.
    """
    evidence = np.cumsum((seen * np.log(slid / stuck) - (slid - stuck)).sum(axis=0))
    above = [np.flatnonzero(evidence >= level_of(rate)) for rate in asked]
    return [float(found[0] + 1) if len(found) else math.inf for found in above]


def level_of(per_hour: float) -> float:
    """Return the level at which Page's test has at most this rate of false alarms."""
    return math.log(3600e9 / STEP_NS / per_hour)


def without_slip(t_ns: I64, rows: F64, tip: int, slip_ns: int) -> F64:
    """Return loads in which a tip is dragged on as before it slid, (m, 3 n).

    Its tangential forces go on as they changed in the last `SLOPE_NS`; the others stay.
    """
    stuck, after = rows.copy(), t_ns > slip_ns
    lately = (t_ns > slip_ns - SLOPE_NS) & ~after
    since = (t_ns - slip_ns) * 1e-9
    for part in (3 * tip, 3 * tip + 1):
        slope = np.polyfit(since[lately], rows[lately, part], 1)[0]
        stuck[after, part] = np.interp(0.0, since, rows[:, part]) + slope * since[after]
    return stuck


def _rates(counts: Sequence[F64]) -> F64:
    """Return events per step by polarity, means over `SMOOTHED` steps on either side of the slip.

    Half an event more in each mean, so that none is 0.
    """
    total = np.add.reduce(counts)
    sides = [
        np.array([_means(line) for line in side]) for side in (total[:, :BEFORE], total[:, BEFORE:])
    ]
    return np.concatenate(sides, axis=1) / len(counts)


def _means(line: F64) -> F64:
    kernel = np.ones(SMOOTHED)
    seen = np.convolve(np.ones(len(line)), kernel, "same")
    return (np.convolve(line, kernel, "same") + 0.5) / seen
