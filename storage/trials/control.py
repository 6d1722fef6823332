"""What people asked of a store from another terminal: one small file a request, kept for good.

    STORE/control/000001.json        what was asked, by whom, when and why
    STORE/control/000001.done.json   when and by whom it was carried out, and what came of it

Any program may ask. Whoever holds the store's lock carries out: a collection between two trials,
or, while nobody collects, the program that asks.
"""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from sliplab.storage.errors import StoreError
from sliplab.storage.files import make_folder, read_json, safe_name, write_new_json
from sliplab.storage.process import now, user_name
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import Store

Kind = Literal["pause", "resume", "stop", "skip", "again"]
FOLDER = "control"
_REQUEST = re.compile(r"(\d{6,12})\.json")
_MOST_TRIES = 1000


@dataclass(frozen=True)
class Request:
    """One thing that was asked for.

    Attributes:
        number: its place among the requests, from 1.
        when: UTC, ISO 8601.
        campaign: whose trials; empty where the whole store is meant.
    """

    number: int
    kind: Kind
    who: str
    when: str
    why: str = ""
    host: str = ""
    campaign: str = ""
    trials: tuple[str, ...] = ()

    @property
    def by(self) -> Json:
        """Who, when and why, to be kept with what follows from it."""
        return {
            "who": self.who,
            "when": self.when,
            "why": self.why,
            "host": self.host,
            "request": self.number,
        }

    def __str__(self) -> str:
        why = f" ({self.why})" if self.why else ""
        return f"{self.kind} by {self.who}, {self.when}{why}"


def ask(
    store: Store,
    kind: Kind,
    *,
    who: str = "",
    why: str = "",
    campaign: str = "",
    trials: tuple[str, ...] = (),
) -> Request:
    """Put a request into the store; it stands after every one that was there before.

    Raises:
        OSError: it cannot be written.
    """
    folder = store.folder / FOLDER
    make_folder(folder)
    number = max((n for n, _ in _files(store)), default=0)
    for _ in range(_MOST_TRIES):
        number += 1
        made = Request(
            number, kind, who or user_name(), now(), why, socket.gethostname(), campaign, trials
        )
        data = {name: value for name, value in vars(made).items() if name != "number"}
        if write_new_json(folder / f"{number:06d}.json", data):
            return made
    raise OSError(f"{folder}: no number is free")


def requests(store: Store, after: int = 0) -> list[Request]:
    """Requests in their order, those with a number above `after` only; unreadable ones left out."""
    found = []
    for number, path in _files(store):
        if number <= after:
            continue
        try:
            data = read_json(path)
            made = Request(
                number,
                data["kind"],
                str(data["who"]),
                str(data["when"]),
                str(data.get("why", "")),
                str(data.get("host", "")),
                safe_name(name) if (name := str(data.get("campaign", ""))) else "",
                tuple(safe_name(str(trial)) for trial in data.get("trials", ())),
            )
        except (OSError, ValueError, KeyError, TypeError, StoreError):
            continue
        if made.kind in get_args(Kind):
            found.append(made)
    return found


def answer(store: Store, request: Request, did: Json) -> Json:
    """Keep what came of a request; an answer that is there already stands."""
    path = _answer_path(store, request)
    write_new_json(path, {"when": now(), "by": user_name(), "did": did})
    return answered(store, request) or {"did": {}}


def answered(store: Store, request: Request) -> Json | None:
    """What came of a request, None while it is open."""
    try:
        found = read_json(_answer_path(store, request))
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        found = {}
    return found if isinstance(found.get("did"), dict) else {"did": {}}


def open_requests(store: Store, after: int = 0) -> list[Request]:
    """Requests that nobody has carried out yet, in their order."""
    return [item for item in requests(store, after) if answered(store, item) is None]


def paused(store: Store) -> Request | None:
    """The request by which the store is paused, if it is: the last word counts."""
    last = None
    for item in requests(store):
        if item.kind in {"pause", "resume"}:
            last = item
    return last if last is not None and last.kind == "pause" else None


def _files(store: Store) -> list[tuple[int, Path]]:
    folder = store.folder / FOLDER
    if not folder.is_dir():
        return []
    found = [(_REQUEST.fullmatch(path.name), path) for path in folder.iterdir()]
    return sorted((int(match[1]), path) for match, path in found if match)


def _answer_path(store: Store, request: Request) -> Path:
    return store.folder / FOLDER / f"{request.number:06d}.done.json"
