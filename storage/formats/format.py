"""Formats of recordings: what one is, and how a lab lays out its files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from sliplab.storage.formats.foreign import ForeignTrial
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore

Reader = Callable[[Path, str], ForeignTrial]
"""Reads a file as a trial of the given name.

It raises FormatError for a file that is damaged, or of another format.
"""


def _never(path: Path, head: bytes) -> bool:
    return False


@dataclass(frozen=True)
class Format:
    """A format; a function that it lacks is None. A layout may join its files to recordings.

    Attributes:
        suffixes: endings of its files, in lower case and with the dot. They decide where no format
            recognises a file's content.
        sniff: recognises a file by its first bytes, or with none a folder that is one recording or
            one data set.
        read: reads one file, or a folder that is one recording. salvage: reads the intact part
            before the damage in a damaged one.
        read_all: reads the trials of a folder that is one data set.
        check: raises InputError or ModuleNotFoundError where a file's library is not installed.
        export: writes the events of one stream of a trial, and what else the format holds, to a
            new file; returns the numbers of `events`, `frames` and `triggers`. It raises
            ValueError where the trial does not fit the format.
        publish: writes a trial to a new file with all that belongs to it, such that `read` returns
            it as it was; the last argument are keys of its provenance that are left out. It raises
            FormatError where the trial does not fit the format.
        card: Markdown about the published files, for the data card.
    """

    suffixes: tuple[str, ...] = ()
    sniff: Callable[[Path, bytes], bool] = _never
    read: Reader | None = None
    salvage: Reader | None = None
    read_all: Callable[[Path], Iterator[ForeignTrial]] | None = None
    check: Callable[[Path], None] | None = None
    export: Callable[[Recording, Path, str], dict[str, int]] | None = None
    publish: Callable[[Path, TrialStore, Campaign, Recording, Iterable[str]], object] | None = None
    card: str = ""


@dataclass(frozen=True)
class Files:
    """The files of one recording.

    Attributes:
        stem: what the trial is named after.
        kind: name of their format.
        read: reads them as a trial of the given name; if the second argument is true, reads the
            intact part of a damaged file. Raises FormatError or InputError.
    """

    stem: str
    kind: str
    files: tuple[Path, ...]
    read: Callable[[str, bool], ForeignTrial]

    def __str__(self) -> str:
        return " and ".join(sorted(file.name for file in self.files))


@dataclass(frozen=True)
class Layout:
    """Layout of the files and folders of recordings; plug-ins declare it as a hook.

    Attributes:
        folder: returns the folder of the recordings' files in a path; None for any other layout. It
            raises InputError where it cannot decide.
        owns: returns True if an entry of such a path belongs to the recordings.
        join: returns recordings of several files, among files with their formats (None: unknown).
            Its second argument is the format that the user named, its third the path for messages.
        complete: adds the files next to a recording in the path that is imported.
    """

    folder: Callable[[Path], Path | None] = lambda path: None
    owns: Callable[[Path], bool] = lambda entry: False
    join: Callable[[Mapping[Path, str | None], str | None, Path], list[Files]] = (
        lambda files, kind, path: []
    )
    complete: Callable[[ForeignTrial, Files, Path], ForeignTrial] = lambda trial, files, path: trial
