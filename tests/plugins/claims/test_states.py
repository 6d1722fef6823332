"""Claims over a grid: estimates, verdicts and chosen trials, in worlds whose truth is known."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.claims.choosing import next_batch, spread_out
from sliplab.plugins.claims.document import ClaimState, TrialBatch
from sliplab.plugins.claims.evidence import ClaimEvidence, TrialGrid, chosen_estimate
from sliplab.plugins.claims.shown import count_text, verdict_text
from sliplab.plugins.claims.simulated import course
from sliplab.plugins.claims.states import settled, states
from sliplab.protocols import Plan
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import make_plan
from sliplab.protocols.yaml_file import validate
from tests.conftest import SMALL
from tests.patching import loose

WITHIN = {"figure": "slip_duration", "within": "150 ms"}


def plan_of(
    *claims: dict[str, Any], repetitions: int = 6, block: int | None = None, **more: Any
) -> Plan:
    """The pilot's 36 conditions some times, with claims."""
    data = copy.deepcopy(SMALL)
    stopping: dict[str, Any] = {"claims": list(claims)}
    if block is not None:
        stopping["block"] = block
    data["collection"] |= {"repetitions": repetitions, "stopping": stopping, **more}
    return make_plan(validate(Protocol, data, Path("p.yaml")), "p.yaml")


def world(grid: TrialGrid, seed: int, noise: float = 100.0) -> np.ndarray:
    """Figures of every trial: effects of depth and speed, and scatter; ms."""
    rng = np.random.default_rng(seed)
    effects = [rng.normal(0, 400, 3), rng.normal(0, 400, 3), rng.normal(0, 50, 4)]
    found = 3000.0 + sum(effect[grid.levels[:, k]] for k, effect in enumerate(effects))
    return np.asarray(found + rng.normal(0, noise, len(grid.trials)))


def shuffled(plan: Plan, y: np.ndarray) -> Iterator[tuple[ClaimState, ...]]:
    """The claims after each block."""
    grid, stopping = TrialGrid.of(plan), plan.protocol.collection.stopping
    assert stopping is not None
    ends = np.arange(36, len(y) + 1, 36)
    found: tuple[ClaimState, ...] = ()
    whole = ClaimEvidence(grid, np.arange(len(y)), ends, {"slip_duration": y}, block=stopping.block)
    for k in range(len(ends)):
        found = states(whole.until(k), stopping, earlier=found)
        yield found


def adaptive(plan: Plan, y: np.ndarray) -> Iterator[tuple[ClaimEvidence, tuple[ClaimState, ...]]]:
    """The evidence and the claims after each batch."""
    grid, collection = TrialGrid.of(plan), plan.protocol.collection
    stopping, choice = collection.stopping, collection.adaptive
    assert stopping is not None
    assert choice is not None
    batches: list[TrialBatch] = []
    evidence = ClaimEvidence(
        grid,
        np.array([], np.int64),
        np.array([], np.int64),
        {"slip_duration": np.array([])},
        np.array([]),
    )
    while (batch := next_batch(evidence, batches, stopping, choice, 5)) is not None:
        batches.append(batch)
        items = [(item, each) for each in batches for item in each.trials]
        taken = np.array([grid.number[item.trial] for item, _ in items])
        chance = [np.nan if item.chance is None else item.chance for item, _ in items]
        evidence = ClaimEvidence(
            grid,
            taken,
            np.cumsum([len(each.trials) for each in batches]),
            {"slip_duration": y[taken]},
            np.array(chance),
        )
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
        repetitions=36,
    )
    grid = TrialGrid.of(plan)
    depth = np.array([float(loose(dict(t.condition)["depth"])) for t in grid.trials])
    y = 3000.0 + 600.0 * (depth == 2.4) + np.random.default_rng(1).normal(0, 50, len(depth))
    *_, last = shuffled(plan, y)
    assert [(s.holds, s.refuted) for s in last] == [
        (True, False),
        (True, False),
        (False, True),
        (True, False),
        (True, False),
        (True, False),
    ]
    assert settled(last)
    assert last[0].estimate == pytest.approx(np.median(y), abs=20)
    assert last[4].estimate == pytest.approx(-600, abs=40)


