"""Checks for effects that a scene lacks: on drawn slides with and without them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.stats import lomax

from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.twin.camera_estimates import NAMES, NOISE_TREND
from sliplab.plugins.twin.contact_estimates import read_contact
from sliplab.plugins.twin.contact_springs import Guess, steady
from sliplab.plugins.twin.misfits import (
    BROKEN,
    CHECKS,
    FEWEST,
    FORCE_DELAY,
    LEVEL,
    LIGHT,
    RAMP,
    SPOT,
    STICKY,
    TAIL,
    TILT,
    TURN,
    Tail,
    distances,
    line_over_noise,
    misfit_numbers,
    misfits,
    ramp_mm,
    stream_of,
)
from sliplab.plugins.twin.pilot import PilotTrial, SlideEvents, SlideMotion
from sliplab.plugins.twin.pilots import simulate_pilot
from sliplab.plugins.twin.trends import LAG, PULL
from sliplab.protocols.plan import load_plan
from sliplab.rigs.core.faults import PapillaTorn
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.storage.streams import F64, EventChunk
from tests.conftest import ROOT
from tests.plugins.twin.test_contact_estimates import LATTICE, RING

WAYS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
LENGTH_MM = 9.0
SPEEDS = (1.0, 1.6)


def base_way(t: F64, speed: float, ramp_mm_s2: float) -> tuple[F64, float]:
    """Way of an arm that speeds up and brakes at a rate, and when it arrives."""
    rise = speed / ramp_mm_s2
    end = LENGTH_MM / speed + rise
    if rise == 0.0:
        return np.clip(speed * t, 0.0, LENGTH_MM), end

    def ramp(since: F64) -> F64:
        """Way while speed rises from 0 and then stays."""
        return speed * (np.clip(since, 0.0, rise) ** 2 / (2 * rise) + np.maximum(since - rise, 0.0))

    return ramp(t) - ramp(t - (end - rise)), end


def pilot(
    friction: F64 | None = None,
    raised_mm: F64 | None = None,
    ramp_mm_s2: float = np.inf,
    spot: tuple[float, float] | None = None,
    seed: int = 0,
    worn: float = 0.0,
    ways: Sequence[tuple[float, float]] = WAYS,
) -> list[PilotTrial]:
    """Slides at three depths and two speeds in some directions, of papillae that are springs.

    Args:
        friction: of each papilla over the usual. raised_mm: height over that of its layer.
        ramp_mm_s2: the arm's acceleration. spot: middle of a place of radius 4 mm with friction of
            0.6 of that beside it.
        worn: share of its friction that the skin loses from the first slide to the last.
    """
    guess, rng = Guess(), np.random.default_rng(seed)
    height = (
        guess.height_mm - guess.layer_step_mm * RING + (0.0 if raised_mm is None else raised_mm)
    )
    mu = guess.kinetic * (1.0 if friction is None else friction)
    base = 1000 * guess.youngs_modulus_mpa / np.array([150.0, 200.0])
    found = []
    for number, (depth, speed, way) in enumerate(product((2.4, 2.8, 3.4), SPEEDS, WAYS)):
        t_s = np.arange(-2.0, LENGTH_MM / speed + speed / ramp_mm_s2, 0.01) + 0.003
        noise = _noise(rng, len(t_s))  # of all, so that those left out change no other
        if way in ways:
            deep = depth - (guess.height_mm - height)
            left = 1.0 - worn * number / 23
            lag, _ = steady(left * mu * np.ones(19), height, deep, *base, guess)
            motion = SlideMotion(depth, speed, np.array(way))
            found.append(_slide(lag, motion, t_s, ramp_mm_s2, spot, noise))
    return found


def _noise(rng: np.random.Generator, count: int) -> tuple[F64, F64, F64, F64]:
    """Draw places at rest, waves of friction along the way, their phases, and noise of tips."""
    rest, waves = rng.normal(0.0, 0.02, LATTICE.shape), rng.normal(0.0, 0.03, (19, 8))
    return rest, waves, rng.uniform(0.0, 6.3, (19, 8)), rng.normal(0.0, 2e-4, (count, 19, 2))


def _slide(
    lag: F64,
    motion: SlideMotion,
    t_s: F64,
    ramp_mm_s2: float,
    spot: tuple[float, float] | None,
    noise: tuple[F64, F64, F64, F64],
) -> PilotTrial:
    base, end_s = base_way(t_s, motion.speed_mm_s, ramp_mm_s2)
    away, waves, phases, shake = noise
    way = motion.direction
    rest = LATTICE + away - 4.5 * way
    path, now = np.zeros((len(t_s), 19)), np.zeros(19)
    # each papilla's friction varies along its path
    rate = np.linspace(1.0, 4.0, 8)
    for k in np.flatnonzero(base):
        here = 1.0 + (waves * np.cos(rate * now[:, None] + phases)).sum(axis=1)
        if spot is not None:
            inside = np.hypot(*(rest + now[:, None] * way - spot).T) < 4.0
            here = np.where(inside, 0.6 * here, here)
        now = np.maximum(now, base[k] - lag * here)
        path[k] = now
    tips = rest + path[..., None] * way + shake
    trial = f"{motion.depth_mm}-{motion.speed_mm_s}-{way}"
    return PilotTrial(trial, motion, -2.0, end_s, t_s, tips, base[:, None] * way)


def numbers(trials: Sequence[PilotTrial]) -> dict[str, float]:
    seen = [trial for trial in trials if trial.camera is not None]
    return misfit_numbers(trials, seen, read_contact(trials))


@pytest.fixture(scope="module")
def clean() -> dict[str, float]:
    return numbers(pilot())


def test_a_pilot_without_effects_has_small_numbers(clean: dict[str, float]) -> None:
    assert clean[TILT] < 2e-3
    assert clean[STICKY] < 4.0
    assert clean[BROKEN] == 0.0
    assert clean[RAMP] < 1e-9
    assert clean[SPOT] < 8.0
    assert np.isnan(clean[LIGHT])


@pytest.mark.long
def test_a_tilted_plate_is_a_plane_through_the_gaps(clean: dict[str, float]) -> None:
    slope = np.tan(np.radians(1.0))
    found = numbers(pilot(raised_mm=slope * LATTICE @ [0.6, 0.8]))
    # weak priors of the heights take a part
    assert found[TILT] == pytest.approx(slope, rel=0.2)
    assert found[STICKY] < 4.0
    assert found[BROKEN] == 0.0


@pytest.mark.quick(1)
@pytest.mark.parametrize("papilla", [0, 3, 12])
def test_a_sticky_papilla_stands_out(clean: dict[str, float], papilla: int) -> None:
    friction = np.where(np.arange(19) == papilla, 1.6, 1.0)
    found = numbers(pilot(friction=friction))
    assert found[STICKY] > 2.0 * clean[STICKY]
    assert found[TILT] < 2e-3
    assert found[SPOT] < 8.0


@pytest.mark.long
def test_a_papilla_without_a_marker_or_a_hold_is_missing() -> None:
    whole = pilot()
    unseen = []
    for trial in whole:
        tips = trial.tips_mm.copy()
        tips[:, 3] = np.nan
        unseen.append(replace(trial, tips_mm=tips))
    found = numbers(unseen)
    assert found[BROKEN] == 1.0
    assert found[STICKY] < 4.0
    assert found[TILT] < 2e-3
    # it is seen, and goes with the sensor from the start
    lowered = np.where(np.arange(19) == 3, -3.0, 0.0)
    assert numbers(pilot(raised_mm=lowered))[BROKEN] == 1.0
    # a marker that is lost in one slide
    assert numbers([unseen[0], *whole[1:]])[BROKEN] == pytest.approx(1 / 24)


def test_a_spot_shows_where_it_is(clean: dict[str, float]) -> None:
    found = numbers(pilot(spot=(6.0, 3.0)))
    assert found[SPOT] > 2.0 * clean[SPOT]
    assert found[BROKEN] == 0.0


@pytest.mark.quick(1)
@pytest.mark.parametrize("ramp_mm_s2", [1.0, 5.0, 20.0])
def test_a_ramp_costs_half_its_square_of_speed(ramp_mm_s2: float) -> None:
    expected = np.mean(np.square(SPEEDS)) / (2.0 * ramp_mm_s2)
    # the drawn slides end up to a frame before the arm arrives
    assert ramp_mm(pilot(ramp_mm_s2=ramp_mm_s2)) == pytest.approx(expected, rel=0.1)
    assert np.isnan(ramp_mm([]))


def lit(share: float, hz: float = 100.0, scans_hz: float = 0.0, seed: int = 0) -> list[PilotTrial]:
    """Slides with 3000 noise events a second in the hold that follow a light's intensity."""
    found = []
    for number, trial in enumerate(pilot()[:8]):
        rng = np.random.default_rng([seed, number])
        t = np.sort(rng.uniform(-2.0, 1.0, 9000))
        p = rng.choice([-1, 1], len(t), p=[0.3, 0.7]).astype(np.int8)
        phase = rng.uniform(0.0, 6.3)
        kept = rng.random(len(t)) < 0.5 * (1.0 + share * p * np.sin(2 * np.pi * hz * t + phase))
        if scans_hz:
            t = np.ceil(t * scans_hz) / scans_hz
        events = EventChunk(
            rng.integers(0, 400, kept.sum()).astype(np.int16),
            rng.integers(0, 400, kept.sum()).astype(np.int16),
            p[kept],
            np.round(t[kept] * 1e6).astype(np.int64),
        )
        found.append(replace(trial, camera=SlideEvents(events, (400, 400))))
    return found


