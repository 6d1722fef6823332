"""Campaigns that end by their claims: how often they are wrong, and how many trials they take.

    python -m benchmarks fewer
    python -m benchmarks.fewer [--worlds 200] [--adaptive 200] [--seed 1] [--cores 2]

A world is the simulated rig `rehearsal` with its parameters drawn 30 % around the defaults and
another skin; the contact alone is simulated, so that all 864 slides of the kinematic grid take a
fraction of a second. Figures are the physical ones: the first slip of any tip, and the time from
there to the centre's. Every world has the same claims, stated around its own truth, that of the
grid taken five times, whichever the order. A false one is false by the least that there is: a bound
at the truth itself.

Campaigns look after every block of `order: shuffled` (288 trials), or after every batch of
`order: adaptive`. All figures are simulated.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from benchmarks.measure import SEED, Figures
from benchmarks.one_slide import run_slide
from benchmarks.twin import CLEAN, pilot_slides, prior_of
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.plugins.claims.document import ClaimState
from sliplab.plugins.claims.evidence import TrialGrid
from sliplab.plugins.claims.simulated import course
from sliplab.plugins.simulation.physics import springs_of
from sliplab.plugins.simulation.settings import MockSettings, scene_of, skin_of
from sliplab.protocols import Plan
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import make_plan
from sliplab.protocols.yaml_file import parse_yaml, validate

F64 = npt.NDArray[np.float64]
ROOT = Path(__file__).parents[1]
ERROR = 0.05
TIMES = 5
"""Grids of which the truth is the figure."""
ORDERS = ("shuffled", "adaptive")
TRIALS, BATCH, BLOCK = 864, 24, 12
"""Of the grid, of a batch, and of a block: the slides of a world share nothing."""


@dataclass(frozen=True)
class Stated:
    """A claim around the truth.

    Attributes:
        share: the value as a share of the true one. true: whether the claim is.
    """

    name: str
    figure: str
    statistic: str
    kind: str
    share: float
    true: bool
    between: tuple[str, float, float] | None = None


CLAIMS = (
    Stated("median duration known to 5 %", "slip_duration", "median", "within", 0.05, True),
    Stated("median first slip known to 5 %", "first_slip", "median", "within", 0.05, True),
    Stated("p05 of duration at least 80 % of it", "slip_duration", "p05", "at_least", 0.8, True),
    Stated("p05 of duration at least itself", "slip_duration", "p05", "at_least", 1.0, False),
    Stated("median duration at most itself", "slip_duration", "median", "at_most", 1.0, False),
    Stated("p90 of first slip at most itself", "first_slip", "p90", "at_most", 1.0, False),
    Stated(
        "duration differs by half, slow and fast",
        "slip_duration",
        "median",
        "at_least",
        0.5,
        True,
        ("speed", 0.6, 1.6),
    ),
    Stated(
        "duration differs by all, slow and fast",
        "slip_duration",
        "median",
        "at_least",
        1.0,
        False,
        ("speed", 0.6, 1.6),
    ),
)
QUANTILES = {"median": 0.5, "p05": 0.05, "p90": 0.9}


def world(number: int, seed: int) -> MockSettings:
    """Return the settings of a simulated rig."""
    return scene_of(prior_of(CLEAN, seed).world(number, pilot_slides()).rig)


def figures(settings: MockSettings, grid: TrialGrid, times: int) -> dict[str, F64]:
    """Return what slides show, (times, N) by figure, ms; infinite where the centre never slips."""
    skin = skin_of(settings)
    found = {name: np.empty((times, len(grid.trials))) for name in ("first_slip", "slip_duration")}
    for time in range(times):
        for k, trial in enumerate(grid.trials):
            levels = {name: float(level) for name, level in trial.condition}
            springs = springs_of(settings, skin, hash_integer(trial.seed, time))
            slips = run_slide(springs, levels["depth"], levels["speed"], levels["direction"])
            first = 1000.0 * float(np.nanmin(slips.slipped_s))
            centre = 1000.0 * float(slips.slipped_s[0])
            found["first_slip"][time, k] = first
            found["slip_duration"][time, k] = np.inf if np.isnan(centre) else centre - first
    return found


def quantile(values: F64, share: float) -> float:
    """Return the smallest value that at least a share of values does not exceed."""
    ordered = np.sort(values, axis=None)
    return float(ordered[max(int(np.ceil(share * len(ordered) - 1e-9)) - 1, 0)])


def truth(stated: Stated, values: F64, grid: TrialGrid) -> float:
    """Return the true figure of a claim, ms."""
    share = QUANTILES[stated.statistic]
    if stated.between is None:
        return quantile(values, share)
    name, *levels = stated.between
    of = np.array([float(dict(trial.condition)[name]) for trial in grid.trials])
    first, second = (quantile(values[:, of == level], share) for level in levels)
    return abs(second - first)


def claim_of(stated: Stated, true: float) -> dict[str, Any]:
    """Return a claim as a protocol has it; a false one by the least that there is."""
    nudge = {True: 0.0, False: 1e-3 if stated.kind == "at_least" else -1e-3}[stated.true]
    made: dict[str, Any] = {
        "figure": stated.figure,
        "statistic": stated.statistic,
        stated.kind: f"{stated.share * true + nudge:.6f} ms",
    }
    if stated.between is not None:
        name, *levels = stated.between
        made["between"] = {"factor": name, "levels": levels}
    return made


@dataclass(frozen=True)
class CampaignSetting:
    """How campaigns of one world are planned.

    Attributes:
        seed: of the plan. Every world needs its own: with one for all, the same draw would be
            lucky or unlucky in each of them, and their errors would be one error counted often.
    """

    seed: int
    batch: int = BATCH
    experiment: str = "kinematic"


def plan_of(order: str, claims: Sequence[dict[str, Any]], setting: CampaignSetting) -> Plan:
    """Return the plan of an experiment with claims."""
    source = ROOT / f"protocols/{setting.experiment}.yaml"
    data = parse_yaml(source.read_text(), source)
    data["collection"] |= {
        "order": order,
        "seed": setting.seed,
        "stopping": {"error": ERROR, "claims": list(claims)},
    }
    if order == "shuffled":
        data["collection"]["stopping"]["block"] = BLOCK
    else:
        data["collection"]["choice"] = {"batch": setting.batch}
    return make_plan(validate(Protocol, data, source), str(source))


@dataclass(frozen=True)
class Call:
    """A claim that was called, after how many trials."""

    trials: int
    state: ClaimState

    def wrong(self, stated: Stated, true: float) -> bool:
        """Return whether the call, or the interval of a width, is wrong."""
        low, high = self.state.low, self.state.high
        if stated.kind != "within":
            return self.state.holds != stated.true
        return low is None or high is None or not low <= true <= high


def campaign(
    order: str,
    claims: list[dict[str, Any]],
    values: dict[str, F64],
    setting: CampaignSetting,
) -> list[Call | None]:
    """Return the call of each claim; None for never."""
    plan = plan_of(order, claims, setting)
    went = course(plan, TrialGrid.of(plan), values)
    ends = went.evidence.looks
    return [None if it.look is None else Call(int(ends[it.look]), it.state) for it in went.claims]


def world_row(number: int, seed: int, adaptive: int, batch: int) -> dict[str, Any]:
    """Do both campaigns in one world."""
    with threadpool_limits(1):
        setting = CampaignSetting(hash_integer("campaign", seed, number), batch)
        grid = TrialGrid.of(plan_of("shuffled", [claim_of(CLAIMS[0], 1000.0)], setting))
        settings = world(number, seed)
        grids = figures(settings, grid, TIMES)
        values = {name: each[0] for name, each in grids.items()}
        row: dict[str, Any] = {"world": number}
        for order in ORDERS if number < adaptive else ORDERS[:1]:
            row[order] = []
            for stated in CLAIMS:
                true = truth(stated, grids[stated.figure], grid)
                (call,) = campaign(order, [claim_of(stated, true)], values, setting)
                row[order].append(call and (call.trials, call.wrong(stated, true)))
    return row


def lines(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield a table in Markdown."""
    total = TRIALS
    yield "| claim | true | order | called | wrongly | 95 % | median trials | of the grid |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    for k, stated in enumerate(CLAIMS):
        for order in ORDERS:
            found = [row[order][k] for row in rows if order in row]
            if not found:
                continue
            called = [each for each in found if each is not None]
            wrong = sum(off for _, off in called)
            low, high = exact_interval(wrong, len(found))
            trials = float(np.median([total if each is None else each[0] for each in found]))
            yield (
                f"| {stated.name} | {'yes' if stated.true else 'no'} | {order} "
                f"| {len(called)} of {len(found)} | {100 * wrong / len(found):.1f} % "
                f"| {100 * low:.1f} to {100 * high:.1f} % | {trials:.0f} "
                f"| {100 * trials / total:.0f} % |"
            )


