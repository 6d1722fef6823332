"""Calibration of a simulated rig: its scene's parameters fitted to a pilot's trials."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_TWIN = "sliplab.plugins.twin"
PLUGIN = Plugin(
    studies={
        "calibrate scene": f"{_TWIN}.study:STUDY",
        "calibrate drift": f"{_TWIN}.drift.study:STUDY",
        "calibrate gap": f"{_TWIN}.gap.study:STUDY",
    },
)