@pytest.mark.long
@pytest.mark.parametrize("hz", [50.0, 100.0, 120.0, 333.0])
def test_a_light_makes_a_line(hz: float) -> None:
    # the largest of 481 means of 32 logarithms; a light of a tenth would be 4 times the noise
    quiet = line_over_noise(lit(0.0))
    assert 0.8 < quiet < 1.9
    assert line_over_noise(lit(0.2, hz)) > 3.0 * quiet


@pytest.mark.long
def test_scans_of_a_read_out_make_no_line() -> None:
    for scans_hz in (3333.0, 4990.0, 5000.0, 6600.0):
        assert line_over_noise(lit(0.0, scans_hz=scans_hz)) < 1.8
    assert np.isnan(line_over_noise(pilot()[:2]))


def test_without_slides_nothing_is_known() -> None:
    found = misfit_numbers([], [], None)
    assert set(found) == {check.key for check in CHECKS}
    assert np.isnan(list(found.values())).all()
    dark = [replace(t, tips_mm=np.full_like(t.tips_mm, np.nan)) for t in pilot()[:3]]
    found = numbers(dark)
    assert np.isfinite(found[RAMP])
    assert np.isnan([found[TILT], found[STICKY], found[SPOT]]).all()


def test_a_simulated_pilot_keeps_faults_where_they_are_asked_for() -> None:
    rig, _ = load_rig_file(shipped_rigs()["rehearsal"])
    plan = load_plan(ROOT / "protocols/pilot.yaml")
    torn = PapillaTorn(kind="papilla_torn", papilla=5, since="trial", at_s=0.0)
    broken = changed(rig, {"faults": (torn,)})

    def tips(rig: RigFile, with_faults: bool) -> F64:
        return simulate_pilot(rig, plan, plan.trials[:1], 3, False, with_faults)[0].tips_mm

    seen = tips(broken, True)
    assert np.isnan(seen).all(axis=(0, 2)).tolist() == [papilla == 5 for papilla in range(19)]
    np.testing.assert_array_equal(tips(broken, False), tips(rig, True))


