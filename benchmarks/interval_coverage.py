"""Coverage of intervals: rates of alarms, medians over worlds, shares, differences of counts.

`python -m benchmarks.interval_coverage [--draws N]` prints all tables. Each row draws data sets
from a known truth and counts in how many the 95 % interval holds it, with the exact 95 % interval
of that share.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.intervals import (
    count_difference,
    exact_interval,
    median_interval,
    rate_interval,
    share_interval,
)

SEED = 44
TRIAL_H = 48 / 3600
"""Of holding in a trial of `protocols/nuisances.yaml`."""
PER_HOUR = 168.0
"""False alarms of the pilot's network under all nuisances (docs/stress.md)."""
NUISANCES, REPETITIONS, ALARMED = 39, 4, 6
"""Conditions of `protocols/nuisances.yaml`, trials of each, and conditions that have all alarms."""

Counts = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
Draw = Callable[[np.random.Generator, npt.NDArray[np.float64]], Counts]


@dataclass(frozen=True)
class IntervalCoverage:
    """How often an interval holds the truth.

    Attributes:
        case: what is drawn. clusters: trials or worlds of a data set.
        draws: data sets. held: of them, those whose interval holds the truth.
        width: median width in units of the truth; of shares in points.
    """

    case: str
    clusters: int
    draws: int
    held: int
    width: float

    @property
    def share(self) -> float:
        """Coverage, 0..1."""
        return self.held / self.draws

    @property
    def span(self) -> tuple[float, float]:
        """Its exact 95 % interval, 0..1."""
        return exact_interval(self.held, self.draws)


def _alike(rng: np.random.Generator, mean: npt.NDArray[np.float64]) -> Counts:
    return rng.poisson(mean)


def _gamma(shape: float) -> Draw:
    return lambda rng, mean: rng.poisson(mean * rng.gamma(shape, 1 / shape, len(mean)))


def _few(share: float) -> Draw:
    return lambda rng, mean: rng.poisson(mean / share * (rng.random(len(mean)) < share))


CLUSTERS: dict[str, Draw] = {
    "alike": _alike,
    "gamma rates, shape 1": _gamma(1.0),
    "gamma rates, shape 0.3": _gamma(0.3),
    "15 % have all alarms": _few(0.15),
}
"""Alarms of clusters by their expected numbers."""


def _rates(
    case: str,
    draws: int,
    mean: npt.NDArray[np.float64],
    counts: Callable[[np.random.Generator], Counts],
    strata: Sequence[Hashable] | None,
) -> IntervalCoverage:
    """Cover the rate 1 an hour of clusters whose hours are their expected numbers of alarms."""
    rng = np.random.default_rng(SEED)
    spans = np.array([rate_interval(counts(rng), mean, strata) for _ in range(draws)])
    held = (spans[:, 0] <= 1) & (spans[:, 1] >= 1)
    return IntervalCoverage(
        case, len(mean), draws, int(held.sum()), float(np.median(np.diff(spans)))
    )


def alarm_rates(
    draws: int = 1000, sizes: Sequence[int] = (8, 16, 24, 32, 64, 156)
) -> Iterator[IntervalCoverage]:
    """Cover rates of alarms in clusters: by size, and for trials of a design with nuisances.

    Args:
        draws: data sets of each row. sizes: numbers of clusters.
    """
    each = PER_HOUR * TRIAL_H
    for size in sizes:
        for case, draw in CLUSTERS.items():
            mean = np.full(size, each)
            yield _rates(case, draws, mean, lambda rng, d=draw, m=mean: d(rng, m), None)
    # hours of the bench's 16 test worlds: about two long holds in each, and few or many alarms
    for alarms in (1.0, 3.0, 20.0, 100.0):
        for case, draw in CLUSTERS.items():
            mean = np.where(np.arange(16) < 14, 2.0, 1.0)
            mean *= alarms / mean.sum()
            name = f"{case}; {alarms:g} alarms expected in worlds of unequal time"
            yield _rates(name, draws, mean, lambda rng, d=draw, m=mean: d(rng, m), None)
    # the same nuisances have all alarms in every repetition of the design
    strata = np.repeat(np.arange(NUISANCES), REPETITIONS)
    mean = np.full(len(strata), each)
    alarmed = np.where(strata < ALARMED, mean * NUISANCES / ALARMED, 0.0)
    for case, draw in CLUSTERS.items():
        name = f"{ALARMED} of {NUISANCES} conditions have all alarms, their trials: {case}"
        yield _rates(name, draws, mean, lambda rng, d=draw: d(rng, alarmed), strata.tolist())


