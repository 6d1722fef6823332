"""The request to collect: protocol, rig and store, checked together before anything moves.

A campaign that is continued must have the same collection and the same rig; what differs is named
key by key. Nothing here needs Prefect, so a wrong input is answered at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypedDict

from sliplab.flows.planning.campaign_trials import (
    ExcludedTrial,
    excluded_trials,
    pending_trials,
)
from sliplab.flows.planning.disk_space import check_space
from sliplab.flows.planning.parameters import NO_METADATA, SessionMetadata
from sliplab.flows.planning.size_estimate import plan_bytes
from sliplab.protocols import InputError, Plan, PlannedTrial, load_plan
from sliplab.protocols.claims import section_hash
from sliplab.protocols.differences import comparable_collection, format_differences
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.templates import written_out
from sliplab.protocols.yaml_file import (
    input_error,
    mask_secrets,
    parse_yaml,
    read_text,
    without_secrets,
)
from sliplab.rigs.physics_levels import levels_of, with_level
from sliplab.rigs.rig_file import RigFile, check_plan, load_rig_file, rig_hash, same_rig
from sliplab.storage.schema.campaign_end import CampaignEnd
from sliplab.storage.trials import control
from sliplab.storage.trials.context import SKIN, LoggedContext
from sliplab.storage.trials.store import IMPORTED, Campaign, CampaignInfo, StoreError, TrialStore

Claims = Literal["use", "overrule", "ignore"]
"""`overrule`: claims are evaluated and do not end the campaign."""


class CampaignCounts(TypedDict):
    """Numbers of a campaign's trials; planned = committed + missing.

    Attributes:
        quarantined: attempts, of all trials.
        set_aside: ids of the excluded trials; causes: the same with their causes.
    """

    campaign: str
    planned: int
    committed: int
    quarantined: int
    set_aside: list[str]
    causes: list[ExcludedTrial]
    missing: int
    simulated: bool


@dataclass(frozen=True)
class RunRequest:
    """A requested collection, checked by `make_request`.

    Attributes:
        rig_text: the rig file as it was read.
        enable: optional levels that are switched on, ``factor=level``.
        most: how many trials to take at most; None for all.
        until: when the rig has to be free again, seconds since 1970; None for no such time.
        only: ids of the trials that may be taken; None for all.
        claims: what the protocol's claims do.
        judging_model: file of the network that claims are judged by; None where none needs one.
        since: number of the last control request when it was made: a later stop ends it before
            anything moves. None: only a stop during the collection does.
    """

    plan: Plan
    rig: RigFile
    rig_text: str
    store: Path
    campaign: str
    enable: tuple[str, ...]
    metadata: SessionMetadata = NO_METADATA
    most: int | None = None
    until: float | None = None
    only: frozenset[str] | None = None
    claims: Claims = "use"
    judging_model: Path | None = None
    since: int | None = None

    def due_trials(self, campaign: Campaign) -> list[PlannedTrial]:
        """Return the trials to take now, in the plan's order."""
        pending = pending_trials(self.plan, campaign)
        if (begun := self._begun(campaign)) is not None:
            pending = [trial for trial in pending if trial.id in begun]
        return [t for t in pending if self.only is None or t.id in self.only][: self.most]

    @property
    def has_claims(self) -> bool:
        """Return True if claims are evaluated."""
        return self.plan.protocol.collection.stopping is not None and self.claims != "ignore"

    def _begun(self, campaign: Campaign) -> set[str] | None:
        """Return the trials that a campaign had begun when its claims ended it; else None."""
        if self._ended_by_claims(campaign) is None:
            return None
        begun: set[str] = plugins().hook("begun_trials")(self.plan, campaign.folder)
        return begun

    def _ended_by_claims(self, campaign: Campaign) -> CampaignEnd | None:
        """Return how its claims ended a campaign; None where they did not."""
        claims = self.plan.protocol.collection.stopping
        if claims is None or self.claims != "use":
            return None
        end = CampaignEnd.of(campaign.folder)
        if end is None or not end.ended or end.section != section_hash(claims):
            return None
        return end

    def end_reason(self, campaign: Campaign) -> str:
        """Return why a collection ended that nothing interrupted."""
        if replace(self, most=None).due_trials(campaign):
            return f"as many trials as --trials {self.most} allows"
        claims, end = self.plan.protocol.collection.stopping, self._ended_by_claims(campaign)
        if end is not None and claims is not None:
            if end.verdict == "settled":
                return "all claims are settled"
            return f"another round would exceed collection.stopping.most = {claims.most}"
        if pending_trials(self.plan, campaign):
            return "all requested trials are taken"
        excluded = len(excluded_trials(self.plan, campaign))
        if excluded:
            return f"all trials are taken but {excluded} that were skipped or set aside"
        return "all trials are taken"

    def counts(self, campaign: Campaign) -> CampaignCounts:
        """Count what the campaign holds now; planned = committed + missing."""
        planned = {trial.id for trial in self.plan}
        committed = campaign.committed() & planned
        excluded = excluded_trials(self.plan, campaign)
        return {
            "campaign": campaign.name,
            "planned": len(planned),
            "committed": len(committed),
            "quarantined": len(campaign.quarantined()),
            "set_aside": sorted(item["trial"] for item in excluded),
            "causes": excluded,
            "missing": len(planned) - len(committed),
            "simulated": self.rig.simulated,
        }


