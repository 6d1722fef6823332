"""Recordings that show classes of their own, such as touched objects, instead of slip."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_CLASSES = "sliplab.plugins.classes"
PLUGIN = Plugin(
    problems={"classes": f"{_CLASSES}.problem:classes_of_recordings"},
    documents={
        "classes": (
            f"{_CLASSES}.document:ClassEvaluation",
            "An evaluation of SlipLab on recordings of classes",
        ),
        "classes-summary": (
            f"{_CLASSES}.document:ClassSummary",
            "The summary of a report of SlipLab on recordings of classes",
        ),
    },
)
