"""The table of decisions by each onset: every row's figures, and the sentence that reads them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from sliplab.analysis.detectors import onset_references
from sliplab.analysis.detectors.latency import DetectedOnsets, TrueSlip
from sliplab.analysis.detectors.onset_references import Decided, Name, OnsetReference, References
from sliplab.analysis.report.onsets import Explained, OnsetSection, onset_section
from sliplab.analysis.report.page import render_section
from sliplab.analysis.report.summary import first_slip_ms
from sliplab.storage.schema import evaluation
from sliplab.storage.schema.evaluation import DetectorComparison, DetectorRate, OnsetFigures
from sliplab.storage.schema.summary import Kinematic, NetworkSummary, Summary

MS = 1_000_000
LABEL: dict[Name, OnsetReference] = {
    "paper": OnsetReference(TrueSlip(1000 * MS, 1500 * MS, 1800 * MS))
}
POINT: dict[Name, OnsetReference] = {
    "change_point": OnsetReference(TrueSlip(900 * MS, 1400 * MS, 1800 * MS), (899 * MS, 902 * MS))
}
TRUE: dict[Name, OnsetReference] = {
    "true": OnsetReference(TrueSlip(901 * MS, 1401 * MS, 1800 * MS))
}


def figures(
    *incipient_ms: int | None, references: Mapping[Name, OnsetReference]
) -> dict[str, OnsetFigures]:
    """Decisions on trials with the same onsets; those of gross slip at 1550 ms."""
    return onset_references.judge_by_reference(
        [
            Decided(DetectedOnsets(None if at is None else at * MS, 1550 * MS), references, 30 * MS)
            for at in incipient_ms
        ]
    )


@pytest.mark.parametrize(
    ("labelled_ms", "true_ms", "found"),
    [
        ([1000, 1000, 1000], [901, 880, 950], -99.0),
        ([1000, None, 1000], [901, 880, None], -99.0),  # without a label, and of a real trial
        ([1000], [None], None),
    ],
)
def test_the_first_slip_is_the_median_of_the_truth_from_the_label(
    labelled_ms: list[int | None], true_ms: list[int | None], found: float | None
) -> None:
    rows = [
        evaluation.TrialScore.model_construct(
            campaign="c", trial=str(k), incipient_ns=None if at is None else at * MS
        )
        for k, at in enumerate(labelled_ms)
    ]
    slips: dict[tuple[str, str], References] = {
        ("c", str(k)): {"true": OnsetReference(TrueSlip(at * MS, 1401 * MS, 1800 * MS))}
        for k, at in enumerate(true_ms)
        if at is not None
    }
    assert first_slip_ms(rows, slips) == found


def summary(
    own: Mapping[str, OnsetFigures], detectors: Mapping[str, Mapping[str, OnsetFigures]]
) -> Summary:
    """A summary of these rows alone; a network of another title has those of the store's own."""
    scores = tuple(
        evaluation.DetectorScores.model_construct(
            name=name,
            stride_ms=30,
            curve=(),
            rates=(
                DetectorRate.model_construct(allowed=0, by_reference={}),
                DetectorRate.model_construct(allowed=2, by_reference=dict(of)),
            ),
        )
        for name, of in detectors.items()
    )
    kinematic = Kinematic.model_construct(by_reference=dict(own))
    other = NetworkSummary.model_construct(title="preset: paper", kinematic=kinematic)
    compared = DetectorComparison.model_construct(detectors=scores, carried=None)
    found: Any = Summary.model_construct(
        kinematic=kinematic,
        networks={"preset-paper": other},
        detectors=compared if scores else None,
    )
    return found  # type: ignore[no-any-return]


def shown(section: OnsetSection, simulated: bool = True) -> str:
    """The section as text."""
    made = render_section(section, simulated=simulated)
    return " ".join(f"{made.title} {made.html}".split())


def test_every_decider_has_a_row_for_each_onset_and_the_sentence_adds_them_up() -> None:
    every = {**TRUE, **POINT, **LABEL}
    own = figures(950, 1020, 1030, None, references=every)
    cusum = figures(500, 880, 950, 960, references=every)
    section = onset_section(summary(own, {"cusum counts": cusum}))
    assert section is not None
    assert [row[:2] for row in section.table.rows] == [
        [title, onset]
        for title in (
            "this store's network and rule",
            "preset: paper",
            "CUSUM, counts, every 30 ms",
        )
        for onset in ("2 pixels (paper)", "change point", "true (simulated)")
    ]
    rows = [row[2:] for row in section.table.rows]
    assert rows[0][:5] == ["4 (0)", "30", "1 (1 to 81 %)", "1, 0", "–"]
    assert rows[2][:5] == ["4 (0)", "124", "0 (0 to 60 %)", "1, 0", "1 of 1"]
    # of four false alarms by 2 pixels one is real, and 880 ms is early within the tolerance
    assert rows[6][2] == "4 (40 to 100 %)"
    assert rows[8][:5] == ["4 (0)", "49", "1 (1 to 81 %)", "0, 0", "2 of 4"]
    assert section.explained == [
        Explained("change point", 6, 4),
        Explained("true (simulated)", 6, 4),
    ]
    text = shown(section)
    assert (
        "4 of 6 false early detections by the 2-pixel onset, all rows together, come at or after "
        "the onset by: true (simulated)." in text
    )
    assert "allow 2 validation trials" in text
    assert "interval is 3.0 ms wide" in text


def test_real_data_name_no_true_onset() -> None:
    own = figures(950, 1020, references={**LABEL, **POINT})
    section = onset_section(summary(own, {}))
    assert section is not None
    assert [row[1] for row in section.table.rows[:3]] == [
        "2 pixels (paper)",
        "change point",
        "2 pixels (paper)",
    ]
    text = shown(section, simulated=False)
    assert "simulat" not in text
    assert "allow" not in text


def test_an_older_evaluation_has_rows_of_networks_and_none_of_detectors() -> None:
    own = figures(1020, references={**LABEL, **TRUE})
    section = onset_section(summary(own, {"smoothing": {}}))
    assert section.allowed is None
    assert {row[0] for row in section.table.rows} == {
        "this store's network and rule",
        "preset: paper",
    }
    # no trial has a change point: counted as lacking, with no interval to tell of
    assert section.table.rows[1][1:4] == ["change point", "0 (1)", "–"]
    assert "wide in the median" not in shown(section)
    assert "No row has a false early detection" in shown(section)


def test_without_any_onset_there_is_no_section() -> None:
    assert onset_section(summary({}, {"smoothing": {}})) is None
