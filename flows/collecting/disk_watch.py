"""Is there room for the next trial? Looked at before each one, so that no disk is ever full."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from sliplab.flows.collecting.stops import CampaignStopped
from sliplab.flows.planning.estimate import RESERVE, trial_bytes
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running.console import size
from sliplab.protocols import Trial
from sliplab.storage.trials.store import Campaign

_LOOK_BACK = 50
"""Committed trials that a session learns from when it begins."""


class DiskWatch:
    """Compares what is free with what the next trial needs.

    That is the plan's estimate, times the largest ratio of true size to estimate that a trial of
    this campaign had so far. Frames that are spooled raw count with their raw size besides.

    Args:
        free: bytes free where a folder is.
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

    def learn(self, trial: Trial) -> None:
        """Take the size of a trial that was just committed into account."""
        folder = self._campaign.folder / "trials" / trial.id
        took = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
        ratio = took / max(trial_bytes(self._run_request.rig, self._run_request.plan, trial), 1.0)
        self._ratio = max(ratio, self._ratio or 0.0)

    def needs(self, trial: Trial) -> float:
        """Bytes that a trial takes while it is written."""
        rig, plan = self._run_request.rig, self._run_request.plan
        kept = trial_bytes(rig, plan, trial) * (1.0 if self._ratio is None else self._ratio)
        frame = rig.frame_px(plan)
        if not rig.frame_camera.spool or frame is None:
            return kept
        rate = plan.protocol.collection.recording.sync_rate
        return kept + frame[0] * frame[1] * rate * plan.seconds(trial, recorded_only=True)

    def check(self, trial: Trial) -> None:
        """Whether the next trial fits.

        Raises:
            CampaignStopped: it does not.
        """
        needed, free = self.needs(trial), self._free(self._campaign.folder)
        if needed + RESERVE > free:
            known = "by the plan" if self._ratio is None else "by the trials so far"
            raise CampaignStopped(
                f"{self._run_request.store}: stopped before its disk is full: {size(free)} are "
                f"free, the next trial needs {size(needed)} ({known}) and {size(RESERVE)} stay in "
                "reserve; make room, then run the same command to go on. Every committed trial "
                "is kept"
            )
