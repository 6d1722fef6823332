"""The lab's recordings in their folders: two pickles or an HDF5 file each, and further files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from sliplab.plugins.formats.lab.events import Pair, is_stream, pairs, read_pair, unnamed
from sliplab.plugins.formats.lab.run import (
    EVENTS_FOLDER,
    check_polarity,
    compare,
    described,
    is_of_run,
    run_folder,
    with_run,
)
from sliplab.protocols.errors import InputError
from sliplab.storage.formats.foreign import ForeignTrial, FormatError
from sliplab.storage.formats.format import Files, Format, Layout
from sliplab.storage.formats.recognition import read_file

LAB_PICKLES, LAB_HDF5, DSEC = "lab-pickles", "lab-hdf5", "dsec"


def _events_folder(path: Path) -> Path | None:
    run = run_folder(path)
    return None if run is None else run / EVENTS_FOLDER


def _join(files: Mapping[Path, str | None], kind: str | None, path: Path) -> list[Files]:
    if kind is None:
        found = pairs(
            file
            for file, known in files.items()
            if known is None or (known in {LAB_HDF5, DSEC} and is_stream(file))
        )
        if not found and not any(files.values()):
            found = unnamed(files)
    elif kind == LAB_PICKLES:
        found = pairs(file for file in files if not is_stream(file)) or unnamed(files)
        if not found:
            raise InputError(path, "", None, "holds no NAME_events_on or NAME_events_off")
    elif kind == LAB_HDF5:
        found = [pair for pair in pairs(files) if pair.stream is not None]
    else:
        found = []
    return [
        Files(
            pair.stem,
            LAB_PICKLES if pair.stream is None else LAB_HDF5,
            pair.files,
            partial(_read, pair),
        )
        for pair in found
    ]


def _read(pair: Pair, name: str, salvage: bool) -> ForeignTrial:
    """Return a recording of its stream, or else of its pickles."""
    note = ""
    if pair.stream is not None:
        try:
            found = read_file(LAB_HDF5, pair.stream, name, salvage)
            return described(compare(found, pair), pair.stem)
        except FormatError as error:
            if pair.on is None and pair.off is None:
                raise FormatError(str(error), pair.stream) from None
            note = f"{pair.stream.name} is not imported: {error}"
    found = replace(read_pair(pair, name), kind=LAB_PICKLES)
    return replace(found, notes=lambda: (*((note,) if note else ()), *found.notes()))


def _complete(trial: ForeignTrial, files: Files, path: Path) -> ForeignTrial:
    """Add a recording's files in the folder of a run, and check the polarity in its name."""
    if files.kind != LAB_PICKLES and len(files.files) == 1:
        trial = check_polarity(trial, files.stem)
    return with_run(trial, files.stem, run_folder(path))


PICKLES = Format()  # joined by the layout
LAYOUT = Layout(folder=_events_folder, owns=is_of_run, join=_join, complete=_complete)
