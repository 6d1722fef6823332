"""Numbers of trials that claims need, as a pilot lets expect, against campaigns that were taken."""

from __future__ import annotations

import copy
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.claims.blocks import F64
from sliplab.plugins.claims.document import ClaimState
from sliplab.plugins.claims.evidence import TrialGrid
from sliplab.plugins.claims.power.document import ClaimPower
from sliplab.plugins.claims.power.drawing import (
    CampaignDraw,
    Drawing,
    claim_powers,
    more_trials,
    spread,
)
from sliplab.plugins.claims.power.resampling import (
    ASSUMED,
    PilotFigures,
    Sessions,
    SharedFactor,
    sessions_text,
    shared_axes,
)
from sliplab.plugins.claims.simulated import claims_of, course
from sliplab.protocols import Plan
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import make_plan
from sliplab.protocols.yaml_file import validate
from tests.conftest import SMALL

DEPTHS = (Decimal("2.4"), Decimal("2.8"), Decimal("3.4"))
MEDIAN = {"figure": "first_slip", "within": "50 ms"}


def plan_of(claims: list[dict[str, Any]], repetitions: int = 60, **collection: Any) -> Plan:
    """Three depths, nothing else varied."""
    data = copy.deepcopy(SMALL)
    data["collection"]["factors"] = {
        "depth": {"unit": "mm", "values": [Decimal("2.4"), Decimal("2.8"), Decimal("3.4")]},
        "speed": {"unit": "mm/s", "values": [1]},
        "direction": {"unit": "deg", "values": [0]},
    }
    stopping = {"claims": claims, **collection.pop("stopping", {})}
    data["collection"] |= {"repetitions": repetitions, "stopping": stopping, **collection}
    return make_plan(validate(Protocol, data, "p.yaml"), "p.yaml")


def pilot_of(plan: Plan, depths: list[Decimal], values: dict[str, F64]) -> PilotFigures:
    """Trials at these depths, all in one block."""
    conditions = [{"depth": depth} for depth in depths]
    axes, _ = shared_axes(plan, conditions)
    return PilotFigures(axes, tuple(conditions), np.zeros(len(depths), np.int64), values)


def normal_pilot(plan: Plan, count: int, seed: int, deviation: float = 200.0) -> PilotFigures:
    """First slips of normal distribution around 1 s, the same at all depths."""
    values = np.random.default_rng(seed).normal(1000.0, deviation, count)
    return pilot_of(plan, [DEPTHS[k % 3] for k in range(count)], {"first_slip": values})


def power_of(plan: Plan, pilot: PilotFigures, campaigns: int = 20) -> tuple[ClaimPower, ...]:
    """Draw campaigns."""
    drawing = Drawing(plan, pilot, 1)
    return claim_powers(drawing, [drawing.campaign(k) for k in range(campaigns)])


@pytest.mark.long
def test_normal_figures_take_as_many_trials_as_foretold() -> None:
    """The real procedure on fresh data of 20 worlds, each foretold by a pilot of 36 trials.

    Campaigns of one and the same world differ by a factor of 1.3 in their trials themselves.
    """
    plan = plan_of([{"figure": "first_slip", "within": "80 ms"}], repetitions=120)
    grid = TrialGrid.of(plan)
    ratios, inside = [], 0
    for world in range(20):
        deviation = 150.0 + 5.0 * world
        (found,) = power_of(plan, normal_pilot(plan, 36, world, deviation), 10)
        fresh = np.random.default_rng([7, world]).normal(1000.0, deviation, len(grid.trials))
        taken = course(plan, grid, {"first_slip": fresh}).ended
        low, median, high = found.trials.low, found.trials.median, found.trials.high
        assert None not in (taken, low, median, high)
        ratios.append(median / taken)  # type: ignore[operator]
        inside += low <= taken <= high  # type: ignore[operator]
    assert 1 / 1.3 < np.median(ratios) < 1.3
    assert inside >= 12


@pytest.mark.long
def test_a_claim_that_is_certain_needs_few_trials() -> None:
    plan = plan_of([{"figure": "first_slip", "statistic": "p90", "at_most": "5 s"}])
    (found,) = power_of(plan, normal_pilot(plan, 36, 1))
    assert found.holds == 1.0
    assert found.trials.high is not None
    assert 90 < found.trials.high < 150  # a tenth of the trials is seen in 30 blocks of three
    assert found.repetitions is None


