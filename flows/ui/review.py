"""Labels to review: the list of trials, one trial's data, and a reviewer's verdict.

The list is made from small JSON files only, so that a whole campaign is listed at once. It is made
again when something it depends on has changed, such as a decision of another reviewer, or a trial
that a running campaign has committed. A trial's data are loaded when it is chosen.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from sliplab.analysis.campaigns import Collected, has_plan, need_slip
from sliplab.analysis.labels.reviewed import State, label_key, state_of
from sliplab.analysis.review.doubt import reasons_for_doubt, suggested_onsets
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.protocols.adapter import CLASSES
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import did_you_mean
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.streams import F64, I64, U8
from sliplab.storage.trials import review
from sliplab.storage.trials.derived import Arrays, Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.review import Decision, ReviewedOnsets, Verdict
from sliplab.storage.trials.store import Store
from sliplab.storage.trials.video import FrameReader

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
        state: of the decision; who: its reviewer; decisions: number of all decisions.
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


def row_of(store: Store, item: Collected, trial: str, order: int) -> ReviewRow:
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
    """The rows of a store; `refresh` makes those again that may have changed."""

    def __init__(self, store: Store, campaigns: Sequence[str] = ()) -> None:
        self.store = store
        self._names = list(campaigns)
        self._folders: object = None
        self._ranks: Mapping[tuple[str, str], int] = {}
        self.items: dict[str, Collected] = {}
        self.rows: list[ReviewRow] = []
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
            need_slip(list(items.values()))
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
        return True

    def renew(self, row: ReviewRow) -> ReviewRow:
        """Make the row of a trial again."""
        item = self.items[row.campaign]
        fresh = self._ranked(row_of(self.store, item, row.trial, row.order))
        self.rows = [fresh if other.name == row.name else other for other in self.rows]
        return fresh

    def rank(self, names: Sequence[tuple[str, str]]) -> None:
        """List trials, by campaign and id, in this order, and others behind them."""
        self._ranks = {name: place for place, name in enumerate(names)}
        self.rows = [self._ranked(row) for row in self.rows]

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


def as_columns(rows: Sequence[ReviewRow]) -> dict[str, list[str]]:
    """Return the rows as columns of the page's table."""
    return {
        "trial": [row.trial for row in rows],
        "campaign": [row.campaign for row in rows],
        "state": [row.status for row in rows],
        "doubt": ["?" * row.severity for row in rows],
        "reasons": ["; ".join((row.campaign, *row.reasons)) for row in rows],
    }


RATE_NS = 10_000_000
"""Width of a bin of the event rate."""


