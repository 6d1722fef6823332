"""The paper's claims: how many trials they take, with the figures of a simulated study's network.

    python -m benchmarks.fewer_study figures STORE MODEL > benchmarks/results/trial_figures.csv
    python -m benchmarks.fewer_study claims [--worlds 200] [--adaptive 20] [--seed 1]
    python -m benchmarks.fewer_study forecasts [--worlds 20] [--adaptive 10] [--seed 1]

`figures` judges every trial of a store by a network that was trained on another one, and writes
what it found. `claims` draws worlds around these figures: what a condition is expected to give, by
a fit over the factors; the scatter of the fit, drawn anew for each trial; and a shift of the whole
world by a fifth of its scatter. A trial was not detected as often as in the study. `forecasts`
compares what `sliplab power` foretells from a pilot of such a world with what a campaign in it then
took, beside a forecast by other campaigns in the same world, which nobody can better. All figures
are simulated.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from benchmarks.fewer import (
    BATCH,
    F64,
    ORDERS,
    ROOT,
    CampaignSetting,
    campaign,
    in_worlds,
    plan_of,
    quantile,
)
from sliplab.analysis.campaigns import collected
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.plugins.claims.evidence import TrialGrid
from sliplab.plugins.claims.expectation import coded, expectation
from sliplab.plugins.claims.power.drawing import SHARES, Drawing
from sliplab.plugins.claims.power.resampling import PilotFigures, shared_axes
from sliplab.plugins.claims.trial_figures import Judge, trial_figures
from sliplab.protocols import Plan
from sliplab.protocols.claims import FIGURES
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.plan import load_plan
from sliplab.storage.trials.store import TrialStore

TABLE = ROOT / "benchmarks/results/trial_figures.csv"
BATCHES = {"kinematic": BATCH, "gravity": 8}
"""A round of gravity trials has a batch of each of three plates."""
SHIFT = 0.2
GRIDS = 20
"""Of which the truth is the figure."""
PILOT = 72
"""Trials of a pilot, at most a third of the grid."""
FACTOR = 1.3
"""By which a forecast may be off."""
CLAIMS: dict[str, tuple[str, dict[str, Any]]] = {
    "accuracy known to 1 point": ("kinematic", {"figure": "accuracy", "within": "1 %"}),
    "median latency known to 10 ms": (
        "kinematic",
        {"figure": "latency_incipient", "within": "10 ms"},
    ),
    "lead at least 360 ms in 95 %": (
        "gravity",
        {"figure": "lead", "statistic": "p05", "at_least": "360 ms"},
    ),
}


def write_figures(store: Path, model: Path) -> None:
    """Write a row for every trial of a store."""
    rows = []
    for item in collected(TrialStore.open(store)):
        for trial, recording in item.trials:
            if trial.role != "measured":
                continue
            found = trial_figures(recording, Judge(item.settings, model))
            levels = {name: str(level) for name, level in trial.condition}
            rows.append(
                {
                    "experiment": item.experiment,
                    **levels,
                    **{name: found.of(name) for name in FIGURES},
                }
            )
    pd.DataFrame(rows).to_csv(sys.stdout, index=False, float_format="%.3f")


@cache
def fitted(experiment: str, figure: str) -> tuple[TrialGrid, F64, F64, float, float]:
    """Return the grid, what is expected of each trial, residuals, and how often none is detected.

    The last is the value of a trial that is not detected.
    """
    table = pd.read_csv(TABLE)
    table = table[table["experiment"] == experiment].reset_index(drop=True)
    grid = TrialGrid.of(load_plan(ROOT / f"protocols/{experiment}.yaml"))
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


def figures_of(number: int, seed: int, title: str) -> tuple[TrialGrid, F64]:
    """Return the figures of `GRIDS` campaigns in one world, (GRIDS, N) by the grid's trials."""
    experiment, claim = CLAIMS[title]
    grid, mean, residuals, lost, never = fitted(experiment, claim["figure"])
    rng = np.random.default_rng([seed, number, list(CLAIMS).index(title)])
    size = (GRIDS, len(mean))
    y = mean + rng.normal(0, SHIFT * residuals.std()) + rng.choice(residuals, size)
    if claim["figure"] == "accuracy":
        y = np.clip(y, 0.0, 100.0)
    y[rng.random(size) < lost] = never
    return grid, y


def setting_of(number: int, seed: int, experiment: str) -> CampaignSetting:
    """Return how campaigns of one world are planned."""
    return CampaignSetting(hash_integer("campaign", seed, number), BATCHES[experiment], experiment)


def _places(grid: TrialGrid, other: TrialGrid) -> list[int]:
    """Return where the trials of a grid with another seed stand in the first one."""
    at = {(trial.condition, trial.repetition): k for k, trial in enumerate(grid.trials)}
    return [at[trial.condition, trial.repetition] for trial in other.trials]


