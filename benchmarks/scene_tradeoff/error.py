"""Difference of two simulated recordings of a trial, in quantities that an experiment uses.

A scene can be made arbitrarily expensive: more physics, shorter steps, smoother paths. The gain is
measured by onsets, times of events, labels of windows and the network's own samples; two seeds of
the same scene say which difference is small. Pure functions of recordings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import GROSS, INCIPIENT, NO_SLIP
from sliplab.analysis.windows.samples import consecutive_windows
from sliplab.analysis.windows.windows import bin_events
from sliplab.plugins.simulation.scene_runs import Onsets, SceneRun
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import EventChunk

I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SceneError:
    """Difference of a run from the reference; None where one of the two has no such quantity."""

    first_slip_ms: float | None
    """Absolute difference of the first slip of all papillae."""
    centre_slip_ms: float | None
    """The same of the centre's."""
    event_median_us: float | None
    """Median difference of the times of matched events."""
    event_p95_us: float | None
    """Their 95th percentile."""
    early_p95_us: float | None
    """The same of events before the reference's gross onset: a marker that hardly moves crosses a
    threshold at any time, and steadily sliding ones hardly move."""
    unmatched: float | None
    """Share of the events of both runs that have no partner in the other."""
    flipped: float | None
    """Share of windows with another label; where markers are not simulated, by slips of tips."""
    tensor_l1: float | None
    """Sum of |a - b| over the sum of b: all samples of the recorded part, b the reference's."""


@dataclass(frozen=True)
class Matched:
    """Pairs of events, as indices into both runs, each (k,)."""

    first: I64
    second: I64
    unmatched: float | None
    """Share of the events of both that have no partner; None if there are no events."""


def match_events(a: EventChunk, b: EventChunk) -> Matched:
    """Pair the nth event of a pixel and polarity in `a` with the nth one in `b`.

    Args:
        a, b: in order of time.
    """
    key_a, key_b = _ordinal_keys(a), _ordinal_keys(b)
    _, first, second = np.intersect1d(key_a, key_b, assume_unique=True, return_indices=True)
    total = len(key_a) + len(key_b)
    return Matched(first, second, 1.0 - 2.0 * len(first) / total if total else None)


def _ordinal_keys(events: EventChunk) -> I64:
    """Column, row, polarity and ordinal of each event in one integer, (n,)."""
    place = events.x.astype(np.int64) << 17 | events.y.astype(np.int64) << 1 | (events.p > 0)
    order = np.argsort(place, kind="stable")
    grouped = place[order]
    begins = np.flatnonzero(np.diff(grouped, prepend=-1))
    counts = np.diff(begins, append=len(grouped))
    keys = np.empty(len(place), np.int64)
    keys[order] = grouped << 28 | (np.arange(len(grouped)) - np.repeat(begins, counts))
    return keys


def label_windows(starts_us: I64, length_us: int, onsets: Onsets) -> I64:
    """Return the class of each window by its middle: 0 no slip, 1 incipient, 2 gross, (n,).

    Args:
        onsets: incipient and gross; an onset of None never comes.
    """
    middle_ns = starts_us * 1000 + length_us * 500
    labels = np.full(len(middle_ns), NO_SLIP, np.int64)
    for onset, name in zip(onsets, (INCIPIENT, GROSS), strict=True):
        if onset is not None:
            labels[middle_ns >= onset] = name
    return labels


def flipped_share(begin_us: int, end_us: int, windows: Windows, a: Onsets, b: Onsets) -> float:
    """Return the share of windows with another label by other onsets; one begins at every step.

    So the share is the onsets' difference over the recording, to a step, wherever a grid of
    consecutive windows would happen to lie. Without a whole window it is 0.
    """
    length_us = windows.length_ms * 1000
    starts = np.arange(begin_us, end_us - length_us + 1, windows.step_ms * 1000, dtype=np.int64)
    if not len(starts):
        return 0.0
    other = label_windows(starts, length_us, a) != label_windows(starts, length_us, b)
    return float(other.mean())