def test_a_claim_that_is_false_is_refuted() -> None:
    plan = plan_of([{"figure": "first_slip", "at_least": "1.3 s"}])
    (found,) = power_of(plan, normal_pilot(plan, 36, 1))
    assert found.refuted == 1.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("within", "repetitions", "campaigns"),
    [("50 ms", 12, 6), pytest.param("20 ms", 60, 20, marks=pytest.mark.long)],
)
def test_a_claim_that_the_plan_cannot_have_says_how_many_repetitions_would(
    within: str, repetitions: int, campaigns: int
) -> None:
    """Of normal figures a median known to 20 ms takes more than 180 trials, to 50 ms than 36."""
    claim = {"figure": "first_slip", "within": within}
    plan = plan_of([claim], repetitions)
    pilot = normal_pilot(plan, 60, 3)
    (found,) = power_of(plan, pilot, campaigns)
    assert found.never == 1.0
    assert found.trials.median is None
    assert found.repetitions is not None
    (enough,) = power_of(plan_of([claim], repetitions=2 * found.repetitions), pilot, 6)
    assert enough.trials.median is not None
    assert 0.4 < enough.trials.median / (3 * found.repetitions) < 2.5


def test_an_estimate_at_what_is_claimed_is_never_called() -> None:
    plan = plan_of([{"figure": "first_slip", "at_least": "1 s"}])
    claim = claims_of(plan).claims[0]
    at = ClaimState(
        claim="",
        kind="at_least",
        value=1000.0,
        unit="ms",
        trials=9,
        estimate=1000.0,
        low=900.0,
        high=1100.0,
        holds=False,
        refuted=False,
    )
    assert more_trials(claim, at) == np.inf
    half = at.model_copy(update={"estimate": 1050.0, "low": 950.0})
    assert more_trials(claim, half) == pytest.approx(4.0)
    assert more_trials(claim, at.model_copy(update={"low": None})) == np.inf


@pytest.mark.long
def test_undetected_trials_come_as_often_as_in_the_pilot() -> None:
    """At one depth nothing is detected in half of the trials; a sixth of the campaign's then."""
    plan = plan_of([{"figure": "latency_gross", "at_most": "100 ms"}])
    depths = [DEPTHS[k % 3] for k in range(60)]
    values = np.random.default_rng(1).normal(40.0, 10.0, 60)
    values[2::6] = np.inf
    values[0] = np.nan
    pilot = pilot_of(plan, depths, {"latency_gross": values})
    grid = TrialGrid.of(plan)
    drawn = [pilot.campaign(grid, np.random.default_rng(k))["latency_gross"] for k in range(20)]
    deepest = np.array([dict(trial.condition)["depth"] == DEPTHS[2] for trial in grid.trials])
    share = np.mean([np.isinf(each[deepest]).mean() for each in drawn])
    assert share == pytest.approx(0.5, abs=0.08)
    assert not any(np.isinf(each[~deepest]).any() for each in drawn)
    missing = np.mean([np.isnan(each).mean() for each in drawn])
    assert missing == pytest.approx(1 / 60, abs=0.01)
    (found,) = power_of(plan, pilot)
    assert found.holds > 0.9
    (against,) = power_of(
        plan_of([{"figure": "latency_gross", "statistic": "p90", "at_most": "100 ms"}]), pilot
    )
    assert against.holds == 0.0


def test_effects_of_factors_and_of_blocks_are_kept() -> None:
    plan = plan_of([MEDIAN])
    rng = np.random.default_rng(2)
    depths = [DEPTHS[k % 3] for k in range(120)]
    blocks = np.arange(120) // 6
    of_block = rng.normal(0.0, 100.0, 20)[blocks]
    values = 300.0 * (np.arange(120) % 3) + of_block + rng.normal(0.0, 30.0, 120)
    pilot = PilotFigures(
        pilot_of(plan, depths, {}).axes,
        tuple({"depth": depth} for depth in depths),
        blocks,
        {"first_slip": values},
    )
    grid = TrialGrid.of(plan)
    drawn = np.array(
        [pilot.campaign(grid, np.random.default_rng(k))["first_slip"] for k in range(30)]
    )
    by_depth = [
        drawn[:, [dict(trial.condition)["depth"] == depth for trial in grid.trials]].mean()
        for depth in DEPTHS
    ]
    assert np.diff(by_depth) == pytest.approx([300.0, 300.0], abs=40.0)
    within = drawn.reshape(30, 60, 3).mean(axis=2).std(axis=1)
    assert within.mean() == pytest.approx(100.0, rel=0.3)