# -- the verdict -------------------------------------------------------------------------------


def test_the_tail_is_that_of_an_exponential_distribution() -> None:
    values = np.exp(np.random.default_rng(1).exponential(0.3, 5000))
    tail = Tail.of(values, 0.0)
    for share in (0.1, 0.01, 0.001):
        assert tail.limit(share) == pytest.approx(share**-0.3, rel=0.05)
        assert tail.share(tail.limit(share)) == pytest.approx(share)
    # with few worlds: a Lomax distribution of the excesses
    few = Tail.of(values[:20], 0.0)
    excess = np.sort(np.log(values[:20]))[-4:] - np.sort(np.log(values[:20]))[-5]
    expected = TAIL * lomax(4, scale=excess.sum()).sf(1.0)
    beyond = float(np.exp(np.sort(np.log(values[:20]))[-5] + 1.0))
    assert few.share(beyond) == pytest.approx(expected)
    assert few.share(1.0) == 1.0


def test_a_number_that_is_always_zero_has_a_limit() -> None:
    tail = Tail.of(np.zeros(100), 0.25)
    assert tail.share(0.0) == 1.0
    assert tail.share(1 / 30) > 0.005
    assert tail.share(1.0) < 1e-4
    assert 0.05 < tail.limit(0.005) < 0.5


STATISTICS = (
    "kinetic",
    "correlation_mm",
    "friction_scatter",
    "tremor_mm",
    "height_reach_mm",
    "normal_n",
    "ratio",
    "pull_ring1_n_per_mm",
    *NAMES[:8],
)


def worlds(k: int, rng: np.random.Generator) -> tuple[list[dict[str, float]], F64]:
    """Numbers with tails of several kinds, and statistics of few hidden parameters."""
    q = len(STATISTICS)
    mix = np.random.default_rng(5).normal(size=(4, q))
    s = rng.uniform(-1.0, 1.0, (k, 4)) @ mix + 0.05 * rng.standard_t(5, (k, q))
    rows = np.column_stack(
        [
            0.002 * rng.rayleigh(size=k),
            2.5 * rng.lognormal(0.0, 0.2, k),
            np.zeros(k),
            1.2 * rng.lognormal(0.0, 0.08, k),
            1e-3 * rng.gamma(4.0, 0.3, k),
            3.0 + rng.gumbel(size=k),
            # those that tell of places, times and trends
            *(
                np.abs(rng.normal(size=k)) if not it.signed else rng.normal(1.0, it.floor, k)
                for it in CHECKS[6:]
            ),
        ]
    )
    keys = [check.key for check in CHECKS]
    return [dict(zip(keys, row, strict=True)) for row in rows.tolist()], s