def test_undetected_trials_count_as_the_worst() -> None:
    claim = {"figure": "slip_duration", "statistic": "p90", "at_most": "3500 ms"}
    plan = plan_of(claim, repetitions=36)
    y = np.full(1296, 3000.0)
    y[::50] = np.inf  # 2 %
    *_, last = shuffled(plan, y)
    assert last[0].holds
    assert (last[0].trials, last[0].undetected, last[0].missing) == (1270, 26, 0)
    y[::3] = np.inf  # a third
    *_, last = shuffled(plan, y)
    assert last[0].refuted
    assert last[0].estimate is None  # the 90th percentile was not detected


def test_nothing_is_called_without_a_figure() -> None:
    plan = plan_of(WITHIN)
    *_, last = shuffled(plan, np.full(216, np.nan))
    assert not settled(last)
    assert (last[0].trials, last[0].low, last[0].high, last[0].estimate) == (0, None, None, None)


def test_missing_figures_count_against_a_claim() -> None:
    """A third of the conditions is bad, and mostly has no label: the claim is false."""
    claim = {"figure": "slip_duration", "statistic": "p25", "at_least": "2500 ms"}
    plan = plan_of(claim, repetitions=24)
    grid, rng = TrialGrid.of(plan), np.random.default_rng(4)
    bad = grid.levels[:, 0] == 0
    y = np.where(bad, 2000.0, 3200.0) + rng.normal(0, 100, len(bad))
    y[bad & (rng.random(len(y)) < 0.9)] = np.nan
    *_, (last,) = shuffled(plan, y)
    assert (last.holds, last.refuted) == (False, False)
    assert last.missing == np.isnan(y).sum()
    assert last.alike == "holds"
    assert f"holds if the {last.missing} missing trials were like the others" in verdict_text(last)
    assert f"{last.missing} without a figure" in count_text(last)
    y[np.isnan(y)] = 3200.0  # had they been good, it would be true
    *_, (last,) = shuffled(plan, y)
    assert last.holds


def test_few_missing_figures_leave_a_claim_that_is_far_from_its_bound() -> None:
    plan = plan_of({"figure": "slip_duration", "at_most": "3500 ms"}, repetitions=12)
    y = 3000.0 + np.random.default_rng(1).normal(0, 100, 432)
    y[::20] = np.nan
    *_, (last,) = shuffled(plan, y)
    assert last.holds


def test_a_percentile_needs_so_many_blocks() -> None:
    claim = {"figure": "slip_duration", "statistic": "p10", "at_least": "1000 ms"}
    y = 3000.0 + np.random.default_rng(1).normal(0, 100, 36 * 36)
    *_, (last,) = shuffled(plan_of(claim, repetitions=12), y[:432])
    assert verdict_text(last) == "open: needs at least 30 blocks, and has 12"
    assert last.low is None
    *_, (last,) = shuffled(plan_of(claim, repetitions=36), y)
    assert last.holds


def test_open_claim_with_interval_beyond_its_bound_says_why() -> None:
    claim = {"figure": "slip_duration", "at_least": "2000 ms"}
    y = 3000.0 + np.random.default_rng(1).normal(0, 100, 36 * 24)
    first = next(s for (s,) in shuffled(plan_of(claim, repetitions=24), y) if s.blocks == 6)
    assert (first.holds, first.trend) == (False, None)
    assert first.low is not None
    assert first.low > 2000.0
    assert verdict_text(first) == (
        "open: the interval is beyond the bound, but a call this early takes more blocks"
    )


@pytest.mark.parametrize(("kind", "verdict"), [("at_most", "holds"), ("at_least", "refuted")])
def test_open_claim_that_its_trend_would_undo_says_so(kind: str, verdict: str) -> None:
    plan = plan_of({"figure": "slip_duration", kind: "3000 ms"}, repetitions=24)
    y = world(TrialGrid.of(plan), 1) + np.linspace(-600, 600, 36 * 24)
    (found,) = next(states for states in shuffled(plan, y) if states[0].blocks == 7)
    assert (found.holds, found.refuted, found.trend) == (False, False, verdict)
    text = f"open: {verdict} only if the trend so far does not continue to the end"
    assert verdict_text(found) == text


