"""Labels in the report: differences between the rules, and of each from the simulated truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels import label_errors
from sliplab.analysis.report.campaign import source_words
from sliplab.analysis.report.figures.trials import label_uncertainty
from sliplab.analysis.report.page import Content, Figure, Table, number
from sliplab.storage.schema.evaluation import ChangePointCoverage, LabelCheck, RuleErrors
from sliplab.storage.schema.label import KINDS, LABELS, TrialLabel
from sliplab.storage.schema.summary import HoldSummary, OneCameraSummary, Summary
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

RULES = {"paper": "paper's rule", "change_point": "change point"}
RULING = {
    "paper": "the paper's rule",
    "change_point": "the change points",
    "force": "the force along the plate",
    "given": "the data set's own labels",
}


@dataclass(frozen=True)
class LabelSection(Content):
    """Both rules, each against its truth.

    Attributes:
        source: what labels are read from; ruling: the rule that counts.
        papillae: change points of all papillae; None where no truth is known.
        truth: the figure has distances from the truth.
        from_events: there are no frames.
    """

    template: ClassVar[str] = "labels.html"
    folded: ClassVar[bool] = True
    source: str
    ruling: str
    papillae: ChangePointCoverage | None
    check: LabelCheck | None
    figure: Figure
    truth: bool
    rules: Table
    holds: Table
    doubted: Table
    from_events: bool
    frame_ms: float
    """Interval of two frames."""


def label_section(
    store: TrialStore,
    campaigns: list[Collected],
    summary: Summary | OneCameraSummary,
) -> LabelSection | None:
    """Compare the labels; None where nothing is labelled by both rules."""
    if (labels := summary.labels) is None:
        return None
    rules = labels.rules_ms
    if not rules.apart.incipient.n:
        return None
    known = rules.paper.incipient.n > 0
    distances = label_errors.distances(store, campaigns)
    errors = {RULES[rule]: kinds for rule, kinds in distances.items()}
    every = [
        (
            item,
            recording.record.geometry.centre,
            Derived.of(store, LABELS, item.name).load(trial.id, TrialLabel),
        )
        for item in campaigns
        for trial, recording in item.trials
    ]
    causes = Counter(
        (item.name, kind, doubt)
        for item, _, label in every
        for kind in KINDS
        if (doubt := label.doubts.of(kind)) is not None
    )
    return LabelSection(
        source_words(summary),
        " and ".join(RULING.get(name, name) for name in labels.error_ms.rule.split("+")),
        rules.papillae if known else None,
        labels.check,
        _figure([(label, centre) for _, centre, label in every], errors, summary.simulated),
        bool(errors),
        _rules(rules, known),
        _holds(labels.holds),
        Table(
            ("campaign", "onset", "trials", "in doubt because"),
            [[*key[:2], str(count), key[2]] for key, count in causes.most_common()],
        ),
        bool(labels.source.get("events")),
        _frame_ms(campaigns),
    )


def _frame_ms(campaigns: Sequence[Collected]) -> float:
    """Return the interval of two frames in the first trial that has any; 10 without one."""
    records = (recording.record for item in campaigns for _, recording in item.trials)
    found = next((record for record in records if record.counts.frames), None)
    if found is None or not found.recorded_s:
        return 10.0
    return 1000 * found.recorded_s / found.counts.frames


def _rules(rules: RuleErrors, known: bool) -> Table:
    """List each rule's distances from its truth, where it is known, and between the rules."""
    rows = [
        ("paper's rule less the true crossing", rules.paper),
        ("change point less the true start of the slip", rules.change_point),
        ("paper's rule less the change point", rules.apart),
    ]
    columns = (
        "difference",
        "onset",
        "trials",
        "median (ms)",
        "median distance (ms)",
        "largest (ms)",
    )
    cells = [
        [
            title,
            f"{kind} onset",
            str(values.n),
            *(number(value, 2) for value in (values.median, values.median_abs, values.max_abs)),
        ]
        for title, found in (rows if known else rows[2:])
        for kind, values in (("incipient", found.incipient), ("gross", found.gross))
    ]
    return Table(columns, cells)


def _figure(
    labels: Sequence[tuple[TrialLabel, int]],
    errors: Mapping[str, Mapping[str, Sequence[float]]],
    simulated: bool,
) -> Figure:
    """Draw distances from the truth where it is known, and the change points' own intervals."""
    widths: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for label, centre in labels:
        found = label.change_point
        if found is None:
            continue
        for kind in KINDS:
            marker = found.first_marker if kind == "incipient" else centre
            if found.known_ns(kind) is not None and marker is not None:
                widths[kind].append((found.high_ns[marker] - found.low_ns[marker]) / 1e6)
    data = {
        f"{rule}, {kind}: distance from the truth (ms)": values
        for rule, kinds in errors.items()
        for kind, values in kinds.items()
    } | {
        f"change point, {kind}: width of the 95 % interval (ms)": values
        for kind, values in widths.items()
    }
    return Figure(label_uncertainty(errors, widths, simulated=simulated), name="labels", data=data)


def _holds(holds: Mapping[str, HoldSummary]) -> Table:
    """List slips in the hold, and how the onsets depend on the reference end of the hold."""
    columns = (
        "campaign",
        "trials",
        "slipped in the hold",
        "most (px)",
        "incipient apart, median (ms)",
        "largest (ms)",
        "gross apart, median (ms)",
        "largest (ms)",
    )
    rows = [
        [
            name,
            str(found.trials),
            str(found.slipped),
            number(found.most_px, 2),
            *(
                number(value, 0)
                for spread in (found.apart_ms.incipient, found.apart_ms.gross)
                for value in (spread.median, spread.max_abs)
            ),
        ]
        for name, found in holds.items()
    ]
    return Table(columns, rows)