def make_request(
    protocol: Path,
    rig: Path,
    store: Path,
    *,
    enable: tuple[str, ...] = (),
    campaign: str | None = None,
    metadata: SessionMetadata = NO_METADATA,
    most: int | None = None,
    until: float | None = None,
    claims: Claims = "use",
    since: int | None = None,
) -> RunRequest:
    """Read protocol and rig file, and check everything that can be known before anything moves.

    Args:
        since: as `RunRequest.since`; by default, that of now.

    Raises:
        InputError: protocol, rig, or a plan that this rig or this disk cannot take.
        NoStore: the folder holds something else.
        StoreError: the campaign was started under another collection.
    """
    if since is None:  # before anything that takes long
        since = control.last_number(TrialStore(store))
    plan = load_plan(protocol, enable, judged=claims != "ignore")
    rig_file, rig_text = load_rig_file(rig)
    check_plan(rig_file, plan, str(rig))
    if plan.protocol.collection.plate is not None and not rig_file.has_plate:
        raise InputError(rig, "devices.plate", None, f"is needed: {protocol} moves a sliding plate")
    name = campaign or plan.protocol.name
    begun = None
    if TrialStore.exists(store):
        found = TrialStore.open(store).campaign(name)
        begun = found if found.begun else None
    # a level of a factor that is added later must not change the campaign's physics
    level = begun.info.get("scene_level") if begun else None
    levels = levels_of(rig_file)
    if level and levels is not None:
        rig_file = levels.at(rig_file, level)
    else:
        rig_file = with_level(rig_file, plan)
    run_request = RunRequest(
        plan,
        rig_file,
        rig_text,
        store,
        name,
        enable,
        metadata,
        most,
        until,
        claims=claims,
        judging_model=None if claims == "ignore" else judging_model(plan),
        since=since,
    )
    if begun:
        _check_same(run_request, begun)
    elif not rig_file.simulated and TrialStore.exists(store):
        _check_skin(run_request, rig)
    return run_request


def judging_model(plan: Plan) -> Path | None:
    """Return the file of the network that the claims of a plan are judged by.

    Raises:
        InputError: one is needed, and there is none.
    """
    claims = plan.protocol.collection.stopping
    try:
        return None if claims is None else claims.network_file(plan.file)
    except KeyedError as error:
        raise input_error(plan.file, error) from None


