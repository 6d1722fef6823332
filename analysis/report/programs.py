"""Results of other commands in the report, if they exist in the store.

They take minutes to hours, so the report never computes them: it shows existing results, and names
the command for missing ones. It does not check whether they are up to date.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.schema.document import Document
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import TrialStore

DocumentT = TypeVar("DocumentT", bound=Document)


@dataclass(frozen=True)
class CommandResult:
    """Result file that another command writes into a store.

    Attributes:
        file: in the store.
        text: the command; ``{store}``, ``{folder}`` and ``{file}`` are replaced by paths.
    """

    file: str
    text: str

    def read(self, store: TrialStore) -> Json | None:
        """Read the results; None where there are none.

        Raises:
            StoreError: the file is there and cannot be read.
        """
        path = store.folder / self.file
        try:
            return read_json(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise StoreError(f"{error}; delete {path}, or make it again") from None

    def key(self, store: TrialStore, campaigns: object) -> list[Json]:
        """Return the results for a report's key; empty where there are none. Raises StoreError."""
        found = self.read(store)
        return [] if found is None else [found]

    def command(self, store: TrialStore) -> str:
        """Return the command for a store."""
        path = store.folder.resolve() / self.file
        return self.text.format(store=store.folder.resolve(), folder=path.parent, file=path)

    @contextmanager
    def shape_checked(self) -> Iterator[None]:
        """Name the file where its numbers are not of the shape that the block reads.

        Raises:
            StoreError: instead of what the block raised.
        """
        try:
            yield
        except (KeyError, TypeError, AttributeError, IndexError, ValueError) as error:
            raise StoreError(
                f"{self.file}: is not of the shape that this version reads ({error!r}); delete "
                "it, or make it again"
            ) from None

    def parse(self, kind: type[DocumentT], found: Json) -> DocumentT:
        """Return the results as a document.

        Raises:
            StoreError: they are of another shape.
        """
        with self.shape_checked():
            return kind.parse(found, Path(self.file))


HOLDOUT = CommandResult("holdout/results.json", "sliplab holdout {store}")
STRESS = CommandResult("stress/stress.json", "sliplab stress {store}")
RESULTS = {"holdout": HOLDOUT, "stress": STRESS}
"""Results that the summary has figures of."""


def read_programs(store: TrialStore) -> dict[str, Json]:
    """Read the `RESULTS` that there are, by name.

    Raises:
        StoreError: a file is there and cannot be read.
    """
    found = {name: result.read(store) for name, result in RESULTS.items()}
    return {name: result for name, result in found.items() if result is not None}
