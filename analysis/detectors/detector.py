"""Interface of a detector: events in, evidence out.

A detector is given a sensor's events in the order of time, some at once, with the moment up to
which they are complete. It answers with its evidence for slip and when that was known. Who uses it
sets the level above which the evidence is an alarm, so a detector has no threshold. A scene of the
bench, a stored trial and a rig's running stream (`StreamDetector`) are pushed to the same object.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.storage.streams import EventChunk

NO_LABEL = -1
"""Label of a decision without a class."""


NOTHING_US = -(1 << 62)
"""Time before all events."""


class DetectorError(ValueError):
    """A detector broke the rules of its interface, or failed."""


@dataclass(frozen=True)
class Slip:
    """True times of a scene, microseconds since it began.

    Attributes:
        physical_us: the first tip slides.
        paper_us: a marker has moved 2 pixels, the paper's incipient onset.
        gross_us: all markers have, the paper's gross onset.
    """

    physical_us: int
    paper_us: int
    gross_us: int

    def incipient_us(self, by_paper: bool) -> int:
        """Return the onset of incipient slip, by the 2-pixel rule or the physical one."""
        return self.paper_us if by_paper else self.physical_us


@dataclass(frozen=True)
class Scene:
    """A simulated recording: a hold, and the slide that ends it.

    Attributes:
        events: of the whole scene, from time 0 on.
        width, height: the sensor's pixels.
        end_us: end of the recording.
        world: simulated rig that it shares with other scenes; empty if with none.
        still_us: moment up to which surely nothing slips, where the slip is a label's; None: up to
            the physical onset.
    """

    name: str
    events: EventChunk
    width: int
    height: int
    end_us: int
    slip: Slip
    world: str = ""
    still_us: int | None = None


@dataclass(frozen=True)
class JudgedWindow:
    """What one answer rests on. Time in microseconds since the detector began.

    Attributes:
        number: from 0; a network's windows leave out those in a gap.
        events: of the window, all over the sensor and of both polarities.
        last_event_us: the latest of them; None in a window without events.
        counts: a network's output spikes in the order of `analysis.metrics.classification.CLASSES`.
        smoothed: their trailing means; both are None for a detector without a network.
    """

    number: int
    start_us: int
    events: int
    last_event_us: int | None
    counts: tuple[int, int, int] | None = None
    smoothed: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Evidence:
    """Answers of a detector, in the order of time.

    Attributes:
        t_us: int64 (n,), when each was known: the end of the events that it rests on.
        value: float64 (n,), evidence for slip, finite or -inf; larger is more.
        label: int8 (n,), 0 no slip, 1 incipient, 2 gross slip; `NO_LABEL` without classes.
        windows: n of them from a `StreamDetector`; others may leave them out.
        slipped: float64 (n,), share of the tips that have let go, 0 to 1, NaN where unknown; None
            from a detector that does not know tips.
    """

    t_us: npt.NDArray[np.int64]
    value: npt.NDArray[np.float64]
    label: npt.NDArray[np.int8]
    windows: tuple[JudgedWindow, ...] = ()
    slipped: npt.NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.t_us)

    @staticmethod
    def of(
        t_us: npt.ArrayLike, value: npt.ArrayLike, label: npt.ArrayLike | None = None
    ) -> Evidence:
        """Return evidence of any numbers; without labels it has no classes."""
        times = np.asarray(t_us, np.int64)
        labels = np.full(times.shape, NO_LABEL) if label is None else label
        return Evidence(times, np.asarray(value, np.float64), np.asarray(labels, np.int8))

    @staticmethod
    def joined(parts: Sequence[Evidence]) -> Evidence:
        """Return evidence of parts that follow each other."""
        none = Evidence.of([], [])
        every = [none, *parts]
        slipped = [part.slipped for part in parts if part.slipped is not None]
        return Evidence(
            np.concatenate([part.t_us for part in every]),
            np.concatenate([part.value for part in every]),
            np.concatenate([part.label for part in every]),
            slipped=np.concatenate(slipped) if slipped and len(slipped) == len(parts) else None,
        )


@dataclass(frozen=True)
class Cost:
    """Cost of a detector as it states it; None where it does not.

    Attributes:
        operations: additions and multiplications of a decision, mean.
        memory_bytes: of its parameters.
    """

    operations: float | None = None
    memory_bytes: int | None = None


class Detector(ABC):
    """A detector of slip; see the module."""

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:  # noqa: B027
        """Train on scenes, and select by the validation scenes. Does nothing by default."""

    @abstractmethod
    def begin(self, width: int, height: int) -> None:
        """Begin a scene at time 0, with a sensor of so many pixels; nothing of the last one stays.

        Raises:
            ValueError: the detector does not work with such a sensor.
        """

    @abstractmethod
    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """Take the next events, complete up to `until_us`; return what is known by then.

        Args:
            events: sorted by time, from the last call's `until_us` on and before this one's.

        Returns:
            evidence of times after the last call's `until_us`, up to this one's.
        """

    def cost(self) -> Cost:
        """Return its cost, after `train`."""
        return Cost()

    def close(self) -> None:  # noqa: B027
        """Release what it holds, such as a process. By default nothing."""


class StreamDetector(Detector):
    """A detector on a running stream, whose labels are its decisions.

    Events may come out of order. Those of a call are sorted; they may be older than the last
    call's, and as young as `until_us`.
    """

    span_us: int = 0
    """Span of the events that a decision rests on; 0 where it is not known."""

    @property
    @abstractmethod
    def settled_us(self) -> int:
        """Time before which events no longer count; `NOTHING_US` before anything is settled."""

    @abstractmethod
    def warm_up(self, width: int, height: int) -> None:
        """Load and compile everything before `begin`, so that the first answer need not wait."""

    @abstractmethod
    def resume(self, at_us: int) -> None:
        """Begin again at a time, before which the stream was interrupted."""


def checked(found: object, before_us: int, until_us: int) -> Evidence:
    """Return evidence that keeps the rules.

    Args:
        before_us, until_us: the moments up to which events were complete before, and now.

    Raises:
        DetectorError: it is none, is not of that time, or is not a number.
    """
    if not isinstance(found, Evidence):
        raise DetectorError(f"push returned {type(found).__name__}; must be Evidence")
    n = len(found.t_us)
    if found.slipped is not None and found.slipped.shape != (n,):
        raise DetectorError(f"evidence has {n} times and {found.slipped.shape} shares of tips")
    if found.value.shape != (n,) or found.label.shape != (n,):
        raise DetectorError(
            f"evidence has {n} times, {found.value.shape} values and {found.label.shape} labels; "
            "must be as many"
        )
    if not n:
        return found
    if (found.t_us[1:] <= found.t_us[:-1]).any():
        raise DetectorError("times of evidence must increase")
    first, last = int(found.t_us[0]), int(found.t_us[-1])
    if first <= before_us or last > until_us:
        wrong = first if first <= before_us else last
        raise DetectorError(
            f"evidence at {wrong} us; must be after {before_us} us and not after {until_us} us, "
            "up to which it was given events"
        )
    if np.isnan(found.value).any() or (found.value == np.inf).any():
        raise DetectorError("a value of evidence is nan or inf; must be finite or -inf")
    if found.label.min() < NO_LABEL or found.label.max() >= len(CLASSES):
        wrong = int(found.label.min() if found.label.min() < NO_LABEL else found.label.max())
        raise DetectorError(f"label = {wrong}: must be -1 (none), 0, 1 or 2")
    return found
