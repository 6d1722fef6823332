"""Statements of reports and claims, in campaigns whose truth is known: how often each is wrong.

    python -m benchmarks statements
    python -m benchmarks.statements [--orders] [--campaigns 200] [--seed 1] [--cores 2]

A campaign has 24 repetitions of the pilot's 36 conditions, whose figures are drawn: effects of the
conditions, and scatter of 100 ms between trials. On top of that its blocks differ, or its trials
resemble the ones before, or drift, or lack a figure. A false claim is false by the least that there
is, and is looked at after each block; an interval is that of the whole campaign. The truth is that
of conditions repeated for ever; with a drift, that of the campaign's time. Below that the orders
of trials are compared in campaigns of the same worlds and of the same truth: of 12 repetitions, at
most 288 trials are taken, with blocks and batches of 12. Last, the intervals of clustered alarms
and of medians over worlds (`interval_coverage`). All figures are drawn.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import norm
from threadpoolctl import threadpool_limits

from benchmarks.interval_coverage import IntervalCoverage, alarm_rates, medians_by_world
from benchmarks.measure import SEED, Figures
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.plugins.claims.evidence import TrialGrid
from sliplab.plugins.claims.simulated import course
from sliplab.protocols import Plan
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import make_plan
from sliplab.protocols.yaml_file import parse_yaml, validate

F64 = npt.NDArray[np.float64]
ROOT = Path(__file__).parents[1]
PILOT = ROOT / "protocols" / "pilot.yaml"
TRIAL_MS, CENTRE_MS = 100.0, 3000.0
ERROR = 0.05
GRID = 3, 3, 4
"""Levels of depth, speed and direction."""


@dataclass(frozen=True)
class CampaignKind:
    """How the trials of a campaign resemble each other, or are missing.

    Attributes:
        blocks: deviation between blocks, as a share of that between trials.
        memory: correlation of each trial with the one before.
        drift: from the first trial to the last, as a share of the deviation between trials.
        missing: share of trials without a figure. by_outcome: only the long ones lack it.
        uneven: deviation between trials at the fastest speed, of that at the others.
        by_factor: effects of conditions are sums over the factors' levels.
    """

    name: str
    blocks: float = 0.0
    memory: float = 0.0
    drift: float = 0.0
    missing: float = 0.0
    by_outcome: bool = False
    uneven: float = 1.0
    by_factor: bool = False


@dataclass(frozen=True)
class Design:
    """How campaigns are planned.

    Attributes:
        block: trials in a row that resemble each other; None: those of a repetition.
        most: trials; None: all.
    """

    order: str = "shuffled"
    repetitions: int = 24
    block: int | None = None
    most: int | None = None

    def plan(self, claims: Sequence[dict[str, Any]], seed: int = 1) -> Plan:
        """Return the plan of a campaign with claims."""
        data = parse_yaml(PILOT.read_text(), PILOT)
        stopping: dict[str, Any] = {"error": ERROR, "claims": list(claims)}
        collection = {"repetitions": self.repetitions, "order": self.order, "seed": seed}
        if self.most is not None:
            stopping["most"] = self.most
        if self.order == "adaptive":
            collection["choice"] = {"batch": self.block}
        elif self.block is not None:
            stopping["block"] = self.block
        data["collection"] |= collection | {"stopping": stopping}
        return make_plan(validate(Protocol, data, PILOT), str(PILOT))


PLANNED = Design()
COMPARED = tuple(Design(order, 12, 12, 288) for order in ("shuffled", "adaptive"))

KINDS = (
    CampaignKind("independent"),
    CampaignKind("blocks differ by 10 %", blocks=0.1),
    CampaignKind("blocks differ by 25 %", blocks=0.25),
    CampaignKind("blocks differ by 50 %", blocks=0.5),
    CampaignKind("blocks differ by 100 %", blocks=1.0),
    CampaignKind("AR(1) of 0.5", memory=0.5),
    CampaignKind("AR(1) of 0.9", memory=0.9),
    CampaignKind("drift of 100 %", drift=1.0),
    CampaignKind("5 % missing, at random", missing=0.05),
    CampaignKind("10 % missing, the longest", missing=0.1, by_outcome=True),
)


COMPARED_KINDS = (
    KINDS[0],
    CampaignKind("effects by factor", by_factor=True),
    CampaignKind("scatter of 300 % at one of three speeds", uneven=3.0, by_factor=True),
    *(kind for kind in KINDS if kind.blocks == 0.5 or kind.drift or kind.missing == 0.05),
)


@cache
def effects(by_factor: bool = False) -> F64:
    """Return the effect of each condition, ms; their sum is zero."""
    rng = np.random.default_rng(0)
    if by_factor:
        sides = (rng.normal(0.0, TRIAL_MS / np.sqrt(3.0), n) for n in GRID)
        found = sum(np.meshgrid(*sides, indexing="ij")).ravel()  # type: ignore[union-attr]
    else:
        found = rng.normal(0.0, TRIAL_MS, int(np.prod(GRID)))
    return np.asarray(found - found.mean())


def deviations(kind: CampaignKind) -> F64:
    """Return the deviation between trials of each condition, of `TRIAL_MS`."""
    found = np.ones(GRID)
    found[:, -1] = kind.uneven
    return found.ravel()


def figures(
    kind: CampaignKind, design: Design, grid: TrialGrid, rng: np.random.Generator
) -> tuple[F64, F64]:
    """Return a figure of each trial, ms, NaN where it is missing; and what time adds to each."""
    count = len(grid.trials)
    noise = rng.normal(size=count)
    for k in range(1, count if kind.memory else 0):
        noise[k] = kind.memory * noise[k - 1] + np.sqrt(1.0 - kind.memory**2) * noise[k]
    place, block = np.arange(count), design.block or int(np.prod(GRID))
    shared = rng.normal(0.0, kind.blocks, count // block)[place // block]
    shared += kind.drift * (place / ((design.most or count) - 1) - 0.5)
    found = CENTRE_MS + effects(kind.by_factor)[grid.condition]
    found = found + TRIAL_MS * noise * deviations(kind)[grid.condition]
    lost = rng.random(count) < kind.missing
    if kind.by_outcome:
        lost = found > np.quantile(found, 1.0 - kind.missing)
    return np.asarray(np.where(lost, np.nan, found)), TRIAL_MS * shared


@cache
def truth(kind: CampaignKind) -> float:
    """Return the median of a kind, ms, of conditions repeated for ever."""
    centres = CENTRE_MS + effects(kind.by_factor)[:, None]
    centres = centres + TRIAL_MS * kind.drift * np.linspace(-0.5, 0.5, 201)
    deviation = TRIAL_MS * np.hypot(deviations(kind), kind.blocks)[:, None]
    low, high = centres.min() - 5.0 * deviation.max(), centres.max() + 5.0 * deviation.max()
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = float(norm.cdf((middle - centres) / deviation).mean())
        low, high = (middle, high) if below < 0.5 else (low, middle)
    return float(low)


@dataclass(frozen=True)
class Statement:
    """What is stated of a campaign.

    Attributes:
        figure, statistic: of the claim. scale, centre: of a figure in ms about its truth.
        between: two speeds, of which the second's statistic less the first's is stated.
    """

    name: str
    figure: str
    statistic: str
    unit: str
    scale: float
    centre: float
    between: tuple[float, ...] = ()

    def of(self, ms: F64, kind: CampaignKind) -> F64:
        """Return figures in the statement's unit, with the truth of all at `centre`."""
        at = truth(kind) if self.statistic == "median" else CENTRE_MS
        return self.centre + self.scale * (ms - at)

    def true(self, kind: CampaignKind) -> float:
        """Return the true value; a difference's is positive."""
        return self.scale * _slope(kind) if self.between else self.centre

    def claims(self, kind: CampaignKind) -> list[dict[str, Any]]:
        """Return two claims that are false by the least, a true one, and one of a width."""
        true, nudge, half = self.true(kind), 1e-6, 0.5 * TRIAL_MS * self.scale
        of: dict[str, Any] = {"figure": self.figure, "statistic": self.statistic}
        if self.between:
            of["between"] = {"factor": "speed", "levels": list(self.between)}
        bounds = [
            ("at_least", true + nudge),
            ("at_most", true - nudge),
            ("at_most", true + half),
            ("within", nudge),
        ]
        return [{**of, side: f"{at:.6f} {self.unit}"} for side, at in bounds]


