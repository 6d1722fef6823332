"""Which trials are in a file or folder of others, by format."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from protocols.errors import InputError
from storage.exchange.by_faery import read_by_faery
from storage.exchange.dsec import is_lab_hdf5, read_dsec, read_lab_hdf5
from storage.exchange.foreign import ForeignTrial, Wrong
from storage.exchange.lab_pickles import pairs, read_pair
from storage.exchange.manifest import as_it_was, read_manifest
from storage.exchange.read_aedat4 import read_aedat4

Reader = Callable[[Path, str], ForeignTrial]
READERS: dict[str, tuple[tuple[str, ...], Reader]] = {
    "aedat4": ((".aedat4",), read_aedat4),
    "dsec": ((".h5", ".hdf5"), read_dsec),
    "lab-hdf5": ((".h5", ".hdf5"), read_lab_hdf5),
    "raw": ((".raw", ".dat"), read_by_faery),
    "es": ((".es",), read_by_faery),
}
LAB_PICKLES = "lab-pickles"
KINDS = (*READERS, LAB_PICKLES)
_PICKLES = (".pickle", ".pkl")
_UNSAFE = re.compile(r"[^A-Za-z0-9=,._+-]+")


def kind_of(path: Path) -> str:
    """The format of a file, or of the files in a folder, by their names.

    Raises:
        InputError: none of them is known, or they are of several.
    """
    files = _files(path)
    found = {_kind(file) for file in files} - {None}
    if len(found) == 1:
        return str(found.pop())
    what = f"holds files of several formats ({', '.join(sorted(map(str, found)))})"
    raise InputError(
        path, "", None,
        f"{what if found else 'holds no file of a known format'}; name one of {', '.join(KINDS)}",
    )  # fmt: skip


def trials_in(path: Path, kind: str) -> Iterator[ForeignTrial]:
    """The trials of a file or folder, in the order of their names.

    Raises:
        InputError: there is none.
        Wrong: a file is damaged.
    """
    files = _files(path)
    if kind == LAB_PICKLES:
        found = pairs(files)
        if not found:
            raise InputError(path, "", None, "holds no NAME_events_on.pickle or ..._off.pickle")
        for pair in found:
            yield read_pair(pair, name_of(pair.stem))
        return
    suffixes, reader = READERS[kind]
    told = read_manifest(path) if path.is_dir() else None
    if told is not None:
        for item in told["trials"]:
            file = path / item["file"]
            if file.is_symlink() or not file.is_file():
                raise Wrong(f"{file}: is missing, or no plain file")
            yield as_it_was(reader(file, item["trial"]), item, told["simulated"])
        return
    wanted = [file for file in files if file.suffix.lower() in suffixes]
    if not wanted:
        raise InputError(path, "", None, f"holds no file that ends in {' or '.join(suffixes)}")
    for file in wanted:
        yield reader(file, name_of(file.stem))


def name_of(stem: str) -> str:
    """A file's name as that of a trial: what cannot stand in one becomes ``_``."""
    plain = re.sub(r"\.{2,}", "_", _UNSAFE.sub("_", stem)).lstrip("=,._+-")[:200]
    return plain or "trial"


def _files(path: Path) -> list[Path]:
    """Plain files; links are left out, for they may lead anywhere."""
    if path.is_dir():
        found = sorted(file for file in path.iterdir() if file.is_file() and not file.is_symlink())
    elif path.is_file():
        found = [path]
    else:
        raise InputError(path, "", None, "no such file or folder")
    return found


def _kind(file: Path) -> str | None:
    suffix = file.suffix.lower()
    if suffix in _PICKLES:
        return LAB_PICKLES if pairs([file]) else None
    if suffix in READERS["dsec"][0]:
        try:
            return "lab-hdf5" if is_lab_hdf5(file) else "dsec"
        except Wrong as error:
            raise InputError(file, "", None, str(error)) from None
    return next((kind for kind, (ends, _) in READERS.items() if suffix in ends), None)
