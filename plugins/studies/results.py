"""Places of the results of trade-offs in a store."""

from __future__ import annotations

from sliplab.analysis.report.programs import CommandResult

_LABELS = "python -m benchmarks {} --json > {{file}}"
RESULTS = {
    "scene": CommandResult(
        "derived/tradeoff/tradeoff.json", "sliplab tradeoff --scene PROTOCOL --out {folder}"
    ),
    "labels": CommandResult("derived/tradeoff/labels.json", _LABELS.format("labels")),
    "labels_truth": CommandResult(
        "derived/tradeoff/labels_truth.json", _LABELS.format("labels_truth")
    ),
    "detector": CommandResult(
        "report/detector_tradeoff.json", "sliplab tradeoff --detector {store}"
    ),
}
"""By name: of the scene, of the benchmarks of labels, and of the detector."""
