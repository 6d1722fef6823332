"""Faults on purpose: everything that a campaign must survive can be asked for by name."""

from __future__ import annotations

from collections.abc import Sequence

from rigs.mock.settings import Fault, FaultKind


class FaultBook:
    """The faults of one trial, and which of them have happened."""

    def __init__(self, faults: Sequence[Fault], trial: int) -> None:
        self._faults = [fault for fault in faults if fault.trial in {None, trial}]
        self._happened: set[int] = set()

    def of(self, kind: FaultKind) -> list[Fault]:
        """The trial's faults of one kind."""
        return [fault for fault in self._faults if fault.kind == kind]

    @staticmethod
    def due_ns(fault: Fault, recording_ns: int | None) -> int | None:
        """True time at which `fault` happens; None while its recording has not begun."""
        origin = 0 if fault.since == "trial" else recording_ns
        return None if origin is None else origin + round(fault.at_s * 1e9)

    def arm_stop_due(self, begin_ns: int, end_ns: int, recording_ns: int | None) -> int | None:
        """When, after `begin_ns` and up to `end_ns`, the arm stops; each fault happens once."""
        for index, fault in enumerate(self._faults):
            due = self.due_ns(fault, recording_ns)
            wanted = fault.kind == "arm_protective_stop" and index not in self._happened
            if wanted and due is not None and due <= end_ns:
                self._happened.add(index)
                return max(due, begin_ns)
        return None

    def gaps_ns(self, recording_ns: int | None) -> list[tuple[int, int]]:
        """True times between which the event camera sends nothing."""
        gaps = []
        for fault in self.of("event_gap"):
            due = self.due_ns(fault, recording_ns)
            if due is not None:
                gaps.append((due, due + round(fault.seconds * 1e9)))
        return gaps