def world_row(number: int, seed: int, adaptive: int) -> dict[str, Any]:
    """Do all claims in one world."""
    row: dict[str, Any] = {"world": number}
    with threadpool_limits(1):
        for title, (experiment, claim) in CLAIMS.items():
            figure = claim["figure"]
            grid, y = figures_of(number, seed, title)
            setting = setting_of(number, seed, experiment)
            row[title] = {}
            for order in ORDERS if number < adaptive else ORDERS[:1]:
                taken = y[0][_places(grid, TrialGrid.of(plan_of(order, [claim], setting)))]
                (call,) = campaign(order, [claim], {figure: taken}, setting)
                row[title][order] = [
                    len(grid.trials),
                    call and call.trials,
                    _wrong(claim, call, y),
                ]
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


def forecast_row(number: int, seed: int, adaptive: int, draws: int) -> dict[str, Any]:
    """Foretell all claims in one world, by a pilot and by other campaigns in it.

    Trials after which a claim is called; one that never is counts as called by the last of them.
    """
    row: dict[str, Any] = {}
    with threadpool_limits(1):
        for title, (experiment, claim) in CLAIMS.items():
            grid, y = figures_of(number, seed, title)
            figure, total = claim["figure"], len(grid.trials)
            setting = setting_of(number, seed, experiment)
            row[title] = {}
            for order in ORDERS if number < adaptive else ORDERS[:1]:
                plan = plan_of(order, [claim], setting)
                own = _places(grid, TrialGrid.of(plan))
                calls = [campaign(order, [claim], {figure: each[own]}, setting) for each in y[:-1]]
                took = [total if call is None else call.trials for (call,) in calls]
                pilot = _pilot(plan, grid, y[-1], figure, np.random.default_rng([seed, number]))
                drawing = Drawing(plan, pilot, seed)
                foretold = [drawing.campaign(k).called[0] or total for k in range(draws)]
                row[title][order] = [
                    took[0],
                    float(np.median(took[1:])),
                    *(float(n) for n in np.quantile(foretold, SHARES)),
                ]
    return row


def _pilot(
    plan: Plan, grid: TrialGrid, y: F64, figure: str, rng: np.random.Generator
) -> PilotFigures:
    """Return `PILOT` of a grid's trials as a pilot, or a third of them where that is less."""
    count = len(grid.trials)
    taken = rng.choice(count, min(PILOT, count // 3), replace=False)
    trials = [grid.trials[k] for k in taken]
    conditions = [dict(trial.condition) for trial in trials]
    axes, _ = shared_axes(plan, conditions)
    blocks = np.array([trial.block for trial in trials], np.int64)
    return PilotFigures(axes, tuple(conditions), blocks, {figure: y[taken]})


def by_claim(rows: Sequence[dict[str, Any]]) -> Iterator[tuple[str, list[Any]]]:
    """Yield the first cells of a line of a table, and what was found in each world."""
    for title in CLAIMS:
        for order in ORDERS:
            found = [row[title][order] for row in rows if order in row[title]]
            if found:
                yield f"| {title} | {order} |", found


def print_forecasts(asked: argparse.Namespace) -> None:
    """Print the table of forecasts."""
    one = partial(forecast_row, seed=asked.seed, adaptive=asked.adaptive, draws=asked.draws)
    print("| claim | order | within 1.3, by a pilot | by the world itself | 80 % range holds |")
    print("| --- | --- | --- | --- | --- |")
    for cells, found in by_claim(in_worlds(one, asked.worlds, asked.cores)):
        took, known, low, median, high = np.array(found).T
        close = [int((np.abs(np.log(n / took)) <= np.log(FACTOR)).sum()) for n in (median, known)]
        holds = int(((low <= took) & (took <= high)).sum())
        print(cells, " ".join(f"{n} of {len(found)} |" for n in (*close, holds)))


def print_claims(asked: argparse.Namespace) -> None:
    """Print the table of all claims."""
    one = partial(world_row, seed=asked.seed, adaptive=asked.adaptive)
    print("| claim | order | called | wrongly (95 %) | median trials | of the grid |")
    print("| --- | --- | --- | --- | --- | --- |")
    for cells, found in by_claim(in_worlds(one, asked.worlds, asked.cores)):
        wrong = sum(off for *_, off in found)
        low, high = exact_interval(wrong, len(found))
        size = found[0][0]
        trials = float(np.median([size if n is None else n for _, n, _ in found]))
        called = sum(n is not None for _, n, _ in found)
        span = f"{100 * low:.1f} to {100 * high:.1f}"
        print(
            f"{cells} {called} of {len(found)} | {100 * wrong / len(found):.1f} % ({span}) "
            f"| {trials:.0f} of {size} | {100 * trials / size:.0f} % |"
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
    forecasts = kinds.add_parser("forecasts")
    forecasts.add_argument("--worlds", type=int, default=20)
    forecasts.add_argument("--adaptive", type=int, default=10, help="worlds with this order, too")
    forecasts.add_argument("--draws", type=int, default=40, help="campaigns drawn from a pilot")
    forecasts.add_argument("--seed", type=int, default=1)
    forecasts.add_argument("--cores", type=int, default=2)
    asked = parser.parse_args()
    if asked.kind == "figures":
        write_figures(asked.store, asked.model)
    elif asked.kind == "forecasts":
        print_forecasts(asked)
    else:
        print_claims(asked)


if __name__ == "__main__":
    main()
