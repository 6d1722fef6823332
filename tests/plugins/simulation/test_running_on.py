"""A world whose clocks go on over its trials, as those of real devices do."""

from __future__ import annotations

import pytest

from sliplab.plugins.simulation.world import SimulatedWorld
from tests.plugins.simulation.driving import SMALL

CLOCKS = ("arm", "event_camera", "frame_camera")


def shown(world: SimulatedWorld) -> list[int]:
    """Return the current readings of the devices' clocks, ns."""
    clocks = (getattr(world.clocks, name) for name in CLOCKS)
    return [int(clock.to_reference(world.now_ns)) for clock in clocks]


def test_clocks_go_on_from_trial_to_trial() -> None:
    world = SimulatedWorld(SMALL, run_on=True)
    world.pass_time(1_234_567_891)
    drifts = [getattr(world.clocks, name).drift for name in CLOCKS]
    for seed in (11, 12, 13):
        before = shown(world)
        world.begin_trial(seed)
        assert world.now_ns == 0
        assert shown(world) == pytest.approx(before, abs=1)
        world.pass_time(2_000_000_003)
        passed = [after - first for after, first in zip(shown(world), before, strict=True)]
        assert passed == pytest.approx([2_000_000_003] * 3, rel=250e-6)
    assert [getattr(world.clocks, name).drift for name in CLOCKS] == drifts
    assert world.past_ns == 1_234_567_891 + 2 * 2_000_000_003


def test_the_rest_is_drawn_anew_by_the_trials_seed() -> None:
    one, other = SimulatedWorld(SMALL, run_on=True), SimulatedWorld(SMALL, run_on=True)
    other.pass_time(5_000_000_000)
    for world in (one, other):
        world.begin_trial(21)
    assert one.seed == other.seed == 21
    # time has passed for one of them only
    gained = [b - a for a, b in zip(shown(one), shown(other), strict=True)]
    assert gained == pytest.approx([5_000_000_000] * 3, rel=250e-6)


def test_else_every_trial_finds_them_at_a_time_of_its_own() -> None:
    world = SimulatedWorld(SMALL)
    world.begin_trial(11)
    first = shown(world)
    world.pass_time(2_000_000_000)
    world.begin_trial(12)
    apart = [abs(b - a) for a, b in zip(first, shown(world), strict=True)]
    assert max(apart) > 3_600_000_000_000
    world.begin_trial(11)
    assert shown(world) == first
