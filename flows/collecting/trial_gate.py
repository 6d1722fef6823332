"""Between two trials: what people asked for meanwhile, room on the disk, drift of references.

Nothing of this is looked at while the arm moves, and all of it before it moves again.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from datetime import datetime

from sliplab.flows.collecting.disk_watch import DiskWatch
from sliplab.flows.collecting.reference_watch import ReferenceWatch
from sliplab.flows.collecting.stops import CampaignStopped, WindowOver
from sliplab.flows.planning.run_request import RunRequest, pending_trials
from sliplab.flows.running import console, stopping
from sliplab.protocols import Trial
from sliplab.storage.streams import Json
from sliplab.storage.trials import control, decisions
from sliplab.storage.trials.control import Request
from sliplab.storage.trials.store import Campaign, Store

PAUSE_LIMIT_S = 12 * 3600.0
LOOK_S = 0.5
"""How often a paused collection looks whether it may go on."""


def carry_out(store: Store, running: bool = False) -> list[tuple[Request, Json]]:
    """Do what was asked for and is open; whoever calls holds the store's lock.

    Args:
        running: whether it is a collection that does so, between two trials.

    Returns:
        What was done, in order: the requests and their answers.
    """
    done = []
    for request in control.open_requests(store):
        did: Json
        if request.kind in {"pause", "resume"}:
            now = control.paused(store)
            did = {"paused": now is not None, "running": running}
        elif request.kind == "stop":
            did = {"stopped": running, "running": running}
        else:
            change = decisions.skip if request.kind == "skip" else decisions.again
            where = store.campaign(request.campaign)
            if where.begun:
                trials = change(where, request.trials, request.by)
            else:
                trials = dict.fromkeys(request.trials, "there is no such campaign")
            did = {"trials": trials, "running": running}
        done.append((request, control.answer(store, request, did)))
    return done


def refuse_paused(store: Store) -> None:
    """A collection that is begun while its store is paused would stand still at once.

    Raises:
        CampaignStopped: the store is paused.
    """
    if request := control.paused(store):
        raise CampaignStopped(
            f"{store.folder} is paused ({request}): `sliplab resume {store.folder}`, then run the "
            "same command"
        )


class TrialGate:
    """Trial gate: asked before each trial, notified after it.

    Attributes:
        wait: lets some seconds pass, and answers stop requests.
        on_pause: called with the seconds of a pause when it is over.
        fresh_start: called when a pause is over: the rig may not be what it was.
        clock: seconds since 1970, by which a window ends.
    """

    def __init__(
        self,
        run_request: RunRequest,
        store: Store,
        campaign: Campaign,
        disk: DiskWatch | None = None,
    ) -> None:
        self._run_request, self._store, self._campaign = run_request, store, campaign
        self.disk = DiskWatch(run_request, campaign) if disk is None else disk
        self._references = ReferenceWatch(run_request, campaign)
        self.wait: Callable[[float], None] = stopping.wait
        self.on_pause: Callable[[float], None] = lambda seconds: None
        self.fresh_start: Callable[[], None] = lambda: None
        self.clock: Callable[[], float] = time.time
        self._seen: frozenset[str] = frozenset()
        self._paused: Request | None = None
        self._skipped = frozenset(decisions.skipped(campaign))
        self._wanted: set[str] = set()

    def begin(self) -> None:
        """Before the first trial.

        Raises:
            CampaignStopped: the last reference trial had drifted.
        """
        self._references.begin()

    def may_take(self, trial: Trial) -> bool:
        """Whether to take `trial` now; waits as long as the store is paused.

        Raises:
            KeyboardInterrupt: somebody asked to stop.
            CampaignStopped: the disk has no room for it, or a pause was never ended.
            WindowOver: it would not be over in time.
        """
        if self._look():
            self._stand_still(trial)
        if trial.id in self._skipped:
            return False
        self._check_window(trial)
        self.disk.check(trial)
        return True

    def after(self, trial: Trial, outcome: str) -> None:
        """A trial is over.

        Raises:
            CampaignStopped: it was a reference trial, and drifted.
        """
        if outcome == "committed":
            self.disk.learn(trial)
            self._references.look(trial)

    def more(self) -> list[Trial]:
        """Trials that were asked for again meanwhile and are pending, in the plan's order."""
        self._look()
        wanted, self._wanted = self._wanted, set()
        if not wanted:
            return []
        return [t for t in pending_trials(self._run_request.plan, self._campaign) if t.id in wanted]

    def _look(self) -> Request | None:
        """Carry out what is new; returns the request by which the store is paused, if it is."""
        names = self._names()
        if names != self._seen:
            self._seen = names  # without the answers below: so what comes meanwhile is seen, too
            for request, answer in carry_out(self._store, running=True):
                self._apply(request, answer)
            self._paused = control.paused(self._store)
        return self._paused

    def _apply(self, request: Request, answer: Json) -> None:
        """Apply an answered request to this session."""
        if request.kind == "stop":
            console.say(f"stopped: {request}")
            stopping.stop()
        if request.kind in {"pause", "resume"} or request.campaign != self._campaign.name:
            return
        self._skipped = frozenset(decisions.skipped(self._campaign))
        if request.kind == "again":
            self._wanted |= set(request.trials)
        for trial, did in answer["did"].get("trials", {}).items():
            console.say(f"{request.kind} {trial}: {did}")

    def _check_window(self, trial: Trial) -> None:
        """A trial is begun only if its planned time fits in: the arm rests when people come."""
        until = self._run_request.until
        if until is None:
            return
        virtual = self._run_request.rig.in_virtual_time
        planned = 0.0 if virtual else self._run_request.plan.seconds(trial)
        if self.clock() + planned > until:
            raise WindowOver(
                f"the window of campaign {self._campaign.name} ends "
                f"{datetime.fromtimestamp(until).astimezone():%Y-%m-%d %H:%M %Z}, too soon for "
                f"{trial.id}; the next collection goes on"
            )

    def _stand_still(self, trial: Trial) -> None:
        console.say(
            f"paused before {trial.id} ({self._paused}); `sliplab resume {self._store.folder}` "
            "goes on"
        )
        waited = 0.0
        while request := self._look():
            self._check_window(trial)
            if waited >= PAUSE_LIMIT_S:
                raise CampaignStopped(
                    f"{self._store.folder} was paused ({request}) for "
                    f"{console.duration(PAUSE_LIMIT_S)} and nobody resumed it: `sliplab resume "
                    f"{self._store.folder}`, then run the same command to go on"
                )
            self.wait(LOOK_S)
            waited += LOOK_S
        console.say("resumed")
        self.on_pause(waited)
        self.fresh_start()

    def _names(self) -> frozenset[str]:
        try:
            return frozenset(os.listdir(self._store.folder / control.FOLDER))
        except FileNotFoundError:
            return frozenset()
