"""The report's words on the labels: how far both rules are apart, and each from the truth."""

from __future__ import annotations

from collections import Counter
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.figures.trials import label_uncertainty
from sliplab.analysis.report.page import Figure, Section, Table, number, percent
from sliplab.flows.labelling.label_errors import distances
from sliplab.flows.reporting.results import source_text
from sliplab.storage.schema.label import KINDS, LABELS, TrialLabel
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store

_ROWS = (
    ("paper", "paper's rule less the true crossing"),
    ("change_point", "change point less the true start of the slip"),
    ("apart", "paper's rule less the change point"),
)


def section(
    store: Store, campaigns: list[Collected], summary: dict[str, Any], simulated: bool
) -> Section | None:
    """Both rules against the simulation's truth; None where nothing is labelled by both."""
    rules = summary["labels"]["rules_ms"]
    if not rules["apart"]["incipient"]["n"]:
        return None
    known = rules["paper"]["incipient"]["n"] > 0
    rows = []
    for name, title in _ROWS if known else _ROWS[2:]:
        for kind in ("incipient", "gross"):
            values = rules[name][kind]
            rows.append(
                [
                    title,
                    f"{kind} onset",
                    str(values["n"]),
                    number(values["median"], 2),
                    number(values["median_abs"], 2),
                    number(values["max_abs"], 2),
                ]
            )
    said = [
        f"Labels are read from {source_text(summary)} alone. The paper dates a slip by the frame "
        "in which a marker has gone 2 pixels; the change point says when the papilla let go, with "
        f"an interval. Which of them rules is the protocol's: here {_ruling(summary)}."
    ]
    if known:
        papillae = rules["papillae"]
        said.append(
            "The mock rig knows both moments, and nothing else reads them. Over "
            f"{papillae['n']} papilla slips (simulated) the change point is "
            f"{number(papillae['median_abs'], 2, 'ms')} off in the median, and its 95 % interval "
            f"holds the truth in {percent(papillae['coverage'])} of them."
        )
    if (check := summary["labels"]["check"]) is not None:
        said.append(_checked(check))
    columns = (
        "difference", "onset", "trials", "median (ms)", "median distance (ms)", "largest (ms)"
    )  # fmt: skip
    return Section(
        "How exact the labels are",
        said,
        [_figure(store, campaigns, simulated)],
        [
            Table(columns, rows, "One frame is 10 ms."),
            *_holds(summary["labels"]["holds"]),
            *_doubted(store, campaigns),
        ],
    )


def _checked(check: dict[str, Any]) -> str:
    """What video does to the labels of trials that were taken as tracks."""
    rules = check["rules_ms"]
    paper, papillae = rules["paper"], rules["papillae"]
    far = {kind: number(paper[kind]["median_abs"], 2, "ms") for kind in KINDS}
    return (
        f"{check['trials']} slides were taken again on the same simulated rig with the video drawn "
        f"and tracked: there the paper's rule is {far['incipient']} (incipient) and {far['gross']} "
        f"(gross) off the true crossing in the median, at most "
        f"{number(paper['incipient']['max_abs'], 1, 'ms')} and "
        f"{number(paper['gross']['max_abs'], 1, 'ms')}; the change point of {papillae['n']} "
        f"papilla slips is {number(papillae['median_abs'], 2, 'ms')} off, and its interval holds "
        f"the truth in {percent(papillae['coverage'])} of them."
    )


def _figure(store: Store, campaigns: list[Collected], simulated: bool) -> Figure:
    """Distances from the truth where it is known, and the change points' own intervals."""
    errors = {_RULES[rule]: kinds for rule, kinds in distances(store, campaigns).items()}
    widths: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for item in campaigns:
        labels = Derived.of(store, LABELS, item.name)
        for trial, recording in item.trials:
            found = labels.load(trial.id, TrialLabel).change_point
            if found is None:
                continue
            centre = recording.record.geometry.centre
            for kind in KINDS:
                marker = found.first_marker if kind == "incipient" else centre
                if found.known_ns(kind) is not None and marker is not None:
                    width = found.high_ns[marker] - found.low_ns[marker]
                    widths[kind].append(width / 1e6)
    data: dict[str, list[float]] = {
        f"{rule}, {kind}: distance from the truth (ms)": values
        for rule, kinds in errors.items()
        for kind, values in kinds.items()
    }
    for name, values in widths.items():
        data[f"change point, {name}: width of the 95 % interval (ms)"] = values
    seen = (
        "Left: how many trials' labels lie within so much of the truth, each rule against its own "
        "(the crossing of 2 pixels, the start of the slip). Right: how"
        if errors
        else "How"
    )
    return Figure(
        label_uncertainty(errors, widths, simulated=simulated),
        f"{seen} sure the change points are of themselves. A curve further left is better.",
        "labels",
        data,
    )


_RULES = {"paper": "paper's rule", "change_point": "change point"}


def _doubted(store: Store, campaigns: list[Collected]) -> list[Table]:
    """Why labels of the ruling rule lack an onset."""
    causes = Counter(
        (item.name, kind, doubt)
        for item in campaigns
        for trial, _ in item.trials
        for label in (Derived.of(store, LABELS, item.name).load(trial.id, TrialLabel),)
        for kind in KINDS
        if (doubt := label.doubts.of(kind)) is not None
    )
    if not causes:
        return []
    rows = [[*key[:2], str(count), key[2]] for key, count in causes.most_common()]
    return [
        Table(("campaign", "onset", "trials", "in doubt because"), rows, "Doubted onsets are none.")
    ]


def _holds(holds: dict[str, Any]) -> list[Table]:
    """Slips in the hold, and what it would matter from which end displacements count."""
    if not holds:
        return []
    rows = [
        [
            name,
            str(found["trials"]),
            str(found["slipped"]),
            number(found["most_px"], 2),
            *(
                number(found["apart_ms"][kind][key], 0)
                for kind in KINDS
                for key in ("median", "max_abs")
            ),
        ]
        for name, found in holds.items()
    ]
    columns = (
        "campaign", "trials", "slipped in the hold", "most (px)", "incipient apart, median (ms)",
        "largest (ms)", "gross apart, median (ms)", "largest (ms)",
    )  # fmt: skip
    words = (
        "Slips in the recorded hold leave a trial's onsets in doubt. Apart: the paper's onset with "
        "displacements counted from the hold's end less the one counted from its start."
    )
    return [Table(columns, rows, words)]


def _ruling(summary: dict[str, Any]) -> str:
    words = {"paper": "the paper's rule", "change_point": "the change points"}
    names = summary["labels"]["error_ms"]["rule"].split("+")
    return " and ".join(words.get(name, name) for name in names)