@pytest.mark.long
@pytest.mark.parametrize("k", [40, pytest.param(200, marks=pytest.mark.long)])
def test_false_alarms_keep_to_the_level(k: int) -> None:
    rng = np.random.default_rng(k)
    alarms = total = 0
    for _ in range(10):
        bank, s = worlds(k, rng)
        pilots, observed = worlds(30, rng)
        for own, seen in zip(pilots, observed, strict=True):
            found = misfits(own, bank, STATISTICS, seen, s)
            assert len(found) == len(CHECKS) + 3
            alarms, total = alarms + found[0].found, total + 1
    # 300 pilots: three standard deviations above the level
    assert alarms / total < LEVEL + 3.0 * np.sqrt(LEVEL * (1 - LEVEL) / total)


@pytest.mark.parametrize(
    ("key", "value", "stream"),
    [
        (TILT, 0.0175, "frames"),
        (STICKY, 8.0, "frames"),
        (BROKEN, 1.0, "frames"),
        (LIGHT, 1e4, "events"),
        (RAMP, 0.1, "poses"),
        (SPOT, 20.0, "frames"),
        (TURN, 6.0, "frames"),
        (LAG, 9.0, "frames"),
        (PULL, 9.0, "force"),
        (NOISE_TREND, 9.0, "events"),
        (FORCE_DELAY, -15.0, "force"),
    ],
)
def test_an_effect_is_called_by_its_stream(key: str, value: float, stream: str) -> None:
    rng = np.random.default_rng(3)
    bank, s = worlds(100, rng)
    (own, *_), observed = worlds(1, rng)
    found = misfits(own | {key: value}, bank, STATISTICS, observed[0], s)
    title = next(check.title for check in CHECKS if check.key == key)
    assert (found[0].found, found[0].stream, found[0].title) == (True, stream, title)
    check = next(check for check in CHECKS if check.key == key)
    assert found[0].pilot == pytest.approx(abs(value), abs=1.2 if check.signed else 1e-9)
    assert set(found[0].touches) == check.touches
    assert found[0].share < LEVEL / 9 < found[1].share
    assert found[0].limit < abs(value)
    # what other statistics show as well does not come before it
    found = misfits(own | {key: value}, bank, STATISTICS, observed[0] + 3.0, s)
    assert found[0].title == title
    assert found[1].found


def test_statistics_that_do_not_go_together_are_a_misfit_of_their_stream() -> None:
    rng = np.random.default_rng(4)
    bank, s = worlds(100, rng)
    pilots, observed = worlds(1, rng)
    for name, stream in (("kinetic", "frames"), ("ratio", "force"), (NAMES[2], "events")):
        seen = observed[0].copy()
        seen[STATISTICS.index(name)] += 1.5
        found = misfits(pilots[0], bank, STATISTICS, seen, s)
        assert (found[0].found, found[0].stream) == (True, stream)
        assert stream_of(name) == stream


def test_distances_ignore_what_says_nothing() -> None:
    rng = np.random.default_rng(6)
    s = rng.normal(size=(200, 5))
    observed = np.zeros(5)
    found, own = distances(s, observed)
    assert np.mean(found**2) == pytest.approx(1.0, abs=0.15)
    assert own < 0.3
    # a constant one, one that few worlds have, one that is missing in the pilot
    more = np.column_stack([s, np.ones(200), np.where(rng.random(200) < 0.2, 1.0, np.nan)])
    assert distances(more, np.append(observed, [7.0, 1.0]))[1] == pytest.approx(own)
    assert distances(s, np.append(observed[:4], np.nan))[1] > 2.0
    assert np.isnan(distances(np.ones((200, 2)), np.ones(2))[1])


def test_what_is_not_there_is_not_checked() -> None:
    rng = np.random.default_rng(7)
    bank, s = worlds(100, rng)
    (own, *_), observed = worlds(1, rng)
    events = np.array([stream_of(name) == "events" for name in STATISTICS])
    blind = own | {check.key: float("nan") for check in CHECKS if check.stream == "events"}
    names = [name for name, one in zip(STATISTICS, events, strict=True) if not one]
    found = misfits(blind, bank, names, observed[0][~events], s[:, ~events])
    assert {check.stream for check in found} == {"frames", "force", "poses"}
    assert misfits(own, bank[: FEWEST - 1], STATISTICS, observed[0], s[: FEWEST - 1]) == ()
    assert misfits(dict.fromkeys(own, np.nan), bank, STATISTICS, np.full(16, np.nan), s) == ()
