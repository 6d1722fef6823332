"""The share of the tips that have let go, by `papillae`, against the simulation's truth.

Slides of the bench's training worlds. The error is the mean over all milliseconds from the moment
at which the first tip slides to that of the last one; `to_one_tip` is how often the number of tips
is right to within one, and `alarms` how many slides had evidence of slip at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from benchmarks.measure import Figures
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.papillae import Papillae
from sliplab.plugins.bench.definition import SIZES, WORLDS
from sliplab.plugins.bench.scenes import scene_of_trial, since_us, take, training_scenes


@dataclass(frozen=True)
class FollowedSlide:
    """Shares of the tips that have let go at each millisecond of a slide, (m,).

    Attributes:
        shown: by the detector. true: of the simulation.
        slipping: from the first tip to the last. first: the millisecond of the first tip.
    """

    shown: npt.NDArray[np.float64]
    true: npt.NDArray[np.float64]
    slipping: npt.NDArray[np.bool_]
    first: int
    tips: int


def followed(count: int, worlds: str) -> list[FollowedSlide]:
    """Return some slides of the bench's training worlds."""
    drawn, _ = training_scenes(SIZES["full"], worlds)
    found = []
    for scene in drawn[:: max(len(drawn) // count, 1)][:count]:
        taken = take(scene)
        evidence = feed(Papillae(), scene_of_trial(scene, taken))
        assert evidence.slipped is not None
        onsets = taken.truth["slip_per_papilla_ns"]
        at_us = np.array([np.inf if ns is None else since_us(taken, ns) for ns in onsets])
        true = (at_us < evidence.t_us[:, None]).mean(axis=1)
        slipping = (true > 0) & (evidence.t_us <= at_us[np.isfinite(at_us)].max())
        first = int(np.searchsorted(evidence.t_us, at_us.min()))
        found.append(FollowedSlide(evidence.slipped, true, slipping, first, len(onsets)))
    return found


def measure(slides: int = 24) -> Figures:
    """Figures of so many slides in each kind of worlds."""
    figures: Figures = {}
    for worlds in WORLDS:
        name = worlds.replace("-", "_")
        every = followed(slides, worlds)
        errors = [np.abs(each.shown - each.true)[each.slipping] for each in every]
        right = [error <= 1 / each.tips for each, error in zip(every, errors, strict=True)]
        figures |= {
            f"{name}_error_percent": 100 * float(np.mean([error.mean() for error in errors])),
            f"{name}_error_worst_percent": 100 * float(max(error.mean() for error in errors)),
            f"{name}_to_one_tip_percent": 100 * float(np.mean([each.mean() for each in right])),
            f"{name}_alarms": float(sum(bool((each.shown > 0).any()) for each in every)),
        }
    return figures