def test_levels_between_are_said_and_those_outside_are_refused() -> None:
    plan = plan_of([MEDIAN])
    few: list[dict[str, Any]] = [{"depth": DEPTHS[0]}, {"depth": DEPTHS[2]}]
    axes, notes = shared_axes(plan, few)
    assert any("lacks depth 2.8 mm" in note for note in notes)
    (depth,) = axes
    assert depth.weights(DEPTHS[1], np.random.default_rng(0)) == pytest.approx([0.6, 0.4])
    outside: list[dict[str, Any]] = [{"depth": DEPTHS[0]}, {"depth": DEPTHS[1]}]
    with pytest.raises(
        KeyedError, match=r"outside of the pilot's levels, 2\.4 mm, 2\.8 mm"
    ) as error:
        shared_axes(plan, outside)
    assert (error.value.key, error.value.value) == ("collection.factors.depth", "3.4 mm")


def test_directions_go_round() -> None:
    axis = SharedFactor("direction", tuple(map(Decimal, (0, 90, 180, 270))), turns=True)
    rng = np.random.default_rng(0)
    assert axis.knows(Decimal(315))
    assert axis.weights(Decimal(315), rng) == pytest.approx([0.5, 0, 0, 0.5])
    assert axis.weights(Decimal(-30), rng) == pytest.approx([2 / 3, 0, 0, 1 / 3])
    assert not SharedFactor("twist", axis.levels).knows(Decimal(315))


def test_words_that_the_pilot_lacks_are_taken_for_one_of_its_own() -> None:
    axis = SharedFactor("skin", ("a", "b"))
    rng = np.random.default_rng(0)
    drawn = np.array([axis.weights("c", rng) for _ in range(200)])
    assert set(map(tuple, drawn)) == {(1.0, 0.0), (0.0, 1.0)}
    assert drawn.mean(axis=0) == pytest.approx([0.5, 0.5], abs=0.1)


def test_a_number_of_trials_that_few_campaigns_reach() -> None:
    assert spread([30, None, 10, 20, None]).median == 30
    assert spread([30, None, 10, None, None]).median is None


def test_an_adaptive_campaign_takes_one_more_round_than_it_needs() -> None:
    plan = plan_of([MEDIAN], order="adaptive", choice={"batch": 15, "start": 30})
    grid = TrialGrid.of(plan)
    values = {"first_slip": np.random.default_rng(1).normal(1000.0, 120.0, len(grid.trials))}
    found = course(plan, grid, values)
    (claim,) = found.claims
    assert claim.look is not None
    assert found.ended == found.evidence.looks[claim.look] + 15


def test_least_and_most_bound_a_campaign() -> None:
    certain = {"figure": "first_slip", "at_most": "9 s"}
    grid = TrialGrid.of(plan := plan_of([certain], stopping={"least": 100}))
    values = {"first_slip": np.random.default_rng(1).normal(1000.0, 120.0, len(grid.trials))}
    assert course(plan, grid, values).ended == 102
    short = plan_of([MEDIAN], stopping={"most": 20})
    found = course(short, grid, values)
    assert (found.ended, len(found.evidence.taken)) == (None, 18)


