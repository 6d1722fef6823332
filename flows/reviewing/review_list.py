"""What a reviewer chooses from: every committed trial with its label's doubts and its decision.

Made from small JSON files only, so that a whole campaign is listed at once. It is made anew when
something it depends on has changed, such as a decision of another reviewer, or a trial that a
running campaign has committed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from sliplab.analysis.campaigns import Collected
from sliplab.flows.labelling.label import label_key
from sliplab.flows.labelling.reviewed import State, state_of
from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.label import KINDS, LABELS, TrialLabel
from sliplab.storage.trials import review
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import IMPORTED, Store

LabelState = Literal["fresh", "stale", "missing"]
_GRAVE, _ODD, _SLIGHT = 3, 2, 1
"""An onset in doubt; an onset that is not there; something to look at."""


@dataclass(frozen=True)
class Row:
    """One trial in the list.

    Attributes:
        order: its place among all.
        label: whether there is a label, made from the trial and the settings as they are now.
        key: of the label that is wanted now.
        reasons: for doubt, in words, gravest first.
        severity: of the gravest reason, 0 for none.
        state: what is decided; who: by whom; decisions: how many there are in all.
        problem: why its decisions cannot be read; empty if they can.
    """

    order: int
    campaign: str
    trial: str
    label: LabelState
    key: str
    reasons: tuple[str, ...]
    severity: int
    state: State
    who: str
    decisions: int
    problem: str = ""

    @property
    def name(self) -> tuple[str, str]:
        """Campaign and trial."""
        return self.campaign, self.trial

    @property
    def word(self) -> str:
        """How it stands, in short."""
        if self.problem:
            return "damaged"
        if self.label != "fresh":
            return "no label" if self.label == "missing" else "old label"
        return self.state

    @property
    def doubtful(self) -> bool:
        """Whether there is a reason to look at it."""
        return self.severity > 0


def doubts_of(label: TrialLabel) -> list[tuple[int, str]]:
    """Reasons to doubt a label, with their severity, gravest first."""
    found: list[tuple[int, str]] = []
    for kind in KINDS:
        if doubt := label.doubts.of(kind):
            found.append((_GRAVE, f"{kind}: {doubt}"))
        elif label.at_ns(kind) is None:
            nothing = "no slip was found" if kind == "incipient" else "no gross slip was found"
            found.append((_ODD, nothing))
    found += [(_ODD, text) for text in label.flags]
    if label.markers_lost:
        found.append((_SLIGHT, f"{label.markers_lost} times a marker was not seen"))
    if label.plate_lost:
        found.append((_SLIGHT, f"the plate's marker was not seen in {label.plate_lost} frames"))
    return sorted(dict.fromkeys(found), key=lambda item: -item[0])


def row_of(store: Store, item: Collected, trial: str, order: int) -> Row:
    """The row of one committed trial.

    Raises:
        StoreError: the trial is damaged or gone.
    """
    recording = item.campaign.recording(trial)
    key = label_key(recording, item.settings.labelling)
    state: LabelState = "missing"
    doubts: list[tuple[int, str]] = []
    try:
        label = Derived.of(store, LABELS, item.name).load(trial, TrialLabel)
    except (OSError, StoreError):
        pass  # there is none, or it is damaged and has to be made again
    else:
        state = "fresh" if label.key == key else "stale"
        doubts = doubts_of(label)
    decision, problem = None, ""
    try:
        decision = review.last(store, item.name, trial)
    except StoreError as error:
        problem = str(error)
    return Row(
        order,
        item.name,
        trial,
        state,
        key,
        tuple(text for _, text in doubts),
        doubts[0][0] if doubts else 0,
        state_of(decision, key),
        decision.who if decision and decision.verdict != "reopen" else "",
        decision.number if decision else 0,
        problem,
    )


class TrialList:
    """The rows of a store, made anew where they may have changed."""

    def __init__(self, store: Store, campaigns: Sequence[str] = ()) -> None:
        self.store = store
        self._names = list(campaigns)
        self._folders: object = None
        self.items: dict[str, Collected] = {}
        self.rows: list[Row] = []
        self.refresh()

    def refresh(self) -> bool:
        """Look again; whether there is anything new.

        Raises:
            StoreError: a campaign is damaged.
            InputError: a campaign that the store does not have.
        """
        # looked at before the rows are made: what changes meanwhile is seen the next time
        folders, counts = self._look()
        if folders == self._folders:
            changed = [row for row in self.rows if row.decisions != _count(counts, row)]
            for row in changed:
                self.renew(row)
            return bool(changed)
        found = {item.name: item for item in self.store.campaigns()}
        for name in self._names:
            if name not in found:
                there = ", ".join(found) or "none"
                raise InputError(
                    "--campaign", "", name, f"is not in {self.store.folder}; there are {there}"
                )
        ours = sorted(name for name, item in found.items() if IMPORTED not in item.info)
        # a store with nothing else is refused by the first imported campaign's own message
        names = self._names or ours or sorted(found)
        items = {name: Collected(found[name]) for name in names}
        rows: list[Row] = []
        for item in items.values():
            whole = item.campaign.committed()
            planned = [trial.id for trial in item.plan if trial.id in whole]
            for trial in [*planned, *sorted(whole.difference(planned))]:
                try:
                    rows.append(row_of(self.store, item, trial, len(rows)))
                except StoreError:
                    continue  # it was damaged or taken away meanwhile: `verify` names it
        self.items, self.rows, self._folders = items, rows, folders
        return True

    def renew(self, row: Row) -> Row:
        """The row of a trial as it is now."""
        fresh = row_of(self.store, self.items[row.campaign], row.trial, row.order)
        self.rows = [fresh if other.name == row.name else other for other in self.rows]
        return fresh

    def _look(self) -> tuple[object, dict[str, dict[str, int]]]:
        """What changes when a row does: folders' times, and how many decisions there are."""
        seen, counts = [], {}
        for campaign in self.store.campaigns():
            derived = (Derived.of(self.store, step, campaign.name) for step in (LABELS, "sync"))
            folders = (campaign.folder / "trials", *(step.folder for step in derived))
            times = [path.stat().st_mtime_ns if path.is_dir() else 0 for path in folders]
            protocol = campaign.protocol_file
            times.append(protocol.stat().st_mtime_ns if protocol.is_file() else 0)
            seen.append((campaign.name, times))
            counts[campaign.name] = review.counts(self.store, campaign.name)
        return seen, counts


