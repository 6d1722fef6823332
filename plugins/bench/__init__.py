"""An open bench of slip detectors: their interface, scenes and figures, and those that ship."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_STRESS = "sliplab.plugins.bench.stress"
PLUGIN = Plugin(
    commands={
        "bench": "sliplab.plugins.bench.command:app",
    },
    studies={"stress": f"{_STRESS}.study:STUDY"},
    documents={
        "bench": (
            "sliplab.plugins.bench.document:BenchResult",
            "The table of the bench of detectors, by SlipLab",
        ),
    },
    hooks={"false_alarms": f"{_STRESS}.rates:report_alarms"},
)
