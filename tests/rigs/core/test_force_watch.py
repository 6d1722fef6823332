"""Presses to a force: when the arm is stopped, and where the force ends."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.simulation.force import MockForceSensor
from sliplab.plugins.simulation.settings import MockSettings, scene_of
from sliplab.protocols.program import Move, Position
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import Mounting
from sliplab.rigs.core.force_watch import POLL_S, ForceWatch
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.streams import WrenchChunk
from tests.patching import loose, put

MS = 1_000_000
PLATE = PlateFrame.taught(((0.0, 0.0, 0.0), (50.0, 0.0, 0.0), (0.0, 50.0, 0.0)))


class Scripted:
    """A sensor that returns what it was given."""

    mounting = Mounting()

    def __init__(self, *chunks: WrenchChunk) -> None:
        self.chunks = list(chunks)

    def start(self) -> None:
        """It streams."""

    def read(self) -> WrenchChunk:
        return self.chunks.pop(0) if self.chunks else WrenchChunk.empty()


def readings(
    normal_n: np.ndarray, period_ms: float = 1.0, late_ms: np.ndarray | float = 0.5
) -> WrenchChunk:
    """Samples on a clock that is 7 s ahead of the host's; the first was taken at the host's 0."""
    taken_ns = np.round(np.arange(len(normal_n)) * period_ms * MS).astype(np.int64)
    host_ns = np.maximum.accumulate(taken_ns + np.round(late_ms * MS).astype(np.int64))
    force = np.zeros((len(normal_n), 3))
    force[:, 2] = normal_n
    return WrenchChunk(taken_ns + 7_000 * MS, host_ns, force, np.zeros_like(force))


def watch(*chunks: WrenchChunk, delay_s: float = 0.0005) -> ForceWatch:
    found: Any = ForceWatch(loose(Scripted(*chunks)), PLATE, None, delay_s)
    for _ in chunks:
        found.read()
    return found


def test_a_force_that_rises_evenly_is_reached_when_the_line_says() -> None:
    """4 N/s since the first sample reach 2 N at 500 ms; it is 300.5 ms now."""
    rise = 4e-3 * np.arange(301)
    for parts in ([rise], [rise[:3], rise[3:]]):
        whole = readings(np.concatenate(parts))
        chunks, first = [], 0
        for part in parts:
            rows = slice(first, first + len(part))
            chunks.append(whole[rows])
            first += len(part)
        found = watch(*chunks)
        assert found.seconds_to(2.0, round(300.5 * MS)) == pytest.approx(0.1995, abs=1e-6)
        # it goes on to rise while nothing comes
        assert found.seconds_to(2.0, 400 * MS) == pytest.approx(0.1, abs=1e-6)
        assert found.seconds_to(2.0, 510 * MS) == pytest.approx(-0.01, abs=1e-6)


def test_samples_that_come_late_are_no_younger_for_it() -> None:
    rng = np.random.default_rng(1)
    late_ms = 0.5 + np.abs(rng.normal(0, 0.4, 301))
    late_ms[295] = 0.5
    found = watch(readings(4e-3 * np.arange(301), late_ms=late_ms))
    assert found.seconds_to(2.0, 302 * MS) == pytest.approx(0.198, abs=1e-6)


def test_noise_is_filtered() -> None:
    rng = np.random.default_rng(2)
    off = []
    for _ in range(400):
        noisy = 4e-3 * np.arange(301) + rng.normal(0, 0.005, 301)
        found = watch(readings(noisy))
        # 1.212 N are reached 2.5 ms from now: as N, with the rate of 4 N/s
        off.append(4.0 * (found.seconds_to(1.212, round(300.5 * MS)) - 0.0025))
    # a line through ten samples, 7.5 ms from their middle: sqrt(1 / n + d^2 / sum of squares)
    assert np.std(off) == pytest.approx(0.005 * np.sqrt(0.1 + 7.5**2 / 82.5), rel=0.15)
    assert abs(np.mean(off)) < 0.001


def test_a_force_that_does_not_rise_is_never_reached() -> None:
    assert watch(delay_s=0.0).seconds_to(2.0, 0) == np.inf
    assert watch(readings(np.full(50, 1.0))).seconds_to(2.0, 50 * MS) == np.inf
    falling = 1.0 - 1e-3 * np.arange(50)
    assert watch(readings(falling)).seconds_to(0.99, 50 * MS) == np.inf
    assert watch(readings(falling)).seconds_to(0.9, 50 * MS) == -np.inf


def test_a_slow_sensor_is_followed_by_its_last_five_samples() -> None:
    rise = np.concatenate([np.zeros(20), 0.4 * np.arange(5)])
    found = watch(readings(rise, period_ms=100.0))
    assert found.seconds_to(2.0, round(2400.5 * MS)) == pytest.approx(0.0995, abs=1e-6)
    assert found.normal_n == pytest.approx(0.8)


# -- presses on the mock -------------------------------------------------------------------

TARGET_N, LIMIT_N = 2.0, 2.1
SPEEDS = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Speeds of presses, mm/s: that of the templates is 2."""
TRIALS_A_RIG = 50
AFTER_S = 0.3
"""A tremor lasts this long after a stop."""


def force_rig(seed: int) -> Rig:
    """The shipped rig with a force sensor, made anew: skin, cross-talk, drift, taught plane."""
    file, _ = load_rig_file(Path("mock-force"))
    changes = {"frame_camera": {"level": "tracks"}, "seed": seed}
    scene = MockSettings.model_validate(scene_of(file).model_dump() | changes)
    rig = build_rig(file.model_copy(update={"mock": scene}))
    rig.connect()
    rig.force_limit_n = LIMIT_N
    return rig


