"""What was asked for, checked before anything moves: protocol, rig and store belong together.

Nothing here needs Prefect, so a wrong input is answered at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sliplab.flows.planning.changes import format_differences
from sliplab.flows.planning.estimate import check_space, plan_bytes
from sliplab.protocols import InputError, Plan, Trial, load_plan
from sliplab.protocols.yaml_file import mask_secrets, parse_yaml, read_text, without_secrets
from sliplab.rigs.levels import at_level, with_level
from sliplab.rigs.rig_file import RigFile, check_plan, load_rig_file, rig_hash, same_rig
from sliplab.storage.trials.decisions import skipped
from sliplab.storage.trials.store import FORGIVEN, IMPORTED, Campaign, Store, StoreError


@dataclass(frozen=True)
class SessionMetadata:
    """Operator and conditions of one session at the rig."""

    operator: str = ""
    temperature_c: float | None = None
    humidity_percent: float | None = None
    note: str = ""


@dataclass(frozen=True)
class RunRequest:
    """A requested collection that was checked and found possible."""

    plan: Plan
    rig: RigFile
    rig_text: str
    store: Path
    campaign: str
    enable: tuple[str, ...]
    metadata: SessionMetadata = SessionMetadata()
    most: int | None = None
    """Trials that were asked for at most."""
    until: float | None = None
    """When the rig has to be free again, seconds since 1970; None for no such time."""
    only: frozenset[str] | None = None
    """Ids of the trials that may be taken; None for all."""

    def wanted(self, campaign: Campaign) -> list[Trial]:
        """Trials to take now, in the plan's order."""
        pending = pending_trials(self.plan, campaign)
        return [t for t in pending if self.only is None or t.id in self.only][: self.most]


def make_request(
    protocol: Path,
    rig: Path,
    store: Path,
    *,
    enable: tuple[str, ...] = (),
    campaign: str | None = None,
    metadata: SessionMetadata = SessionMetadata(),
    most: int | None = None,
    until: float | None = None,
) -> RunRequest:
    """Read and check everything that can be known before anything moves.

    Raises:
        InputError: protocol, rig, or a plan that this rig or this disk cannot take.
        NoStore: the folder holds something else.
        StoreError: the campaign was begun under another collection.
    """
    plan = load_plan(protocol, enable)
    rig_file, rig_text = load_rig_file(rig)
    check_plan(rig_file, plan, str(rig))
    if plan.protocol.collection.plate is not None and not rig_file.has_plate:
        raise InputError(rig, "devices.plate", None, f"is needed: {protocol} moves a sliding plate")
    name = campaign or plan.protocol.name
    begun = None
    if Store.exists(store):
        found = Store.open(store).campaign(name)
        begun = found if found.begun else None
    # one campaign, one physics: a level of a factor that is added later must not change it
    level = begun.info.get("scene_level") if begun else None
    rig_file = at_level(rig_file, level) if level else with_level(rig_file, plan)
    run_request = RunRequest(plan, rig_file, rig_text, store, name, enable, metadata, most, until)
    if begun:
        _check_same(run_request, begun)
    return run_request


def _check_same(run_request: RunRequest, campaign: Campaign) -> None:
    info = campaign.info
    if IMPORTED in info:
        raise StoreError(
            f"{campaign.folder}: was imported; give the new one its own name with --campaign"
        )
    if info["collection_hash"] != run_request.plan.collection_hash:
        raise StoreError(
            f"{campaign.folder}: was begun under another `collection:` section; changing "
            "analysis, levels or repetitions is fine, anything else would mix two experiments. "
            f"Give the new one its own name with --campaign.{_changed(run_request, campaign)}"
        )
    if info["rig_hash"] != rig_hash(run_request.rig_text) and not same_rig(
        read_text(campaign.folder / "rig.yaml", "rig file"), run_request.rig_text
    ):
        raise StoreError(
            f"{campaign.folder}: was begun on another rig file (its copy is rig.yaml there); "
            f"give the new one its own name with --campaign.{_rig_changed(run_request, campaign)}"
        )
    if missing := campaign.committed() - {trial.id for trial in run_request.plan}:
        raise StoreError(
            f"{campaign.folder}: holds trials that the protocol no longer has, such as "
            f"{min(missing)}; a protocol may only add trials to a campaign."
            f"{_changed(run_request, campaign)}"
        )


