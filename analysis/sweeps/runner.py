"""Runner of all sweeps: points in order, each measured once and stored at once; resumable.

A point is a setting with the name that its result is stored under and the key of all that the
result depends on. Points without a stored result are pending, so a sweep may be stopped anywhere,
continued, and made larger later.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy.typing as npt

from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.hashing import hash_integer
from sliplab.storage.files import make_folder, read_json, write_json
from sliplab.storage.schema.document import Document, Part
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import load_document

Arrays = dict[str, npt.NDArray[Any]]
Progress = Callable[[float, str], None]
"""Called with how much more is done, in the units of `Sweep.expected`, and a note."""
Advance = Callable[[str, float, str], None]
"""Called with the part of a point, the share of that part that was done since, and a note."""


class Point(Protocol):
    """One setting of a sweep."""

    @property
    def name(self) -> str:
        """The name of the result, unique in the sweep."""

    @property
    def key(self) -> str:
        """The hash of all that the result depends on."""

    @property
    def title(self) -> str:
        """The setting as text."""


class Results(Protocol):
    """A place for results, such as `sliplab.storage.trials.derived.Derived`."""

    def fresh(self, name: str, key: str) -> bool:
        """Return whether the result `name` was made with `key`."""

    def write(self, name: str, key: str, data: Json | Part, arrays: Arrays | None = None) -> None:
        """Keep a result."""


DocumentT = TypeVar("DocumentT", bound=Document)


@dataclass(frozen=True)
class ResultFile(Generic[DocumentT]):
    """The results of a whole sweep in one document, by name, each with its key.

    Attributes:
        kind: of the document.
        field: key of the document that holds the results.
        head: other entries of the document.
    """

    path: Path
    kind: type[DocumentT]
    field: str
    head: Json

    def load(self) -> DocumentT:
        """Read the document.

        Raises:
            FileNotFoundError: nothing was stored yet.
            StoreError: it is damaged, or was written by a newer version.
        """
        return load_document(self.path, self.kind)

    def fresh(self, name: str, key: str) -> bool:
        """Return whether the result `name` was made with `key`."""
        return self._kept().get(name, {}).get("key") == key

    def write(self, name: str, key: str, data: Json | Part, arrays: Arrays | None = None) -> None:
        """Store a result with the others; it has no arrays."""
        make_folder(self.path.parent)
        plain = data.to_json() if isinstance(data, Part) else data
        found = {**self._kept(), name: {"key": key, **plain}}
        write_json(self.path, {**self.head, self.field: found})

    def _kept(self) -> dict[str, Json]:
        """Return the results by name, unchecked: stale ones may have another version's shape."""
        try:
            found: dict[str, Json] = read_json(self.path)[self.field]
        except FileNotFoundError:
            return {}
        return found


P = TypeVar("P", bound=Point)


@dataclass(frozen=True)
class Sweep(Generic[P]):
    """Points, the measurement of one, and the place of the results.

    Attributes:
        measure: returns the result of a point and its arrays; calls back as parts of it are done.
        estimate: returns what a point is expected to take, by part: seconds, say. Without it each
            point counts as one.
    """

    points: Sequence[P]
    results: Results
    measure: Callable[[P, Advance], tuple[Json | Part, Arrays | None]]
    estimate: Callable[[P], Mapping[str, float]] = lambda point: {"": 1.0}

    def done(self, point: P) -> bool:
        """Return whether a point's result is stored."""
        return self.results.fresh(point.name, point.key)

    @property
    def pending(self) -> list[P]:
        """The points whose results are not stored, in order."""
        return [point for point in self.points if not self.done(point)]

    def expected(self, advance: Callable[[], None] = lambda: None) -> dict[str, dict[str, float]]:
        """Return what each pending point is expected to take, by name and part.

        Args:
            advance: called after each point.
        """
        found = {}
        for point in self.pending:
            found[point.name] = dict(self.estimate(point))
            advance()
        return found

    def run(
        self,
        progress: Progress = lambda amount, note: None,
        expected: Mapping[str, Mapping[str, float]] | None = None,
        *,
        over: Callable[[], bool] = lambda: False,
        begin: Callable[[int, int, P], None] = lambda number, count, point: None,
    ) -> int:
        """Measure the pending points, store each when it is done, and return their number.

        Args:
            expected: what `expected` returned.
            over: asked before each point; no other is started once it returns True.
            begin: called before each point with its number, from 1, and how many there are.
        """
        pending = self.pending
        expected = self.expected() if expected is None else expected
        for number, point in enumerate(pending):
            if over():
                return number
            begin(number + 1, len(pending), point)
            self.make(point, progress, expected[point.name])
        return len(pending)

    def make(
        self,
        point: P,
        progress: Progress = lambda amount, note: None,
        expected: Mapping[str, float] | None = None,
    ) -> None:
        """Measure one point and keep the result."""
        whole = {} if expected is None else expected
        left = dict(whole)

        def advance(part: str, share: float, note: str) -> None:
            step = min(left.get(part, 0.0), share * whole.get(part, 0.0))
            left[part] = left.get(part, 0.0) - step
            progress(step, note)

        data, arrays = self.measure(point, advance)
        self.results.write(point.name, point.key, data, arrays)
        progress(sum(left.values()), point.title)


@dataclass(frozen=True)
class SweepTask:
    """A point that measures itself."""

    name: str
    key: str
    work: Callable[[], Part]

    @property
    def title(self) -> str:
        """The name."""
        return self.name


def task_sweep(tasks: Sequence[SweepTask], results: Results) -> Sweep[SweepTask]:
    """Return the sweep of tasks, each of which counts as one."""
    return Sweep(tasks, results, lambda task, advance: (task.work(), None))


def sample_trials(plan: Plan, count: int) -> list[PlannedTrial]:
    """Return `count` measured trials that use each level as evenly as can be.

    Ties are decided by hashes of the protocol's seed and the trials' ids. All trials if there
    are not more.
    """
    seed = plan.protocol.collection.seed
    left = [trial for trial in plan if trial.role == "measured"]
    left.sort(key=lambda trial: hash_integer(seed, "trade-off", trial.id))
    chosen: list[PlannedTrial] = []
    while left and len(chosen) < count:
        used = [level for trial in chosen for level in trial.condition]
        best = min(left, key=lambda trial: sum(used.count(level) for level in trial.condition))
        chosen.append(best)
        left.remove(best)
    return chosen
