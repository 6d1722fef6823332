"""The paper's claims: how many trials they take, with the figures of a simulated study's network.

    python -m benchmarks.fewer_study figures STORE MODEL > benchmarks/results/trial_figures.csv
    python -m benchmarks.fewer_study claims [--worlds 200] [--adaptive 20] [--seed 1]

`figures` judges every trial of a store by a network that was trained on another one, and writes
what it found. `claims` draws worlds around these figures: what a condition is expected to give, by
a fit over the factors; the scatter of the fit, drawn anew for each trial; and a shift of the whole
world by a fifth of its scatter. A trial was not detected as often as in the study. All figures are
simulated.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from benchmarks.fewer import BATCH, F64, ORDERS, ROOT, campaign, plan_of, quantile
from sliplab.analysis.campaigns import collected
from sliplab.analysis.claims.evidence import Grid
from sliplab.analysis.claims.expectation import coded, expectation
from sliplab.analysis.claims.trial_figures import Judge, trial_figures
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.protocols.claims import FIGURES
from sliplab.protocols.plan import load_plan
from sliplab.storage.trials.store import Store

TABLE = ROOT / "benchmarks/results/trial_figures.csv"
BATCHES = {"kinematic": BATCH, "gravity": 8}
"""A round of gravity trials has a batch of each of three plates."""
SHIFT = 0.2
GRIDS = 20
"""Of which the truth is the figure, for `order: shuffled`."""
CLAIMS: dict[str, tuple[str, dict[str, Any]]] = {
    "accuracy known to 1 point": ("kinematic", {"figure": "accuracy", "within": "1 %"}),
    "median latency known to 10 ms":
        ("kinematic", {"figure": "latency_incipient", "within": "10 ms"}),
    "lead at least 360 ms in 95 %":
        ("gravity", {"figure": "lead", "statistic": "p05", "at_least": "360 ms"}),
}  # fmt: skip


def write_figures(store: Path, model: Path) -> None:
    """Write a row for every trial of a store."""
    rows = []
    for item in collected(Store.open(store)):
        for trial, recording in item.trials:
            if trial.role != "measured":
                continue
            found = trial_figures(recording, Judge(item.settings, model))
            levels = {name: str(level) for name, level in trial.condition}
            rows.append(
                {"experiment": item.experiment, **levels,
                 **{name: found.of(name) for name in FIGURES}}
            )  # fmt: skip
    pd.DataFrame(rows).to_csv(sys.stdout, index=False, float_format="%.3f")


@cache
def fitted(experiment: str, figure: str) -> tuple[Grid, F64, F64, float, float]:
    """Return the grid, what is expected of each trial, residuals, and how often none is detected.

    The last is the value of a trial that is not detected.
    """
    table = pd.read_csv(TABLE)
    table = table[table["experiment"] == experiment].reset_index(drop=True)
    grid = Grid.of(load_plan(ROOT / f"protocols/{experiment}.yaml"))
    keys = [tuple(_number(level) for _, level in trial.condition) for trial in grid.trials]
    first = {key: number for number, key in reversed(list(enumerate(keys)))}
    names = [name for name, _ in grid.trials[0].condition]
    levels = [tuple(map(_number, row)) for row in table[names].itertuples(index=False)]
    at = np.array([first[key] for key in levels])
    y = table[figure].to_numpy(np.float64)
    found = expectation(coded(grid.levels), at, y)
    ok = np.isfinite(y)
    lost = np.isinf(y)
    never = float(y[lost][0]) if lost.any() else 0.0
    return grid, found.mean, (y - found.mean[at])[ok], float(lost.mean()), never


def _number(level: Any) -> float | str:
    return level if isinstance(level, str) else float(level)


def world_row(number: int, seed: int, adaptive: int) -> dict[str, Any]:
    """Do all claims in one world."""
    row: dict[str, Any] = {"world": number}
    with threadpool_limits(1):
        for title, (experiment, claim) in CLAIMS.items():
            figure = claim["figure"]
            grid, mean, residuals, lost, never = fitted(experiment, figure)
            rng = np.random.default_rng([seed, number, list(CLAIMS).index(title)])
            size = (GRIDS, len(mean))
            y = mean + rng.normal(0, SHIFT * residuals.std()) + rng.choice(residuals, size)
            if figure == "accuracy":
                y = np.clip(y, 0.0, 100.0)
            y[rng.random(size) < lost] = never
            row[title] = {}
            for order in ORDERS if number < adaptive else ORDERS[:1]:
                whole = y if order == "shuffled" else y[:1]
                trials = Grid.of(plan_of(order, [claim], BATCHES[experiment], experiment)).trials
                taken = y[0][[grid.number[trial.id] for trial in trials]]
                (call,) = campaign(order, [claim], {figure: taken}, BATCHES[experiment], experiment)
                row[title][order] = [len(mean), call and call.trials, _wrong(claim, call, whole)]
    return row


def _wrong(claim: dict[str, Any], call: Any, y: F64) -> bool:
    """Return whether a claim was called wrongly."""
    if call is None:
        return False
    state = call.state
    if "within" in claim:
        true = float(y.mean()) if claim["figure"] == "accuracy" else quantile(y, 0.5)
        return not (state.low or 0.0) <= true <= (np.inf if state.high is None else state.high)
    return bool(state.holds != (quantile(y, 0.05) >= state.value))


def print_claims(asked: argparse.Namespace) -> None:
    """Print the table of all claims."""
    one = partial(world_row, seed=asked.seed, adaptive=asked.adaptive)
    with ProcessPoolExecutor(asked.cores, get_context("spawn")) as pool:
        rows = list(pool.map(one, range(asked.worlds)))
    print("| claim | order | called | wrongly (95 %) | median trials | of the grid |")
    print("| --- | --- | --- | --- | --- | --- |")
    for title in CLAIMS:
        for order in ORDERS:
            found = [row[title][order] for row in rows if order in row[title]]
            if not found:
                continue
            wrong = sum(off for *_, off in found)
            low, high = exact_interval(wrong, len(found))
            size = found[0][0]
            trials = float(np.median([size if n is None else n for _, n, _ in found]))
            called = sum(n is not None for _, n, _ in found)
            span = f"{100 * low:.1f} to {100 * high:.1f}"
            print(
                f"| {title} | {order} | {called} of {len(found)} "
                f"| {100 * wrong / len(found):.1f} % ({span}) | {trials:.0f} of {size} "
                f"| {100 * trials / size:.0f} % |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    table = kinds.add_parser("figures")
    table.add_argument("store", type=Path)
    table.add_argument("model", type=Path)
    claims = kinds.add_parser("claims")
    claims.add_argument("--worlds", type=int, default=200)
    claims.add_argument("--adaptive", type=int, default=20, help="worlds with this order, too")
    claims.add_argument("--seed", type=int, default=1)
    claims.add_argument("--cores", type=int, default=2)
    asked = parser.parse_args()
    if asked.kind == "figures":
        write_figures(asked.store, asked.model)
    else:
        print_claims(asked)


if __name__ == "__main__":
    main()