def _changed(run_request: RunRequest, campaign: Campaign) -> str:
    """What differs from the campaign's own copy of its protocol, if that can be read."""
    try:
        begun = load_plan(campaign.protocol_file, campaign.info.get("enabled", ()), stored=True)
    except InputError:
        return ""
    old, new = begun.collection_data, run_request.plan.collection_data
    for data, enabled in ((old, begun.enabled), (new, run_request.plan.enabled)):
        for name, factor in data["factors"].items():  # however they were written
            for key in ("values", "range", "optional"):
                factor.pop(key)
            factor["levels"] = [str(level) for level in enabled[name]]
    changes = format_differences(old, new, "collection")
    return f" What changed:{changes}" if changes else ""


def _rig_changed(run_request: RunRequest, campaign: Campaign) -> str:
    """What differs from the campaign's own copy of its rig file."""
    old = parse_yaml(read_text(campaign.folder / "rig.yaml", "rig file"), "rig.yaml")
    new = parse_yaml(run_request.rig_text, "rig file")
    changes = format_differences(without_secrets(old), without_secrets(new))
    return f" What changed:{changes}" if changes else ""


def pending_trials(plan: Plan, campaign: Campaign) -> list[Trial]:
    """Trials that are neither committed nor set aside, in the plan's order."""
    done = campaign.committed() | skipped(campaign).keys()
    failed = campaign.failed_attempts()
    retakes = plan.protocol.collection.gates.retakes
    return [t for t in plan if t.id not in done and failed.get(t.id, 0) <= retakes]


def set_aside(
    plan: Plan, campaign: Campaign, committed: set[str] | None = None
) -> list[dict[str, Any]]:
    """Trials of the plan that no collection takes, in its order, each with its cause.

    By JSON names: ``trial``, ``cause``, ``attempts`` that failed, ``by`` (a person, or None for
    the gates), ``when``. Whoever knows which trials are whole spares looking with `committed`.
    """
    done = campaign.committed() if committed is None else committed
    by_person, failed = skipped(campaign), campaign.failed_attempts()
    retakes = plan.protocol.collection.gates.retakes
    causes: dict[str, list[str]] = {}
    for item in campaign.quarantined():
        if str(item["cause"]).startswith("gate") and FORGIVEN not in item:
            causes.setdefault(item["trial"], []).append(str(item["cause"]))
    found = []
    for trial in plan:
        if trial.id in done:
            continue
        attempts, known = failed.get(trial.id, 0), by_person.get(trial.id)
        if known is not None:
            cause = known.get("why") or "no reason given"
        elif attempts > retakes:
            cause = "; then ".join(dict.fromkeys(causes[trial.id]))
        else:
            continue
        person = known or {}
        found.append(
            {"trial": trial.id, "cause": cause, "attempts": attempts,
             "by": person.get("who"), "when": person.get("when")}
        )  # fmt: skip
    return found


def describe_campaign(store: Store, run_request: RunRequest) -> Campaign:
    """Write what the campaign is; the protocol's analysis and levels may have changed."""
    campaign = store.campaign(run_request.campaign)
    info = {
        "name": run_request.campaign,
        "protocol": run_request.plan.protocol.name,
        "experiment": run_request.plan.protocol.collection.experiment,
        "collection_hash": run_request.plan.collection_hash,
        "rig": run_request.rig.name,
        "rig_hash": rig_hash(run_request.rig_text),
        "simulated": run_request.rig.simulated,
        "scene_level": run_request.rig.scene.scene.level if run_request.rig.simulated else None,
        "enabled": list(run_request.enable),
    }
    protocol_text = read_text(Path(run_request.plan.file), "protocol")
    campaign.update(info, protocol_text, mask_secrets(run_request.rig_text))
    return campaign


def missing_bytes(run_request: RunRequest) -> float:
    """Bytes that the trials still to take are expected to need."""
    pending = run_request.wanted(Store(run_request.store).campaign(run_request.campaign))
    done = {trial.id for trial in run_request.plan} - {trial.id for trial in pending}
    return plan_bytes(run_request.rig, run_request.plan, done)


def check_disk(run_requests: list[RunRequest]) -> int:
    """Free bytes where the requests' store is or will be.

    Raises:
        InputError: what is still to be taken does not fit.
    """
    return check_space(
        run_requests[0].store, sum(missing_bytes(run_request) for run_request in run_requests)
    )


def campaign_counts(run_request: RunRequest, campaign: Campaign) -> dict[str, Any]:
    """What a campaign holds now: planned = committed + missing."""
    planned = {trial.id for trial in run_request.plan}
    committed = campaign.committed() & planned
    aside = set_aside(run_request.plan, campaign)
    return {
        "campaign": campaign.name,
        "planned": len(planned),
        "committed": len(committed),
        "quarantined": len(campaign.quarantined()),
        "set_aside": sorted(item["trial"] for item in aside),
        "causes": aside,
        "missing": len(planned) - len(committed),
        "simulated": run_request.rig.simulated,
    }
