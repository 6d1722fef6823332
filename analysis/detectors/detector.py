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
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.storage.streams import EventChunk

_N = TypeVar("_N", np.int64, np.float64, np.int8)
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
        times = _cast(t_us, np.int64)
        labels = np.full(times.shape, NO_LABEL) if label is None else label
        return Evidence(times, _cast(value, np.float64), _cast(labels, np.int8))

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
    level: float | None = None
    """Evidence above it is an alarm; None where the label alone says slip."""

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
        DetectorError: it is none, is not of that time, or is not made of numbers.
    """
    if not isinstance(found, Evidence):
        raise DetectorError(f"push returned {type(found).__name__}; must be Evidence")
    t_us = _array("times", found.t_us, np.int64)
    n = len(t_us)
    value = _array("values", found.value, np.float64, n)
    label = _array("labels", found.label, np.int8, n)
    slipped = (
        None if found.slipped is None else _array("shares of tips", found.slipped, np.float64, n)
    )
    if not n:
        return Evidence(t_us, value, label, found.windows, slipped)
    if (t_us[1:] <= t_us[:-1]).any():
        raise DetectorError("times of evidence must increase")
    first, last = int(t_us[0]), int(t_us[-1])
    if first <= before_us or last > until_us:
        wrong = first if first <= before_us else last
        raise DetectorError(
            f"evidence at {wrong} us; must be after {before_us} us and not after {until_us} us, "
            "up to which it was given events"
        )
    if np.isnan(value).any() or (value == np.inf).any():
        raise DetectorError("a value of evidence is nan or inf; must be finite or -inf")
    if label.min() < NO_LABEL or label.max() >= len(CLASSES):
        wrong = label.min() if label.min() < NO_LABEL else label.max()
        raise DetectorError(f"label = {wrong}: must be -1 (none), 0, 1 or 2")
    if slipped is not None and ((slipped < 0) | (slipped > 1)).any():
        raise DetectorError("a share of slipped tips must be from 0 to 1, or nan where unknown")
    return Evidence(t_us, value, label, found.windows, slipped)


def _array(name: str, given: object, like: type[_N], n: int | None = None) -> npt.NDArray[_N]:
    """Return an array of evidence in its type: (n,), of any n where None.

    Raises:
        DetectorError: it is none, of another shape, or of something else than such numbers.
    """
    if not isinstance(given, np.ndarray):
        kind = type(given).__name__
        raise DetectorError(f"{name} of evidence are of type {kind}; must be a NumPy array")
    if given.ndim != 1 or n not in (None, len(given)):
        most = "must be one list" if n is None else "must be as many"
        times = "" if n is None else f"{n} times, "
        raise DetectorError(f"evidence has {times}{given.shape} {name}; {most}")
    made = _cast(given, like)
    if made.dtype != like and len(given):
        must = "real numbers" if like is np.float64 else f"whole numbers in {like.__name__}"
        raise DetectorError(f"{name} of evidence, {given.dtype}, must be {must}")
    return made if len(made) else np.zeros(0, like)


def _cast(given: npt.ArrayLike, like: type[_N]) -> npt.NDArray[_N]:
    """Return an array of a type, as it is where that would change it, so that `checked` says it."""
    here = np.asarray(given)
    if here.dtype == like or here.dtype.kind not in "biuf":
        return here
    with np.errstate(invalid="ignore", over="ignore"):
        made = here.astype(like)
    return made if np.array_equal(made, here, equal_nan=True) else here
