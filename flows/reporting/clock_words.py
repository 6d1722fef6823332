"""How the report speaks of clocks: never a latency without how the frames behind it were timed."""

from __future__ import annotations

from typing import Any

from sliplab.analysis.report.page import number
from sliplab.protocols.timing import WIRED

_NO_GRADE = "unknown clocks"


def frames_grade(summary: dict[str, Any]) -> str:
    """How frames are timed, for onsets are read from frames."""
    return str(summary["sync"]["grade"] or _NO_GRADE)


def frames_uncertainty_us(summary: dict[str, Any]) -> float | None:
    """The worst trial's uncertainty of events against frames."""
    worst: dict[str, float] = summary["sync"]["worst_against_events_us"]
    return worst.get("frames", worst.get("arm"))


def unwired(summary: dict[str, Any]) -> bool:
    """Whether some trial's frames were timed through the host alone."""
    return any(grade not in WIRED for grade in frames_grade(summary).split(" or "))


def latency_note(summary: dict[str, Any]) -> str:
    """Under every table of latencies: the grade, and how far off it may be."""
    uncertain = number(frames_uncertainty_us(summary), 1, "µs")
    note = f"Frames: {frames_grade(summary)}; events against them within {uncertain}, worst trial."
    if unwired(summary):
        note += (
            " No wire ties these frames to the events: every latency here may be off by that much."
        )
    return note


def figure_note(summary: dict[str, Any]) -> str:
    """Under a figure of latencies, where they may be off by what can be seen in it."""
    return f" {latency_note(summary)}" if unwired(summary) else ""


def short_note(summary: dict[str, Any]) -> str:
    """Beside a headline latency."""
    note = f"frames: {frames_grade(summary)}"
    if unwired(summary):
        note += f", within {number(frames_uncertainty_us(summary), 1, 'µs')}"
    return note


def worst(summary: dict[str, Any]) -> tuple[str, str]:
    """The worst trial's uncertainty, and which device it is of, with its grade."""
    sync = summary["sync"]
    value = number(sync["worst_uncertainty_us"], 1, "µs")
    known: dict[str, float] = sync["worst_against_events_us"]
    if not known:
        return value, "no clock"
    device = max(known, key=lambda name: known[name])
    against = "" if device == "events" else "events against "
    return value, f"{against}{device} ({sync['grades'][device]})"
