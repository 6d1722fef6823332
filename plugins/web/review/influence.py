"""Figures of an evaluation over trials, and their change where reviews find other onsets.

The only approximation is Monte Carlo over review outcomes: for each draw a trial is scored again by
the evaluation's bounds, and each figure is computed again with that score. Windows keep the
network's answer and have the class of the phase that their middle lies in, as in the evaluation's
tenths; a trial that comes in has no windows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sliplab.analysis.detectors.latency import NEVER, is_false_early, is_late
from sliplab.analysis.metrics.classification import winners
from sliplab.analysis.metrics.intervals import Span, interval
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.plugins.web.review.doubt import LabelDoubt
from sliplab.protocols.hashing import hash_integer
from sliplab.storage.schema.evaluation import Evaluation, TrialLatency, TrialScore
from sliplab.storage.streams import F64, I64

DRAWS = 1000
"""Reviews that are drawn of each trial, twice."""
TIMES = {
    "latency_incipient_ms": "incipient latency",
    "latency_gross_ms": "gross latency",
    "lead_ms": "lead",
}
"""Times of a trial that figures are over, and their names."""
LOST_MS = {"latency_incipient_ms": np.inf, "latency_gross_ms": np.inf, "lead_ms": -np.inf}
"""Value of a missed or late detection in a median."""
STATISTICS: tuple[Literal["median", "mean"], ...] = ("median", "mean")
Name = tuple[str, str]
"""Campaign and trial."""


@dataclass(frozen=True)
class ReviewDraws:
    """Random review outcomes of one trial: 2 DRAWS of them.

    Attributes:
        incipient_ns, gross_ns: (2 DRAWS,) int64. usable: (2 DRAWS,), False where it has no onsets.
    """

    incipient_ns: I64
    gross_ns: I64
    usable: np.ndarray[tuple[int], np.dtype[np.bool_]]

    @staticmethod
    def of(name: Name, doubt: LabelDoubt) -> ReviewDraws:
        """Draw reviews of a trial, the same at every call."""
        return ReviewDraws(*doubt.draw(2 * DRAWS, hash_integer("review", *name)))


@dataclass(frozen=True)
class ReviewStatistic:
    """A statistic over n trials, now and as reviews may leave it.

    Of a mean it is a sum over a sum: values over trials, or hits over windows.

    Attributes:
        sums, sizes: (n,) of each trial; size 0: it is not in the figure.
        drawn: by place among the trials, sums and sizes (2 DRAWS,) of what reviews may find.
        span: the figure's 95 % interval over trials; None if there is none.
    """

    name: str
    experiment: str
    unit: Literal["ms", "share"]
    statistic: Literal["median", "mean"]
    places: Mapping[Name, int]
    sums: F64
    sizes: F64
    drawn: Mapping[int, tuple[F64, F64]]
    span: Span | None

    @property
    def value(self) -> float:
        """The figure now; NaN without trials."""
        return float(_statistic(self.statistic, self.sums, self.sizes))

    @property
    def width(self) -> float | None:
        """Width of the interval, None where there is none or all of it."""
        width = 0.0 if self.span is None else self.span[1] - self.span[0]
        return width or None

    def changes(self, name: Name) -> F64:
        """Return by how much each drawn review of one trial changes the figure, (DRAWS,).

        NaN where the figure cannot be computed before or after it.
        """
        place = self.places.get(name)
        if place is None or place not in self.drawn:
            return np.zeros(DRAWS)
        return self._with({place: slice(DRAWS)}) - self.value

    def label_deviation(self, reviewed: Iterable[Name]) -> float:
        """Return the standard deviation that labels alone leave in the figure after reviews.

        The mean over what reviews may find of the variance that is left then, as half the mean
        square between two draws that share the reviewed trials (Jansen 1999).

        Args:
            reviewed: trials whose onsets are then known.
        """
        known = {self.places[name] for name in reviewed if name in self.places}
        first, second = slice(DRAWS), slice(DRAWS, 2 * DRAWS)
        one = self._with(dict.fromkeys(self.drawn, first))
        other = self._with({at: first if at in known else second for at in self.drawn})
        square = (one - other) ** 2
        there = square[np.isfinite(square)]
        return float(np.sqrt(there.mean() / 2)) if len(there) else 0.0

    def _with(self, draws: Mapping[int, slice]) -> F64:
        """Return the figure with draws in place of some trials, (DRAWS,)."""
        sums, sizes = (np.tile(part, (DRAWS, 1)) for part in (self.sums, self.sizes))
        for place, which in draws.items():
            sums[:, place], sizes[:, place] = (part[which] for part in self.drawn[place])
        return _statistic(self.statistic, sums, sizes)


def _statistic(statistic: str, sums: F64, sizes: F64) -> F64:
    """Median or mean over the last axis without trials of size 0; NaN of none, or if infinite."""
    if statistic == "mean":
        total = sizes.sum(axis=-1)
        return np.asarray(np.where(total, sums.sum(axis=-1) / np.where(total, total, 1), np.nan))
    ordered = np.sort(np.where(sizes > 0, sums, np.nan), axis=-1)  # NaN last
    count = np.count_nonzero(sizes > 0, axis=-1)[..., None]
    middle = [
        np.take_along_axis(ordered, np.maximum(at, 0), axis=-1)[..., 0]
        for at in ((count - 1) // 2, count // 2)
    ]
    found = np.asarray((middle[0] + middle[1]) / 2)
    return np.asarray(np.where(np.isfinite(found), found, np.nan))


def time_figures(
    evaluation: Evaluation, doubts: Mapping[Name, LabelDoubt], drawn: Mapping[Name, ReviewDraws]
) -> list[ReviewStatistic]:
    """Return median and mean of each time of each experiment's test trials.

    Args:
        doubts, drawn: of the trials that are to be reviewed.
    """
    found = []
    for experiment in evaluation.experiments:
        rows = [row for row in evaluation.trials if row.experiment == experiment]
        places = {(row.campaign, row.trial): place for place, row in enumerate(rows)}
        reviews = {
            places[name]: _times(
                rows[places[name]],
                round(evaluation.detection[name[0]].false_early_ms * 1e6),
                doubts[name].end_ns,
                drawn[name],
            )
            for name in drawn
            if name in places
        }
        for time, title in TIMES.items():
            now = np.array([_time(row.latency, time) for row in rows], np.float64)
            for statistic in STATISTICS:
                sums, sizes = _counted(now, statistic)
                drawn_times = {
                    place: _counted(times[time], statistic) for place, times in reviews.items()
                }
                span = interval(now[sizes > 0], statistic)
                if span is not None and not np.isfinite(span).all():
                    span = None
                found.append(
                    ReviewStatistic(
                        f"{statistic} {title}",
                        experiment,
                        "ms",
                        statistic,
                        places,
                        sums,
                        sizes,
                        drawn_times,
                        span,
                    )
                )
    return found


def _time(latency: TrialLatency | None, time: str) -> float:
    """Return a time of a trial, ms; infinite where it was lost, NaN where it does not count."""
    if latency is None:
        return np.nan
    kind = "gross" if time == "latency_gross_ms" else "incipient"
    lost = getattr(latency, f"missed_{kind}") or getattr(latency, f"late_{kind}_ms") is not None
    if lost:
        return LOST_MS[time]
    value = getattr(latency, time)
    return np.nan if value is None else float(value)


def _counted(times: F64, statistic: str) -> tuple[F64, F64]:
    """Return sums and sizes of times; lost ones count in the median alone, as in reports."""
    there = np.isfinite(times) if statistic == "mean" else ~np.isnan(times)
    return np.where(there, times, 0.0), there.astype(np.float64)


def _times(row: TrialScore, tolerance_ns: int, end_ns: int, drawn: ReviewDraws) -> dict[str, F64]:
    """Return the times of a trial's detections, ms, in each draw; see `_time`."""

    def since(found_ns: int | None, onset_ns: I64, end_ns: I64) -> F64:
        found = NEVER if found_ns is None else found_ns
        lost = (found == NEVER) | is_late(found, end_ns)
        out = ~drawn.usable | (is_false_early(found, onset_ns, tolerance_ns) & ~lost)
        times = np.where(lost, np.inf, (found - onset_ns) / 1e6)
        return np.where(out, np.nan, times)

    incipient, gross = drawn.incipient_ns, drawn.gross_ns
    latency = since(row.detected_incipient_ns, incipient, gross)
    found = row.detected_incipient_ns or 0
    return {
        "latency_incipient_ms": latency,
        "latency_gross_ms": since(row.detected_gross_ns, gross, np.maximum(end_ns, gross)),
        "lead_ms": np.where(np.isfinite(latency), (gross - found) / 1e6, -latency),
    }


