"""Registration of a protocol in a store, and the line by which `collect` shows it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from sliplab.analysis.registration import protocol_deviations
from sliplab.flows.collecting.requests import store_lock
from sliplab.flows.planning.run_request import judging_model
from sliplab.protocols.errors import InputError
from sliplab.protocols.plan import Plan, load_plan
from sliplab.protocols.templates import written_out
from sliplab.protocols.yaml_file import mask_secrets, read_text
from sliplab.rigs.rig_file import check_plan, load_rig_file, rig_hash
from sliplab.storage.errors import StoreError
from sliplab.storage.files import sha256
from sliplab.storage.process import now
from sliplab.storage.streams import Json
from sliplab.storage.trials.registration import add_registration, registrations
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.versions import FIGURES, RECORDING, installed_versions


def register(
    protocol: Path,
    store: Path,
    *,
    enable: Iterable[str] = (),
    campaign: str | None = None,
    rig: Path | None = None,
) -> tuple[Campaign, Path]:
    """Write the next registration of a protocol's campaign; the store is made if there is none.

    Args:
        enable: optional levels that are switched on, ``factor=level``.
        campaign: its name; by default the protocol's.
        rig: the rig file, if it is to be registered, too.

    Returns:
        The campaign and the registration's file.

    Raises:
        InputError: the protocol or the rig file, or a plan that the rig cannot take.
        StoreError: the campaign was imported, or begun under another `collection:` section.
        Locked: another program writes into the store.
    """
    enable = tuple(enable)
    plan = load_plan(protocol, enable, judged=True)
    text = read_text(Path(plan.file), "protocol")
    model = judging_model(plan)
    content: Json = {
        "protocol": {
            "name": plan.name,
            "file_sha256": sha256(Path(plan.file)),
            "text": written_out(text, plan.file),
            "enabled": list(enable),
            "collection_hash": plan.collection_hash,
            "analysis_hash": plan.analysis_hash,
        },
        "analysis": plan.protocol.analysis.model_dump(mode="json"),
        "stopping": plan.collection_data.get("stopping"),
        "judging_model": None if model is None else sha256(model),
        "planned": len(plan),
        "rig": None if rig is None else _rig(rig, plan),
        "versions": installed_versions((*RECORDING, *FIGURES)),
    }
    opened = TrialStore.create(store)
    found = opened.campaign(campaign or plan.name)
    with store_lock(opened):
        if found.begun and found.info.get("collection_hash") != plan.collection_hash:
            raise StoreError(
                f"{found.folder}: was imported, or begun under another `collection:` section; "
                "register this protocol under its own name with --campaign"
            )
        attempts = sum(1 for name in ("incoming", "quarantine") for _ in found.folders(name))
        taken = {"committed": len(found.committed()), "attempts": attempts}
        return found, add_registration(found, {**content, "taken": taken, "registered": now()})


def _rig(path: Path, plan: Plan) -> Json:
    rig, text = load_rig_file(path)
    check_plan(rig, plan, str(path))
    return {"name": rig.name, "sha256": rig_hash(text), "text": mask_secrets(text)}


def registration_line(campaign: Campaign, plan: Plan) -> str:
    """Return a line: whether a campaign is registered, and whether this protocol deviates."""
    try:
        found = registrations(campaign)
    except StoreError as error:
        return f"campaign {campaign.name}: its registration is damaged: {error}"
    if not found:
        return f"campaign {campaign.name} is not registered (docs/register.md)"
    path, first = found[0]
    line = f"campaign {campaign.name} was registered {first.after}, {first.registered}: {path}"
    if len(found) > 1:
        line += f"; {len(found)} registrations, this is the first"
    try:
        text = written_out(read_text(Path(plan.file), "protocol"), plan.file)
        count = sum(1 for _ in protocol_deviations(first, path, plan, text))
    except InputError as error:
        return f"{line}; the registered protocol cannot be read: {error}"
    return f"{line}; the protocol deviates from it: see the report" if count else line
