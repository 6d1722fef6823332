"""The log of a store: what people and programs did to it, in the order of time.

    STORE/log/000001.json   a note: who, when, text; maybe a change (`storage.trials.context`)

Everything else is read from where it is used: requests and their answers
(`storage.trials.control`), flow runs (`flows.running.run_records`), sessions at the rig, attempts
in quarantine, decisions about labels (`storage.trials.review`) and registrations. Nothing is
written twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sliplab.analysis.campaigns import Collected
from sliplab.flows.running import run_records
from sliplab.flows.running.console import duration
from sliplab.protocols import InputError, Plan
from sliplab.protocols.quantity import canonical, parse
from sliplab.protocols.shown import CONTROL, did_you_mean
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.streams import Json
from sliplab.storage.trials import control, review
from sliplab.storage.trials.checksums import PROVENANCE
from sliplab.storage.trials.context import check_values, log_journal, planned_names
from sliplab.storage.trials.journal import signature
from sliplab.storage.trials.registration import registrations
from sliplab.storage.trials.store import AGAIN, CAUSE, IMPORTED, Campaign, TrialStore

MOST_CHARACTERS = 10_000
"""Length of a note."""


@dataclass(frozen=True, kw_only=True)
class LogEntry:
    """One line of the log.

    Attributes:
        when: UTC, ISO 8601, to a second.
        who: the person, or the program's user; empty where it is not known.
        what: ``note``, ``context``, ``run``, ``session``, ``quarantine``, ``register``, a request
            (``pause``, ``resume``, ``stop``, ``skip``, ``again``) or a decision about a label
            (``accept``, ``adjust``, ``reject``, ``reopen``).
        text: the note, the reason or the cause.
        campaign, trials: what it is about; empty for the whole store.
    """

    when: str
    who: str
    what: str
    text: str
    campaign: str = ""
    trials: tuple[str, ...] = ()


def add_note(
    store: TrialStore,
    text: str = "",
    *,
    who: str = "",
    context: Mapping[str, str] | None = None,
    campaigns: Sequence[str] | None = None,
    argument: str = "text",
) -> LogEntry:
    """Add a note to the log, or a change of context that is stored with every trial from then on.

    It may be added while trials are taken: no lock is needed, and the next trial has it.

    Args:
        who: empty for the user that is logged in.
        context: new values by name: ``{"skin": "0043", "temperature": "24 degC"}``.
        campaigns: those that the change is about; all that have begun by default.
        argument: that gave the text.

    Raises:
        InputError: text, `who` or a value is wrong, a campaign is unknown, or its protocol plans
            what was logged.
        OSError: it cannot be written.
    """
    text = text.strip()
    for name, value in ((argument, text), ("who", who)):
        if "\n" in value or "\t" in value or CONTROL.search(value):
            raise InputError(name, "", value, "must be one line without control characters")
    if not text and not context:
        raise InputError(argument, "", text, "must not be empty")
    if len(text) > MOST_CHARACTERS:
        fault = f"has {len(text)} characters: must have {MOST_CHARACTERS} at most"
        raise InputError(argument, "", text, fault)
    signed = signature(who, "")
    entry: Json = {**signed, "text": text}
    if context:
        check_values(context, "--context")
        found = _begun(store, campaigns)
        made = dict(context)
        for campaign in found:
            made = _in_units(made, Collected(campaign).plan, campaign.name)
        entry |= {"context": made, "campaigns": [campaign.name for campaign in found]}
    log_journal(store).append(entry)
    return _entry(entry)


def _begun(store: TrialStore, names: Sequence[str] | None) -> list[Campaign]:
    """Return the campaigns that a change is about."""
    there = {item.name: item for item in store.campaigns() if IMPORTED not in item.info}
    for name in names or ():
        if name not in there:
            text = f"is no campaign that was collected here; there are {', '.join(there) or 'none'}"
            raise InputError("--campaign", "", name, text + did_you_mean(name, there))
    if not there:
        raise InputError(
            store.folder,
            "",
            None,
            "no campaign has begun in this store: write the skin into the rig file "
            "(`skin.serial`), other values below `collection.context` of the protocol",
        )
    return [there[name] for name in (names or there)]


def _in_units(context: Mapping[str, str], plan: Plan, campaign: str) -> dict[str, str]:
    """Return the values in the units of a campaign's protocol.

    Raises:
        InputError: the protocol plans one of them trial by trial.
    """
    collection, made = plan.protocol.collection, dict(context)
    for name, value in context.items():
        if name not in collection.all_factors:
            continue
        if name in planned_names(plan):
            text = (
                f"is planned trial by trial by {collection.key_of(name)} of campaign {campaign}; "
                "log it for others with --campaign, or add a level to that protocol"
            )
            raise InputError("--context", name, value, text)
        unit = collection.all_factors[name].unit
        if unit is not None:
            try:
                made[name] = f"{canonical(parse(value, unit))} {unit}"
            except ValueError as error:
                raise InputError("--context", name, value, str(error)) from None
        elif " " in value:
            text = f"must be a name without a unit, as in campaign {campaign}"
            raise InputError("--context", name, value, text)
    return made


def _entry(data: Json) -> LogEntry:
    """Return a note or a change as an entry of the log."""
    context = data.get("context")
    context = context if isinstance(context, dict) else {}
    parts = [f"{name} {value}" for name, value in context.items()]
    parts += [str(data["text"])] if data.get("text") else []
    return LogEntry(
        when=data["when"],
        who=str(data.get("who", "")),
        what="context" if context else "note",
        text=", ".join(parts),
        campaign=", ".join(data.get("campaigns") or ()),
    )


def log_entries(store: TrialStore, unreadable: list[str] | None = None) -> list[LogEntry]:
    """Return the log, oldest first.

    Args:
        unreadable: gets a line for each file that cannot be read.
    """
    faults = [] if unreadable is None else unreadable
    found = [*_notes(store, faults), *_requests(store), *_runs(store)]
    for campaign in store.campaigns():
        found += _sessions(campaign, faults)
        found += _quarantined(campaign, faults)
        found += _registered(campaign, faults)
        found += _decisions(store, campaign, faults)
    return sorted(found, key=lambda entry: (entry.when, entry.campaign, entry.what, entry.trials))


def _notes(store: TrialStore, faults: list[str]) -> Iterator[LogEntry]:
    journal = log_journal(store)
    for number in journal.numbers():
        data = _read(journal.path(number), "when", faults)
        if data is not None:
            yield _entry(data)


def _requests(store: TrialStore) -> Iterator[LogEntry]:
    for request in control.requests(store):
        answer = control.answered(store, request)
        text = request.why if answer is not None else f"{request.why} (not carried out yet)".strip()
        yield LogEntry(
            when=request.when,
            who=request.who,
            what=request.kind,
            text=text,
            campaign=request.campaign,
            trials=request.trials,
        )


def _runs(store: TrialStore) -> Iterator[LogEntry]:
    for run, ended in run_records.runs(store.folder):
        name = " of ".join(filter(None, [run["flow"], run.get("deployment", "")]))
        if ended is None:
            text = f"{name}: no end is known"
        else:
            stopped = run_records.was_stopped(ended)
            state = "stopped by a person" if stopped else str(ended["state"]).lower()
            took = datetime.fromisoformat(ended["when"]) - datetime.fromisoformat(run["began"])
            text = f"{name}: {state} after {duration(took.total_seconds())}"
            text += f": {ended['message']}" if ended.get("message") and not stopped else ""
        yield LogEntry(
            when=_to_second(run["began"]),
            who=str(run.get("process", {}).get("user", "")),
            what="run",
            text=text,
        )


def _sessions(campaign: Campaign, faults: list[str]) -> Iterator[LogEntry]:
    for path in sorted((campaign.folder / "bench").glob("*.json")):
        data = _read(path, "began", faults)
        if data is None:
            continue
        parts = [f"rig {data.get('rig', '?')}"]
        parts += [f"skin {data['skin']}"] if data.get("skin") else []
        for key, unit in (("temperature_c", "°C"), ("humidity_percent", "% humidity")):
            if data.get(key) is not None:
                parts.append(f"{data[key]:g} {unit}")
        parts += [str(data["note"])] if data.get("note") else []
        yield LogEntry(
            when=data["began"],
            who=str(data.get("operator", "")),
            what="session",
            text=", ".join(parts),
            campaign=campaign.name,
        )


def _quarantined(campaign: Campaign, faults: list[str]) -> Iterator[LogEntry]:
    for item in campaign.quarantined():
        if str(item["cause"]).startswith(AGAIN):
            continue  # the request says it
        folder = campaign.folder / "quarantine" / item["folder"]
        try:
            ended = str(read_json(folder / PROVENANCE).get("ended") or "")
        except (OSError, ValueError):
            ended = ""
        try:
            when = _to_second(ended) if ended else _changed(folder / CAUSE)
        except (OSError, ValueError) as error:
            faults.append(f"{folder}: {error}")
            continue
        yield LogEntry(
            when=when,
            who="",
            what="quarantine",
            text=str(item["cause"]),
            campaign=campaign.name,
            trials=(item["trial"],),
        )


def _registered(campaign: Campaign, faults: list[str]) -> Iterator[LogEntry]:
    try:
        found = registrations(campaign)
    except StoreError as error:
        faults.append(str(error))
        return
    for path, registration in found:
        yield LogEntry(
            when=_to_second(registration.registered),
            who="",
            what="register",
            text=f"{path.parent.name}/{path.name}",
            campaign=campaign.name,
        )


def _decisions(store: TrialStore, campaign: Campaign, faults: list[str]) -> Iterator[LogEntry]:
    for trial in sorted(review.counts(store, campaign.name)):
        try:
            history = review.history(store, campaign.name, trial)
        except StoreError as error:
            faults.append(str(error))
            continue
        for decision in history:
            yield LogEntry(
                when=decision.when,
                who=decision.who,
                what=decision.verdict,
                text=decision.why,
                campaign=campaign.name,
                trials=(trial,),
            )


def _read(path: Path, moment: str, faults: list[str]) -> Json | None:
    """Return a file's content, with its moment in UTC to a second; None if it is damaged."""
    try:
        found = read_json(path)
        return {**found, moment: _to_second(str(found[moment]))}
    except (OSError, ValueError, KeyError) as error:
        faults.append(str(error) if str(path) in str(error) else f"{path}: {error!r}")
        return None


def _to_second(moment: str) -> str:
    """Return a moment in UTC, ISO 8601, to a second.

    Raises:
        ValueError: it is none.
    """
    return datetime.fromisoformat(moment).astimezone(UTC).isoformat(timespec="seconds")


def _changed(path: Path) -> str:
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")
