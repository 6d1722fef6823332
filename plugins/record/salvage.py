"""Trials whose recording was killed: what verifies of them is committed, and says so."""

from __future__ import annotations

import json
from pathlib import Path

from sliplab.plugins.record.campaign import FORMAT
from sliplab.plugins.record.trial_record import BegunTrial, make_record
from sliplab.storage.files import sweep_temporary, sync_folder, write_json_aside
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.schema.trial import Lost, Provenance
from sliplab.storage.trials.checksums import PROVENANCE, RECORD
from sliplab.storage.trials.prefix import keep_prefix
from sliplab.storage.trials.prefix_journal import BEGUN, JOURNAL
from sliplab.storage.trials.recovery import recover
from sliplab.storage.trials.store import IMPORTED, Campaign, TrialStore
from sliplab.storage.trials.writer import data_files


def salvage(store: TrialStore) -> list[str]:
    """Commit what verifies of all killed recordings of a store, whose lock the caller holds.

    Returns:
        The trials, as ``campaign/trial``.
    """
    return [
        f"{campaign.name}/{trial}"
        for campaign in store.campaigns()
        if campaign.info.get(IMPORTED, {}).get("format") == FORMAT
        for trial in salvage_campaign(campaign)
    ]


def killed(campaign: Campaign) -> list[Path]:
    """Return the folders of recordings that ended without being committed."""
    return [path for path in campaign.folders("incoming") if (path / JOURNAL).exists()]


def salvage_campaign(campaign: Campaign) -> list[str]:
    """Commit what verifies of a campaign's killed recordings; others go to quarantine."""
    found = [path.name for path in killed(campaign) if not (path / RECORD).exists()]
    for name in found:
        _salvage(campaign.folder / "incoming" / name)
    recover(campaign)
    campaign.sweep()
    return [name for name in found if (campaign.folder / "trials" / name).is_dir()]


@uninterrupted
def _salvage(folder: Path) -> None:
    """Cut a trial to its longest verified prefix and write its record, if it has one."""
    sweep_temporary(folder)
    try:
        begun = BegunTrial.model_validate(json.loads((folder / BEGUN).read_bytes()))
    except (OSError, ValueError):
        return
    before = sum((folder / name).stat().st_size for name in data_files(folder))
    state = keep_prefix(folder)
    if state is None:
        return
    size = sum((folder / name).stat().st_size for name in data_files(folder))
    end_ns = max(each["host_ns"] for each in state.values())
    lost = Lost(
        at_byte=size,
        unread_bytes=max(before - size, 0),
        reason=f"ends {(end_ns - begun.begin_ns) / 1e9:.1f} s after its begin: the program that "
        "recorded it was killed, or the power failed",
    )
    record = make_record(folder, begun, end_ns, lost=lost)
    provenance = Provenance(started=begun.started, operator=begun.operator)
    write_json_aside(folder / PROVENANCE, provenance.to_json())
    sync_folder(folder)  # as when a trial is committed
    write_json_aside(folder / RECORD, record.to_json())
