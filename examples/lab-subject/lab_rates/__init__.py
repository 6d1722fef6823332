"""Event rates before and in the motion: a study, its report section, and a detector."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(
    studies={"rates": "lab_rates.study:STUDY"},
    searches={"rates": "lab_rates.study:search"},
    sections={"rates": "lab_rates.section:SECTION"},
    detectors={"lab_jump": "lab_rates.detector:Jump"},
)
