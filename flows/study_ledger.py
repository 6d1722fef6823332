"""Ledger of a study: state and cost of each step, and the time left; `study.json` in its store.

A study runs for half an hour or for weeks, is stopped and continued, and is watched from another
terminal. So the seconds of a step are added up over all its runs and written as it ends, well or
not. The time left is what the other steps are expected to take, times the pace of the steps that
are over.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from sliplab.flows.running import console
from sliplab.storage.files import read_json, write_json

FILE = "study.json"
TO_DO, RUNNING, STOPPED, DONE = "to do", "running", "stopped", "done"
LEFT_OUT = "left out"
LEAST, MOST = 0.2, 5.0
"""Limits of the pace: the seconds of the steps that are over, by the expected ones."""
BELIEF_S = 60.0
"""Weight of the estimate, as work already done at its pace: the first step also compiles the
kernels, once in an installation, and predicts little about the others if it is short."""


@dataclass(frozen=True)
class StudyStep:
    """One step of a study.

    Attributes:
        state: `TO_DO`, `RUNNING`, `STOPPED` (in the middle, to be continued), `DONE` or
            `LEFT_OUT` (the note says why).
        seconds: taken so far, over all runs.
        expected_s: expected from nothing.
        note: its result in a few words.
    """

    name: str
    state: str
    seconds: float
    expected_s: float
    note: str


class Ledger:
    """The steps of one study.

    Args:
        folder: the study's store.
        expected: seconds that each step is expected to take from nothing, in their order.
        clock: seconds of a clock that only goes forwards.
    """

    def __init__(
        self,
        folder: Path,
        expected: Mapping[str, float],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._path, self._clock = folder / FILE, clock
        before = {row.name: row for row in read(folder)}
        self._rows = {
            name: StudyStep(
                name, TO_DO, before[name].seconds if name in before else 0.0, seconds, ""
            )
            for name, seconds in expected.items()
        }
        self._known = {name for name, row in before.items() if row.state == DONE}

    def rows(self) -> list[StudyStep]:
        """Return all steps in their order."""
        return list(self._rows.values())

    @contextmanager
    def step(self, name: str, unit: str) -> Iterator[Callable[[int], None]]:
        """Time a step; yield a callback that takes how much it did.

        Args:
            unit: noun in plural that its work is counted in, and what follows it.
        """
        before, began = self._rows[name], self._clock()
        self._put(before, state=RUNNING)
        place = list(self._rows).index(name) + 1
        counted: list[int] = []
        console.say(f"[{place}/{len(self._rows)}] {name}{self._times()}")
        state = STOPPED
        try:
            yield counted.append
            state = DONE
        finally:
            note = _in_words(counted[-1], unit) if counted else ""
            spent = 0.0 if counted and not counted[-1] else self._clock() - began
            self._put(before, state=state, seconds=before.seconds + spent, note=note)

    def leave_out(self, name: str, reason: str) -> None:
        """Mark a step as one that cannot be done, with its reason."""
        place = list(self._rows).index(name) + 1
        console.say(f"[{place}/{len(self._rows)}] {name}: left out: {reason}")
        self._put(self._rows[name], state=LEFT_OUT, note=reason)

    def left_s(self) -> float:
        """Return the seconds that the steps to do and to continue are likely to take."""
        over = [r for r in self._rows.values() if r.state == DONE and r.seconds > 0]
        expected = sum(row.expected_s for row in over)
        pace = (sum(row.seconds for row in over) + BELIEF_S) / (expected + BELIEF_S)
        pace = min(max(pace, LEAST), MOST)
        return sum(
            max(row.expected_s * pace - row.seconds, 0.0)
            for row in self._rows.values()
            if row.state not in {DONE, LEFT_OUT} and row.name not in self._known
        )

    def _times(self) -> str:
        spent = sum(row.seconds for row in self._rows.values())
        left = self.left_s()
        reports = f": about {console.duration(left)} left" if left else ""
        return reports + (f", {console.duration(spent)} so far" if spent else "")

    def _put(
        self, row: StudyStep, *, state: str, seconds: float | None = None, note: str = ""
    ) -> None:
        spent = row.seconds if seconds is None else seconds
        self._rows[row.name] = StudyStep(row.name, state, spent, row.expected_s, note)
        write_json(self._path, {"steps": [vars(each) for each in self._rows.values()]})


def _in_words(done: int, unit: str) -> str:
    if not done:
        return "nothing to do"
    noun, space, rest = unit.partition(" ")
    if done == 1:
        noun = noun.removesuffix("es" if noun.endswith("ches") else "s")
    return f"{done} {noun}{space}{rest}"


def read(folder: Path) -> list[StudyStep]:
    """Return the steps of a study as last written; none if there is no study."""
    path = folder / FILE
    if not path.exists():
        return []
    return [StudyStep(**row) for row in read_json(path)["steps"]]


def print_rows(rows: list[StudyStep]) -> None:
    """Print state, cost and result of each step as a table."""
    total = sum(row.seconds for row in rows)
    shown: list[list[str]] = [
        [
            row.name,
            row.state,
            console.duration(row.seconds) if row.seconds else "-",
            f"{100 * row.seconds / total:.0f} %" if total else "-",
            row.note,
        ]
        for row in rows
    ]
    shown.append(["all", "", console.duration(total), "", ""])
    console.print_table("Study", ["step", "state", "took", "share", "what it did"], shown)