@dataclass
class ShownTrial:
    """The data of a trial that the page shows. Times: seconds on the time line unless in ns.

    Attributes:
        label: its label, None where it has none; label_key: the label's own key.
        frame_ns: (n,) int64; displacement_px: (n, m), NaN where unknown; both empty without label.
        xy_px: (n, m, 2) places of the markers, NaN where lost; None where they were not stored.
        plate_px: (n, 2) the same of the plate's marker; None without.
        rate_s: (k,) middle of each bin of 10 ms; rate: (k,) events a second.
        span_s: start and end of the recording; motion_s: of the slide or retraction.
    """

    row: ReviewRow
    item: Collected
    recording: Recording
    label: TrialLabel | None
    frame_ns: I64
    displacement_px: F64
    xy_px: F64 | None
    plate_px: F64 | None
    rate_s: F64
    rate: F64
    span_s: tuple[float, float]
    motion_s: tuple[float, float]
    _reader: FrameReader | None = field(default=None, repr=False)

    @property
    def label_key(self) -> str:
        """The key of the label that is shown; empty without one."""
        return "" if self.label is None else self.label.key

    @property
    def centre(self) -> int:
        """Index of the centre marker."""
        return self.recording.record.geometry.centre

    @property
    def threshold_px(self) -> float:
        """Displacement that counts as slip."""
        return self.item.settings.labelling.threshold_px

    @cached_property
    def frame_s(self) -> F64:
        """(n,) float64, the frames' times."""
        return self.frame_ns / 1e9

    @property
    def onsets(self) -> ReviewedOnsets:
        """The label's onsets."""
        if self.label is None:
            return ReviewedOnsets()
        return ReviewedOnsets(self.label.incipient_ns, self.label.gross_ns)

    @property
    def suggested(self) -> ReviewedOnsets:
        """Onsets by the markers that were seen, also where the label is in doubt."""
        return ReviewedOnsets() if self.label is None else suggested_onsets(self.label, self.centre)

    def frame_at(self, time_s: float) -> int:
        """Return the index of the frame nearest to a time; -1 without frames."""
        if not len(self.frame_ns):
            return -1
        return int(np.argmin(np.abs(self.frame_ns - round(time_s * 1e9))))

    def picture(self, index: int) -> U8 | None:
        """Return a frame of the video, uint8 (height, width); None if none was stored."""
        if not self.recording.has_video:
            return None
        if self._reader is None:
            self._reader = self.recording.frame_reader()
        return self._reader.frame(index)

    def places(self, index: int) -> F64:
        """Return the positions of the markers in a frame, (m, 2) px, NaN where lost; m may be 0."""
        return np.empty((0, 2)) if self.xy_px is None else self.xy_px[index]

    def close(self) -> None:
        """Close the video."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def load_trial(store: Store, item: Collected, row: ReviewRow) -> ShownTrial:
    """Read the displayed data of a trial; frames are read later, one at a time.

    Raises:
        StoreError: the trial is damaged.
    """
    recording = item.campaign.recording(row.trial)
    derived = Derived.of(store, LABELS, item.name)
    label: TrialLabel | None = None
    arrays: Arrays = {}
    if row.label != "missing":
        label, arrays = derived.load(row.trial, TrialLabel), derived.arrays(row.trial)
    frame_ns = np.empty(0, np.int64)
    if "frame_ns" in arrays:
        frame_ns = np.asarray(arrays["frame_ns"], np.int64)
    elif recording.frame_source != "none":
        frame_ns = recording.frame_times()
    moved = np.asarray(arrays.get("displacement_px", np.empty((len(frame_ns), 0))), np.float64)
    places, plate = arrays.get("xy_px"), arrays.get("plate_px")
    if places is None and recording.has_tracks:
        tracks = recording.tracks()
        places, plate = tracks.markers_px, tracks.plate_px
    start, end = recorded_span(recording)
    motion = recording.motion_ns
    rate_s, rate = event_rate(recording, start, end)
    return ShownTrial(
        row,
        item,
        recording,
        label,
        frame_ns,
        moved,
        None if places is None else np.asarray(places, np.float64),
        None if plate is None else np.asarray(plate, np.float64),
        rate_s,
        rate,
        (start / 1e9, end / 1e9),
        (motion[0] / 1e9, motion[1] / 1e9),
    )


def event_rate(recording: Recording, start_ns: int, end_ns: int) -> tuple[F64, F64]:
    """Return events per second in bins of 10 ms from the recording's start, whole bins only.

    Returns:
        (k,) float64 middle of each bin, s; (k,) float64 events a second.
    """
    bins = max(0, (end_ns - start_ns) // RATE_NS)
    edges = start_ns + np.arange(bins + 1, dtype=np.int64) * RATE_NS
    device_us = -(-np.asarray(recording.clock("events").to_device(edges)) // 1000)
    with recording.open() as reader:
        times = reader.event_times()
    counted = np.diff(np.searchsorted(times, device_us, "left"))
    return (edges[:-1] + RATE_NS // 2) / 1e9, counted * (1e9 / RATE_NS)


class LabelChanged(ValueError):
    """The label is not the one that the reviewer saw."""


def record_verdict(
    trials: TrialList,
    shown: ShownTrial,
    verdict: Verdict,
    lines: ReviewedOnsets,
    who: str,
    why: str,
) -> Decision:
    """Store a verdict on the trial and label that are shown.

    Args:
        lines: where the onset lines are; they count for ``adjust`` only.

    Raises:
        LabelChanged: the label on the disk is another one by now, or out of date.
        Overtaken: another user decided in the meantime.
        ValueError: onsets that cannot be, or a rejection without a reason.
        OSError: it cannot be written.
    """
    now = trials.renew(shown.row)
    if now.label != "fresh" or now.key != shown.label_key:
        raise LabelChanged("the label has changed in the meantime; review it again")
    new = {"adjust": lines, "reject": ReviewedOnsets()}.get(verdict, shown.onsets)
    for kind, time in vars(new).items():
        if time is not None and not shown.span_s[0] <= time / 1e9 <= shown.span_s[1]:
            name = kind.removesuffix("_ns")
            raise ValueError(f"the {name} onset lies outside the recording")
    return review.decide(
        trials.store,
        *shown.row.name,
        verdict,
        label=shown.label_key,
        old=shown.onsets,
        new=new,
        seen=shown.row.decisions,
        who=who.strip(),
        why=why,
    )