def _check_same(run_request: RunRequest, campaign: Campaign) -> None:
    """Check that a campaign that was started may continue under this request."""
    info = campaign.info
    if IMPORTED in info:
        raise StoreError(
            f"{campaign.folder}: is an imported campaign; choose another name with --campaign"
        )
    if info["collection_hash"] != run_request.plan.collection_hash:
        raise StoreError(
            f"{campaign.folder}: was begun under another `collection:` section; changing "
            "analysis, levels or repetitions is fine, anything else would mix two experiments. "
            f"Give the new one its own name with --campaign.{_changed(run_request, campaign)}"
        )
    logged = LoggedContext(TrialStore(run_request.store), campaign.name).read().get(SKIN)
    begun_on = read_text(campaign.folder / "rig.yaml", "rig file")
    if info["rig_hash"] != rig_hash(run_request.rig_text) and not same_rig(
        begun_on, run_request.rig_text, skin=logged
    ):
        serial = run_request.rig.skin.serial
        if same_rig(begun_on, run_request.rig_text, skin=serial):
            raise StoreError(
                f"{campaign.folder}: the rig file has another skin than the campaign, or what was "
                f"measured on it: log it with `sliplab log {run_request.store} --skin {serial}`"
            )
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


def _check_skin(run_request: RunRequest, file: Path) -> None:
    """Check that a new campaign's rig file does not name a skin that was replaced.

    Raises:
        InputError: the log of the store says so.
    """
    store, serial = TrialStore.open(run_request.store), run_request.rig.skin.serial
    for campaign in store.campaigns():
        if campaign.info.get("rig") != run_request.rig.name:
            continue
        logged = LoggedContext(store, campaign.name)
        now = logged.read().get(SKIN, serial)
        before = load_rig_file(campaign.folder / "rig.yaml", stored=True)[0].skin.serial
        if now != serial == before:
            text = f"was replaced by {now} (log of {store.folder}): write the skin that is mounted"
            raise InputError(file, "skin.serial", serial, text)


def _changed(run_request: RunRequest, campaign: Campaign) -> str:
    """Return what differs from the campaign's own copy of its protocol, if that can be read."""
    try:
        begun = load_plan(campaign.protocol_file, campaign.info.get("enabled", ()), stored=True)
    except InputError:
        return ""
    old, new = comparable_collection(begun), comparable_collection(run_request.plan)
    changes = format_differences(old, new, "collection")
    return f" What changed:{changes}" if changes else ""


def _rig_changed(run_request: RunRequest, campaign: Campaign) -> str:
    """Return what differs from the campaign's own copy of its rig file."""
    old = parse_yaml(read_text(campaign.folder / "rig.yaml", "rig file"), "rig.yaml")
    new = parse_yaml(run_request.rig_text, "rig file")
    changes = format_differences(without_secrets(old), without_secrets(new))
    return f" What changed:{changes}" if changes else ""


def describe_campaign(store: TrialStore, run_request: RunRequest) -> Campaign:
    """Write the campaign's description; the protocol's analysis and levels may have changed."""
    campaign = store.campaign(run_request.campaign)
    levels = levels_of(run_request.rig)
    info: CampaignInfo = {
        "name": run_request.campaign,
        "protocol": run_request.plan.protocol.name,
        "experiment": run_request.plan.protocol.collection.experiment,
        "collection_hash": run_request.plan.collection_hash,
        "rig": run_request.rig.name,
        "rig_hash": rig_hash(run_request.rig_text),
        "simulated": run_request.rig.simulated,
        "scene_level": None if levels is None else levels.stated(run_request.rig),
        "enabled": list(run_request.enable),
    }
    file = run_request.plan.file
    protocol_text = written_out(read_text(Path(file), "protocol"), file)
    campaign.update(info, protocol_text, mask_secrets(run_request.rig_text))
    return campaign


def missing_bytes(run_request: RunRequest) -> float:
    """Return the bytes that the trials still to collect are expected to need."""
    pending = run_request.due_trials(TrialStore(run_request.store).campaign(run_request.campaign))
    done = {trial.id for trial in run_request.plan} - {trial.id for trial in pending}
    return plan_bytes(run_request.rig, run_request.plan, done)


def check_disk(run_requests: list[RunRequest]) -> int:
    """Return the free bytes where the requests' store is or will be.

    Raises:
        InputError: the trials still to collect do not fit.
    """
    return check_space(
        run_requests[0].store, sum(missing_bytes(run_request) for run_request in run_requests)
    )
