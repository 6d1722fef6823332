"""An open bench of slip detectors: their interface, scenes and figures, and those that ship."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_BENCH = "sliplab.plugins.bench"
PLUGIN = Plugin(
    studies={"bench": f"{_BENCH}.study:STUDY", "stress": f"{_BENCH}.stress.study:STUDY"},
    hooks={"false_alarms": f"{_BENCH}.stress.rates:report_alarms"},
)
