"""Drift of a campaign's reference trials: each is compared with the first one of its skin.

Compared are the event rate in the hold and, on a rig with a force sensor, the friction in the
slide. Onsets are not: they are unknown until `sliplab label` has read the outside camera's frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sliplab.analysis.force import sliding_friction
from sliplab.analysis.quality import hold_rate
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.gates import ReferenceGate
from sliplab.storage.trials.context import SKIN
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign


@dataclass(frozen=True)
class ReferenceDrift:
    """A figure of a reference trial against that of the first one.

    Attributes:
        key: of the protocol's ``gates.reference``.
        first, trial: ids of the two trials.
        expected, value: their figures, in events/s or as a share.
        bound_percent: largest change that the protocol allows.
    """

    key: str
    first: str
    trial: str
    expected: float
    value: float
    bound_percent: float

    @property
    def percent(self) -> float:
        """Change since the first reference trial, %."""
        if self.expected:
            return 100 * (self.value / self.expected - 1)
        return 100.0 if self.value else 0.0

    @property
    def beyond(self) -> bool:
        """True if it changed by more than the protocol allows; a figure that is NaN did."""
        return not abs(self.percent) <= self.bound_percent


def reference_figures(recording: Recording, gate: ReferenceGate) -> dict[str, float]:
    """Return the figures that a protocol compares, by key of ``gates.reference``."""
    figures = {"event_rate": hold_rate(recording)}
    if gate.friction is not None:
        figures["friction"] = sliding_friction(recording)
    return figures


def reference_trials(plan: Plan, committed: set[str]) -> list[PlannedTrial]:
    """Return the committed reference trials, in the plan's order."""
    return [trial for trial in plan if trial.role == "reference" and trial.id in committed]


def of_skin(
    campaign: Campaign, trials: Sequence[PlannedTrial], skin: str | None
) -> list[PlannedTrial]:
    """Return the trials that were taken with a skin; None for that of the last trial."""
    skins = [campaign.recording(trial.id).context.get(SKIN) for trial in trials]
    wanted = skin if skin is not None or not skins else skins[-1]
    return [trial for trial, found in zip(trials, skins, strict=True) if found == wanted]


def compare(
    gate: ReferenceGate,
    first: tuple[str, dict[str, float]],
    trial: tuple[str, dict[str, float]],
) -> list[ReferenceDrift]:
    """Compare two trials, each an id and its `reference_figures`."""
    bounds = {"event_rate": gate.event_rate, "friction": gate.friction}
    return [
        ReferenceDrift(key, first[0], trial[0], expected, trial[1][key], float(bounds[key] or 0))
        for key, expected in first[1].items()
    ]


def last_drift(plan: Plan, campaign: Campaign, committed: set[str]) -> list[ReferenceDrift]:
    """Compare the last committed reference trial with the first of its skin.

    Returns:
        Nothing without two of them, or a gate.
    """
    gate = plan.protocol.collection.gates.reference
    if gate is None:
        return []
    known = of_skin(campaign, reference_trials(plan, committed), None)
    if len(known) < 2:
        return []
    first, last = (
        (trial.id, reference_figures(campaign.recording(trial.id), gate))
        for trial in (known[0], known[-1])
    )
    return compare(gate, first, last)
