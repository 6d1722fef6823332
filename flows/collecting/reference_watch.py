"""Reference trials over a campaign: does the same condition still look the same?

Only the event rate in the hold is compared. Onsets are not known while a campaign runs: they are
read from the outside camera's pictures by `sliplab label`.
"""

from __future__ import annotations

from sliplab.flows.collecting.stops import CampaignStopped
from sliplab.flows.planning.run_request import RunRequest
from sliplab.protocols import Trial
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign


def hold_rate(recording: Recording) -> float:
    """Events a second while the arm held still in contact, recorded part."""
    start, end = recording.step("hold")
    return len(recording.events(start, end)) / ((end - start) / 1e9)


class ReferenceWatch:
    """Holds every reference trial against the campaign's first one."""

    def __init__(self, run_request: RunRequest, campaign: Campaign) -> None:
        self._run_request, self._campaign = run_request, campaign
        self._gate = run_request.plan.protocol.collection.gates.reference
        self._first: tuple[str, float] | None = None

    def begin(self) -> None:
        """Look at the last reference trial of the stretches before.

        Raises:
            CampaignStopped: it had drifted, and nobody asked for it again.
        """
        if self._gate is None:
            return
        there = self._campaign.committed()
        known = [t for t in self._run_request.plan if t.role == "reference" and t.id in there]
        for trial in dict.fromkeys([*known[:1], *known[-1:]]):
            self.look(trial)

    def look(self, trial: Trial) -> None:
        """Compare a trial that was just committed, if it is a reference trial.

        Raises:
            CampaignStopped: it drifted beyond the protocol's bound.
        """
        if self._gate is None or trial.role != "reference":
            return
        rate = hold_rate(self._campaign.recording(trial.id))
        if self._first is None:
            self._first = (trial.id, rate)
            return
        first, expected = self._first
        drift = 100 * (rate / expected - 1) if expected else (100.0 if rate else 0.0)
        bound = float(self._gate.event_rate)
        if abs(drift) <= bound:
            return
        simulated = "simulated " if self._run_request.rig.simulated else ""
        raise CampaignStopped(
            f"campaign {self._campaign.name}: {simulated}reference trials drifted apart: "
            f"{trial.id} has {rate:,.0f} events/s in the hold, {first} had {expected:,.0f} "
            f"({drift:+.1f} %, gates.reference.event_rate = {bound:g} %). Skin, light or lens "
            f"changed: see to it, then `sliplab again {self._run_request.store} {trial.id} "
            f"--why ...` and the same command go on (give {first} as well if the new state is the "
            "one to compare with). Onsets were not compared: they are known after `sliplab label` "
            "only"
        )