def test_blocks_of_some_trials_are_stated_by_the_protocol() -> None:
    claim = {"figure": "slip_duration", "at_most": "3500 ms"}
    y = 3000.0 + np.random.default_rng(1).normal(0, 100, 108)
    *_, (last,) = shuffled(plan_of(claim, repetitions=3), y)
    assert (last.blocks, last.holds) == (3, False)
    *_, (last,) = shuffled(plan_of(claim, repetitions=3, block=12), y)
    assert (last.blocks, last.holds) == (9, True)


@pytest.mark.long
@pytest.mark.parametrize(
    ("between_blocks", "campaigns", "most"),
    # 5 % are stated; more than 6 of 40, or 11 of 100, have a chance of 0.4 %
    [(25.0, 40, 6), *(pytest.param(it, 100, 11, marks=pytest.mark.long) for it in (0, 25, 100))],
)
def test_claims_that_are_just_false_are_seldom_called_true(
    between_blocks: float, campaigns: int, most: int
) -> None:
    plan = plan_of({"figure": "slip_duration", "at_least": "3000 ms"}, repetitions=12)
    grid, rng, called = TrialGrid.of(plan), np.random.default_rng(11), 0
    block = np.array([trial.repetition for trial in grid.trials]) - 1
    for _ in range(campaigns):
        y = 3000.0 - 1e-6 + rng.normal(0, 100, 432) + rng.normal(0, between_blocks, 12)[block]
        found = course(plan, grid, {"slip_duration": y})
        called += found.claims[0].state.holds
    assert called <= most


def test_chosen_trials_give_unbiased_estimates_whatever_is_expected() -> None:
    # the mean of the corrected estimates over many draws is the grid's, with wrong expectations
    plan = plan_of(WITHIN, order="adaptive")
    grid = TrialGrid.of(plan)
    rng = np.random.default_rng(2)
    y = (rng.random(len(grid.trials)) < 0.3).astype(float)
    expected = rng.random(len(grid.trials))
    chance = rng.random(len(grid.trials)) ** 2 + 0.05
    chance /= chance.sum()
    found = []
    members = np.ones(len(y), np.bool_)
    for _ in range(4000):
        k = int(rng.choice(len(y), p=chance))
        one = ClaimEvidence(grid, np.array([k]), np.array([1]), {}, chance[[k]])
        found.append(chosen_estimate(one, y[[k]], members, expected[None], expected).value)
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found) - y.mean()) < 4 * error


@pytest.mark.long
def test_adaptive_campaigns_are_right_and_take_fewer_trials() -> None:
    chosen = plan_of(WITHIN, order="adaptive", choice={"batch": 12, "start": 24})
    blocks = plan_of(WITHIN)
    order = {trial.id: k for k, trial in enumerate(TrialGrid.of(chosen).trials)}
    same = [order[trial.id] for trial in TrialGrid.of(blocks).trials]
    needed, by_blocks = [], []
    for seed in range(4):
        y = world(TrialGrid.of(chosen), seed, 400.0)
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
    y = world(TrialGrid.of(plan), 4)
    (*_, (first, _)), (*_, (second, _)) = adaptive(plan, y), adaptive(plan, y)
    assert first.taken.tolist() == second.taken.tolist()
    assert sorted(first.taken.tolist()) == list(range(72))  # all of the grid in the end


def test_the_start_spreads_over_the_grid() -> None:
    grid = TrialGrid.of(plan_of(WITHIN))
    found = spread_out(grid, np.arange(len(grid.trials)), 12, np.random.default_rng(0))
    assert len(set(found)) == 12
    assert [len(set(grid.levels[found, k])) for k in range(3)] == [3, 3, 4]
    assert len(set(grid.condition[found])) == 12


def test_trials_that_tell_of_an_open_claim_are_taken_more_often() -> None:
    between = {"factor": "depth", "levels": [2.4, 3.4]}
    claim = {"figure": "slip_duration", "between": between, "within": "1 ms"}
    plan = plan_of(claim, order="adaptive", choice={"batch": 12, "start": 12, "random": 0.2})
    grid = TrialGrid.of(plan)
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