def medians_by_world(
    draws: int = 1000, sizes: Sequence[int] = (6, 8, 16, 32), slides: int = 12
) -> Iterator[IntervalCoverage]:
    """Cover the median 1 of lognormal latencies of slides in worlds, a few of them missed.

    Args:
        draws: data sets of each row. sizes: numbers of worlds. slides: of a world.
    """
    for size in sizes:
        worlds = np.repeat(np.arange(size), slides).tolist()
        for between in (0.0, 0.2, 0.5):
            rng = np.random.default_rng(SEED)
            held, widths = 0, []
            for _ in range(draws):
                parts = rng.normal(size=(size, 1)), rng.normal(size=(size, slides))
                log = between**0.5 * parts[0] + (1 - between) ** 0.5 * parts[1]
                values = np.where(log > 1.8, np.inf, np.exp(log)).ravel()
                span = median_interval(values, worlds)
                assert span is not None, "six worlds bound a median"
                held += span[0] <= 1 <= span[1]
                widths.append(span[1] - span[0])
            case = f"{between:.0%} of the variance between worlds"
            yield IntervalCoverage(case, size, draws, held, float(np.median(widths)))


WINDOWS = 150
"""Of a trial."""
SHARES: dict[str, tuple[Callable[[np.random.Generator, int], FloatArray], float]] = {
    "shares of trials, beta(18, 1)": (lambda rng, n: rng.beta(18, 1, n), 18 / 19),
    "5 % of trials at 30 %, others at 98 %": (
        lambda rng, n: np.where(rng.random(n) < 0.05, 0.3, 0.98),
        0.05 * 0.3 + 0.95 * 0.98,
    ),
}
"""Shares of trials, and the share of all windows."""


def shares_of_windows(
    draws: int = 1000, sizes: Sequence[int] = (6, 12, 20, 36, 132)
) -> Iterator[IntervalCoverage]:
    """Cover the share of windows that are right, of trials with shares of their own.

    Args:
        draws: data sets of each row. sizes: numbers of trials.
    """
    for size in sizes:
        windows = np.full(size, WINDOWS)
        for case, (draw, truth) in SHARES.items():
            rng = np.random.default_rng(SEED)
            found = (
                share_interval(rng.binomial(WINDOWS, draw(rng, size)), windows)
                for _ in range(draws)
            )
            yield _covered(case, size, truth, [span or (0.0, 1.0) for span in found])


def differences_of_counts(
    draws: int = 1000, sizes: Sequence[int] = (6, 14, 36, 132)
) -> Iterator[IntervalCoverage]:
    """Cover the difference of two shares of trials, of the same ones (half alike) or of others.

    Args:
        draws: data sets of each row. sizes: numbers of trials.
    """
    for size in sizes:
        for p, q in ((0.02, 0.0), (0.05, 0.0), (1.0, 0.95), (0.3, 0.3)):
            for paired in (False, True):
                rng, spans = np.random.default_rng(SEED), []
                for _ in range(draws):
                    a, b = rng.random((2, size))
                    b = np.where(paired & (rng.random(size) < 0.5), a, b)
                    spans.append(count_difference(a < p, b < q, paired=paired) or (-1.0, 1.0))
                case = f"{p:.0%} less {q:.0%} of {'the same' if paired else 'other'} trials"
                yield _covered(case, size, p - q, spans)


def _covered(
    case: str, size: int, truth: float, spans: Sequence[tuple[float, float]]
) -> IntervalCoverage:
    """Count the intervals that hold a share; their width is in points."""
    held = sum(low <= truth <= high for low, high in spans)
    width = 100 * float(np.median(np.diff(spans)))
    return IntervalCoverage(case, size, len(spans), held, width)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.interval_coverage")
    parser.add_argument("--draws", type=int, default=1000, help="data sets of each row")
    draws = parser.parse_args().draws
    print("| clusters | case | coverage (%) | median width (of the truth; of shares: points) |")
    print("| --: | --- | --- | --: |")
    tables = (alarm_rates, medians_by_world, shares_of_windows, differences_of_counts)
    for rows in (table(draws) for table in tables):
        for row in rows:
            low, high = row.span
            share = f"{100 * row.share:.1f} ({100 * low:.1f} to {100 * high:.1f})"
            print(f"| {row.clusters} | {row.case} | {share} | {row.width:.2f} |", flush=True)


if __name__ == "__main__":
    main()
