"""Import of recordings from a folder that another program writes into, as its files close.

A file is closed once its size and times have not changed for a while and no process of this machine
has it open for writing, as far as the system shows that. What is in the campaign already is
skipped, so a watch that ended goes on where it was; a file that cannot be imported is named once,
and tried again when it changes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from sliplab.flows.collecting.requests import store_lock
from sliplab.flows.running import console, stopping
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural
from sliplab.storage.files import safe_name
from sliplab.storage.formats.format import Files
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import MIXED, recordings_in, skipped_in, trials_of
from sliplab.storage.streams import Json
from sliplab.storage.trials.lock import Locked
from sliplab.storage.trials.store import TrialStore

SETTLED_S = 5.0
"""Time without a change after which a file may be closed; recorders flush about once a second."""
POLL_S = 1.0
_WRITES = os.O_WRONLY | os.O_RDWR

State = tuple[tuple[str, int, int, int], ...]
"""Name, inode, size and time of change of each file of a recording."""


@dataclass
class FolderWatch:
    """A watch of one folder; the arguments are those of `import_data`.

    Attributes:
        settled_s: see `SETTLED_S`.
        clock: monotonic time, s.
    """

    path: Path
    store: Path
    name: str
    kind: str = MIXED
    simulated: bool = False
    salvage: bool = False
    settled_s: float = SETTLED_S
    clock: Callable[[], float] = time.monotonic
    imported: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    _seen: dict[Path, tuple[State, float]] = field(default_factory=dict)
    _done: dict[Path, State] = field(default_factory=dict)
    _busy: bool = False

    def run(self) -> Json:
        """Watch until the user stops it.

        Returns:
            ids in ``imported``, and in ``failed`` the files that could not be imported.
        """
        console.say(f"watching {self.path}; Ctrl-C ends")
        with suppress(KeyboardInterrupt):
            while True:
                self.look()
                stopping.wait(POLL_S)
        failed = [{"file": file, "reason": text} for file, text in self.failed.items()]
        result: Json = {"campaign": self.name, "imported": self.imported}
        return result | ({"failed": failed} if failed else {})

    def look(self) -> None:
        """Import the recordings whose files are closed by now."""
        closed = {path: state for path, state in self._states() if self._is_closed(path, state)}
        if all(self._done.get(path) == state for path, state in closed.items()):
            return
        found = recordings_in(self.path, self.kind)
        names: dict[str, list[tuple[str, Files]]] = {}
        for name, files in found:
            names.setdefault(name, []).append((name, files))
        for group in names.values():  # several files of one name are an error
            paths = [file for _, each in group for file in each.files]
            every = all(file in closed for file in paths)
            fresh = any(self._done.get(file) != closed.get(file) for file in paths)
            if every and fresh:
                if not self._import(group):
                    return
                self._done |= {file: closed[file] for file in paths}
        for skipped in skipped_in(self.path, self.kind) if found else []:
            file = self.path / skipped.file
            if file in closed and self._done.get(file) != closed[file]:
                console.say(f"skipped: {skipped.file}: {skipped.reason}")
                self._done[file] = closed[file]

    def _import(self, ready: list[tuple[str, Files]]) -> bool:
        """Import recordings; False where another program has the store."""
        trials = trials_of(self.path, ready, salvage=self.salvage)
        if self.simulated:
            trials = (replace(trial, simulated=True) for trial in trials)
        store = TrialStore.create(self.store)
        try:
            with store_lock(store):
                result = import_trials(
                    store, self.name, trials, self.path, self.kind, salvage=self.salvage
                )
        except Locked as error:
            if not self._busy:
                console.say(f"waiting: {error}")
            self._busy = True
            return False
        except InputError as error:
            source = ", ".join(str(files) for _, files in ready)
            result = {"imported": [], "failed": [{"file": source, "reason": error.message}]}
        self._busy = False
        for _, files in ready:
            self.failed.pop(str(files), None)
        self.imported += result["imported"]
        for text in result.get("warnings", ()):
            console.say(f"warning: {text}")
        for name in result["imported"]:
            console.say(f"imported: {name}")
        for item in result.get("failed", ()):
            self.failed[item["file"]] = item["reason"]
            console.say(f"not imported: {item['file']}: {item['reason']}")
        return True

    def _states(self) -> Iterator[tuple[Path, State]]:
        for entry in sorted(self.path.iterdir()):
            with suppress(FileNotFoundError):  # moved away meanwhile
                if not entry.is_symlink():
                    yield entry, _state(entry)

    def _is_closed(self, path: Path, state: State) -> bool:
        before = self._seen.get(path)
        if before is None or before[0] != state:
            self._seen[path] = (state, self.clock())
            return False
        if self._done.get(path) == state:
            return True
        if self.clock() - before[1] < self.settled_s:
            return False
        try:
            return not is_written(path)
        except FileNotFoundError:  # moved away meanwhile
            return False


def _state(path: Path) -> State:
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
    return tuple(
        (file.name, about.st_ino, about.st_size, about.st_mtime_ns)
        for file in files
        for about in [file.stat()]
    )


def is_written(path: Path) -> bool:
    """Return True if a process has a file, or one of a folder, open for writing.

    Only Linux shows that, of the user's own processes and of this machine: files on a share that
    another machine writes are closed once they have settled.
    """
    files = path.rglob("*") if path.is_dir() else [path]
    wanted = {(about.st_dev, about.st_ino) for about in map(os.stat, files)}
    for folder in Path("/proc").glob("[0-9]*/fd"):
        with suppress(OSError):  # ended, or another user's
            for link in folder.iterdir():
                with suppress(OSError):
                    about = link.stat()
                    if (about.st_dev, about.st_ino) in wanted and _writes(folder.parent, link.name):
                        return True
    return False


def _writes(process: Path, number: str) -> bool:
    text = (process / "fdinfo" / number).read_text(encoding="ascii")
    flags = next(line for line in text.splitlines() if line.startswith("flags:"))
    return bool(int(flags.split()[1], 8) & _WRITES)


def watch(
    path: Path,
    store: Path,
    name: str | None,
    kind: str | None,
    *,
    simulated: bool = False,
    salvage: bool = False,
) -> Json:
    """Watch a folder until the user stops it; see `FolderWatch`.

    Raises:
        InputError: it is no folder, or one data set that is imported as a whole.
    """
    if not path.is_dir():
        raise InputError("--watch", "", str(path), "must be a folder")
    if name is None:
        raise InputError("--name", "", None, "is missing: the name of the campaign")
    if store.resolve().is_relative_to(path.resolve()):
        right = f"lies in {path}, where its own files would be imported; name another folder"
        raise InputError("--store", "", str(store), right)
    safe_name(name)
    recordings_in(path, kind or MIXED)
    watched = FolderWatch(path, store, name, kind or MIXED, simulated, salvage)
    result = watched.run()
    console.say(f"imported {plural(len(watched.imported), 'trial')}")
    return result
