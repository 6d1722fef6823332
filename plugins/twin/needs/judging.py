"""Ablation of a scene's effects: predictions of a pilot's test trials with and without each.

A trial is reduced to numbers in a few groups. Worlds of the twin predict each of them; the score of
a prediction is its continuous ranked probability score (CRPS: Gneiting and Raftery 2007), in units
of the twin's own scatter, mean over the numbers of a group and summed over groups. It is proper:
on average nothing predicts better than the truth. Worlds with and without an effect share their
chance, so numbers that the effect does not touch cancel.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from sliplab.plugins.twin.document import Verdict
from sliplab.plugins.twin.event_times import count_intervals
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.plugins.twin.shown import CELLS, event_map, slips_s
from sliplab.storage.streams import F64

BINS = 8
"""Parts of a slide in which events are counted."""
BLOCK = 4
"""Cells of an event map, each way, that are counted together."""
BUSY = 20
"""Pixels that count as the busiest of a hold."""
SOON_US = 1_000
"""Two events of a pixel so close follow each other at once."""
APART_S = 0.05
"""Speeds are differences of places so far apart in time."""
STILL = 1e-5
"""Motion below this counts as rest: mm, or mm/s."""
NEGLIGIBLE = 0.02
"""Losses below so many scatters are negligible: no twin is exact."""
FEWEST_TRIALS = FEWEST_WORLDS = 3


Marks = Mapping[str, F64]
"""Numbers of a trial by group."""


def marks(trial: PilotTrial) -> Marks:
    """Return the numbers of a trial by group; a group is left out without its stream."""
    slips = slips_s(trial)
    found = {
        "slips": np.where(np.isfinite(slips), slips, trial.slide_s),
        "motion": _motion(trial),
    }
    if trial.camera is not None:
        found |= _events(trial)
    if trial.forces is not None:
        found["forces"] = _forces(trial)
    return found


def _motion(trial: PilotTrial) -> F64:
    """Return how unevenly the markers move in the second half of a slide, as logarithms.

    Speeds are differences over 50 ms, less their mean. Root mean squares of: the common speed
    along and across the slide (the arm), each marker's own speed and own place (friction).
    """
    late = (trial.frame_s > 0.5 * trial.slide_s) & (trial.frame_s < trial.slide_s)
    frame_s, moved = float(np.median(np.diff(trial.frame_s))), trial.moved_mm[late]
    step = max(round(APART_S / frame_s), 1)
    common = np.nanmean(moved, axis=1)
    along = moved @ trial.slide.direction
    own = along - np.nanmean(along, axis=1, keepdims=True)

    def uneven(values: F64) -> float:
        return float(np.sqrt(np.nanmean((values - np.nanmean(values, axis=0)) ** 2)))

    def speed(path: F64) -> float:
        return uneven((path[step:] - path[:-step]) / (step * frame_s))

    aside = trial.slide.direction[::-1] * [-1.0, 1.0]
    found = [speed(common @ trial.slide.direction), speed(common @ aside), speed(own), uneven(own)]
    return np.log(np.maximum(found, STILL))


def _events(trial: PilotTrial) -> dict[str, F64]:
    """Return groups of the events: over time, by place, in the hold, and in their times."""
    assert trial.camera is not None
    events, (width, height) = trial.camera.events, trial.camera.size_px
    edges_us = np.linspace(0.0, trial.slide_s, BINS + 1) * 1e6
    positive = events.p > 0
    rates = [np.diff(np.searchsorted(events.t_us[of], edges_us)) for of in (positive, ~positive)]
    blocks = event_map(trial).reshape(CELLS // BLOCK, BLOCK, CELLS // BLOCK, BLOCK).sum((1, 3))
    held = (events.t_us >= trial.hold_s * 1e6) & (events.t_us < 0)
    pixels = np.bincount(events.y[held].astype(np.int64) * width + events.x[held])
    busy = np.sort(pixels)[-BUSY:].sum() / max(held.sum(), 1)
    slid = (events.t_us >= 0) & (events.t_us < edges_us[-1])
    t_us, x, y = events.t_us[slid], events.x[slid], events.y[slid]
    gaps = np.zeros(SOON_US, np.int64)
    everywhere = np.ones((height, width), np.bool_)
    count_intervals(t_us, x, y, everywhere, np.empty((height, width), np.int64), gaps)
    together = np.mean(np.diff(t_us) == 0) if len(t_us) > 1 else 0.0
    return {
        "events over time": np.log1p(np.concatenate(rates)),
        "places of events": np.log1p(blocks.ravel()),
        "events at rest": np.array(
            [np.log1p((held & positive).sum()), np.log1p((held & ~positive).sum()), busy]
        ),
        "times of events": np.array([together, np.log1p(gaps.sum())]),
    }


def _forces(trial: PilotTrial) -> F64:
    """Return normal force when the hold begins and ends, and both forces late in the slide, N."""
    assert trial.forces is not None
    t_s, force = trial.forces.t_s, trial.forces.force_n

    def mean(begin_s: float, end_s: float) -> F64:
        result: F64 = force[(t_s >= begin_s) & (t_s < end_s)].mean(axis=0)
        return result

    first, last = mean(trial.hold_s, trial.hold_s + 0.2), mean(-0.2, 0.0)
    late = mean(trial.slide_s - 1.0, trial.slide_s)
    return np.array([first[2], last[2], late[2], np.hypot(late[0], late[1])])


@dataclass(frozen=True)
class Marked:
    """Numbers of the same trials in several worlds, or of a pilot as one world.

    Attributes:
        values: (worlds, trials, numbers). groups: name of each number's group, (numbers,).
    """

    values: F64
    groups: tuple[str, ...]


def marked(worlds: Sequence[Sequence[Marks]], retained: Collection[str]) -> Marked:
    """Return the numbers of worlds that took the same trials.

    Args:
        worlds: `marks` of each trial. kept: groups.
    """
    first = worlds[0][0]
    names = [name for name in first if name in retained]
    groups = tuple(name for name in names for _ in first[name])
    values = [[np.concatenate([one[name] for name in names]) for one in row] for row in worlds]
    return Marked(np.array(values), groups)


def crps(ensemble: F64, truth: F64) -> F64:
    """Return the score of each prediction, in units of the values; less is better.

    It is the mean distance to the truth less half that between two members, which has no bias for
    few members (Ferro 2014).

    Args:
        ensemble: (k, ...), at least two members. truth: (...).
    """
    k = len(ensemble)
    ordered = np.sort(ensemble, axis=0)
    weight = (2.0 * np.arange(1, k + 1) - k - 1.0).reshape(-1, *[1] * truth.ndim)
    apart = 2.0 * (weight * ordered).sum(axis=0) / (k * (k - 1.0))
    result: F64 = np.abs(ensemble - truth).mean(axis=0) - 0.5 * apart
    return result


@dataclass(frozen=True)
class Need:
    """Ablation of an effect: the change in the prediction of test trials.

    Attributes:
        loss: mean of the score without less that with it. low, high: its 90 % interval over trials,
            of which either end holds in 95 of 100 cases.
        limit: largest loss by chance where the effect is not there, at least `NEGLIGIBLE`.
        expected: least loss where it is there as the twin has it.
        shown_by: the group of numbers with the largest loss or gain.
    """

    loss: float
    low: float
    high: float
    limit: float
    expected: float
    shown_by: str

    @property
    def verdict(self) -> Verdict:
        """The verdict: an effect is required if its loss exceeds chance, over trials and worlds."""
        if self.low > 0.0 and self.loss > self.limit:
            return "asked for"
        return "not asked for" if self.expected > self.limit else "not shown"


def need(pilot: Marked, having: Marked, without: Marked) -> Need:
    """Return what leaving an effect out does.

    Each world is also predicted by the others, as if it were the pilot: those without the effect
    say what chance does, those with it what is lost if it is there.

    Args:
        pilot: one world. having, without: the same number of worlds with the same chance.

    Raises:
        ValueError: fewer than `FEWEST_TRIALS` trials or `FEWEST_WORLDS`.
    """
    worlds, trials, _ = having.values.shape
    if trials < FEWEST_TRIALS or worlds < FEWEST_WORLDS:
        raise ValueError(f"{trials} trials in {worlds} worlds are too few to compare")
    scatter = np.sqrt(having.values.var(axis=0, ddof=1).mean(axis=0))
    scale = np.where(scatter > 0.0, scatter, 1.0)
    names = list(dict.fromkeys(pilot.groups))
    of_group = np.array([[group == name for group in pilot.groups] for name in names], np.float64)
    of_group /= of_group.sum(axis=1, keepdims=True) * scale

    def loss(truth: F64, retained: list[int]) -> F64:
        more = crps(without.values[retained], truth) - crps(having.values[retained], truth)
        # a number that one of the trials has not, such as a marker's that was not seen
        result: F64 = np.nan_to_num(more) @ of_group.T
        return result

    every = list(range(worlds))
    found = loss(pilot.values[0], every)
    losses = found.sum(axis=1)
    others = [[k for k in every if k != own] for own in every]
    absent, present = (
        np.array(
            [
                loss(one, retained).sum(axis=1).mean()
                for one, retained in zip(of, others, strict=True)
            ]
        )
        for of in (without.values, having.values)
    )
    return Need(
        loss=float(losses.mean()),
        low=float(losses.mean() - _reach(losses, 0.0)),
        high=float(losses.mean() + _reach(losses, 0.0)),
        limit=max(float(absent.mean() + _reach(absent, 1.0)), NEGLIGIBLE),
        expected=float(present.mean() - _reach(present, 1.0)),
        shown_by=names[int(np.argmax(np.abs(found.mean(axis=0))))],
    )


def _reach(values: F64, more: float) -> float:
    """Return how far a mean may lie above the mean of these, in 95 of 100 cases (Student's t).

    Args:
        more: what it varies by besides the error of these values' own mean: 1 for one more value, 0
            for the mean of infinitely many.
    """
    n = len(values)
    return float(student.ppf(0.95, n - 1) * values.std(ddof=1) * np.sqrt(more + 1.0 / n))
