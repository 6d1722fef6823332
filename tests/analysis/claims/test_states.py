"""Claims over a grid: estimates, verdicts and chosen trials, in worlds whose truth is known."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.claims.choosing import next_batch, spread_out
from sliplab.analysis.claims.evidence import Chances, Evidence, Grid, weighted_bets
from sliplab.analysis.claims.states import settled, states
from sliplab.protocols import Plan
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import make_plan
from sliplab.protocols.yaml_file import validate
from sliplab.storage.schema.claims import Batch, ClaimState
from tests.conftest import SMALL

WITHIN = {"figure": "slip_duration", "within": "150 ms"}


def plan_of(*claims: dict[str, Any], repetitions: int = 6, **more: Any) -> Plan:
    """The pilot's 36 conditions some times, with claims."""
    data = copy.deepcopy(SMALL)
    data["collection"] |= {"repetitions": repetitions, "stopping": {"claims": list(claims)}, **more}
    return make_plan(validate(Protocol, data, Path("p.yaml")), "p.yaml")


def world(grid: Grid, seed: int, noise: float = 100.0) -> np.ndarray:
    """Figures of every trial: effects of depth and speed, and scatter; ms."""
    rng = np.random.default_rng(seed)
    effects = [rng.normal(0, 400, 3), rng.normal(0, 400, 3), rng.normal(0, 50, 4)]
    found = 3000.0 + sum(effect[grid.levels[:, k]] for k, effect in enumerate(effects))
    return np.asarray(found + rng.normal(0, noise, len(grid.trials)))


def shuffled(plan: Plan, y: np.ndarray) -> Iterator[tuple[ClaimState, ...]]:
    """The claims after each block."""
    grid, stopping = Grid.of(plan), plan.protocol.collection.stopping
    assert stopping is not None
    ends = np.arange(36, len(y) + 1, 36)
    for k, n in enumerate(ends):
        taken = np.arange(n)
        yield states(Evidence(grid, taken, ends[: k + 1], {"slip_duration": y[:n]}), stopping)


def adaptive(plan: Plan, y: np.ndarray) -> Iterator[tuple[Evidence, tuple[ClaimState, ...]]]:
    """The evidence and the claims after each batch."""
    grid, collection = Grid.of(plan), plan.protocol.collection
    stopping, choice = collection.stopping, collection.adaptive
    assert stopping is not None
    assert choice is not None
    batches: list[Batch] = []
    evidence = Evidence(
        grid, np.array([], np.int64), np.array([], np.int64),
        {"slip_duration": np.array([])}, Chances(np.array([]), np.array([])),
    )  # fmt: skip
    while (batch := next_batch(evidence, batches, stopping, choice, 5)) is not None:
        batches.append(batch)
        items = [(item, each) for each in batches for item in each.trials]
        taken = np.array([grid.number[item.trial] for item, _ in items])
        chance = [np.nan if item.chance is None else item.chance for item, _ in items]
        least = [np.nan if each.least is None else each.least for _, each in items]
        evidence = Evidence(
            grid, taken, np.cumsum([len(each.trials) for each in batches]),
            {"slip_duration": y[taken]}, Chances(np.array(chance), np.array(least)),
        )  # fmt: skip
        yield evidence, states(evidence, stopping)


def test_a_claim_of_each_kind_is_settled_as_it_is() -> None:
    between = {"factor": "depth", "levels": [2.4, 3.4]}
    plan = plan_of(
        WITHIN,
        {"figure": "slip_duration", "at_least": "2500 ms"},
        {"figure": "slip_duration", "at_most": "2500 ms"},
        {"figure": "slip_duration", "statistic": "p90", "at_most": "4500 ms"},
        {"figure": "slip_duration", "between": between, "at_least": "300 ms"},
        {"figure": "slip_duration", "between": between, "at_most": "-300 ms"},
    )
    grid = Grid.of(plan)
    depth = np.array([float(dict(t.condition)["depth"]) for t in grid.trials])  # type: ignore[arg-type]
    y = 3000.0 + 600.0 * (depth == 2.4) + np.random.default_rng(1).normal(0, 50, len(depth))
    *_, last = shuffled(plan, y)
    assert [(s.holds, s.refuted) for s in last] == [
        (True, False), (True, False), (False, True), (True, False), (True, False), (True, False),
    ]  # fmt: skip
    assert settled(last)
    assert last[0].estimate == pytest.approx(np.median(y), abs=20)
    assert last[4].estimate == pytest.approx(-600, abs=40)


def test_undetected_trials_count_as_the_worst_and_unknown_ones_not_at_all() -> None:
    plan = plan_of({"figure": "slip_duration", "statistic": "p90", "at_most": "3500 ms"})
    y = np.full(216, 3000.0)
    y[::50] = np.inf  # 2 %
    y[1::20] = np.nan
    *_, last = shuffled(plan, y)
    assert last[0].holds
    y[::3] = np.inf  # a third
    *_, last = shuffled(plan, y)
    assert last[0].refuted
    assert last[0].estimate is None  # the 90th percentile was not detected


