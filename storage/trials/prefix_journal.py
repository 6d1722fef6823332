"""Journal of a trial while it is written: how much of it is on the disk, and its checksums.

A line is added after the rows that it counts were flushed, so what it says is in the files after a
crash or a power cut. `storage.trials.prefix` keeps what still matches the journal. The trial's
description (`BEGUN`) is beside it.
"""

from __future__ import annotations

import json
import os
import queue
import threading
from pathlib import Path

from sliplab.storage.files import sync_file
from sliplab.storage.streams import Json

JOURNAL, BEGUN = "journal.jsonl", "begun.json"
_WAIT_S = 60.0


class PrefixJournal:
    """Appends states to a trial's journal, in a thread that waits for the disk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._states: queue.Queue[Json | None] = queue.Queue(1)
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def add(self, state: Json) -> None:
        """Note a state; it is left out while the disk is busy with the one before.

        Args:
            state: by file, what `StreamFile.mark` returns and the images.

        Raises:
            OSError: the disk refused an earlier one.
        """
        if self._error is not None:
            raise self._error
        if not self._states.full():
            self._states.put(state)

    def close(self) -> None:
        """End the thread, once it has noted what waits; safe to call more than once."""
        if self._thread.is_alive():
            self._states.put(None, timeout=_WAIT_S)
            self._thread.join(_WAIT_S)

    def _run(self) -> None:
        path = self._folder / JOURNAL
        while (state := self._states.get()) is not None:
            if self._error is not None:
                continue  # `close` must not wait for a place
            try:
                for file in sorted(self._folder.iterdir()):
                    if file.suffix in {".h5", ".mkv"}:
                        sync_file(file)
                with path.open("ab") as out:
                    out.write(json.dumps(state).encode() + b"\n")
                    out.flush()
                    os.fsync(out.fileno())
            except OSError as error:
                self._error = error


def read_journal(folder: Path) -> list[Json]:
    """Return the states that were noted, oldest first; a last line that was cut is left out."""
    states = []
    for line in (folder / JOURNAL).read_bytes().splitlines(keepends=True):
        try:
            states.append(json.loads(line))
        except ValueError:
            break
    return states


def drop_journal(folder: Path) -> None:
    """Delete the journal of a trial that is complete."""
    for name in (JOURNAL, BEGUN):
        (folder / name).unlink(missing_ok=True)