def _count(counts: dict[str, dict[str, int]], row: Row) -> int:
    return counts.get(row.campaign, {}).get(row.trial, 0)


def chosen(
    rows: Iterable[Row], *, campaign: str = "", state: str = "", text: str = "",
    doubtful_first: bool = True,
) -> list[Row]:  # fmt: skip
    """Rows that a reviewer wants to see, in the order of work.

    Args:
        campaign, state: only these; all where empty. The state ``doubtful`` means trials that
            nobody has decided on and that have a reason for doubt.
        text: only trials whose id holds it.
        doubtful_first: what is left to be decided comes first, gravest doubts before others.
    """
    found = [
        row
        for row in rows
        if campaign in ("", row.campaign)
        and (state in ("", row.state) or (state == "doubtful" and _waits(row) and row.doubtful))
        and text.strip().lower() in row.trial.lower()
    ]
    if doubtful_first:
        found.sort(key=lambda row: (not _waits(row), -row.severity, row.order))
    return found


def _waits(row: Row) -> bool:
    return row.state in {"open", "stale"}


def as_columns(rows: Sequence[Row]) -> dict[str, list[str]]:
    """The rows as a table's columns."""
    return {
        "trial": [row.trial for row in rows],
        "campaign": [row.campaign for row in rows],
        "state": [row.word for row in rows],
        "doubt": ["?" * row.severity for row in rows],
        "reasons": ["; ".join((row.campaign, *row.reasons)) for row in rows],
    }
