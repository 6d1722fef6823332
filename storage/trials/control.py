"""Operator requests to a store: pause, resume, stop, skip and retake.

    STORE/control/000001.json        a request: who, when, why
    STORE/control/000001.done.json   its answer: when and by whom it was carried out, and the result
    campaigns/NAME/skipped.json      trials that a person skipped: who, when, why
    campaigns/NAME/quarantine/ID.N/cause.json   who withdrew a committed trial

Any program may submit one. The holder of the store's lock carries it out: a collection between two
trials, or, while none runs, the program that submits it. Nothing is deleted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, get_args

from sliplab.protocols.shown import plural
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, safe_name, write_json, write_new_json
from sliplab.storage.process import now, user_name
from sliplab.storage.streams import Json
from sliplab.storage.trials.journal import Entry, Journal, signature
from sliplab.storage.trials.store import AGAIN, CAUSE, FORGIVEN, Campaign, TrialStore

Kind = Literal["pause", "resume", "stop", "skip", "again"]
FOLDER, SKIPPED = "control", "skipped.json"


@dataclass(frozen=True, kw_only=True)
class ControlRequest(Entry):
    """One request.

    Attributes:
        campaign: campaign of the trials; empty where the whole store is meant.
        moment: `when` to a microsecond; empty in stores of older versions.
    """

    kind: Kind
    moment: str = ""
    campaign: str = ""
    trials: tuple[str, ...] = ()

    @property
    def by(self) -> Json:
        """Person, time and reason of the request, to be stored with its consequences."""
        names = ("who", "when", "why", "host")
        return {**{name: getattr(self, name) for name in names}, "request": self.number}

    def __str__(self) -> str:
        return self._summary(self.kind)


def ask(
    store: TrialStore,
    kind: Kind,
    *,
    who: str = "",
    why: str = "",
    campaign: str = "",
    trials: tuple[str, ...] = (),
) -> ControlRequest:
    """Put a request into the store, after every one that exists.

    Raises:
        OSError: it cannot be written.
    """
    content: Json = {"kind": kind, "campaign": campaign, "trials": trials, **signature(who, why)}
    content["moment"] = datetime.now(UTC).isoformat()
    number = _journal(store).append(content)
    return ControlRequest(number=number, **content)


def requests(store: TrialStore) -> list[ControlRequest]:
    """Return all requests in order; unreadable ones are left out."""
    journal, found = _journal(store), []
    for number in journal.numbers():
        try:
            data = read_json(journal.path(number))
            made = ControlRequest(
                number=number,
                kind=data["kind"],
                moment=str(data.get("moment", "")),
                who=str(data["who"]),
                when=str(data["when"]),
                why=str(data.get("why", "")),
                host=str(data.get("host", "")),
                campaign=safe_name(name) if (name := str(data.get("campaign", ""))) else "",
                trials=tuple(safe_name(str(trial)) for trial in data.get("trials", ())),
            )
        except (OSError, ValueError, KeyError, TypeError, StoreError):
            continue
        if made.kind in get_args(Kind):
            found.append(made)
    return found


def last_number(store: TrialStore) -> int:
    """Return the number of the last request; 0 if there is none."""
    return max(_journal(store).numbers(), default=0)


def stop_after(store: TrialStore, number: int) -> ControlRequest | None:
    """Return the last stop requested after request `number`, answered or not; None without."""
    if last_number(store) <= number:
        return None
    later = (item for item in reversed(requests(store)) if item.number > number)
    return next((item for item in later if item.kind == "stop"), None)


def answer(store: TrialStore, request: ControlRequest, did: Json) -> Json:
    """Store the result of a request; an existing answer is not replaced."""
    write_new_json(_answer_path(store, request), {"when": now(), "by": user_name(), "did": did})
    return answered(store, request) or {"did": {}}


def answered(store: TrialStore, request: ControlRequest) -> Json | None:
    """Return the answer to a request; None while it is open."""
    try:
        found = read_json(_answer_path(store, request))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        found = {}
    return found if isinstance(found.get("did"), dict) else {"did": {}}


def open_requests(store: TrialStore) -> list[ControlRequest]:
    """Return the requests that have not been carried out yet, in order."""
    return [item for item in requests(store) if answered(store, item) is None]


def paused(store: TrialStore) -> ControlRequest | None:
    """Return the request by which the store is paused, if it is: the last one counts."""
    both = [item for item in requests(store) if item.kind in {"pause", "resume"}]
    return both[-1] if both and both[-1].kind == "pause" else None


def skipped(campaign: Campaign) -> dict[str, Json]:
    """Return the trials that a person skipped: ``who``, ``when``, ``why`` by id.

    Raises:
        StoreError: the list is damaged.
    """
    path = campaign.folder / SKIPPED
    try:
        found = read_json(path)
        if not all(isinstance(by, dict) for by in found.values()):
            raise ValueError(f"{path}: does not say who set which trial aside")
        return found
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise StoreError(
            f"{error}; it is damaged: restore it from a copy, or delete it to collect those trials "
            "(the requests themselves are in control/)"
        ) from None


def skip(campaign: Campaign, trials: Iterable[str], by: Json) -> dict[str, str]:
    """Skip trials, so that no collection takes them; the caller holds the store's lock.

    Args:
        by: who, when and why.

    Returns:
        The result for each trial, as text.
    """
    committed, known, did = campaign.committed(), skipped(campaign), {}
    for trial in trials:
        if trial in committed:
            did[trial] = "is committed: left as it is"
        elif trial in known:
            did[trial] = "was set aside already"
        else:
            known[trial] = by
            did[trial] = "set aside"
    if "set aside" in did.values():
        write_json(campaign.folder / SKIPPED, known)
    return did


def again(campaign: Campaign, trials: Iterable[str], by: Json) -> dict[str, str]:
    """Make trials pending again; the caller holds the store's lock.

    Committed ones go to quarantine, with who, when and why. Those skipped by a person, or after too
    many retakes, are skipped no longer.

    Returns:
        The result for each trial, as text.
    """
    committed, known, did = campaign.committed(), skipped(campaign), {}
    before = len(known)
    for trial in trials:
        done = []
        if trial in committed:
            folder = campaign.folder / "trials" / trial
            cause = f"{AGAIN}: {by.get('why') or 'no reason given'}"
            target = campaign.quarantine(folder, cause, asked=by)
            done.append(f"moved to quarantine/{target.name}")
        if known.pop(trial, None) is not None:
            done.append("no longer set aside")
        if count := _reset_attempts(campaign, trial, by):
            done.append(
                f"{plural(count, 'failed attempt')} count{'s' if count == 1 else ''} no longer"
            )
        did[trial] = "; ".join([*done, "will be taken again"] if done else ["was pending already"])
    if len(known) < before:
        write_json(campaign.folder / SKIPPED, known)
    return did


def _reset_attempts(campaign: Campaign, trial: str, by: Json) -> int:
    """Mark the failed attempts at a trial, so that they count no longer; return how many."""
    count = 0
    for item in campaign.quarantined():
        gate = item["trial"] == trial and str(item["cause"]).startswith("gate")
        if gate and FORGIVEN not in item:
            path = campaign.folder / "quarantine" / item["folder"] / CAUSE
            write_json(path, {**read_json(path), FORGIVEN: by})
            count += 1
    return count


def _journal(store: TrialStore) -> Journal:
    return Journal(store.folder / FOLDER)


def _answer_path(store: TrialStore, request: ControlRequest) -> Path:
    return _journal(store).path(request.number, ".done")
