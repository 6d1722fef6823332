"""All statistics of a pilot by name, in the form in which pilots and worlds are compared."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sliplab.plugins.twin.camera_estimates import read_camera
from sliplab.plugins.twin.contact_estimates import NOT_LOGGED, contact_estimates, read_contact
from sliplab.plugins.twin.contact_springs import Guess
from sliplab.plugins.twin.misfits import misfit_numbers
from sliplab.plugins.twin.pilot import PilotTrial
from sliplab.storage.streams import F64


def events_of(slides: Sequence[PilotTrial], with_events: Collection[str]) -> list[PilotTrial]:
    """Return the slides whose events are read.

    Args:
        with_events: ids of trials.
    """
    return [slide for slide in slides if slide.trial in with_events and slide.camera is not None]


VERSION = 5
"""Raised with every change of a statistic or of the scene's physics: worlds are simulated again."""


@dataclass(frozen=True)
class SlideStatistics:
    """Statistics of slides, by name.

    Attributes:
        fitted: of contact and event camera; parameters are estimated by them.
        effects: the numbers of the checks for effects that the scene lacks.
    """

    fitted: dict[str, float]
    effects: dict[str, float]


def statistics(
    slides: Sequence[PilotTrial], with_events: Collection[str], guess: Guess
) -> SlideStatistics:
    """Return what slides show.

    Args:
        with_events: ids of those whose events are read. guess: see `read_contact`.
    """
    seen = events_of(slides, with_events)
    contact = read_contact(slides, guess)
    found = contact_estimates(contact) if contact else {}
    camera, checked = read_camera(seen)
    if seen:
        found |= camera
    return SlideStatistics(found, misfit_numbers(slides, seen, contact) | checked)


def of_names(values: Mapping[str, float], names: Sequence[str]) -> F64:
    """Return the logarithms of statistics by name, (q,); NaN for one that is missing.

    Those that may be negative stay as they are.
    """
    found = np.array([values.get(name, np.nan) for name in names], np.float64)
    plain = np.array([name in NOT_LOGGED for name in names], np.bool_)
    with np.errstate(invalid="ignore", divide="ignore"):
        logged = np.log(np.where(found > 0.0, found, np.nan))
    result: F64 = np.where(plain, found, logged)
    return result
