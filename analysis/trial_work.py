"""Results to compute from single trials, each with the key of its inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

Make = Callable[[Recording, Any], Any]
"""Compute a result of a trial and settings. It may run in other processes, so it is a function of a
module that loads quickly. For `run_trials` it returns a result's JSON and arrays."""


@dataclass(frozen=True)
class TrialWork:
    """One result to compute from one trial, with the key of its inputs."""

    recording: Recording
    campaign: str
    key: str
    settings: Any = None


def stale_trials(store: TrialStore, step: str, required: list[TrialWork]) -> list[TrialWork]:
    """Return the `required` results that are missing or have another key."""
    return [
        work
        for work in required
        if not Derived.of(store, step, work.campaign).fresh(work.recording.folder.name, work.key)
    ]


Done = Callable[[int, Any], None]
"""Receives the number of an item of the work, and its result."""
EachTrial = Callable[[Sequence[TrialWork], Make, Done], None]
"""Computes every item of some work, in any order: in this process, or on other machines."""


def in_order(work: Sequence[TrialWork], make: Make, done: Done) -> None:
    """Compute every item in this process, one after the other."""
    for number, item in enumerate(work):
        done(number, make(item.recording, item.settings))


KeepTrials = Callable[[str, list[TrialWork], Make], None]
"""Computes every item of some work and stores it with the derived results of the named step."""
