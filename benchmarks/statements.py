"""Statements of reports and claims, in campaigns whose truth is known: how often each is wrong.

    python -m benchmarks statements
    python -m benchmarks.statements [--campaigns 200] [--seed 1] [--cores 2]

A campaign has 24 repetitions of the pilot's 36 conditions, whose figures are drawn: effects of the
conditions, and scatter of 100 ms between trials. On top of that its blocks differ, or its trials
resemble the ones before, or drift, or lack a figure. A false claim is false by the least that there
is, and is looked at after each block; an interval is that of the whole campaign. The truth is that
of conditions repeated for ever; with a drift, that of the campaign's time. Below that the intervals
of clustered alarms and of medians over worlds (`interval_coverage`). All figures are drawn.
"""

from __future__ import annotations

import argparse
import copy
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

from benchmarks.interval_coverage import Coverage, alarm_rates, medians_by_world
from benchmarks.measure import SEED, Figures
from sliplab.analysis.claims.evidence import Grid
from sliplab.analysis.claims.simulated import course, planned_evidence
from sliplab.analysis.claims.states import states
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.protocols import Plan
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import make_plan
from sliplab.protocols.yaml_file import parse_yaml, validate

F64 = npt.NDArray[np.float64]
ROOT = Path(__file__).parents[1]
PILOT = ROOT / "protocols" / "pilot.yaml"
REPETITIONS, TRIAL_MS, CENTRE_MS = 24, 100.0, 3000.0
ERROR = 0.05


@dataclass(frozen=True)
class Kind:
    """How the trials of a campaign resemble each other, or are missing.

    Attributes:
        blocks: deviation between blocks, as a share of that between trials.
        memory: correlation of each trial with the one before.
        drift: from the first trial to the last, as a share of the deviation between trials.
        missing: share of trials without a figure. by_outcome: only the long ones lack it.
    """

    name: str
    blocks: float = 0.0
    memory: float = 0.0
    drift: float = 0.0
    missing: float = 0.0
    by_outcome: bool = False


KINDS = (
    Kind("independent"),
    Kind("blocks differ by 10 %", blocks=0.1),
    Kind("blocks differ by 25 %", blocks=0.25),
    Kind("blocks differ by 50 %", blocks=0.5),
    Kind("blocks differ by 100 %", blocks=1.0),
    Kind("AR(1) of 0.5", memory=0.5),
    Kind("AR(1) of 0.9", memory=0.9),
    Kind("drift of 100 %", drift=1.0),
    Kind("5 % missing, at random", missing=0.05),
    Kind("10 % missing, the longest", missing=0.1, by_outcome=True),
)


def plan_of(claims: Sequence[dict[str, Any]]) -> Plan:
    """Return the plan of a campaign with claims."""
    data = copy.deepcopy(parse_yaml(PILOT.read_text(), PILOT))
    data["collection"] |= {
        "repetitions": REPETITIONS, "order": "shuffled", "seed": 1,
        "stopping": {"error": ERROR, "claims": list(claims)},
    }  # fmt: skip
    return make_plan(validate(Protocol, data, PILOT), str(PILOT))


@cache
def effects() -> F64:
    """Return the effect of each condition, ms; their sum is zero."""
    found = np.random.default_rng(0).normal(0.0, TRIAL_MS, 36)
    return np.asarray(found - found.mean())


def figures(kind: Kind, grid: Grid, rng: np.random.Generator) -> F64:
    """Return a figure of each trial, ms, about its truth of `median`; NaN where it is missing."""
    count = len(grid.trials)
    noise = rng.normal(size=count)
    for k in range(1, count if kind.memory else 0):
        noise[k] = kind.memory * noise[k - 1] + np.sqrt(1.0 - kind.memory**2) * noise[k]
    noise += rng.normal(0.0, kind.blocks, REPETITIONS)[grid.repetition - 1]
    noise += kind.drift * (np.arange(count) / (count - 1) - 0.5)
    found = CENTRE_MS + effects()[grid.condition] + TRIAL_MS * noise
    lost = rng.random(count) < kind.missing
    if kind.by_outcome:
        lost = found > np.quantile(found, 1.0 - kind.missing)
    return np.asarray(np.where(lost, np.nan, found))


@cache
def truth(kind: Kind) -> float:
    """Return the median of a kind, ms, of conditions repeated for ever."""
    drift = kind.drift * np.linspace(-0.5, 0.5, 201)
    centres = CENTRE_MS + (effects()[:, None] + TRIAL_MS * drift).ravel()
    deviation = TRIAL_MS * np.sqrt(1.0 + kind.blocks**2)
    low, high = centres.min() - 5.0 * deviation, centres.max() + 5.0 * deviation
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
    """

    name: str
    figure: str
    statistic: str
    unit: str
    scale: float
    centre: float

    def of(self, ms: F64, kind: Kind) -> F64:
        """Return figures in the statement's unit, with the truth at `centre`."""
        at = truth(kind) if self.statistic == "median" else CENTRE_MS
        return self.centre + self.scale * (ms - at)


