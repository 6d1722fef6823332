"""Places of the markers at rest, and the rings that they form."""

from __future__ import annotations

import numpy as np

from sliplab.plugins.twin.contact_slips import SlideSlips, mean_seen
from sliplab.storage.streams import F64, I64


def rest_places(slips: SlideSlips) -> F64:
    """Return each marker's place in the last 0.5 s of each hold, mm, (k, m, 2), NaN where unseen.

    Slides begin at different places of the plate: they are shifted onto those of
    one slide.
    """
    places = np.array(
        [
            mean_seen(trial.tips_mm[(trial.frame_s < 0.0) & (trial.frame_s >= -0.5)])
            for trial in slips.trials
        ]
    )
    here = places[int(np.argmax(np.isfinite(places[:, :, 0]).sum(axis=1)))]
    for place in places:
        shift = (place - here)[np.isfinite(place - here).all(axis=1)]
        place -= np.median(shift, axis=0) if len(shift) else np.nan
    return places


def rings_of(slips: SlideSlips) -> tuple[I64, F64]:
    """Return each marker's ring, 0 for the centre and -1 where it was never seen, and its place,
    (m, 2): `rest_places`."""
    place = mean_seen(rest_places(slips))
    seen = np.isfinite(place).all(axis=1)
    ring = np.full(len(place), -1)
    if not seen.any():
        return ring, place
    # the marker that is nearest to the middle of all is the centre
    off = np.hypot(*(place[seen] - np.median(place[seen], axis=0)).T)
    far = np.hypot(*(place[seen] - place[seen][np.argmin(off)]).T)
    order = np.argsort(far)
    steps = np.diff(far[order])
    jumps = steps > 0.5 * steps.max(initial=0.0)
    inside = np.zeros(len(far), np.int64)
    inside[order] = np.concatenate([[0], np.cumsum(jumps)])
    ring[seen] = inside
    return ring, place


def place_scatter(ring: I64, place: F64) -> float:
    """Standard deviation of places about a lattice of rings, mm: the best place, turn and scale."""
    lattice = np.full(place.shape, np.nan)
    seen = np.isfinite(place).all(axis=1)
    if seen.sum() < 4 or not np.any(seen & (ring == 0)):
        return float("nan")
    middle = place[seen & (ring == 0)].mean(axis=0)
    for r in np.unique(ring[seen]):
        these = np.flatnonzero(seen & (ring == r))
        angle = np.arctan2(*(place[these] - middle).T[::-1])
        if r == 0 or len(these) < 2:
            lattice[these] = 0.0 if r == 0 else np.nan
            continue
        turns = np.sort(angle)
        step = np.median(np.diff(np.append(turns, turns[0] + 2 * np.pi)))
        count = max(round(2 * np.pi / step), 1)
        step = 2 * np.pi / count
        lead = np.angle(np.mean(np.exp(1j * count * angle))) / count
        index = np.round((angle - lead) / step)
        turn = lead + index * step
        lattice[these] = r * np.column_stack([np.cos(turn), np.sin(turn)])
    use = np.isfinite(lattice).all(axis=1)
    z, w = (points[use] @ [1.0, 1.0j] for points in (lattice, place))
    design = np.column_stack([z, np.ones(len(z))])
    best, *_ = np.linalg.lstsq(design, w, rcond=None)
    rest = np.abs(w - design @ best)
    free = 2 * len(w) - 4
    return float(np.sqrt(np.sum(rest**2) / free)) if free > 0 else float("nan")
