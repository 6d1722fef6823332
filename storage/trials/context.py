"""Context that people log in mid-campaign: another skin, a temperature, a serial number.

    STORE/log/000002.json   who, when, text; `context`: values that hold from then on; `campaigns`

It holds for the campaigns that had begun by then: a later one has the skin of its rig file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from sliplab.protocols import InputError, Plan
from sliplab.protocols.model import COLUMNS
from sliplab.storage.errors import StoreError
from sliplab.storage.files import inside, read_json
from sliplab.storage.trials.journal import Entry, Journal
from sliplab.storage.trials.store import TrialStore

LOG = "log"
SKIN = "skin"
_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_VALUE = re.compile(
    r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}|[+-]?(\d+(\.\d*)?|\.\d+) [A-Za-z%][A-Za-z0-9/%]{0,15}"
)


@dataclass(frozen=True, kw_only=True)
class ContextChange(Entry):
    """A change that a person logged.

    Attributes:
        context: the new values by name, as text: ``{"skin": "0043", "temperature": "24 degC"}``.
        campaigns: names of those that it is about.
    """

    context: dict[str, str]
    campaigns: tuple[str, ...]


def log_journal(store: TrialStore) -> Journal:
    """Return the journal of notes and changes."""
    return Journal(inside(store.folder / LOG, store.folder))


def check_values(context: Mapping[str, str], where: str = "context") -> None:
    """Check names and values.

    Args:
        where: option or file that gave them.

    Raises:
        InputError: the first that is wrong, and what would be right.
    """
    for name, value in context.items():
        if not _NAME.fullmatch(name) or name in COLUMNS or name == "r":
            text = "its name must be small letters, digits and '_', and no column of every table"
            raise InputError(where, name, value, text)
        if not _VALUE.fullmatch(value):
            text = (
                "must be a text of letters, digits, '_', '-' and '.', 32 characters at most, or a "
                'number with its unit, such as "24 degC"'
            )
            raise InputError(where, name, value, text)


def planned_names(plan: Plan) -> set[str]:
    """Return the names whose values a protocol plans trial by trial, and nobody can log."""
    collection = plan.protocol.collection
    several = {name for name in collection.context if len(plan.enabled[name]) > 1}
    return {*collection.factors, *several}


def unplanned(context: Mapping[str, str], plan: Plan) -> dict[str, str]:
    """Return logged values without those that the protocol has come to plan since."""
    planned = planned_names(plan)
    return {name: value for name, value in context.items() if name not in planned}


@dataclass
class LoggedContext:
    """The context of one campaign, read again and again; each entry of the log is read once."""

    store: TrialStore
    campaign: str
    changes: list[ContextChange] = field(default_factory=list)
    """Those of the campaign, oldest first."""
    _seen: set[int] = field(default_factory=set)

    def read(self) -> dict[str, str]:
        """Return the values that hold now, by name; empty where nobody logged any.

        Raises:
            StoreError: an entry of the log is damaged, so what holds is not known.
        """
        journal = log_journal(self.store)
        for number in journal.numbers():
            if number in self._seen:
                continue
            path = journal.path(number)
            try:
                data = read_json(path)
                if "context" in data:
                    self._add(number, data)
            except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
                raise StoreError(
                    f"{path}: is damaged ({error}), and may say which skin is mounted: restore it "
                    "from a copy, or delete it and log the skin again"
                ) from None
            self._seen.add(number)
        return {name: value for change in self.changes for name, value in change.context.items()}

    def last(self, name: str = SKIN) -> ContextChange | None:
        """Return the change by which a value holds, as of the last `read`; None if nobody did."""
        return next((each for each in reversed(self.changes) if name in each.context), None)

    def _add(self, number: int, data: dict[str, object]) -> None:
        context, campaigns = data["context"], data["campaigns"]
        if not isinstance(context, dict) or not isinstance(campaigns, list):
            raise ValueError("context must be a mapping, and campaigns a list")
        check_values(context)
        if self.campaign in campaigns:
            change = ContextChange(
                number=number,
                who=str(data["who"]),
                when=str(data["when"]),
                why=str(data.get("text", "")),
                host=str(data.get("host", "")),
                context=context,
                campaigns=tuple(campaigns),
            )
            self.changes.append(change)
            self.changes.sort(key=lambda each: each.number)