STATEMENTS = (
    Statement("median of a time", "slip_duration", "median", "ms", 1.0, 3000.0),
    Statement("mean of a share", "accuracy", "mean", "%", 0.02, 80.0),
)


def campaign(number: int, kind: Kind, seed: int) -> list[tuple[int, int, int, float, float]]:
    """Judge every statement of one campaign.

    Returns:
        Of each statement: false claims that were called true (of two), whether the interval of the
        whole holds the truth, the trials that a claim took which is true by half a deviation (0:
        not called), the interval's width, and that of a sample of independent trials.
    """
    with threadpool_limits(1):
        rng = np.random.default_rng([seed, hash_integer("kind", kind.name), number])
        found = []
        grid = Grid.of(plan_of([{"figure": "slip_duration", "within": "1 ms"}]))
        ms = figures(kind, grid, rng)
        for stated in STATEMENTS:
            values = {stated.figure: stated.of(ms, kind)}
            nudge, half = 1e-6, 0.5 * TRIAL_MS * stated.scale
            bounds = [
                ("at_least", stated.centre + nudge), ("at_most", stated.centre - nudge),
                ("at_most", stated.centre + half),
            ]  # fmt: skip
            claims: list[dict[str, Any]] = [
                {
                    "figure": stated.figure,
                    "statistic": stated.statistic,
                    side: f"{at:.6f} {stated.unit}",
                }
                for side, at in bounds
            ]
            claims.append(
                {
                    "figure": stated.figure,
                    "statistic": stated.statistic,
                    "within": f"0.000001 {stated.unit}",
                }
            )
            plan = plan_of(claims)
            went = course(plan, grid, values)
            wrong = sum(it.state.holds for it in went.claims[:2])
            late = went.claims[2]
            took = int(went.evidence.looks[late.look]) if late.look is not None else 0
            stopping = plan.protocol.collection.stopping
            assert stopping is not None
            width = states(planned_evidence(plan, grid, values), stopping)[3]
            low = -np.inf if width.low is None else width.low
            high = np.inf if width.high is None else width.high
            found.append(
                (wrong, int(low <= stated.centre <= high), took, high - low, _fixed(stated, values))
            )
        return found


def _fixed(stated: Statement, values: dict[str, F64]) -> float:
    """Return the width of the 95 % interval of as many independent trials, looked at once."""
    y = values[stated.figure]
    y = y[~np.isnan(y)]
    half = 1.96 / np.sqrt(len(y))
    if stated.statistic == "mean":
        return float(2.0 * half * y.std(ddof=1))
    low, high = np.quantile(y, [0.5 - 0.5 * half, 0.5 + 0.5 * half])
    return float(high - low)


@dataclass(frozen=True)
class Row:
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


def rows_of(campaigns: int, seed: int, cores: int) -> list[Row]:
    """Judge all kinds of campaigns."""
    rows = []
    with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
        for kind in KINDS:
            found = list(
                pool.map(partial(campaign, kind=kind, seed=seed), range(campaigns), chunksize=4)
            )
            for k, stated in enumerate(STATEMENTS):
                wrong, held, took, width, fixed = (
                    np.array(each, float) for each in zip(*(one[k] for one in found), strict=True)
                )
                rows.append(
                    Row(
                        stated.name,
                        kind.name,
                        campaigns,
                        int(wrong.sum()),
                        int(held.sum()),
                        float(np.median(np.where(took > 0, took, np.inf))),
                        float(np.median(width / fixed)),
                    )
                )
    return rows


def lines(rows: Sequence[Row]) -> list[str]:
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
    for row in rows_of(campaigns, SEED, cores):
        name = f"{row.statement}, {row.kind}"
        found[f"{name}: wrong_percent"] = 100.0 * row.wrong / (2 * row.campaigns)
        found[f"{name}: held_percent"] = 100.0 * row.held / row.campaigns
    for each in clustered(5 * campaigns):
        found[f"{each.clusters} clusters, {each.case}: held_percent"] = 100.0 * each.share
    return found


def clustered(draws: int) -> Iterator[Coverage]:
    """Yield the coverage of alarm rates and of medians over worlds."""
    yield from alarm_rates(draws, sizes=(24, 156))
    yield from medians_by_world(draws, sizes=(6, 16))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--campaigns", type=int, default=200)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--cores", type=int, default=2)
    asked = parser.parse_args()
    print("\n".join(lines(rows_of(asked.campaigns, asked.seed, asked.cores))))
    print("\n| clusters | alarms, or medians | 95 % interval holds (95 %) |\n| --- | --- | --- |")
    for each in clustered(5 * asked.campaigns):
        print(f"| {each.clusters} | {each.case} | {_share(each.held, each.draws)} |")


if __name__ == "__main__":
    main()
