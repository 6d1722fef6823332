"""Event rates before and during the motion: a command, a study, its section, and a detector."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(
    commands={"rates": "lab_rates.command:app"},
    searches={"rates": "lab_rates.study:search"},
    sections={"rates": "lab_rates.section:SECTION"},
    detectors={"lab_jump": "lab_rates.detector:Jump"},
)
