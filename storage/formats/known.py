"""The table of formats: those of the core, and those that plug-ins declare, loaded when used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import PluginError, import_foreign
from sliplab.storage.errors import StoreError
from sliplab.storage.formats.aedat4 import AEDAT4
from sliplab.storage.formats.dsec import DSEC, LAB_HDF5
from sliplab.storage.formats.foreign import ForeignTrial, FormatError
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
        return _load(plugins().declared("formats")[name], name)
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
        hooks = [each.hooks.get("layout") for each in plugins().found.values()]
        places = [place for place in hooks if place is not None]
        return tuple(_guarded(import_foreign(place), f"layout ({place})") for place in places)
    except PluginError as error:
        raise InputError("PLUG-IN", "", "layout", f"cannot be loaded: {error}") from None


def joined(files: Mapping[Path, str | None], kind: str | None, path: Path) -> list[Files]:
    """Return the recordings of several files; arguments as those of `Layout.join`."""
    return [each for layout in layouts() for each in layout.join(files, kind, path)]


@cache
def _load(place: str, name: str) -> Format:
    found = import_foreign(place)
    if not isinstance(found, Format):
        raise PluginError(f"{place} is a {type(found).__name__}, not a Format")
    guarded: Format = _guarded(found, f"format {name} ({place})")
    return guarded


_PROMISED = (FormatError, InputError, StoreError, ModuleNotFoundError, MemoryError)
_WRITERS = {"export", "publish"}


def _guarded(found: Any, what: str, promised: tuple[type[Exception], ...] = _PROMISED) -> Any:
    """Return another package's object, whose functions raise FormatError for what is no promise.

    Args:
        what: of whom it is, for messages.
    """
    if "(sliplab." in what:
        return found
    if isinstance(found, Format | ForeignTrial | Layout | Files):
        changed = {}
        for each in fields(found):
            more = (ValueError, OSError) if each.name in _WRITERS else ()
            changed[each.name] = _guarded(getattr(found, each.name), what, (*promised, *more))
        return replace(found, **changed)
    if isinstance(found, Iterator):
        return _iterated(found, what, promised)
    if isinstance(found, list):
        return [_guarded(each, what, promised) for each in found]
    if isinstance(found, dict) and any(map(callable, found.values())):
        return {key: _guarded(each, what, promised) for key, each in found.items()}
    if not callable(found) or isinstance(found, type):
        return found

    def call(*arguments: Any) -> Any:
        with _translated(what, promised):
            return _guarded(found(*arguments), what, promised)

    return call


def _iterated(found: Iterator[Any], what: str, promised: tuple[type[Exception], ...]) -> Any:
    while True:
        with _translated(what, promised):
            try:
                each = next(found)
            except StopIteration:
                return
        yield _guarded(each, what, promised)


@contextmanager
def _translated(what: str, promised: tuple[type[Exception], ...]) -> Iterator[None]:
    try:
        yield
    except promised:
        raise
    except Exception as error:  # another package's code: whatever it raises
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise FormatError(f"fails in the code of the {what}: {text}") from error
