"""Trials in a file or folder of others, by format.

Formats are recognised by how a file begins. Where that says nothing the name's ending does, so that
a damaged file is refused instead of left out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.aedat4 import LINE, read_aedat4
from sliplab.storage.formats.dsec import is_lab_hdf5, read_dsec, read_lab_hdf5
from sliplab.storage.formats.foreign import ForeignTrial, FormatError, read_head
from sliplab.storage.formats.lab_pickles import pairs, read_pair
from sliplab.storage.formats.manifest import as_it_was, read_manifest
from sliplab.storage.formats.prophesee import faery_type, read_by_faery

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
_HDF5 = b"\x89HDF\r\n\x1a\n"
_UNSAFE = re.compile(r"[^A-Za-z0-9=,._+-]+")


def kind_of(path: Path) -> str:
    """The format of a file, or of the files in a folder.

    Raises:
        InputError: none of them is known, or they are of several.
    """
    files = _files(path)
    found = {_kind(file) for file in files} - {None}
    if pairs(files):
        found.add(LAB_PICKLES)
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
        InputError: there is none, or a file is damaged.
    """
    files = _files(path)
    if kind == LAB_PICKLES:
        found = pairs(files)
        if not found:
            raise InputError(path, "", None, "holds no NAME_events_on or NAME_events_off")
        for pair in found:
            yield read_pair(pair, name_of(pair.stem))
        return
    suffixes, reader = READERS[kind]
    told = read_manifest(path) if path.is_dir() else None
    if told is not None:
        for item in told["trials"]:
            file = path / item["file"]
            if file.is_symlink() or not file.is_file():
                raise InputError(file, "", None, "is missing, or no plain file")
            yield as_it_was(_read(reader, file, item["trial"]), item, told["simulated"])
        return
    wanted = [file for file in files if kind in _possible(file)] if path.is_dir() else files
    if not wanted:
        raise InputError(
            path, "", None, f"holds no {kind} file; such files end in {' or '.join(suffixes)}"
        )
    for file in wanted:
        yield _read(reader, file, name_of(_stem(file)))


def _read(reader: Reader, file: Path, name: str) -> ForeignTrial:
    try:
        return reader(file, name)
    except FormatError as error:
        raise InputError(file, "", None, str(error)) from None


def _stem(file: Path) -> str:
    """A file's name without its ending; a name without one may have dots in it."""
    known = {ending for endings, _ in READERS.values() for ending in endings}
    return file.stem if file.suffix.lower() in known else file.name


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


def _possible(file: Path) -> tuple[str, ...]:
    """Formats that a file may have: by how it begins, else by its name's ending."""
    head = read_head(file)
    if head.startswith(LINE):
        return ("aedat4",)
    if head.startswith(_HDF5):
        return ("dsec", "lab-hdf5")
    if form := faery_type(head):
        return ("es",) if form == "es" else ("raw",)
    suffix = file.suffix.lower()
    return tuple(kind for kind, (endings, _) in READERS.items() if suffix in endings)


def _kind(file: Path) -> str | None:
    kinds = _possible(file)
    if "dsec" in kinds:
        try:
            return "lab-hdf5" if is_lab_hdf5(file) else "dsec"
        except FormatError as error:
            raise InputError(file, "", None, str(error)) from None
    return kinds[0] if kinds else None
