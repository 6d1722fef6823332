"""Results that are wanted of single trials, each with the key that it must have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store

Make = Callable[[Recording, Any], Any]
"""Of a trial and settings, what is wanted. It may run in processes of their own, so it stands in a
module, best in one that loads quickly. For `run_trials`, a result's JSON and its arrays."""


@dataclass(frozen=True)
class TrialWork:
    """One result that is wanted of one trial, with the key it must have."""

    recording: Recording
    campaign: str
    key: str
    settings: Any = None


def stale_trials(store: Store, step: str, wanted: list[TrialWork]) -> list[TrialWork]:
    """Those of `wanted` that have to be made."""
    return [
        work
        for work in wanted
        if not Derived.of(store, step, work.campaign).fresh(work.recording.folder.name, work.key)
    ]


Done = Callable[[int, Any], None]
"""Gets the number of an item of the work, and what was made of it."""
EachTrial = Callable[[Sequence[TrialWork], Make, Done], None]
"""Makes every item of some work, in any order: in this process, or on other machines."""


def in_order(work: Sequence[TrialWork], make: Make, done: Done) -> None:
    """Make every item in this process, one after the other."""
    for number, item in enumerate(work):
        done(number, make(item.recording, item.settings))


KeepTrials = Callable[[str, list[TrialWork], Make], None]
"""Makes every item of some work and keeps it among the derived results of a step, by its name."""
