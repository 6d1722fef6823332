"""The table of formats: those of the core, and those that plug-ins declare, loaded when used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import PluginError, import_foreign
from sliplab.storage.formats.aedat4 import AEDAT4
from sliplab.storage.formats.dsec import DSEC, LAB_HDF5
from sliplab.storage.formats.format import Files, Format, Layout

CORE = {"aedat4": AEDAT4, "dsec": DSEC, "lab-hdf5": LAB_HDF5}
"""Formats of the core, by name."""


def format_names() -> tuple[str, ...]:
    """Return the names of all formats; none is loaded."""
    return tuple(dict.fromkeys((*CORE, *plugins().declared("formats"))))


def known_format(name: str) -> Format:
    """Return a format by its name.

    Raises:
        InputError: it is the format of a plug-in that cannot be imported.
    """
    if name in CORE:
        return CORE[name]
    try:
        return _load(plugins().declared("formats")[name])
    except PluginError as error:
        raise InputError("KIND", "", name, f"cannot be loaded: {error}") from None


def known_formats() -> Iterator[tuple[str, Format]]:
    """Yield formats with their names, those of the core first.

    Those of plug-ins are loaded on demand. One that cannot be loaded is left out.
    """
    yield from CORE.items()
    for name in format_names():
        if name in CORE:
            continue
        try:
            yield name, known_format(name)
        except InputError:
            continue


def unusable_formats() -> list[str]:
    """Return why formats of plug-ins cannot be loaded, one line each."""
    faults = []
    for name in format_names():
        try:
            known_format(name)
        except InputError as error:
            faults.append(f"{name} {error.expected}")
    return faults


def export_formats() -> list[str]:
    """Return the names of the formats that trials are exported to; all are loaded."""
    return [name for name, each in known_formats() if each.export is not None]


def layouts() -> tuple[Layout, ...]:
    """Return the layouts of folders that plug-ins declare.

    Raises:
        InputError: one of them cannot be imported.
    """
    try:
        return tuple(plugins().hooks("layout"))
    except PluginError as error:
        raise InputError("PLUG-IN", "", "layout", f"cannot be loaded: {error}") from None


def joined(files: Mapping[Path, str | None], kind: str | None, path: Path) -> list[Files]:
    """Return the recordings of several files; arguments as those of `Layout.join`."""
    return [each for layout in layouts() for each in layout.join(files, kind, path)]


@cache
def _load(place: str) -> Format:
    found = import_foreign(place)
    if not isinstance(found, Format):
        raise PluginError(f"{place} is a {type(found).__name__}, not a Format")
    return found
