"""One session at a rig, from the store's lock to the last trial, without Prefect.

Recovery from a crash happens here, before the first trial.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from sliplab.flows.collecting.session import Session
from sliplab.flows.collecting.trial_gate import TrialGate, carry_out
from sliplab.flows.planning.run_request import RunRequest, describe_campaign, pending_trials
from sliplab.flows.running import stopping
from sliplab.protocols import Trial
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_lock import held
from sliplab.storage.errors import translated_disk_errors
from sliplab.storage.files import sweep_temporary
from sliplab.storage.trials import control
from sliplab.storage.trials.lock import STORE_LOCK, exclusive
from sliplab.storage.trials.migrate import migrate
from sliplab.storage.trials.store import Campaign, Store


@dataclass(frozen=True)
class RunSession:
    """A session that is about to begin, and the trials that it is to take."""

    session: Session
    gate: TrialGate
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
def run_session(run_request: RunRequest) -> Iterator[RunSession]:
    """Open a session round a collection's trials; the rig is closed when the block ends.

    Raises:
        Locked: somebody else collects into the store, or uses the rig.
        StoreError: its disk is full, read-only or failing.
        CampaignStopped: reference trials had drifted.
    """
    store = Store.create(run_request.store)
    with owned(store, collects=run_request.campaign):
        campaign = _recover(store, run_request)
        gate = TrialGate(run_request, store, campaign)
        gate.begin()
        with held(run_request.rig, store.folder):
            rig = build_rig(run_request.rig)
            rig.should_stop = stopping.requested
            trials = run_request.wanted(campaign)
            left_out = len(pending_trials(run_request.plan, campaign)) - len(trials)
            campaign.add_bench_record(_session_record(run_request))
            session = Session(
                run_request.plan, run_request.rig, rig, campaign, run_request.metadata.operator
            )
            session.gate, gate.fresh_start = gate, session.fresh_start
            try:
                yield RunSession(session, gate, trials, left_out)
            finally:
                rig.close()


def refresh(run_request: RunRequest) -> Campaign:
    """Recover the store and write the campaign's description, when there is nothing to take."""
    store = Store.create(run_request.store)
    with owned(store):
        return _recover(store, run_request)


def _recover(store: Store, run_request: RunRequest) -> Campaign:
    """Clean up after a crash and carry out requests that were not carried out yet."""
    clean_up(store)
    campaign = describe_campaign(store, run_request)
    campaign.sweep()
    carry_out(store)
    return campaign


def clean_up(store: Store) -> None:
    """Delete the temporary files that killed programs left outside the campaigns."""
    sweep_temporary(store.folder)
    sweep_temporary(store.folder / control.FOLDER)
    derived = store.folder / "derived"
    folders = [store.folder / "models", store.folder / "report", derived]
    if derived.is_dir():
        folders += [path for path in derived.rglob("*") if path.is_dir()]
    for folder in folders:
        sweep_temporary(folder)


def _session_record(run_request: RunRequest) -> dict[str, Any]:
    """Metadata of one session at the rig, as the store keeps it."""
    began = datetime.now(UTC)
    skin = run_request.rig.skin
    return {
        "began": began.isoformat(timespec="seconds"),
        **asdict(run_request.metadata),
        "rig": run_request.rig.name,
        "sensor": run_request.rig.sensor,
        "skin": skin.serial,
        "calibration": run_request.rig.calibration.model_dump(mode="json", exclude_none=True),
        "skin_age_days": None if skin.made is None else (began.date() - skin.made).days,
        "simulated": run_request.rig.simulated,
    }
