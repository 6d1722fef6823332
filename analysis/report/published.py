"""Published figures of the paper, to compare with those of a report.

Lu, Deng, Redmond, Psomopoulou and Ward-Cherrier, "A Neuromorphic Incipient Slip Detection System
using Papillae Morphology". All of it was measured on the authors' own robot and skin; a figure of a
simulated rig with them compares two different things, and the report says so.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One published figure.

    Attributes:
        value: the number, in the unit that `text` says; None where it is words.
        text: as a person reads it.
    """

    value: float | None
    text: str


PAPER = {
    "accuracy": Published(0.9433, "94.33 %"),
    "incipient_precision": Published(0.9758, "97.58 %"),
    "incipient_recall": Published(0.9609, "96.09 %"),
    "confused": Published(None, "no slip and gross slip"),
    "incipient_latency": Published(88.0, "88 ms"),
    "gross_latency": Published(70.0, "70 ms"),
    "gravity_lead": Published(360.0, "at least 360 ms, in every trial"),
    "disturbance_lead": Published(691.0, "691 ± 118 ms"),
    "incipient_trend": Published(
        None, "larger at a low retraction speed and at a small weight of the plate"
    ),
    "gross_trend": Published(None, "no clear trend; sometimes early"),
    "event_rate": Published(
        None,
        "very low at rest, a sharp rise by shear before the first slip, falling as papillae slip "
        "one after another, low in steady gross slip",
    ),
}
"""Published figures, by name."""

DISTURBANCE_LEAD_STD_MS = 118.0
"""The spread that the paper gives with its mean lead under disturbance."""
