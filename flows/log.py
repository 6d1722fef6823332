"""The log of a store: what people and programs did to it, in the order of time.

    STORE/log/000001.json   a note: who, when, text

Everything else is read from where it is used: requests and their answers
(`storage.trials.control`), flow runs (`flows.running.run_records`), sessions at the rig, attempts
in quarantine, decisions about labels (`storage.trials.review`) and registrations. Nothing is
written twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sliplab.flows.running import run_records
from sliplab.flows.running.console import duration
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.files import inside, read_json
from sliplab.storage.streams import Json
from sliplab.storage.trials import control, review
from sliplab.storage.trials.checksums import PROVENANCE
from sliplab.storage.trials.journal import Journal, signature
from sliplab.storage.trials.registration import registrations
from sliplab.storage.trials.store import AGAIN, CAUSE, Campaign, Store

FOLDER = "log"
MOST_CHARACTERS = 10_000
"""Length of a note."""


@dataclass(frozen=True, kw_only=True)
class LogEntry:
    """One line of the log.

    Attributes:
        when: UTC, ISO 8601, to a second.
        who: the person, or the program's user; empty where it is not known.
        what: ``note``, ``run``, ``session``, ``quarantine``, ``register``, a request (``pause``,
            ``resume``, ``stop``, ``skip``, ``again``) or a decision about a label (``accept``,
            ``adjust``, ``reject``, ``reopen``).
        text: the note, the reason or the cause.
        campaign, trials: what it is about; empty for the whole store.
    """

    when: str
    who: str
    what: str
    text: str
    campaign: str = ""
    trials: tuple[str, ...] = ()


def add_note(store: Store, text: str, *, who: str = "", argument: str = "text") -> LogEntry:
    """Add a note to the log. It may be added while trials are taken: no lock is needed.

    Args:
        who: empty for the user that is logged in.
        argument: that gave the text.

    Raises:
        InputError: the text is empty or too long.
        OSError: it cannot be written.
    """
    text = text.strip()
    if not text:
        raise InputError(argument, "", text, "must not be empty")
    if len(text) > MOST_CHARACTERS:
        fault = f"has {len(text)} characters: must have {MOST_CHARACTERS} at most"
        raise InputError(argument, "", text, fault)
    signed = signature(who, "")
    Journal(inside(store.folder / FOLDER, store.folder)).append({**signed, "text": text})
    return LogEntry(when=signed["when"], who=signed["who"], what="note", text=text)


def log_entries(store: Store, unreadable: list[str] | None = None) -> list[LogEntry]:
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


def _notes(store: Store, faults: list[str]) -> Iterator[LogEntry]:
    journal = Journal(inside(store.folder / FOLDER, store.folder))
    for number in journal.numbers():
        data = _read(journal.path(number), "when", faults)
        if data is not None:
            text = str(data.get("text", ""))
            yield LogEntry(when=data["when"], who=str(data.get("who", "")), what="note", text=text)


def _requests(store: Store) -> Iterator[LogEntry]:
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


def _runs(store: Store) -> Iterator[LogEntry]:
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


def _decisions(store: Store, campaign: Campaign, faults: list[str]) -> Iterator[LogEntry]:
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
