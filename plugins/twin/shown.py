"""Plots that compare a pilot with its twin: slips, event rates, maps of events, by trial.

They are not used for fitting; those of the test trials are shown next to those of simulated worlds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sliplab.plugins.twin.document import QuantityCompared
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.storage.streams import F64

SLIP_MM = 0.1
"""A marker that moved so far has slipped; 2 pixels of 20 px/mm, as in the paper."""
BIN_S = 0.1
CELLS = 20
"""Cells of a map, each way; the centre crop is as wide as the picture is high."""
Course = tuple[F64, F64]
"""Times, (n,), s, and values at these, (n,)."""
QUANTITIES = {
    "first_slip_s": "first slip (s)",
    "centre_slip_s": "centre's slip (s)",
    "hold_events_per_s": "positive events in the hold (1/s)",
    "loading_events_per_s": "positive events until the first slip (1/s)",
    "sliding_events_per_s": "positive events from then to the end (1/s)",
    "normal_n": "normal force before the slide (N)",
    "tangential_n": "force along the plate in its last second (N)",
}


def slips_s(trial: PilotTrial) -> F64:
    """Return when each marker had moved by `SLIP_MM`, s after the start, (m,); NaN: never.

    Between two frames it moves evenly.
    """
    away = np.hypot(*np.moveaxis(trial.moved_mm, 2, 0))
    seen = np.where(np.isnan(away), 0.0, away)
    times = np.full(away.shape[1], np.nan)
    for marker in range(away.shape[1]):
        beyond = np.flatnonzero((seen[:, marker] > SLIP_MM) & (trial.frame_s > 0.0))
        if len(beyond) == 0 or beyond[0] == 0:
            continue
        k = beyond[0]
        before, after = seen[k - 1, marker], seen[k, marker]
        share = (SLIP_MM - before) / (after - before) if after > before else 1.0
        step = trial.frame_s[k] - trial.frame_s[k - 1]
        times[marker] = trial.frame_s[k - 1] + min(max(share, 0.0), 1.0) * step
    return times


def rate_per_s(trial: PilotTrial) -> Course:
    """Return middles of bins of 0.1 s from the hold's start on, s, and positive events/s in them.

    Raises:
        ValueError: the trial has no events.
    """
    if trial.camera is None:
        raise ValueError(f"{trial.trial}: has no events")
    edges = np.arange(trial.hold_s, trial.slide_s, BIN_S)
    events = trial.camera.events
    t_us = events.t_us[events.p > 0]
    counts = np.diff(np.searchsorted(t_us, np.round(edges * 1e6)))
    middles: F64 = 0.5 * (edges[1:] + edges[:-1])
    return middles, counts / BIN_S


def event_map(trial: PilotTrial) -> F64:
    """Return positive events of the slide in the cells of the centre crop, (CELLS, CELLS) by row.

    Raises:
        ValueError: the trial has no events.
    """
    if trial.camera is None:
        raise ValueError(f"{trial.trial}: has no events")
    events, (width, height) = trial.camera.events, trial.camera.size_px
    side = min(width, height)
    retained = (events.p > 0) & (events.t_us >= 0) & (events.t_us < trial.slide_s * 1e6)
    found, _, _ = np.histogram2d(
        events.y[retained] - (height - side) / 2,
        events.x[retained] - (width - side) / 2,
        bins=CELLS,
        range=[[0, side], [0, side]],
    )
    result: F64 = found
    return result


def quantities(trial: PilotTrial) -> dict[str, float]:
    """Return a trial's numbers by the names of `QUANTITIES`; NaN where it has none."""
    found = dict.fromkeys(QUANTITIES, np.nan)
    slips = slips_s(trial)
    if np.isfinite(slips).any():
        found["first_slip_s"] = float(np.nanmin(slips))
    centre = int(np.argmin(np.hypot(*np.nanmean(trial.tips_mm, axis=0).T)))
    found["centre_slip_s"] = float(slips[centre])
    if trial.camera is not None:
        events = trial.camera.events
        t_s = events.t_us[events.p > 0] * 1e-6
        first = found["first_slip_s"] if np.isfinite(found["first_slip_s"]) else trial.slide_s
        parts = {
            "hold_events_per_s": (trial.hold_s, 0.0),
            "loading_events_per_s": (0.0, first),
            "sliding_events_per_s": (first, trial.slide_s),
        }
        for name, (begin, end) in parts.items():
            if end > begin:
                low, high = np.searchsorted(t_s, (begin, end))
                found[name] = float(high - low) / (end - begin)
    if trial.forces is not None:
        t_s, force = trial.forces.t_s, trial.forces.force_n
        held = (t_s >= -0.5) & (t_s < 0.0)
        last = (t_s >= trial.slide_s - 1.0) & (t_s < trial.slide_s)
        if held.any() and last.any():
            found["normal_n"] = float(force[held, 2].mean())
            found["tangential_n"] = float(np.hypot(force[last, 0], force[last, 1]).mean())
    return found


@dataclass(frozen=True)
class SlideCurves:
    """A slide as it is compared, without its events, of which there are millions.

    Attributes:
        trial: its id. numbers: by the names of `QUANTITIES`, NaN where it has none.
        slips_s: see the function.
        moved: times of the frames, s, and the markers' mean displacement along the slide, mm.
        rate: see `rate_per_s`. map: see `event_map`. None without an event camera.
    """

    trial: str
    numbers: Mapping[str, float]
    slips_s: F64
    moved: Course
    rate: Course | None = None
    map: F64 | None = None


def show(trial: PilotTrial) -> SlideCurves:
    """Return what is compared of a slide."""
    along = np.nanmean(trial.moved_mm @ trial.slide.direction, axis=1)
    found = SlideCurves(trial.trial, quantities(trial), slips_s(trial), (trial.frame_s, along))
    if trial.camera is None:
        return found
    return replace(found, rate=rate_per_s(trial), map=event_map(trial))


@dataclass(frozen=True)
class SameTrials:
    """Test trials of a pilot, and the same trials in simulated worlds.

    Attributes:
        twin, before: worlds of the twin, and of the rig file as it was.
        rings: layer of each marker, (m,). streams: that the pilot has.
    """

    pilot: Sequence[SlideCurves]
    twin: Sequence[Sequence[SlideCurves]]
    before: Sequence[Sequence[SlideCurves]]
    rings: F64
    streams: frozenset[str]


def compare(trials: SameTrials) -> tuple[QuantityCompared, ...]:
    """Compare the trials of a pilot and of several worlds, quantity by quantity."""
    if not trials.pilot:
        return ()
    real = _table(trials.pilot)
    of_twin, of_rig = ([_table(world) for world in it] for it in (trials.twin, trials.before))
    found = []
    for name, title in QUANTITIES.items():
        if np.isnan(real[name]).all():
            continue
        twin, before = (np.stack([table[name] for table in it]) for it in (of_twin, of_rig))
        with np.errstate(all="ignore"):
            found.append(
                QuantityCompared(
                    title=title,
                    pilot=float(np.nanmean(real[name])),
                    twin=float(np.nanmean(twin - real[name])),
                    before=float(np.nanmean(before - real[name])),
                    scatter=float(np.sqrt(np.nanmean(np.nanvar(twin, axis=0, ddof=1)))),
                )
            )
    return tuple(found)


def _table(trials: Sequence[SlideCurves]) -> Mapping[str, F64]:
    return {name: np.array([trial.numbers[name] for trial in trials]) for name in QUANTITIES}