def _slope(kind: CampaignKind) -> float:
    """Return the effect of the fastest speed less that of the slowest, ms."""
    of_speed = effects(kind.by_factor).reshape(GRID).mean(axis=(0, 2))
    return float(of_speed[-1] - of_speed[0])


STATEMENTS = (
    Statement("median of a time", "slip_duration", "median", "ms", 1.0, 3000.0),
    Statement("mean of a share", "accuracy", "mean", "%", 0.02, 80.0),
)
DIFFERENCE = Statement(
    "difference of two speeds' shares", "accuracy", "mean", "%", 0.02, 80.0, (0.6, 1.6)
)


def campaign(
    number: int, kind: CampaignKind, design: Design, stated: Statement, seed: int
) -> tuple[int, int, int, float, float]:
    """Judge a statement of one campaign.

    Returns:
        False claims that were called true (of two), whether the interval of the whole holds the
        truth, the trials that were taken until a claim was called which is true by half a deviation
        (0: not called), the interval's width, and that of a sample of independent trials.
    """
    with threadpool_limits(1):
        rng = np.random.default_rng([seed, hash_integer("kind", kind.name), number])
        plan = design.plan(stated.claims(kind), 1 if design == PLANNED else number + 1)
        grid = TrialGrid.of(plan)
        ms, over_time = figures(kind, design, grid, rng)
        values = {stated.figure: stated.of(ms, kind)}
        went = course(plan, grid, values, {stated.figure: stated.scale * over_time})
        wrong = sum(it.state.holds for it in went.claims[:2])
        late, width = went.claims[2], went.claims[3].state
        looks, took = went.evidence.looks, 0
        if late.look is not None:  # an adaptive campaign takes a batch while the last is judged
            took = int(looks[min(late.look + (design.order == "adaptive"), len(looks) - 1)])
        low = -np.inf if width.low is None else width.low
        high = np.inf if width.high is None else width.high
        holds = int(low <= stated.true(kind) <= high)
        y = went.evidence.values[stated.figure]
        return wrong, holds, took, high - low, _fixed(stated, y)


