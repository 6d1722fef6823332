"""Recognition of foreign recordings: which files are trials, of which format, under which names.

Formats are recognised by a file's first bytes, and otherwise by its extension, so that
a damaged file is rejected instead of skipped.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np
from slugify import slugify

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, safe_name
from sliplab.storage.formats.by_time import by_time
from sliplab.storage.formats.foreign import (
    EXPORT_FORMAT,
    EXPORT_MANIFEST,
    EXPORT_UNFINISHED,
    Damage,
    ForeignTrial,
    FormatError,
    Skipped,
    broken,
    inside,
    read_head,
    refusal,
)
from sliplab.storage.formats.format import Files, Format
from sliplab.storage.formats.known import (
    CORE,
    format_names,
    joined,
    known_format,
    known_formats,
    layouts,
    unusable_formats,
)
from sliplab.storage.formats.time_order import in_order
from sliplab.storage.formats.unread import unread
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import REGISTRATIONS

MIXED = "mixed"
"""Files of several formats in one folder."""
_UNSAFE = re.compile(r"[^A-Za-z0-9=,._+-]+")
_RESERVED = re.compile(r"(?i:con|prn|aux|nul|com\d|lpt\d)(?:\..*)?")
"""Names that no file has on Windows."""
_LONGEST_NAME, _HASH = 200, 8
Wanted = tuple[str, Files]
"""Name of a trial, and its files."""


def kind_of(path: Path) -> str:
    """Return the format of a file, or of the files in a folder; `MIXED` for several.

    Raises:
        InputError: none of them is known, or one is damaged.
    """
    if (whole := _data_set(path)) is not None:
        return whole
    found = _sort(path)
    if not found:
        stated = [(file, what) for file in _files(path) if (what := unread(file)) is not None]
        if stated:
            raise InputError(stated[0][0], "", None, stated[0][1])
        text = f"contains no known file format; name one of {', '.join(format_names())}"
        raise InputError(path, "", None, "; ".join([text, *unusable_formats()]))
    kinds = {files.kind for _, files in found}
    return kinds.pop() if len(kinds) == 1 else MIXED


def _data_set(path: Path) -> str | None:
    """Return the format of a folder that is one data set; None for any other path."""
    if not path.is_dir():
        return None
    sets = ((name, each) for name, each in known_formats() if each.read_all is not None)
    return next((name for name, each in sets if _sniffed(each, path, b"")), None)


def trials_in(path: Path, kind: str, *, salvage: bool = False) -> Iterator[ForeignTrial]:
    """Yield the trials of a file or folder, in the order of their names.

    Args:
        kind: the format, or `MIXED`: that of each file.
        salvage: yield the intact part of a file that is damaged already where it begins to be
            read.

    Raises:
        InputError: it does not exist, a file is damaged, or faery is missing.
        ModuleNotFoundError: the extra `publish` is missing, for MCAP files.
    """
    how = None if kind == MIXED else known_format(kind)
    if how is not None and how.read_all is not None:
        if not path.is_dir():
            raise InputError(path, "", None, f"is no folder; {kind} is a folder of files")
        yield from how.read_all(path)
        return
    manifest = _manifest_of(path, kind)
    if manifest is not None:
        for item in manifest["trials"]:
            file, fault = path / item["file"], None
            of = kind
            if file.is_symlink() or not file.is_file():
                fault = "is missing or not a regular file"
            elif kind == MIXED and not (of := _kind(file) or ""):
                readers = [name for name, each in known_formats() if each.read is not None]
                fault = f"is of no known format ({', '.join(readers)})"
            if fault is not None:
                yield broken(item["trial"], item["file"], InputError(file, "", None, fault))
                continue
            found = _opened(_single(file, of), item["trial"], salvage)
            yield _as_exported(found, item, manifest["simulated"])
        return
    wanted = _sort(path) if kind == MIXED else _of_kind(path, kind)
    yield from trials_of(path, wanted, salvage=salvage)


def recordings_in(path: Path, kind: str) -> list[Wanted]:
    """Return the recordings in a folder by name, or none.

    Raises:
        InputError: the folder is one data set.
    """
    if _data_set(path) is not None or _is_recording(path):
        raise InputError(path, "", None, "is one recording or data set; give the folder around it")
    return [item for item in _sort(path) if kind in (MIXED, item[1].kind)]


def trials_of(path: Path, wanted: Sequence[Wanted], *, salvage: bool) -> Iterator[ForeignTrial]:
    """Yield the trials of recordings in a file or folder; arguments as in `trials_in`."""
    laid_out = layouts()
    for _, each in wanted:
        if (check := known_format(each.kind).check) is not None:
            with suppress(FormatError):  # reading it will say so
                check(each.files[0])
    alike: dict[str, list[str]] = {}
    for name, each in wanted:
        alike.setdefault(name, []).append(str(each))
    yield from (_several(path, name, alike[name]) for name in alike if len(alike[name]) > 1)
    for name, each in wanted:
        if len(alike[name]) == 1:
            found = _opened(each, name, salvage)
            try:
                for layout in laid_out:
                    found = layout.complete(found, each, path)
            except FormatError as error:
                found = broken(name, str(each), refusal(each.files[0], error))
            yield found


def skipped_in(path: Path, kind: str) -> list[Skipped]:
    """Return what `trials_in` leaves out of a folder, by name.

    Raises:
        InputError: as `trials_in`.
    """
    if not path.is_dir() or _is_recording(path):
        return []
    if kind != MIXED and known_format(kind).read_all is not None:
        return []
    manifest = _manifest_of(path, kind)
    taken: set[str | None] = {EXPORT_MANIFEST}
    if manifest is not None:
        taken.add(REGISTRATIONS)
        taken |= {item["file"] for item in manifest["trials"]}
        other = f"is not in {EXPORT_MANIFEST}"
    else:
        for _, files in _sort(path) if kind == MIXED else _of_kind(path, kind):
            taken |= {file.name for file in files.files}
        known = ", ".join(format_names())
        other = f"is of no known format ({known})" if kind == MIXED else f"is no {kind} file"
    entries = sorted(path.iterdir())
    if (folder := _folder(path)) != path:
        laid_out = layouts()
        entries = [entry for entry in entries if not any(one.owns(entry) for one in laid_out)]
        entries += sorted(folder.iterdir())
    return [
        Skipped(entry.relative_to(path).as_posix(), _reason(entry, other))
        for entry in entries
        if entry.name not in taken
    ]


def _reason(entry: Path, other: str) -> str:
    if entry.is_symlink():
        return "is a link"
    if entry.is_dir():
        return "is a folder; import it by itself"
    if not entry.is_file():
        return "is no regular file"
    return unread(entry) or other


def _sort(path: Path) -> list[Wanted]:
    """Return what is known in a file or folder, each with its own format, by name."""
    kinds = {file: _kind(file) for file in _files(path)}
    several = joined(kinds, None, path)
    taken = {file for each in several for file in each.files}
    found = [
        _single(file, kind)
        for file, kind in kinds.items()
        if kind is not None and file not in taken
    ]
    return sorted(_named([*found, *several]), key=lambda item: item[0])


def _single(file: Path, kind: str) -> Files:
    return Files(_stem(file), kind, (file,), partial(read_file, kind, file))


def _named(found: list[Files]) -> list[Wanted]:
    """Return recordings with the names of their trials."""
    return list(zip(unique_names([files.stem for files in found]), found, strict=True))


def _of_kind(path: Path, kind: str) -> list[Wanted]:
    """Return what a file or folder holds of one format.

    Raises:
        InputError: that is nothing.
    """
    how, files = known_format(kind), _files(path)
    wanted: list[Path] = []
    if how.read is not None:
        wanted = [file for file in files if kind in _possible(file)] if path.is_dir() else files
    several = joined(dict.fromkeys(files), kind, path)
    if not (wanted or several):
        endings = " or ".join(how.suffixes)
        raise InputError(path, "", None, f"holds no {kind} file; such files end in {endings}")
    taken = {file for each in several for file in each.files}
    return _named([*(_single(file, kind) for file in wanted if file not in taken), *several])


def _several(path: Path, name: str, files: Sequence[str]) -> ForeignTrial:
    """Return a trial that several files are named after, of which none is imported.

    They are mostly one recording in two formats, which must not count twice.
    """
    error = InputError(
        path,
        "",
        None,
        f"holds {len(files)} files for the trial {name}: {', '.join(files)}; keep one of them, "
        "rename the others, or import one format alone: sliplab import KIND PATH",
    )
    return broken(name, ", ".join(files), error)


def name_of(stem: str) -> str:
    """Make the name of a trial from a file's name.

    Letters that are not Latin are transliterated, other characters become ``_``. Where that, or the
    length, makes names ambiguous, the beginning of a hash of the file's name follows. Forms
    of one text (Unicode's NFC and NFD) have one name.
    """
    text = unicodedata.normalize("NFC", stem)
    plain = text
    if not text.isascii():
        plain = slugify(
            text,
            entities=False,
            decimal=False,
            hexadecimal=False,
            lowercase=False,
            separator="_",
            regex_pattern=_UNSAFE.pattern,
        )
    plain = re.sub(r"\.{2,}", "_", _UNSAFE.sub("_", plain)).lstrip("=,._+-").rstrip(".")
    if _RESERVED.fullmatch(plain):
        plain = f"trial_{plain}"
    if text.isascii() and 0 < len(plain) <= _LONGEST_NAME:
        return plain
    return _with_hash(plain or "trial", text)


def _with_hash(name: str, text: str) -> str:
    digest = sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
    return f"{name[: _LONGEST_NAME - _HASH - 1]}-{digest[:_HASH]}"


def unique_names(stems: Sequence[str]) -> list[str]:
    """Return the names of trials from those of their files, also unique where case is ignored.

    Of names that would be alike, those that had to be changed, or have capitals, end in a hash. The
    same name twice stays so.
    """
    names = [name_of(stem) for stem in stems]
    alike: dict[str, set[str]] = {}
    for stem, name in zip(stems, names, strict=True):
        alike.setdefault(name.casefold(), set()).add(stem)
    return [
        _with_hash(name, stem)
        if len(alike[name.casefold()]) > 1 and not (name == stem == name.casefold())
        else name
        for stem, name in zip(stems, names, strict=True)
    ]


def read_file(kind: str, file: Path, name: str, salvage: bool) -> ForeignTrial:
    """Return the trial in a file, or its intact part.

    Raises:
        FormatError: it is damaged, or of another format.
    """
    if (what := unread(file)) is not None:
        raise FormatError(what)
    how = known_format(kind)
    if how.read is None:
        raise FormatError(f"is not a file of {kind}")
    again = None if how.salvage is None else partial(how.salvage, file, name)
    try:
        return replace(how.read(file, name), kind=kind, salvage=again)
    except Damage as error:
        if again is None:
            raise
        return replace(before_damage(again, error, salvage), kind=kind)


def before_damage(
    read: Callable[[], ForeignTrial], error: FormatError, salvage: bool
) -> ForeignTrial:
    """Return the intact part of a file that could not be read.

    Args:
        error: the fault that was found.

    Raises:
        Damage: there is no intact part, or it may not be salvaged, and is only offered.
        FormatError: the fault is no damage.
    """
    try:
        whole = read()
        if whole.lost is None:
            raise error
        if salvage:
            return whole
        events = by_time(whole.events) if whole.any_order else whole.events()
        chunks = (inside(chunk, whole.event_px()) for chunk in events)
        parts = [np.empty(0, np.int64), *(chunk.t_us for chunk in chunks)]
        times = np.concatenate(parts)
        times = times[in_order(times)]
    except FormatError as fault:
        if fault is error:
            raise
        worse = fault if isinstance(fault, Damage) else error
        raise Damage(str(worse), error.file) from None
    if not len(times):
        raise Damage(f"{error}; there is no event before that", error.file)
    packets = "" if whole.packets is None else f", in {whole.packets:,} whole packets"
    offer = f"--salvage imports {len(times):,} events up to {times[-1]} us{packets}"
    raise Damage(f"{error}; {offer}", error.file)


def _opened(files: Files, name: str, salvage: bool) -> ForeignTrial:
    """Return the trial in a recording's files, or the reason why it cannot be read."""
    try:
        return files.read(name, salvage)
    except FormatError as error:
        return broken(name, str(files), refusal(error.file or files.files[0], error))
    except InputError as error:
        return broken(name, str(files), error)


def _stem(file: Path) -> str:
    """Return a file's name without its ending; a name without one may have dots in it."""
    suffix = file.suffix.lower()
    known = any(suffix in each.suffixes for _, each in known_formats())
    return file.stem if known else file.name


def _files(path: Path) -> list[Path]:
    """List plain files, and folders that are one recording each.

    Links are left out, for they may lead anywhere.
    """
    if path.is_dir() and not _is_recording(path):
        found = sorted(
            file
            for file in _folder(path).iterdir()
            if (file.is_file() or _is_recording(file)) and not file.is_symlink()
        )
    elif path.is_dir() or path.is_file():
        found = [path]
    elif path.exists():
        raise InputError(path, "", None, "is neither a file nor a folder")
    else:
        raise InputError(path, "", None, "no such file or folder")
    return found


def _is_recording(path: Path) -> bool:
    """Return whether a path is a folder that is one recording."""
    return path.is_dir() and bool(_recognised(path))


def _folder(path: Path) -> Path:
    """Return the folder of the recordings' files."""
    found = (layout.folder(path) for layout in layouts())
    return next((folder for folder in found if folder is not None), path)


def _recognised(path: Path) -> tuple[str, ...]:
    """Return the formats that a file or folder is of, by its content."""
    head = b"" if path.is_dir() else read_head(path)
    found = tuple(name for name, each in CORE.items() if _sniffed(each, path, head))
    if found:
        return found  # plug-ins are not asked
    readers = ((name, each) for name, each in known_formats() if each.read is not None)
    return tuple(name for name, each in readers if _sniffed(each, path, head))


def _sniffed(how: Format, path: Path, head: bytes) -> bool:
    """Return whether a format recognises a file; where it fails, reading the file will say so."""
    try:
        return how.sniff(path, head)
    except FormatError:
        return path.suffix.lower() in how.suffixes


def _possible(file: Path) -> tuple[str, ...]:
    """Return the formats that a file may have: by its content, else by its name's ending."""
    suffix = file.suffix.lower()
    return _recognised(file) or tuple(
        name for name, each in known_formats() if suffix in each.suffixes
    )


def _kind(file: Path) -> str | None:
    kinds = () if unread(file) is not None else _possible(file)
    return kinds[0] if kinds else None


def _manifest_of(path: Path, kind: str) -> Json | None:
    """Return the manifest of a folder whose files are of a format; None if there is none."""
    single = kind == MIXED or known_format(kind).read is not None
    return read_manifest(path) if single and path.is_dir() else None


def read_manifest(folder: Path) -> Json | None:
    """Read and check the manifest of an exported campaign; None if there is none.

    Raises:
        InputError: it is damaged, or names a file outside of its folder.
    """
    path = folder / EXPORT_MANIFEST
    if not path.is_file() or path.is_symlink():
        return None
    try:
        found = read_json(path)
        if found.get("sliplab_export") != EXPORT_FORMAT:
            raise ValueError(f"{path}: sliplab_export must be {EXPORT_FORMAT}")
        if not isinstance(found.get("simulated"), bool):
            raise ValueError(f"{path}: simulated must be true or false")
        for name in found.get(EXPORT_UNFINISHED, ()):
            safe_name(name)
        for item in found["trials"]:
            safe_name(item["trial"])
            safe_name(item["file"])
            _check_exported(item, path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, StoreError) as error:
        text = str(error).removeprefix(f"{path}: ")
        raise InputError(path, "", None, f"is damaged: {text}") from None
    return found


def _check_exported(item: Json, path: Path) -> None:
    texts = item["condition"]
    if not isinstance(texts, dict) or not all(isinstance(t, str) for t in texts.values()):
        raise ValueError(f"{path}: a condition that is not text")
    for name in ("events", "frames", "triggers", "repetition"):
        if type(item[name]) is not int:
            raise ValueError(f"{path}: {name} must be an integer")


def _as_exported(trial: ForeignTrial, item: Json, simulated: bool) -> ForeignTrial:
    """Return a trial with what the manifest states of it."""
    about = {**trial.about, "exported": item.get("record", {})}
    return replace(
        trial,
        condition=dict(item["condition"]),
        repetition=item["repetition"],
        simulated=simulated or trial.simulated,
        about=about,
        unknown=tuple(what for what in trial.unknown if what != "condition"),
    )