def tensor_l1(reference: SceneRun, other: SceneRun, windows: Windows) -> float | None:
    """Return the L1 distance of all consecutive samples over the sum of the reference's.

    Both are cut into windows that begin with the reference's recording. None without samples.
    """
    if reference.events is None or other.events is None:
        return None
    starts = consecutive_windows(reference.begin_us, reference.end_us, windows.length_ms * 1000)
    b, a = (
        bin_events(seen.events, starts, windows, *seen.size_px)
        for seen in (reference, other)
        if seen.events is not None
    )
    total = int(b.sum(dtype=np.int64))
    # counts are unsigned: the larger less the smaller one
    return (
        float((np.maximum(a, b) - np.minimum(a, b)).sum(dtype=np.int64)) / total if total else None
    )


def compare(reference: SceneRun, other: SceneRun, windows: Windows) -> SceneError:
    """Return the difference of two runs of one program."""
    median = p95 = early = unmatched = None
    if reference.events is not None and other.events is not None:
        pairs = match_events(reference.events, other.events)
        unmatched = pairs.unmatched
        if len(pairs.first):
            t_us = reference.events.t_us[pairs.first]
            apart = np.abs(t_us - other.events.t_us[pairs.second]).astype(np.float64)
            median, p95 = (float(value) for value in np.percentile(apart, (50, 95)))
            before = apart[t_us * 1000 < _gross_ns(reference)]
            early = float(np.percentile(before, 95)) if len(before) else None
    if reference.markers is None or other.markers is None:
        onsets = reference.slips, other.slips
    else:
        onsets = reference.markers, other.markers
    return SceneError(
        first_slip_ms=_apart_ms(reference.slips[0], other.slips[0]),
        centre_slip_ms=_apart_ms(reference.slips[1], other.slips[1]),
        event_median_us=median,
        event_p95_us=p95,
        early_p95_us=early,
        unmatched=unmatched,
        flipped=flipped_share(reference.begin_us, reference.end_us, windows, *onsets),
        tensor_l1=tensor_l1(reference, other, windows),
    )


def _gross_ns(seen: SceneRun) -> int:
    onset = seen.slips[1] if seen.markers is None else seen.markers[1]
    return seen.end_us * 1000 if onset is None else onset


def _apart_ms(a: int | None, b: int | None) -> float | None:
    return None if a is None or b is None else abs(a - b) / 1e6


def mean_error(errors: Sequence[SceneError]) -> SceneError:
    """Return each figure averaged over the trials that have it; None where none has."""
    means: dict[str, float | None] = {}
    for field in fields(SceneError):
        values = [getattr(error, field.name) for error in errors]
        there = [value for value in values if value is not None]
        means[field.name] = float(np.mean(there)) if there else None
    return SceneError(**means)


@dataclass(frozen=True)
class MeasuredChoice:
    """The lowest level that suffices, and the reason."""

    level: int
    reason: str


def choose_by_windows(steps: Mapping[int, SceneError], seeds: SceneError) -> MeasuredChoice:
    """Return the lowest level whose windows differ from the next one's by less than two seeds do.

    Windows differ by their samples (L1) and by their labels (share that flips); both must.

    Args:
        steps: difference of each level from the next one, rising from the lowest; the highest
            level is the one after the last.
        seeds: difference of two seeds of one scene.
    """
    reason = ""
    for level, error in steps.items():
        less = _below(error.tensor_l1, seeds.tensor_l1) and _below(error.flipped, seeds.flipped)
        reason = (
            f"L{level} against L{level + 1} changes samples by {_percent(error.tensor_l1)} and "
            f"{_percent(error.flipped)} of the labels, {'both' if less else 'not both'} less than "
            f"two seeds do, {_percent(seeds.tensor_l1)} and {_percent(seeds.flipped)} (simulated)"
        )
        if less:
            return MeasuredChoice(level, reason)
    return MeasuredChoice(max(steps) + 1, reason)


def _below(value: float | None, limit: float | None) -> bool:
    return value is not None and limit is not None and value < limit


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.3g} %"