def rows_of(worlds: int, seed: int, adaptive: int, batch: int, cores: int) -> list[dict[str, Any]]:
    """Do all worlds."""
    return in_worlds(partial(world_row, seed=seed, adaptive=adaptive, batch=batch), worlds, cores)


def in_worlds(
    one: Callable[[int], dict[str, Any]], worlds: int, cores: int
) -> list[dict[str, Any]]:
    """Do the same in each world, by number."""
    with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
        return list(pool.map(one, range(worlds)))


def measure(worlds: int = 200, adaptive: int = 10, cores: int = 2) -> Figures:
    """Return how often the worst claim was called wrongly, and the trials that true ones took."""
    rows = rows_of(worlds, SEED, adaptive, BATCH, cores)
    found: Figures = {}
    for order in ORDERS:
        calls = {
            stated: [row[order][k] for row in rows if order in row]
            for k, stated in enumerate(CLAIMS)
        }
        found[f"{order}_worlds"] = float(len(calls[CLAIMS[0]]))
        found[f"{order}_worst_claim_wrong_percent"] = max(
            100.0 * float(np.mean([call is not None and call[1] for call in each]))
            for each in calls.values()
        )
        true = [
            TRIALS if call is None else call[0]
            for stated, each in calls.items()
            if stated.true
            for call in each
        ]
        found[f"{order}_true_trials_percent"] = 100.0 * float(np.median(true)) / TRIALS
    both = [
        (row["shuffled"][k], row["adaptive"][k])
        for row in rows
        if "adaptive" in row
        for k, stated in enumerate(CLAIMS)
        if stated.true
    ]
    ratios = [(TRIALS if b is None else b[0]) / (TRIALS if a is None else a[0]) for a, b in both]
    found["adaptive_over_shuffled"] = float(np.median(ratios))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--worlds", type=int, default=200)
    parser.add_argument("--adaptive", type=int, default=200, help="worlds with this order, too")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--batch", type=int, default=BATCH)
    parser.add_argument("--cores", type=int, default=2)
    asked = parser.parse_args()
    rows = rows_of(asked.worlds, asked.seed, asked.adaptive, asked.batch, asked.cores)
    print("\n".join(lines(rows)))


if __name__ == "__main__":
    main()
