"""Labels to review: the list of trials, and a reviewer's verdict.

The list is made from small JSON files only, so that a whole campaign is listed at once. It is made
again when something it depends on has changed, such as a decision of another reviewer, or a trial
that a running campaign has committed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from sliplab.analysis.campaigns import Collected, has_plan, refuse_classes
from sliplab.analysis.labels.reviewed import State, label_key, state_of
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.plugins.web.review.doubt import reasons_for_doubt
from sliplab.protocols.adapter import CLASSES
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import did_you_mean
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.trials import review
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.review import Decision, ReviewedOnsets, Verdict
from sliplab.storage.trials.store import TrialStore

LabelState = Literal["fresh", "stale", "missing"]


@dataclass(frozen=True)
class ReviewRow:
    """One trial in the list.

    Attributes:
        order: its index among all trials.
        label: fresh if it was made from the trial and the settings as they are now.
        key: of the label that the present settings give.
        reasons: for doubt, as texts, gravest first.
        severity: of the gravest reason, 0 for none.
        state: of the decision; who: its reviewer; decisions: number of the last decision.
        problem: why the decisions cannot be read; empty if they can.
        rank: its place among those that a review would change most; 0 for all without that order.
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
    rank: int = 0

    @property
    def name(self) -> tuple[str, str]:
        """Campaign and trial."""
        return self.campaign, self.trial

    @property
    def status(self) -> str:
        """The decision as one word, or the reason why none is possible."""
        if self.problem:
            return "damaged"
        if self.label != "fresh":
            return "no label" if self.label == "missing" else "old label"
        return self.state

    @property
    def doubtful(self) -> bool:
        """True if there is a reason for doubt."""
        return self.severity > 0


def row_of(store: TrialStore, item: Collected, trial: str, order: int) -> ReviewRow:
    """Return the row of one committed trial.

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
        doubts = reasons_for_doubt(label)
    decision, problem = None, ""
    try:
        decision = review.last(store, item.name, trial)
    except StoreError as error:
        problem = str(error)
    return ReviewRow(
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
    """The rows of a store; `refresh` makes those again that may have changed.

    Attributes:
        changes: a number that grows whenever a row changes.
    """

    def __init__(self, store: TrialStore, campaigns: Sequence[str] = ()) -> None:
        self.store = store
        self._names = list(campaigns)
        self._folders: object = None
        self._ranks: Mapping[tuple[str, str], int] = {}
        self.items: dict[str, Collected] = {}
        self.rows: list[ReviewRow] = []
        self.changes = 0
        self.refresh()

    def refresh(self) -> bool:
        """Update the rows; return True if anything changed.

        Raises:
            StoreError: a campaign is damaged.
            InputError: a campaign that the store does not have.
        """
        # looked at before the rows are made: what changes in the meantime is seen the next time
        folders, counts = self._look()
        if folders == self._folders:
            changed = [row for row in self.rows if row.decisions != _count(counts, row)]
            for row in changed:
                self.renew(row)
            return bool(changed)
        found = {item.name: item for item in self.store.campaigns()}
        for name in self._names:
            if name not in found:
                there = (", ".join(found) or "none") + did_you_mean(name, found)
                raise InputError(
                    "--campaign", "", name, f"is not in {self.store.folder}; there are {there}"
                )
        ours = sorted(name for name, item in found.items() if has_plan(item.info))
        # a store with nothing else is refused by the first imported campaign's own message
        names = self._names or ours or sorted(found)
        items = {name: Collected(found[name]) for name in names}
        slips = {name: item for name, item in items.items() if item.experiment != CLASSES}
        if not slips:
            refuse_classes(list(items.values()))
        items = slips
        rows: list[ReviewRow] = []
        for item in items.values():
            whole = item.campaign.committed()
            planned = [trial.id for trial in item.planned if trial.id in whole]
            for trial in [*planned, *sorted(whole.difference(planned))]:
                try:
                    rows.append(self._ranked(row_of(self.store, item, trial, len(rows))))
                except StoreError:
                    continue  # it was damaged or taken away in the meantime: `verify` names it
        self.items, self.rows, self._folders = items, rows, folders
        self.changes += 1
        return True

    def row(self, campaign: str, trial: str) -> ReviewRow:
        """Return the row of a trial.

        Raises:
            StoreError: it is not in the list.
        """
        for row in self.rows:
            if row.name == (campaign, trial):
                return row
        raise StoreError(f"{campaign} / {trial}: is not in the list of trials to review")

    def renew(self, row: ReviewRow) -> ReviewRow:
        """Make the row of a trial again."""
        item = self.items[row.campaign]
        fresh = self._ranked(row_of(self.store, item, row.trial, row.order))
        if fresh != row:
            self.rows = [fresh if other.name == row.name else other for other in self.rows]
            self.changes += 1
        return fresh

    def rank(self, names: Sequence[tuple[str, str]]) -> None:
        """List trials, by campaign and id, in this order, and others behind them."""
        self._ranks = {name: place for place, name in enumerate(names)}
        self.rows = [self._ranked(row) for row in self.rows]
        self.changes += 1

    @property
    def ranked(self) -> bool:
        """True if `rank` gave an order."""
        return bool(self._ranks)

    def _ranked(self, row: ReviewRow) -> ReviewRow:
        return replace(row, rank=self._ranks.get(row.name, len(self._ranks)))

    def _look(self) -> tuple[object, dict[str, dict[str, int]]]:
        """Return what changes when a row does: folders' times, and numbers of decisions."""
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


