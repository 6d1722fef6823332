"""What became of all that the cameras sent: nothing is lost without being in one of these."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass
class GrabCounts:
    """What became of the frames of one run.

    Attributes:
        grabbed: whole frames in order, handed on or still in the queue.
        failed: came incomplete.
        skipped: missing in the camera's ids, or overwritten in pylon.
        late: arrived later after their time than `late_s` allows; they are handed on.
        out_of_order: came after a later one or twice; they are not handed on.
        unstamped: their time never came; they are not handed on.
    """

    grabbed: int = 0
    failed: int = 0
    skipped: int = 0
    late: int = 0
    out_of_order: int = 0
    unstamped: int = 0

    @property
    def lost(self) -> int:
        """Frames that were exposed, as far as one can tell, and not handed on."""
        return self.failed + self.skipped + self.out_of_order + self.unstamped

    def copy(self) -> GrabCounts:
        """As they are now."""
        return GrabCounts(*(getattr(self, field.name) for field in fields(self)))


@dataclass
class EventCounts:
    """What one run received.

    Attributes:
        events: kept, read or not.
        pulses: rising edges.
        gaps: silences of more than `gap_s` between events, on the camera's clock.
        longest_gap_us: the longest silence between two events.
        filtered: dropped by the noise filter, if it is on.
        overflowed: dropped because nobody read; the run ends with an error then.
        other_triggers: triggers that are no rising edges.
        before: events thrown away before the run.
    """

    events: int = 0
    pulses: int = 0
    gaps: int = 0
    longest_gap_us: int = 0
    filtered: int = 0
    overflowed: int = 0
    other_triggers: int = 0
    before: int = 0
