"""Collection: takes the trials that the store lacks, on one rig, under one protocol.

The truth about what is done is the store; Prefect sees a flow a campaign and a task a trial on a
real rig, a task a batch on a mock rig (where a trial takes less time than a task costs).
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.utilities.annotations import quote

from flows import console
from flows.estimate import check_space, plan_bytes
from flows.session import Session, summary
from flows.timing import timed
from protocols import InputError, Plan, Trial, load_plan
from protocols.yaml_file import read_text
from rigs.build import build_rig
from rigs.rig_file import RigFile, check_plan, load_rig_file, rig_hash
from storage.lock import exclusive
from storage.store import Campaign, Store, StoreError

MOCK_BATCH = 25


@dataclass(frozen=True)
class Order:
    """A collection that was asked for and found possible."""

    plan: Plan
    rig: RigFile
    rig_text: str
    store: Path
    campaign: str
    enable: tuple[str, ...]
    operator: str = ""
    note: str = ""


def make_order(
    protocol: Path,
    rig: Path,
    store: Path,
    *,
    enable: tuple[str, ...] = (),
    campaign: str | None = None,
    operator: str = "",
    note: str = "",
) -> Order:
    """Read and check everything that can be known before anything moves.

    Raises:
        InputError: protocol, rig, or a plan that this rig or this disk cannot take.
        StoreError: the folder is no store, or the campaign was begun under another collection.
    """
    plan = load_plan(protocol, enable)
    rig_file, rig_text = load_rig_file(rig)
    check_plan(rig_file, plan, str(rig))
    if plan.protocol.collection.plate is not None and not rig_file.has_plate:
        raise InputError(rig, "mock.plate", None, f"is needed: {protocol} moves a sliding plate")
    name = campaign or plan.protocol.name
    order = Order(plan, rig_file, rig_text, store, name, enable, operator, note)
    if (store / "store.json").exists():
        found = Store.open(store).campaign(name)
        if (found.folder / "campaign.json").exists():
            _check_same(order, found)
    return order


def _check_same(order: Order, campaign: Campaign) -> None:
    info = campaign.info
    if info["collection_hash"] != order.plan.collection_hash:
        raise StoreError(
            f"{campaign.folder}: was begun under another `collection:` section; changing "
            "analysis, levels or repetitions is fine, anything else would mix two experiments. "
            "Give the new one its own name with --campaign"
        )
    if info["rig_hash"] != rig_hash(order.rig_text):
        raise StoreError(
            f"{campaign.folder}: was begun on another rig file (its copy is rig.yaml there); "
            "give the new one its own name with --campaign"
        )
    if missing := campaign.committed() - {trial.id for trial in order.plan}:
        raise StoreError(
            f"{campaign.folder}: holds trials that the protocol no longer has, such as "
            f"{min(missing)}; a protocol may only add trials to a campaign"
        )


def pending_trials(order: Order) -> int:
    """How many trials the store lacks; set-aside ones do not count."""
    if not (order.store / "store.json").exists():
        return len(order.plan)
    campaign = Store.open(order.store).campaign(order.campaign)
    failed = campaign.failed_attempts()
    retakes = order.plan.protocol.collection.gates.retakes
    done = campaign.committed()
    return sum(t.id not in done and failed.get(t.id, 0) <= retakes for t in order.plan)


@task(name="trials", cache_policy=NO_CACHE, persist_result=False)
def take_trials(session: Any, trials: Any) -> int:
    """Take some trials; returns how many."""
    wanted: list[Trial] = trials.unquote()
    session.unquote().take(wanted)
    return len(wanted)


@flow(name="collect", validate_parameters=False, persist_result=False)
def collect_flow(order: Any) -> dict[str, Any]:
    """Take the trials of an order (quoted) that its store lacks."""
    wanted: Order = order.unquote()
    store = Store.create(wanted.store)
    with exclusive(store.folder / ".lock", f"the store {store.folder}"), timed(
        store, f"collect {wanted.campaign}"
    ):
        campaign = _describe(store, wanted)
        campaign.sweep()
        rig = build_rig(wanted.rig)
        session = Session(wanted.plan, wanted.rig, rig, campaign, wanted.operator)
        trials = session.pending()
        done = {t.id for t in wanted.plan} - {t.id for t in trials}
        check_space(store.folder, plan_bytes(wanted.rig, wanted.plan, done))
        campaign.add_bench_record(_bench_record(wanted))
        simulated = "simulated " if wanted.rig.simulated else ""
        with console.bar(f"collect {wanted.campaign} ({simulated}trials)", len(trials)) as bar:
            session.on_trial = lambda trial, outcome: bar.advance(1, f"{trial.id} {outcome}")
            try:
                rig.connect()
                size = MOCK_BATCH if wanted.rig.simulated else 1
                for start in range(0, len(trials), size):
                    take_trials(quote(session), quote(trials[start : start + size]))
            finally:
                rig.close()
        return summary(session)


def _describe(store: Store, order: Order) -> Campaign:
    """Write what the campaign is; the protocol's analysis and levels may have changed."""
    campaign = store.campaign(order.campaign)
    info = {
        "name": order.campaign,
        "protocol": order.plan.protocol.name,
        "experiment": order.plan.protocol.collection.experiment,
        "collection_hash": order.plan.collection_hash,
        "rig": order.rig.name,
        "rig_hash": rig_hash(order.rig_text),
        "simulated": order.rig.simulated,
        "enabled": list(order.enable),
    }
    campaign.update(info, read_text(Path(order.plan.file), "protocol"), order.rig_text)
    return campaign


def _bench_record(order: Order) -> dict[str, Any]:
    return {
        "began": datetime.now(UTC).isoformat(timespec="seconds"),
        "operator": order.operator,
        "note": order.note,
        "rig": order.rig.name,
        "skin": order.rig.skin.serial,
        "simulated": order.rig.simulated,
    }


def collect(order: Order) -> dict[str, Any]:
    """Run the collection; says so and does nothing when the store lacks nothing."""
    if pending_trials(order) == 0:
        store = Store.open(order.store)
        campaign = _describe(store, order)
        planned = {trial.id for trial in order.plan}
        committed = campaign.committed() & planned
        failed = campaign.failed_attempts()
        return {
            "campaign": order.campaign,
            "planned": len(planned),
            "committed": len(committed),
            "taken": 0,
            "retaken": 0,
            "quarantined": len(campaign.quarantined()),
            "set_aside": sorted(planned - committed & set(failed)),
            "missing": len(planned) - len(committed),
            "simulated": order.rig.simulated,
        }
    return collect_flow(quote(order))  # type: ignore[no-any-return]