def accuracy_figure(
    evaluation: Evaluation,
    samples: SampleSet,
    counts: I64,
    length_ns: int,
    drawn: Mapping[Name, ReviewDraws],
) -> ReviewStatistic:
    """Return strict accuracy of the test windows.

    Args:
        samples: the test windows. counts: the network's (n, 3) of them. length_ns: of a window.
    """
    stated = winners(counts)
    hits, total = (stated == samples.y).astype(np.float64), len(samples.trials)
    places: dict[Name, int] = {name: place for place, name in enumerate(samples.trials)}
    reviews = {}
    for name, draw in drawn.items():
        if name in places:
            ours = samples.trial == places[name]
            classes = drawn_classes(samples.start_ns[ours] + length_ns // 2, draw)
            right = (stated[ours, None] == classes).sum(axis=0)
            reviews[places[name]] = (
                np.where(draw.usable, right, 0).astype(np.float64),
                np.where(draw.usable, ours.sum(), 0).astype(np.float64),
            )
    known = evaluation.windows.interval
    return ReviewStatistic(
        "strict accuracy",
        "kinematic",
        "share",
        "mean",
        places,
        np.bincount(samples.trial, hits, total).astype(np.float64),
        np.bincount(samples.trial, minlength=total).astype(np.float64),
        reviews,
        None if known.low is None or known.high is None else (known.low, known.high),
    )


def drawn_classes(middle_ns: I64, drawn: ReviewDraws) -> I64:
    """Return the class of each window in each draw, (n, 2 DRAWS): 0 no slip, 1, 2 gross.

    Args:
        middle_ns: (n,) of each window.
    """
    middle = middle_ns[:, None]
    return (middle >= drawn.incipient_ns).astype(np.int64) + (middle >= drawn.gross_ns)


def trained_shares(
    parts: Sequence[SampleSet], length_ns: int, per_class: int, drawn: Mapping[Name, ReviewDraws]
) -> dict[Name, float]:
    """Return the expected share of the windows of some parts that a review of a trial changes.

    Windows that get another class, drop out with their trial, or come in with it, `per_class` of
    each class.

    Args:
        parts: the windows that train and that choose the network.
    """
    total = sum(len(part) for part in parts)
    found: dict[Name, float] = {}
    for part in parts:
        for place, name in enumerate(part.trials):
            if name not in drawn:
                continue
            draw, ours = drawn[name], part.trial == place
            classes = drawn_classes(part.start_ns[ours] + length_ns // 2, draw)
            changed = (classes != part.y[ours, None]).sum(axis=0)
            windows = int(ours.sum())
            come = 0 if windows else 3 * per_class
            every = np.where(draw.usable, changed + come, windows)
            found[name] = float(every.mean()) / max(total, 1)
    return found
