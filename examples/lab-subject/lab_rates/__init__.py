"""Event rates before and in the motion: a study, its report section, a detector; and a problem."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

PLUGIN = Plugin(
    studies={"rates": "lab_rates.study:STUDY"},
    searches={"rates": "lab_rates.search:search"},
    sections={"rates": "lab_rates.section:SECTION"},
    problems={"boxes": "lab_rates.problem:boxes"},
    detectors={"lab_jump": "lab_rates.detector:Jump"},
)