@dataclass(frozen=True)
class Pressed:
    """True forces of one press, N."""

    end_n: float
    """Normal force when the arm has come to rest."""
    peak_n: float
    """Largest force in any direction, to `AFTER_S` later."""


def press(rig: Rig, seed: int, speed_mm_s: float, target_n: float = TARGET_N) -> Pressed:
    """One trial's press, at a place that the seed draws."""
    sensor = rig.force
    assert isinstance(sensor, MockForceSensor)
    world = sensor._world
    x_mm, y_mm = np.random.default_rng(seed).uniform(-5.0, 5.0, 2)
    home = Position(x_mm, y_mm, -2.0)
    deepest = Position(x_mm, y_mm, 4.0)
    with rig.safely(home):
        rig.begin_trial(home, seed)
        loads = world.keep_loads()
        rig._watch_forces()
        rig.take_step(0, Move("press", deepest, speed_mm_s, until_force_n=target_n), home, None)
        rested_ns = world.now_ns
        rig.wait(AFTER_S)
        world.advance()
        times = np.arange(loads.begin_ns, loads.end_ns, MS)
        tips = loads.at(times)
        force = tips.reshape(len(times), -1, 3).sum(axis=1)
        world.drop_loads()
        rig._forces = None
        sensor.stop()
    end_n = float(np.interp(rested_ns, times, force[:, 2]))
    return Pressed(end_n, float(np.linalg.norm(force, axis=1).max()))


def read_in_a_press(limit_n: float | None) -> list[np.ndarray]:
    """Press 4.8 mm at 1 mm/s on the same rig; return the forces of each reading."""
    rig, home = force_rig(3), Position(0.0, 0.0, -2.0)
    rig.force_limit_n = limit_n
    sensor, found = rig.force, []
    assert isinstance(sensor, MockForceSensor)
    read = sensor.read

    def noted() -> WrenchChunk:
        chunk = read()
        found.append(chunk.force_n)
        return chunk

    with rig.safely(home):
        rig.begin_trial(home, 5)
        put(sensor, "read", noted)
        rig._watch_forces()
        rig.take_step(0, Move("press", Position(0.0, 0.0, 2.8), 1.0), home, None)
    rig.close()
    return found


def test_forces_are_read_often_where_they_have_a_limit() -> None:
    """And are the same as those that are read with the other streams."""
    often, seldom = read_in_a_press(100.0), read_in_a_press(None)
    assert len(often) == pytest.approx(4.8 / POLL_S, rel=0.1)
    assert len(seldom) < len(often) / 5
    most = min(sum(map(len, often)), sum(map(len, seldom)))
    assert most > 4_500
    np.testing.assert_array_equal(np.concatenate(often)[:most], np.concatenate(seldom)[:most])


def presses(trials: int, a_rig: int = TRIALS_A_RIG) -> list[Pressed]:
    """Presses on many rigs, with a seed and one of the speeds each."""
    found = []
    for seed in range(1, trials + 1):
        if seed % a_rig == 1:
            rig = force_rig(1 + seed // a_rig)
        found.append(press(rig, seed, SPEEDS[seed % len(SPEEDS)]))
    return found


def figures(found: list[Pressed]) -> tuple[float, float, float]:
    """Return the largest deviation from the target, the share within 0.1 N, the largest peak."""
    off = np.abs([one.end_n - TARGET_N for one in found])
    peak = max(one.peak_n for one in found)
    print(
        f"simulated: {len(found)} presses to {TARGET_N:g} N: at most {off.max():.3f} N off, "
        f"{np.mean(off <= 0.1):.1%} within 0.1 N, peak {peak:.3f} N, limit {LIMIT_N:g} N"
    )
    return float(off.max()), float(np.mean(off <= 0.1)), peak


def test_presses_end_at_their_force_and_below_the_limit() -> None:
    worst, share, peak = figures(presses(10, a_rig=10))
    assert worst < 0.1
    assert share == 1.0
    assert peak <= LIMIT_N


@pytest.mark.long
def test_presses_end_at_their_force_and_below_the_limit_in_1000_trials() -> None:
    worst, share, peak = figures(presses(1000))
    assert worst < 0.1
    assert share == 1.0
    assert peak <= LIMIT_N


class LateArm:
    """The rig's arm, which goes on for a while after a stop, and says so or not."""

    def __init__(self, rig: Rig, late_s: float) -> None:
        self._arm, self._clock, self._late_s = rig.arm, rig.clock, late_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def stop(self) -> None:
        self._clock.wait(self._late_s)
        self._arm.stop()


class FrankLateArm(LateArm):
    """One that says so."""

    def stopping_s(self, speed_mm_s: float) -> float:
        return self._late_s


@pytest.mark.parametrize(("kind", "off_n"), [(LateArm, 0.3), (FrankLateArm, 0.0)])
def test_an_arm_that_goes_on_after_a_stop_is_stopped_earlier(kind: Any, off_n: float) -> None:
    """At 5 mm/s and about 3 N/mm, 20 ms are 0.3 N."""
    rig = force_rig(1)
    rig.force_limit_n = None
    rig.arm = kind(rig, 0.02)
    found = [press(rig, seed, 5.0).end_n - TARGET_N for seed in (1, 2, 3)]
    print(found)
    assert found == pytest.approx([off_n] * 3, abs=0.1)