def _count(counts: dict[str, dict[str, int]], row: ReviewRow) -> int:
    return counts.get(row.campaign, {}).get(row.trial, 0)


def filtered_rows(
    rows: Iterable[ReviewRow],
    *,
    campaign: str = "",
    state: str = "",
    text: str = "",
    doubtful_first: bool = True,
) -> list[ReviewRow]:
    """Return the rows that pass the filters, in the order of work.

    Args:
        campaign, state: only these; all where empty. The state ``doubtful`` means trials without a
            decision that have a reason for doubt.
        text: only trials whose id contains it.
        doubtful_first: undecided trials come first, by their rank, then those with the gravest
            doubts before others.
    """
    found = [
        row
        for row in rows
        if campaign in ("", row.campaign)
        and (state in ("", row.state) or (state == "doubtful" and _waits(row) and row.doubtful))
        and text.strip().lower() in row.trial.lower()
    ]
    if doubtful_first:
        found.sort(key=lambda row: (not _waits(row), row.rank, -row.severity, row.order))
    return found


def _waits(row: ReviewRow) -> bool:
    return row.state in {"open", "stale"}


class LabelChanged(ValueError):
    """The label is not the one that the reviewer saw."""


def record_verdict(
    trials: TrialList,
    row: ReviewRow,
    verdict: Verdict,
    lines: ReviewedOnsets,
    *,
    label: str,
    seen: int,
    who: str,
    why: str,
) -> Decision:
    """Store a verdict on a trial and its label.

    Args:
        lines: where the onset lines are; they count for ``adjust`` only.
        label: key of the label that the reviewer saw; seen: number of the last decision, likewise.

    Raises:
        LabelChanged: the label on the disk is another one by now, or out of date.
        Overtaken: another user decided in the meantime.
        ValueError: onsets that cannot be, or a rejection without a reason.
        OSError: it cannot be written.
    """
    now = trials.renew(row)
    if now.label != "fresh" or now.key != label:
        raise LabelChanged("the label has changed in the meantime; review it again")
    found = Derived.of(trials.store, LABELS, row.campaign).load(row.trial, TrialLabel)
    old = ReviewedOnsets(found.incipient_ns, found.gross_ns)
    new = {"adjust": lines, "reject": ReviewedOnsets()}.get(verdict, old)
    start, end = recorded_span(trials.items[row.campaign].campaign.recording(row.trial))
    for kind, time in vars(new).items():
        if time is not None and not start <= time <= end:
            name = kind.removesuffix("_ns")
            raise ValueError(f"the {name} onset lies outside the recording")
    return review.decide(
        trials.store,
        *row.name,
        verdict,
        label=label,
        old=old,
        new=new,
        seen=seen,
        who=who.strip(),
        why=why,
    )