def pilot_of_sessions(plan: Plan, away: float) -> PilotFigures:
    """Six sessions of four blocks of six trials, by turns above and below 1 s; scatter 100 ms."""
    sessions = np.arange(144) // 24
    values = 1000.0 + np.random.default_rng(4).normal(0.0, 100.0, 144)
    values += away * (-1.0) ** sessions
    found = pilot_of(plan, [DEPTHS[k % 3] for k in range(144)], {"first_slip": values})
    return replace(found, blocks=np.arange(144) // 6, sessions=sessions)


def drawn(
    plan: Plan, pilot: PilotFigures, sessions: Sessions, campaigns: int = 3
) -> list[CampaignDraw]:
    """Draw campaigns."""
    drawing = Drawing(plan, pilot, 1, sessions)
    return [drawing.campaign(k) for k in range(campaigns)]


def median_trials(campaigns: list[CampaignDraw]) -> float:
    """Median of the trials after which the first claim is called; infinite for never."""
    return float(np.median([it.called[0] or np.inf for it in campaigns]))


@pytest.mark.long
@pytest.mark.parametrize("campaigns", [3, pytest.param(10, marks=pytest.mark.long)])
def test_sessions_that_differ_need_more_trials(campaigns: int) -> None:
    plan = plan_of([{"figure": "first_slip", "within": "80 ms"}], repetitions=120)
    pilot = normal_pilot(plan, 36, 1)
    alike = drawn(plan, pilot, Sessions(), campaigns)
    apart = drawn(plan, pilot, Sessions(6, 1.0), campaigns)
    assert median_trials(apart) > 1.2 * median_trials(alike)
    assert drawn(plan, pilot, Sessions(6, 1.0), 1) == apart[:1]


@pytest.mark.quick(1)
@pytest.mark.parametrize("collection", [{}, {"order": "adaptive"}])
def test_sessions_without_differences_and_drift_change_nothing(collection: dict[str, Any]) -> None:
    plan = plan_of([MEDIAN], repetitions=20, **collection)
    for pilot in (normal_pilot(plan, 36, 1), pilot_of_sessions(plan, 100.0)):
        alike = drawn(plan, pilot, Sessions())
        assert drawn(plan, pilot, Sessions(1, 0.0, 0.0)) == alike
        if not collection:
            rng = np.random.default_rng([1, 0])
            values = pilot.campaign(TrialGrid.of(plan), rng)
            none = course(plan, TrialGrid.of(plan), values)
            assert alike[0].states == tuple(it.state for it in none.claims)
            assert drawn(plan, pilot, Sessions(4, 0.0)) == alike


def test_a_pilot_of_sessions_shows_how_they_differ() -> None:
    plan = plan_of([MEDIAN])
    unknown, given = Sessions(6), Sessions(6, 0.7)
    assert pilot_of_sessions(plan, 200.0).between("first_slip", unknown) == pytest.approx(
        2.2, rel=0.2
    )
    assert pilot_of_sessions(plan, 0.0).between("first_slip", unknown) < 0.3
    assert pilot_of_sessions(plan, 200.0).between("first_slip", given) == 0.7
    assert normal_pilot(plan, 36, 1).between("first_slip", unknown) == ASSUMED


def test_sessions_and_a_drift_are_drawn_in_the_order_of_trials() -> None:
    plan = plan_of([MEDIAN], stopping={"most": 90})
    grid, pilot = TrialGrid.of(plan), pilot_of_sessions(plan, 150.0)
    found = np.array(
        [
            pilot.over_time(plan, grid, Sessions(3), np.random.default_rng(k))["first_slip"][:90]
            for k in range(200)
        ]
    )
    of_session = found.reshape(200, 3, 30)
    assert np.ptp(of_session, axis=2).max() == 0.0
    size = pilot.between("first_slip", Sessions(3)) * pilot.scatter("first_slip")
    assert of_session[:, :, 0].std() == pytest.approx(size, rel=0.1)
    drift = pilot.over_time(plan, grid, Sessions(drift=2.0), np.random.default_rng(1))["first_slip"]
    assert abs(drift[89] - drift[0]) == pytest.approx(2.0 * pilot.scatter("first_slip"))


def test_differences_between_a_pilots_sessions_are_not_drawn_twice() -> None:
    """The pilot's trials scatter by 100 ms once sessions of their own are drawn."""
    plan = plan_of([MEDIAN])
    pilot = pilot_of_sessions(plan, 200.0)
    rest = pilot.without(Sessions(4))
    assert np.std(rest.values["first_slip"]) == pytest.approx(100.0, rel=0.15)
    assert np.std(pilot.values["first_slip"]) > 150.0
    assert pilot.without(Sessions(1)) is pilot


def test_batches_are_the_blocks_of_an_adaptive_campaign() -> None:
    plan = plan_of([MEDIAN], order="adaptive", choice={"batch": 15, "start": 30})
    rng = np.random.default_rng(2)
    blocks = np.arange(120) // 6
    values = rng.normal(0.0, 100.0, 20)[blocks] + rng.normal(0.0, 30.0, 120)
    depths = [DEPTHS[k % 3] for k in range(120)]
    pilot = replace(pilot_of(plan, depths, {"first_slip": values}), blocks=blocks)
    grid = TrialGrid.of(plan)
    added = pilot.over_time(plan, grid, Sessions(), np.random.default_rng(1))["first_slip"]
    assert np.flatnonzero(np.diff(added)).tolist() == [29 + 15 * k for k in range(10)]
    many = [pilot.over_time(plan, grid, Sessions(), np.random.default_rng(k)) for k in range(50)]
    assert np.std([each["first_slip"][::15] for each in many]) == pytest.approx(100.0, rel=0.2)


def test_what_is_drawn_and_what_a_pilot_of_one_session_cannot_show_is_stated() -> None:
    plan = plan_of([MEDIAN])
    one, many = normal_pilot(plan, 36, 1), pilot_of_sessions(plan, 100.0)
    cannot = "a pilot of one session cannot show how sessions differ"
    assert list(sessions_text(one, Sessions())) == [
        f"one session is drawn (see --sessions): {cannot}",
        "no drift is drawn (see --drift)",
    ]
    found, drift = sessions_text(one, Sessions(4, drift=0.5))
    assert found.startswith("4 sessions are drawn, which differ by 0.30 (first_slip)")
    assert found.endswith(f"which is assumed: {cannot}")
    assert drift.startswith("a drift of 0.5 of the scatter")
    assert "one session is drawn (see --sessions): the pilot's 6" in next(
        sessions_text(many, Sessions())
    )
    assert next(sessions_text(many, Sessions(2))).endswith("as the pilot's 6 do")
