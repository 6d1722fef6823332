"""Calibration of a simulated rig: its scene's parameters fitted to a pilot's trials."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_TWIN = "sliplab.plugins.twin"
PLUGIN = Plugin(
    commands={"calibrate": f"{_TWIN}.command:app"},
    documents={
        "twin": (f"{_TWIN}.document:TwinFit", "A fit of a simulated rig to a pilot, by SlipLab"),
        "drift": (
            f"{_TWIN}.drift.document:DriftFit",
            "The drift of a campaign's reference trials, by SlipLab",
        ),
        "gap": (
            f"{_TWIN}.document:TwinGap",
            "Networks of a twin, tested on the rig that it imitates, by SlipLab",
        ),
    },
)
