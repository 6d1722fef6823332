"""One stretch of work at a rig, from the store's lock to the last trial, without Prefect.

Everything that a crash may have left behind is put right here, before the first trial.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from sliplab.flows.collecting.boundary import Boundary, carry_out
from sliplab.flows.collecting.session import Session
from sliplab.flows.planning.orders import Order, describe_campaign, pending_trials
from sliplab.flows.running import stopping
from sliplab.protocols import Trial
from sliplab.rigs.build import build_rig
from sliplab.rigs.capabilities import RigError
from sliplab.rigs.rig_lock import held
from sliplab.storage import control
from sliplab.storage.errors import translated_disk_errors
from sliplab.storage.files import sweep_temporary
from sliplab.storage.lock import STORE_LOCK, exclusive
from sliplab.storage.migrate import migrate
from sliplab.storage.store import Campaign, Store


@dataclass(frozen=True)
class Stretch:
    """A session that is about to begin, and the trials that it is to take."""

    session: Session
    boundary: Boundary
    trials: list[Trial]
    left_out: int = 0
    """Trials that the store lacks besides, and that were not asked for."""


@contextmanager
def owned(store: Store, *, brief: bool = False, collects: str = "") -> Iterator[None]:
    """Hold the store for writing while the block runs; it has the newest format then.

    Args:
        brief: for a moment only: a collection that begins meanwhile waits for it.
        collects: the campaign that trials are taken for; `sliplab stop` stops nothing else.

    Raises:
        Locked: somebody else holds it.
        StoreError: its disk is full, read-only or failing.
    """
    about = {"collects": collects} if collects else None
    with (
        translated_disk_errors(store.folder, RigError),
        exclusive(store.folder / STORE_LOCK, f"the store {store.folder}", brief=brief, about=about),
    ):
        migrate(store)
        yield


@contextmanager
def stretch(order: Order) -> Iterator[Stretch]:
    """What a collection does round its trials; the rig is closed when the block ends.

    Raises:
        Locked: somebody else collects into the store, or uses the rig.
        StoreError: its disk is full, read-only or failing.
        CampaignStopped: reference trials had drifted.
    """
    store = Store.create(order.store)
    with owned(store, collects=order.campaign):
        campaign = _put_right(store, order)
        boundary = Boundary(order, store, campaign)
        boundary.begin()
        with held(order.rig, store.folder):
            rig = build_rig(order.rig)
            rig.should_stop = stopping.requested
            trials = order.wanted(campaign)
            left_out = len(pending_trials(order.plan, campaign)) - len(trials)
            campaign.add_bench_record(_bench_record(order))
            session = Session(order.plan, order.rig, rig, campaign, order.bench.operator)
            session.boundary, boundary.fresh_start = boundary, session.fresh_start
            try:
                yield Stretch(session, boundary, trials, left_out)
            finally:
                rig.close()


def refresh(order: Order) -> Campaign:
    """Put the store right and write what the campaign is, when there is nothing to take."""
    store = Store.create(order.store)
    with owned(store):
        return _put_right(store, order)


def _put_right(store: Store, order: Order) -> Campaign:
    """What a crash left is cleared up, and what was asked for and not done yet is done."""
    clear_up(store)
    campaign = describe_campaign(store, order)
    campaign.sweep()
    carry_out(store)
    return campaign


def clear_up(store: Store) -> None:
    """Delete the temporary files that killed programs left outside the campaigns."""
    sweep_temporary(store.folder)
    sweep_temporary(store.folder / control.FOLDER)
    derived = store.folder / "derived"
    folders = [store.folder / "models", store.folder / "report", derived]
    if derived.is_dir():
        folders += [path for path in derived.rglob("*") if path.is_dir()]
    for folder in folders:
        sweep_temporary(folder)


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
