"""The report's tables of two benchmarks of labels: what following markers costs, how right it is.

Both are one line of JSON whose ``figures`` have numbers by name; those named here are shown.
"""

from __future__ import annotations

import math
from typing import Any

from sliplab.analysis.report.page import Table

Json = dict[str, Any]

WAYS = {
    "": "SlipLab's tracker",
    "tuned_detector_": "OpenCV's blob detector, tuned to these frames",
    "components_": "OpenCV's connected components, weighted by intensity",
    "blob_detector_": "OpenCV's blob detector as it stands",
}
"""How figures of each way to find markers begin."""

SETS = {"": "slides", "falls_": "falling plates", "stressed_": "slides with nuisances"}
"""How figures of each set of trials begin."""

TRUTHS = {
    "trials": "trials",
    "slips": "slips of single markers",
    "centroid_rms_px": "centres, RMS error (px)",
    "swaps": "markers taken for each other",
    "crossing_median_frames": "paper's rule against the true crossing, median (frames)",
    "crossing_p95_frames": "the same, 95th percentile (frames)",
    "paper_slip_median_ms": "paper's rule against the true start of slip, median (ms)",
    "slip_median_ms": "change point against the true start of slip, median (ms)",
    "slip_p95_ms": "the same, 95th percentile (ms)",
    "slip_bias_ms": "the same, median with its sign (ms)",
    "slip_width_ms": "width of its 95 % interval, median (ms)",
    "coverage_95": "share of these intervals that hold the truth",
    "wrong_not_doubted": "onsets of trials that are wrong without a doubt",
}


def speed(figures: Json) -> Table:
    """Time a frame and error of each way to find markers.

    Raises:
        KeyError: SlipLab's own are not among the figures.
    """
    own = float(figures["frame_ms"])
    rows = []
    for begin, words in WAYS.items():
        if f"{begin}frame_ms" not in figures:
            continue
        ms = float(figures[f"{begin}frame_ms"])
        rows.append(
            [words, f"{ms:.3g}", f"{ms / own:.3g}", _format(figures.get(f"{begin}error_px"))]
        )
    return Table(
        ("way to find the markers", "a frame (ms)", "times SlipLab's", "RMS error (px)"),
        rows,
        "The labels: following the markers on drawn frames, one core (simulated; errors on frames "
        "without noise).",
    )


def truth(figures: Json) -> Table:
    """How far labels are off what is true in the simulation, by set of trials.

    Raises:
        KeyError: no set of trials is among the figures.
    """
    sets = {begin: words for begin, words in SETS.items() if f"{begin}trials" in figures}
    if not sets:
        raise KeyError("trials")
    rows = []
    for key, words in TRUTHS.items():
        values = [figures.get(f"{begin}{key}") for begin in sets]
        if any(value is not None for value in values):
            rows.append([words, *map(_format, values)])
    return Table(
        ("labels against the truth", *sets.values()),
        rows,
        "The labels: pictures drawn of random trials, and what was found in them (simulated).",
    )


def _format(value: Any) -> str:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.3g}"