def _fixed(stated: Statement, y: F64) -> float:
    """Return the width of the 95 % interval of as many independent trials, looked at once."""
    y = y[~np.isnan(y)]
    half = 1.96 / np.sqrt(len(y))
    if stated.between:  # each mean is that of a third of the trials
        half *= np.sqrt(6.0)
    if stated.statistic == "mean":
        return float(2.0 * half * y.std(ddof=1))
    low, high = np.quantile(y, [0.5 - 0.5 * half, 0.5 + 0.5 * half])
    return float(high - low)


@dataclass(frozen=True)
class StatementRow:
    """A statement in campaigns of a kind.

    Attributes:
        wrong: false claims called true, of two in each campaign. held: intervals with the truth.
        trials: median that a true claim took; 0: not called. wider: median ratio of the width to
            that of independent trials looked at once.
    """

    statement: str
    kind: str
    campaigns: int
    wrong: int
    held: int
    trials: float
    wider: float


def planned_rows(campaigns: int, seed: int, cores: int) -> list[StatementRow]:
    """Judge all kinds of campaigns in the plan's order."""
    cases = [(kind, PLANNED, stated) for kind in KINDS for stated in STATEMENTS]
    return _rows(cases, campaigns, seed, cores)


def compared_rows(campaigns: int, seed: int, cores: int) -> list[StatementRow]:
    """Judge campaigns of both orders in the same worlds."""
    stated = [(kind, each) for kind in COMPARED_KINDS for each in STATEMENTS]
    stated.append((KINDS[0], DIFFERENCE))
    cases = [(kind, design, each) for kind, each in stated for design in COMPARED]
    return _rows(cases, campaigns, seed, cores)


