"""Collection: takes the trials that the store lacks, on one rig, under one protocol.

The truth about what is done is the store; Prefect sees a flow a campaign and a task a trial on a
real rig, a task a batch on a mock rig (where a trial takes less time than a task costs).
"""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows import console, stopping
from flows.orchestration import Parcel, run
from flows.orders import (
    Order,
    campaign_counts,
    check_disk,
    describe_campaign,
    pending_trials,
)
from flows.session import Session
from flows.timing import timed
from protocols import Trial
from rigs.build import build_rig
from storage.lock import exclusive
from storage.store import Store

MOCK_BATCH = 25


@task(name="trials", cache_policy=NO_CACHE, persist_result=False)
def take_trials(session: Parcel[Session], trials: Parcel[list[Trial]]) -> int:
    """Take some trials; returns how many."""
    session.content.take(trials.content)
    return len(trials.content)


@flow(name="collect", validate_parameters=False, persist_result=False)
def collect_flow(order: Parcel[Order]) -> dict[str, Any]:
    """Take the trials of an order that its store lacks."""
    wanted = order.content
    store = Store.create(wanted.store)
    with (
        exclusive(store.folder / ".lock", f"the store {store.folder}"),
        timed(store, f"collect {wanted.campaign}"),
    ):
        campaign = describe_campaign(store, wanted)
        campaign.sweep()
        rig = build_rig(wanted.rig)
        rig.should_stop = stopping.requested
        session = Session(wanted.plan, wanted.rig, rig, campaign, wanted.bench.operator)
        trials = pending_trials(wanted.plan, campaign)
        campaign.add_bench_record(_bench_record(wanted))
        simulated = "simulated " if wanted.rig.simulated else ""
        with console.bar(f"collect {wanted.campaign} ({simulated}trials)", len(trials)) as bar:
            session.on_trial = lambda trial, outcome: bar.advance(1, f"{trial.id} {outcome}")
            try:
                with stopping.signals():  # Prefect has handlers of its own inside a flow
                    rig.connect()
                    size = MOCK_BATCH if wanted.rig.simulated else 1
                    for start in range(0, len(trials), size):
                        take_trials(Parcel(session), Parcel(trials[start : start + size]))
            finally:
                rig.close()
        return {
            **campaign_counts(wanted, campaign),
            "taken": session.taken,
            "retaken": session.retaken,
        }


def _bench_record(order: Order) -> dict[str, Any]:
    """One stretch of work at the rig."""
    began = datetime.now(UTC)
    skin = order.rig.skin
    return {
        "began": began.isoformat(timespec="seconds"),
        **asdict(order.bench),
        "rig": order.rig.name,
        "sensor": order.rig.sensor,
        "skin": skin.serial,
        "calibration": order.rig.calibration.model_dump(mode="json", exclude_none=True),
        "skin_age_days": None if skin.made is None else (began.date() - skin.made).days,
        "simulated": order.rig.simulated,
    }


def collect(order: Order) -> dict[str, Any]:
    """Run the collection; returns at once when the store lacks nothing that can be taken."""
    store = Store.create(order.store)
    if pending_trials(order.plan, store.campaign(order.campaign)):
        check_disk([order])
        return run(collect_flow, Parcel(order))
    campaign = describe_campaign(store, order)
    return {**campaign_counts(order, campaign), "taken": 0, "retaken": 0}
