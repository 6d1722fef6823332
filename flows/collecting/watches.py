"""Checks between two trials that may end a campaign: disk space, and drift of reference trials."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from sliplab.analysis.references import (
    ReferenceDrift,
    compare,
    of_skin,
    reference_figures,
    reference_trials,
)
from sliplab.flows.collecting.requests import CampaignStopped
from sliplab.flows.planning.disk_space import RESERVE
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.planning.size_estimate import trial_bytes
from sliplab.flows.running.console import size
from sliplab.protocols import PlannedTrial
from sliplab.storage.trials.context import SKIN, LoggedContext
from sliplab.storage.trials.store import Campaign, TrialStore

_LOOK_BACK = 50
"""Committed trials from which a session estimates sizes when it begins."""
_SHOWN = {
    "event_rate": ("{:,.0f}", "events/s in the hold", "Skin, light or lens changed"),
    "friction": (
        "{:.3f}",
        "N/N of friction in the slide",
        "Skin worn, or skin or plate dirty",
    ),
}
"""Format, unit and place, and likely causes of a drift, by key of ``gates.reference``."""


class DiskWatch:
    """Checks that the disk has room for the next trial.

    A trial needs the plan's estimate times the largest ratio of true to estimated size among this
    campaign's trials so far, and the raw size of frames that are spooled.

    Args:
        free: returns the bytes free where a folder is.
    """

    def __init__(
        self,
        run_request: RunRequest,
        campaign: Campaign,
        free: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        self._run_request, self._campaign, self._free = run_request, campaign, free
        self._ratio: float | None = None
        there = campaign.committed()
        for trial in [item for item in run_request.plan if item.id in there][-_LOOK_BACK:]:
            self.learn(trial)

    def learn(self, trial: PlannedTrial) -> None:
        """Update the ratio by the size of a trial that was just committed."""
        folder = self._campaign.folder / "trials" / trial.id
        took = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
        ratio = took / max(trial_bytes(self._run_request.rig, self._run_request.plan, trial), 1.0)
        self._ratio = max(ratio, self._ratio or 0.0)

    def needs(self, trial: PlannedTrial) -> float:
        """Return the bytes that a trial takes while it is written."""
        rig, plan = self._run_request.rig, self._run_request.plan
        stored = trial_bytes(rig, plan, trial) * (1.0 if self._ratio is None else self._ratio)
        frame = rig.frame_px(plan)
        if not rig.frame_camera.spool or frame is None:
            return stored
        rate = rig.frame_rate_hz(plan)
        return stored + frame[0] * frame[1] * rate * plan.seconds(trial, recorded_only=True)

    def check(self, trial: PlannedTrial) -> None:
        """Check that the next trial fits.

        Raises:
            CampaignStopped: it does not.
        """
        needed, free = self.needs(trial), self._free(self._campaign.folder)
        if needed + RESERVE > free:
            known = "by the plan" if self._ratio is None else "by the trials so far"
            raise CampaignStopped(
                f"{self._run_request.store}: stopped, the disk is nearly full: {size(free)} are "
                f"free, the next trial needs {size(needed)} ({known}) and {size(RESERVE)} stay in "
                "reserve; make room, then run the same command to resume. Every committed trial "
                "is kept"
            )


class ReferenceWatch:
    """Compares every reference trial with the first of its skin, and stops at a large drift."""

    def __init__(self, run_request: RunRequest, campaign: Campaign) -> None:
        self._run_request, self._campaign = run_request, campaign
        self._gate = run_request.plan.protocol.collection.gates.reference
        self._first: tuple[str, dict[str, float]] | None = None
        self._skin: str | None = None
        """Of the first one."""

    def begin(self) -> None:
        """Check the last reference trial of earlier sessions.

        Raises:
            CampaignStopped: it had drifted, and no retake was requested.
        """
        if self._gate is None:
            return
        logged = LoggedContext(TrialStore(self._run_request.store), self._campaign.name).read()
        skin = logged.get(SKIN, self._run_request.rig.skin.serial)
        known = reference_trials(self._run_request.plan, self._campaign.committed())
        known = of_skin(self._campaign, known, skin)
        for trial in dict.fromkeys([*known[:1], *known[-1:]]):
            self.look(trial)

    def look(self, trial: PlannedTrial) -> None:
        """Check a trial that was just committed, if it is a reference trial.

        Raises:
            CampaignStopped: it drifted beyond the protocol's bound.
        """
        if self._gate is None or trial.role != "reference":
            return
        recording = self._campaign.recording(trial.id)
        found = trial.id, reference_figures(recording, self._gate)
        skin = recording.context.get(SKIN)
        if self._first is None or skin != self._skin:
            self._first, self._skin = found, skin
        for drift in compare(self._gate, self._first, found):
            if drift.beyond:
                raise CampaignStopped(self._message(drift))

    def _message(self, drift: ReferenceDrift) -> str:
        figure, where, cause = _SHOWN[drift.key]
        simulated = "simulated " if self._run_request.rig.simulated else ""
        return (
            f"campaign {self._campaign.name}: {simulated}reference trials drifted apart: "
            f"{drift.trial} has {figure.format(drift.value)} {where}, {drift.first} had "
            f"{figure.format(drift.expected)} ({drift.percent:+.1f} %, "
            f"gates.reference.{drift.key} = {drift.bound_percent:g} %). {cause}: see to it, then "
            f"`sliplab again {self._run_request.store} {drift.trial} --why ...` and the same "
            f"command go on (give {drift.first} as well if the new state is the one to compare "
            "with). Onsets were not compared: they are known after `sliplab label` only"
        )