def _rows(
    cases: Sequence[tuple[CampaignKind, Design, Statement]], campaigns: int, seed: int, cores: int
) -> list[StatementRow]:
    rows = []
    with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
        for kind, design, stated in cases:
            one = partial(campaign, kind=kind, design=design, stated=stated, seed=seed)
            wrong, held, took, width, fixed = np.array(
                list(pool.map(one, range(campaigns), chunksize=4)), np.float64
            ).T
            rows.append(
                StatementRow(
                    stated.name,
                    kind.name if design == PLANNED else f"{kind.name}; {design.order}",
                    campaigns,
                    int(wrong.sum()),
                    int(held.sum()),
                    float(np.median(np.where(took > 0, took, np.inf))),
                    float(np.median(width / fixed)),
                )
            )
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def lines(rows: Sequence[StatementRow]) -> list[str]:
    """Return a table in Markdown."""
    made = [
        "| statement | trials | false claims called (95 %) | 95 % interval holds (95 %) "
        "| trials until a true claim | width |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        trials = "open at the end" if np.isinf(row.trials) else f"{row.trials:.0f}"
        wider = "no bound" if np.isinf(row.wider) else f"{row.wider:.2f}"
        made.append(
            f"| {row.statement} | {row.kind} | {_share(row.wrong, 2 * row.campaigns)} "
            f"| {_share(row.held, row.campaigns)} | {trials} | {wider} |"
        )
    return made


def _share(count: int, of: int) -> str:
    low, high = exact_interval(count, of)
    return f"{100.0 * count / of:.1f} % ({100.0 * low:.1f} to {100.0 * high:.1f})"


def measure(campaigns: int = 200, cores: int = 2) -> Figures:
    """Return the rates of every statement in every kind of campaign, percent."""
    found: Figures = {}
    planned = planned_rows(campaigns, SEED, cores)
    for row in (*planned, *compared_rows(campaigns, SEED, cores)):
        name = f"{row.statement}, {row.kind}"
        found[f"{name}: wrong_percent"] = 100.0 * row.wrong / (2 * row.campaigns)
        found[f"{name}: held_percent"] = 100.0 * row.held / row.campaigns
    for each in clustered(5 * campaigns):
        found[f"{each.clusters} clusters, {each.case}: held_percent"] = 100.0 * each.share
    return found


def clustered(draws: int) -> Iterator[IntervalCoverage]:
    """Yield the coverage of alarm rates and of medians over worlds."""
    yield from alarm_rates(draws, sizes=(24, 156))
    yield from medians_by_world(draws, sizes=(6, 16))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--campaigns", type=int, default=200)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--orders", action="store_true", help="compare the orders alone")
    asked = parser.parse_args()
    if not asked.orders:
        print("\n".join(lines(planned_rows(asked.campaigns, asked.seed, asked.cores))))
    print("\n".join(lines(compared_rows(asked.campaigns, asked.seed, asked.cores))))
    if asked.orders:
        return
    print("\n| clusters | alarms, or medians | 95 % interval holds (95 %) |\n| --- | --- | --- |")
    for each in clustered(5 * asked.campaigns):
        print(f"| {each.clusters} | {each.case} | {_share(each.held, each.draws)} |")


if __name__ == "__main__":
    main()