def test_nothing_is_called_without_a_figure() -> None:
    plan = plan_of(WITHIN)
    *_, last = shuffled(plan, np.full(216, np.nan))
    assert not settled(last)
    assert (last[0].trials, last[0].low, last[0].high, last[0].estimate) == (0, None, None, None)


def test_claims_that_are_just_false_are_seldom_called_true() -> None:
    # 120 grids of noise alone, a look after each block; the bound is the median itself
    plan = plan_of({"figure": "slip_duration", "at_least": "3000 ms"}, repetitions=4)
    rng = np.random.default_rng(11)
    called = 0
    for _ in range(120):
        y = 3000.0 - 1e-6 + rng.normal(0, 100, 144)
        called += any(found[0].holds for found in shuffled(plan, y))
    assert called <= 12  # 5 % of 120 are 6; more than 12 have a chance of 1 %


def test_chosen_trials_give_unbiased_estimates_whatever_is_expected() -> None:
    # the mean of the corrected estimates over many draws is the grid's, with wrong expectations
    plan = plan_of(WITHIN, order="adaptive")
    grid = Grid.of(plan)
    rng = np.random.default_rng(2)
    y = (rng.random(len(grid.trials)) < 0.3).astype(float)
    expected = rng.random(len(grid.trials))
    chance = rng.random(len(grid.trials)) ** 2 + 0.05
    chance /= chance.sum()
    found = []
    members = np.ones(len(y), np.bool_)
    for _ in range(4000):
        k = int(rng.choice(len(y), p=chance))
        one = Evidence(
            grid, np.array([k]), np.array([1]), {},
            Chances(chance[[k]], np.array([chance.min()])),
        )  # fmt: skip
        bets = weighted_bets(one, y[[k]], members, expected[None])
        assert bets.low[0] <= bets.z[0] <= bets.high[0]
        found.append(bets.z[0])
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found) - y.mean()) < 4 * error


def test_adaptive_campaigns_are_right_and_take_fewer_trials() -> None:
    chosen = plan_of(WITHIN, order="adaptive", choice={"batch": 12, "start": 24})
    blocks = plan_of(WITHIN)
    order = {trial.id: k for k, trial in enumerate(Grid.of(chosen).trials)}
    same = [order[trial.id] for trial in Grid.of(blocks).trials]
    needed, by_blocks = [], []
    for seed in range(4):
        y = world(Grid.of(chosen), seed, 400.0)
        evidence, found = next(each for each in adaptive(chosen, y) if settled(each[1]))
        low, high = found[0].low, found[0].high
        assert low is not None
        assert high is not None
        assert low <= np.median(y) <= high
        needed.append(len(evidence.taken))
        ends = [36 * (k + 1) for k, each in enumerate(shuffled(blocks, y[same])) if settled(each)]
        by_blocks.append((ends or [216])[0])
    assert sum(needed) < 0.9 * sum(by_blocks)


def test_the_same_evidence_chooses_the_same_trials_once_each() -> None:
    plan = plan_of(WITHIN, repetitions=2, order="adaptive", choice={"batch": 10, "start": 10})
    y = world(Grid.of(plan), 4)
    (*_, (first, _)), (*_, (second, _)) = adaptive(plan, y), adaptive(plan, y)
    assert first.taken.tolist() == second.taken.tolist()
    assert sorted(first.taken.tolist()) == list(range(72))  # all of the grid in the end


def test_the_start_spreads_over_the_grid() -> None:
    grid = Grid.of(plan_of(WITHIN))
    found = spread_out(grid, np.arange(len(grid.trials)), 12, np.random.default_rng(0))
    assert len(set(found)) == 12
    assert [len(set(grid.levels[found, k])) for k in range(3)] == [3, 3, 4]
    assert len(set(grid.condition[found])) == 12


def test_trials_that_tell_of_an_open_claim_are_taken_more_often() -> None:
    between = {"factor": "depth", "levels": [2.4, 3.4]}
    claim = {"figure": "slip_duration", "between": between, "at_least": "900 ms"}
    plan = plan_of(claim, order="adaptive", choice={"batch": 12, "start": 12, "random": 0.2})
    grid = Grid.of(plan)
    y = world(grid, 0)
    at = [k for k, _ in zip(range(8), adaptive(plan, y), strict=False)]
    assert len(at) == 8
    for number, (seen, _) in enumerate(adaptive(plan, y)):
        evidence = seen
        if number == 7:
            break
    compared = grid.members(_between(plan), 0) | grid.members(_between(plan), 1)
    assert compared[evidence.taken[24:]].mean() > 0.8  # two of three levels


def _between(plan: Plan) -> Any:
    stopping = plan.protocol.collection.stopping
    assert stopping is not None
    return stopping.claims[0].between
