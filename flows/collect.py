"""Collection of the missing trials of one protocol on one rig.

The store is the only record of progress. Prefect sees one flow per campaign and one task per batch
of trials, which ends after 5 s or 25 trials: one trial on a real rig, as a rule, and many on a
simulated one, where a task costs as much as a trial.
"""

from __future__ import annotations

import time

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.flows.collecting.preparation import announce
from sliplab.flows.collecting.progress import progress_display
from sliplab.flows.collecting.requests import (
    carry_out,
    end_if_stopped,
    refuse_paused,
    store_lock,
)
from sliplab.flows.collecting.session import TrialCollector, open_session, refresh
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import CampaignCounts, RunRequest, check_disk
from sliplab.flows.running import stopping
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import timed
from sliplab.protocols import PlannedTrial
from sliplab.storage.trials import control
from sliplab.storage.trials.store import TrialStore

BATCH = 25
"""Most trials in a task."""
BATCH_S = 5.0
"""After so long a task begins no further trial."""


class CollectResult(CampaignCounts):
    """Numbers of a campaign's trials after a collection, and of what it did.

    Attributes:
        taken: attempts; retaken: those of a trial that an attempt failed of before.
        left_out: trials that the request does not include yet.
        ended: why the collection ended.
    """

    taken: int
    retaken: int
    left_out: int
    ended: str


@task(name="trials", cache_policy=NO_CACHE, persist_result=False)
def take_trials(collector: Opaque[TrialCollector], trials: Opaque[list[PlannedTrial]]) -> int:
    """Collect trials in order, at most `BATCH` and for `BATCH_S`; return their number."""
    began, count = time.monotonic(), 0
    for trial in trials.content[:BATCH]:
        collector.content.take([trial])
        count += 1
        if time.monotonic() - began >= BATCH_S:
            break
    return count


@flow(name="collect", validate_parameters=False, persist_result=False)
def collect_flow(request: RunRequest) -> CollectResult:
    """Collect the missing trials of a campaign."""
    several = "trials from " if request.rig.in_virtual_time else "trial "
    with (
        progress_display(request) as progress,
        open_session(request, progress) as session,
        timed(TrialStore(request.store), f"collect {request.campaign}"),
    ):
        collector, trials = session.collector, session.trials
        # inside a flow Prefect has installed its own handlers
        with progress.begin(trials), stopping.signals():
            announce(request.rig, "connecting sync box, arm and sensors")
            collector.rig.connect()
            begun = 0
            while trials:
                taken = 0
                while taken < len(trials):
                    first = trials[taken].id
                    batch = take_trials.with_options(task_run_name=f"{several}{first}")
                    taken += batch(Opaque(collector), Opaque(trials[taken:]))
                begun += len(trials)
                room = None if request.most is None else request.most - begun
                trials = session.more()[:room] if room != 0 else []
                progress.add(trials)
        left_out = session.left_out
        if session.rounds is not None:
            left_out = len(pending_trials(request.plan, collector.campaign))
        return {
            **request.counts(collector.campaign),
            "taken": collector.taken,
            "retaken": collector.retaken,
            "left_out": left_out,
            "ended": request.end_reason(collector.campaign),
        }


def collect(run_request: RunRequest) -> CollectResult:
    """Run the collection; returns at once when the store lacks nothing that can be taken.

    Raises:
        CampaignStopped: the store is paused, the disk has no room for the next trial, or
            reference trials drifted apart.
        KeyboardInterrupt: it was stopped.
    """
    store = TrialStore.create(run_request.store)
    end_if_stopped(store, run_request.since)
    refuse_paused(store)
    if control.open_requests(store):  # the requester was killed before it carried them out
        with store_lock(store):
            carry_out(store)
    if run_request.due_trials(store.campaign(run_request.campaign)):
        check_disk([run_request])
        return run(collect_flow, run_request)
    campaign = refresh(run_request)
    return {
        **run_request.counts(campaign),
        "taken": 0,
        "retaken": 0,
        "left_out": len(pending_trials(run_request.plan, campaign)),
        "ended": run_request.end_reason(campaign),
    }
