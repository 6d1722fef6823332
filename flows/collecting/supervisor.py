"""Between two trials: may the next one begin? Requests, the time window, the disk, references."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from datetime import datetime

from sliplab.flows.collecting.requests import CampaignStopped, carry_out
from sliplab.flows.collecting.watches import DiskWatch, ReferenceWatch
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import console, stopping
from sliplab.protocols import PlannedTrial
from sliplab.storage.streams import Json
from sliplab.storage.trials import control
from sliplab.storage.trials.control import ControlRequest
from sliplab.storage.trials.store import Campaign, TrialStore

PAUSE_LIMIT_S = 12 * 3600.0
POLL_S = 0.5
"""Interval at which a paused collection checks for its resumption, s."""


class WindowOver(CampaignStopped):
    """The time window of the collection is over; the next collection resumes it."""


class SessionListener:
    """Follows a session, such as a progress display; this one does nothing."""

    def on_trial_done(self, trial: PlannedTrial, outcome: str) -> None:
        """Take note of a trial that is ``committed``, ``set aside`` or ``skipped``."""

    def on_paused(self, why: str) -> None:
        """Take note of a pause: before which trial, who asked for it and why."""

    def on_resumed(self, seconds: float) -> None:
        """Take note of the end of a pause of some seconds."""


NO_LISTENER = SessionListener()


class CollectionSupervisor:
    """Decides between two trials whether the next may begin; notified after each.

    It carries out requests from other terminals, and watches the time window, the disk and the
    reference trials. Only the window's end is looked at while the arm moves; all of it is checked
    before it moves again.

    Attributes:
        wait: waits some seconds, and answers stop requests.
        listener: notified of pauses.
        clock: returns seconds since 1970; passed_s: those since this object was made, of a clock
            that nobody sets. The window ends when either says so.
        in_real_time: False for a rig in virtual time, on which nothing moves that could be late.
    """

    def __init__(
        self,
        run_request: RunRequest,
        store: TrialStore,
        campaign: Campaign,
        disk: DiskWatch | None = None,
        listener: SessionListener = NO_LISTENER,
    ) -> None:
        self._run_request, self._store, self._campaign = run_request, store, campaign
        self.disk = DiskWatch(run_request, campaign) if disk is None else disk
        self._references = ReferenceWatch(run_request, campaign)
        self.wait: Callable[[float], None] = stopping.wait
        self.listener = listener
        self.clock: Callable[[], float] = time.time
        began_s = time.monotonic()
        self.passed_s: Callable[[], float] = lambda: time.monotonic() - began_s
        self._until = math.inf if run_request.until is None else run_request.until
        self._window_s = self._until - self.clock()
        self.in_real_time = not run_request.rig.in_virtual_time
        self._seen: frozenset[str] = frozenset()
        self._paused: ControlRequest | None = None
        self._was_paused = False
        self._skipped = frozenset(control.skipped(campaign))
        self._retakes: set[str] = set()

    def begin(self) -> None:
        """Check reference trials before the first trial.

        Raises:
            CampaignStopped: the last reference trial had drifted.
        """
        self._references.begin()

    def may_take(self, trial: PlannedTrial, preparation_s: float = 0.0) -> bool:
        """Return whether to take `trial` now; waits while the store is paused.

        Args:
            preparation_s: planned time of what the arm does before the trial, s.

        Raises:
            KeyboardInterrupt: a stop was requested.
            CampaignStopped: the disk has no room for it, or a pause was not ended in time.
            WindowOver: the trial does not fit into the window.
        """
        if self._process_requests():
            self._wait_while_paused(trial)
        if trial.id in self._skipped:
            return False
        self.check_window(trial, preparation_s)
        self.disk.check(trial)
        return True

    def check_window(self, trial: PlannedTrial, preparation_s: float = 0.0) -> None:
        """Check that the trial's planned time fits: the arm must rest while people are present.

        Args:
            preparation_s: planned time of what the arm still does before the trial, s.

        Raises:
            WindowOver: it does not.
        """
        if self._run_request.until is None:
            return
        planned = (
            preparation_s + self._run_request.plan.seconds(trial) if self.in_real_time else 0.0
        )
        if self._late_s() + planned > 0:
            raise self.window_over(f"too soon for {trial.id}")

    def is_window_over(self) -> bool:
        """Return whether the window has ended: the arm must rest, whatever it does."""
        return self.in_real_time and self._late_s() > 0

    def _late_s(self) -> float:
        """Return the time since the window's end, s, by the clock that is further."""
        return max(self.clock() - self._until, self.passed_s() - self._window_s)

    def window_over(self, what: str) -> WindowOver:
        """Return the error that says when the window ends, what that means, and what follows."""
        until = self._run_request.until
        assert until is not None
        return WindowOver(
            f"the window of campaign {self._campaign.name} ends "
            f"{datetime.fromtimestamp(until).astimezone():%Y-%m-%d %H:%M %Z}, {what}; "
            "the next collection continues"
        )

    def was_paused(self) -> bool:
        """Return whether there was a pause since the last call: the rig may have changed."""
        found, self._was_paused = self._was_paused, False
        return found

    def after(self, trial: PlannedTrial, outcome: str) -> None:
        """Update the disk estimate and the drift check after a trial.

        Raises:
            CampaignStopped: it was a reference trial, and drifted.
        """
        if outcome == "committed":
            self.disk.learn(trial)
            self._references.look(trial)

    def more(self) -> list[PlannedTrial]:
        """Return pending trials that were requested again in the meantime, in the plan's order."""
        self._process_requests()
        retakes, self._retakes = self._retakes, set()
        if not retakes:
            return []
        return [
            t for t in pending_trials(self._run_request.plan, self._campaign) if t.id in retakes
        ]

    def _process_requests(self) -> ControlRequest | None:
        """Carry out new requests; return the one by which the store is paused, if it is."""
        names = self._names()
        if names != self._seen:
            self._seen = names  # before the answers are written: a request that comes now is seen
            for request, answer in carry_out(self._store, running=True):
                self._apply(request, answer)
            self._paused = control.paused(self._store)
        return self._paused

    def _apply(self, request: ControlRequest, answer: Json) -> None:
        """Apply an answered request to this session."""
        if request.kind == "stop":
            console.say(f"stopped: {request}")
            stopping.stop()
        if request.kind in {"pause", "resume"} or request.campaign != self._campaign.name:
            return
        self._skipped = frozenset(control.skipped(self._campaign))
        if request.kind == "again":
            self._retakes |= set(request.trials)
        for trial, did in answer["did"].get("trials", {}).items():
            console.say(f"{request.kind} {trial}: {did}")

    def _wait_while_paused(self, trial: PlannedTrial) -> None:
        """Wait until the pause is over."""
        why = f"paused before {trial.id} ({self._paused})"
        console.say(f"{why}; `sliplab resume {self._store.folder}` continues it")
        self.listener.on_paused(why)
        waited = 0.0
        while request := self._process_requests():
            self.check_window(trial)
            if waited >= PAUSE_LIMIT_S:
                raise CampaignStopped(
                    f"{self._store.folder} was paused ({request}) for "
                    f"{console.duration(PAUSE_LIMIT_S)} and nobody resumed it: `sliplab resume "
                    f"{self._store.folder}`, then run the same command to resume"
                )
            self.wait(POLL_S)
            waited += POLL_S
        console.say("resumed")
        self.listener.on_resumed(waited)
        self._was_paused = True

    def _names(self) -> frozenset[str]:
        try:
            return frozenset(os.listdir(self._store.folder / control.FOLDER))
        except FileNotFoundError:
            return frozenset()
