"""Deviations of a campaign from its first registration, found in the store alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from sliplab.analysis.campaigns import Collected
from sliplab.protocols.claims import Claim
from sliplab.protocols.differences import comparable_collection, differences
from sliplab.protocols.hashing import hash_text
from sliplab.protocols.plan import Plan, parse_plan
from sliplab.protocols.shown import plural
from sliplab.protocols.yaml_file import parse_yaml, read_text, without_secrets
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.schema.campaign_end import CampaignEnd
from sliplab.storage.schema.registration import Registration
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.trials.control import skipped
from sliplab.storage.trials.store import AGAIN, RIG, QuarantineEntry
from sliplab.storage.versions import FIGURES, installed_versions

_NONE = "–"


class RegistrationDeviation(NamedTuple):
    """One difference between a registration and its campaign, as text."""

    what: str
    registered: str
    found: str


def _hash(sha256: str | None) -> str:
    """Return the first digits of a hash, enough to distinguish two files."""
    return f"SHA-256 {sha256[:16]}" if sha256 else _NONE


def registered_plan(registration: Registration, path: Path) -> Plan:
    """Expand the registered protocol. Raises InputError where this version cannot read it."""
    protocol = registration.protocol
    return parse_plan(protocol.text, path, protocol.enabled, stored=True)


def protocol_deviations(
    registration: Registration, path: Path, plan: Plan, text: str
) -> Iterator[RegistrationDeviation]:
    """Yield what another protocol has that the registered one has not, and the reverse.

    Args:
        path: of the registration; text: of the other protocol, its template written out.
    """
    hashes = [_hash(hash_text(each)) for each in (registration.protocol.text, text)]
    if hashes[0] != hashes[1]:
        yield RegistrationDeviation("text of the protocol", *hashes)
    before = registered_plan(registration, path)
    was, now = comparable_collection(before), comparable_collection(plan)
    was.pop("stopping", None)
    stopping = now.pop("stopping", None)
    for change in differences(was, now, "collection"):
        yield RegistrationDeviation(*change)
    yield from _claim_deviations(before, plan)
    old, new = (_without_claims(each) for each in (registration.stopping, stopping))
    for key, *values in differences(old, new, "collection.stopping"):
        name = "error level of claims: " if key.endswith(".error") else ""
        yield RegistrationDeviation(name + key, *values)
    analysis = plan.protocol.analysis.model_dump(mode="json")
    for change in differences(registration.analysis, analysis, "analysis"):
        yield RegistrationDeviation(*change)


def _without_claims(stopping: Mapping[str, Any] | None) -> dict[str, Any]:
    return {key: value for key, value in (stopping or {}).items() if key != "claims"}


def _claim_deviations(before: Plan, plan: Plan) -> Iterator[RegistrationDeviation]:
    """Yield claims that were removed, changed or added."""
    removed, added = ([*_claims(each)] for each in (before, plan))
    for claim in [each for each in removed if each in added]:
        removed.remove(claim)
        added.remove(claim)
    for claim in removed:
        subject = (claim.figure, claim.of, claim.between)
        other = next((it for it in added if (it.figure, it.of, it.between) == subject), None)
        if other is None:
            yield RegistrationDeviation("claim removed", _claim_text(claim, before), _NONE)
        else:
            added.remove(other)
            yield RegistrationDeviation(
                "claim changed", _claim_text(claim, before), _claim_text(other, plan)
            )
    for claim in added:
        yield RegistrationDeviation("claim added", _NONE, _claim_text(claim, plan))


def _claims(plan: Plan) -> tuple[Claim, ...]:
    stopping = plan.protocol.collection.stopping
    return () if stopping is None else stopping.claims


def _claim_text(claim: Claim, plan: Plan) -> str:
    return claim.text(plan.protocol.collection.all_factors)


def campaign_deviations(
    item: Collected, registration: Registration, path: Path
) -> Iterator[RegistrationDeviation]:
    """Yield every difference of a campaign from a registration, in the order of the work.

    Raises:
        InputError: the registered protocol cannot be read by this version.
        StoreError: a record that is needed is damaged.
    """
    text = read_text(item.campaign.protocol_file, "protocol")
    yield from protocol_deviations(registration, path, item.plan, text)
    enabled = tuple(item.info.get("enabled", ()))
    if enabled != registration.protocol.enabled:
        yield _changed("enabled levels", registration.protocol.enabled, enabled)
    yield from _rig_deviations(item, registration)
    yield from _trial_deviations(item, registration, registered_plan(registration, path))
    yield from _attempt_deviations(item)
    yield from _stopping_deviations(item, registration)
    yield from _version_deviations(item, registration)


def _changed(what: str, old: Iterable[str], new: Iterable[str]) -> RegistrationDeviation:
    return RegistrationDeviation(what, ", ".join(old) or _NONE, ", ".join(new) or _NONE)


def _rig_deviations(item: Collected, registration: Registration) -> Iterator[RegistrationDeviation]:
    rig = registration.rig
    if rig is None or rig.sha256 == item.info.get("rig_hash"):
        return
    yield RegistrationDeviation(
        "rig file",
        f"{rig.name}, {_hash(rig.sha256)}",
        f"{item.info.get('rig')}, {_hash(item.info.get('rig_hash'))}",
    )
    texts = (rig.text, read_text(item.campaign.folder / RIG, "rig file"))
    old, new = (without_secrets(parse_yaml(text, RIG)) for text in texts)
    for change in differences(old, new, "rig"):
        yield RegistrationDeviation(*change)


def _trial_deviations(
    item: Collected, registration: Registration, plan: Plan
) -> Iterator[RegistrationDeviation]:
    """Yield trials that were taken before, are missing, or were not registered."""
    began = datetime.fromisoformat(registration.registered)
    early = [
        trial.id
        for trial, recording in item.trials
        if (when := item.campaign.provenance(recording).started) is not None
        and datetime.fromisoformat(when) < began
    ]
    taken = registration.taken
    if early or taken.committed or taken.attempts:
        found = f"registered {registration.after}"
        if early:
            found += f"; {_listed(early, 'trial')} began before that time"
        yield RegistrationDeviation("trials taken before the registration", _NONE, found)
    planned, committed = {trial.id for trial in plan}, item.campaign.committed()
    more = sorted(committed - planned)
    if more:
        yield RegistrationDeviation(
            "more trials than registered", plural(len(planned), "trial"), _listed(more, "other")
        )
    missing = len(planned - committed)
    if missing:
        end = CampaignEnd.of(item.campaign.folder)
        yield RegistrationDeviation(
            "fewer trials than registered",
            plural(len(planned), "trial"),
            f"{len(planned) - missing}"
            + ("; the campaign was ended by its claims" if end is not None and end.ended else ""),
        )


def _listed(names: Sequence[str], what: str) -> str:
    return f"{plural(len(names), what)}: {'; '.join(names)}"


def _attempt_deviations(item: Collected) -> Iterator[RegistrationDeviation]:
    """Yield trials that were skipped, set aside or retaken, each with its cause."""
    for trial, by in sorted(skipped(item.campaign).items()):
        yield RegistrationDeviation("trial skipped", _NONE, f"{trial}: {_by(by)}")
    kinds: dict[str, list[QuarantineEntry]] = {}
    for entry in item.campaign.quarantined():
        kinds.setdefault(str(entry["cause"]).partition(":")[0], []).append(entry)
    for kind, entries in sorted(kinds.items()):
        if kind == AGAIN:
            for entry in entries:
                found = f"{entry['trial']}: {_by(entry.get('asked', {}))}"
                yield RegistrationDeviation("trial retaken on request", _NONE, found)
        else:
            counts = Counter(entry["trial"] for entry in entries)
            names = [f"{name} ({n} times)" if n > 1 else name for name, n in counts.items()]
            what = "failed a gate" if kind == "gate" else f"quarantined: {kind}"
            yield RegistrationDeviation(f"attempts {what}", _NONE, _listed(names, "trial"))
    committed = item.campaign.committed()
    retakes = item.plan.protocol.collection.gates.retakes
    failed = item.campaign.failed_attempts()
    aside = [name for name, n in failed.items() if n > retakes and name not in committed]
    if aside:
        yield RegistrationDeviation("trials set aside", _NONE, _listed(aside, "trial"))


def _by(by: Mapping[str, Any]) -> str:
    """Return who requested a deviation, when and why."""
    why = f" ({by['why']})" if by.get("why") else ""
    return f"by {by.get('who') or 'unknown'}, {by.get('when') or 'at an unknown time'}{why}"


def _stopping_deviations(
    item: Collected, registration: Registration
) -> Iterator[RegistrationDeviation]:
    """Yield sessions that overruled the claims, and another network that judged them."""
    sessions = []
    for file in sorted((item.campaign.folder / "bench").glob("*.json")):
        try:
            session = read_json(file)
        except (OSError, ValueError) as error:
            raise StoreError(str(error)) from None
        if session.get("no_stopping"):
            sessions.append(str(session.get("began")))
    end = CampaignEnd.of(item.campaign.folder)
    if sessions or (end is not None and end.verdict == "overruled"):
        when = f"; sessions of {', '.join(sessions)}" if sessions else ""
        yield RegistrationDeviation(
            "stopping overruled", _NONE, f"collected with --no-stopping{when}"
        )
    if end is not None and end.model != registration.judging_model:
        models = (registration.judging_model, end.model)
        yield RegistrationDeviation("network that judges the claims", *map(_hash, models))


def _version_deviations(
    item: Collected, registration: Registration
) -> Iterator[RegistrationDeviation]:
    """Yield packages of another version than registered, in trials and in this report."""
    found: dict[str, Counter[str]] = {}
    for _, recording in item.trials:
        provenance: Provenance = item.campaign.provenance(recording)
        for name, version in provenance.versions.items():
            found.setdefault(name, Counter())[version] += 1
    here = installed_versions(FIGURES)
    for name, registered in sorted(registration.versions.items()):
        others = {version: n for version, n in found.get(name, {}).items() if version != registered}
        words = [f"{version} in {plural(n, 'trial')}" for version, n in sorted(others.items())]
        if here.get(name, registered) != registered:
            words.append(f"{here[name]} in this report")
        if words:
            yield RegistrationDeviation(f"version of {name}", registered, "; ".join(words))
