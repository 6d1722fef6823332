"""What a running detector says of each window, and what it lost on the way."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Decision:
    """What the detector says of one window. Times on the camera's clock, microseconds.

    Attributes:
        number: of the window, from 0; gaps leave numbers out.
        counts: output spikes in the order of `analysis.nets.metrics.CLASSES`.
        smoothed, valid_class, onset: as `analysis.detect.live_rule.Step`.
        events: events of the window, all over the sensor and of both polarities.
        last_event_us: the latest of them; None in a window without events.
        by_event: an event ended the window, and not the clock alone.
        decided_ns: monotonic clock when the decision was there.
    """

    number: int
    start_us: int
    end_us: int
    counts: tuple[int, int, int]
    smoothed: tuple[float, float, float]
    valid_class: int
    onset: str | None
    events: int
    last_event_us: int | None
    by_event: bool
    decided_ns: int = field(compare=False)


@dataclass
class Losses:
    """What the stream did that a stored one does not."""

    late: int = 0
    """Events left out: their window had been judged."""
    disordered: int = 0
    """Events that came after a younger one, the late ones among them."""
    gaps: int = 0
    longest_gap_us: int = 0
