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
from importlib import util
from pathlib import Path

from slugify import slugify

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, safe_name
from sliplab.storage.formats.aedat4 import LINE, read_aedat4, salvage_aedat4
from sliplab.storage.formats.dsec import (
    is_lab_hdf5,
    read_dsec,
    read_lab_hdf5,
    salvage_dsec,
    salvage_lab_hdf5,
)
from sliplab.storage.formats.event_stream import (
    EVENT_STREAM,
    check_faery,
    read_es,
    salvage_es,
)
from sliplab.storage.formats.foreign import (
    EXPORT_FORMAT,
    EXPORT_MANIFEST,
    Damage,
    ForeignTrial,
    FormatError,
    Skipped,
    before_damage,
    broken,
    read_head,
    refusal,
)
from sliplab.storage.formats.lab_pickles import Pair, is_stream, pairs, read_pair, unnamed
from sliplab.storage.formats.lab_recordings import (
    EVENTS_FOLDER,
    check_polarity,
    compare,
    described,
    is_of_run,
    run_folder,
    with_run,
)
from sliplab.storage.formats.lerobot_import import is_lerobot, read_lerobot
from sliplab.storage.formats.mcap_import import MAGIC, read_mcap, salvage_mcap
from sliplab.storage.formats.prophesee import (
    is_prophesee,
    read_prophesee,
    salvage_prophesee,
)
from sliplab.storage.formats.published_import import publication_at, read_publication
from sliplab.storage.formats.ros_bags import (
    BAG,
    SQLITE,
    is_bag_folder,
    read_bag,
    salvage_bag,
)
from sliplab.storage.formats.unread import unread
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import REGISTRATIONS
from sliplab.storage.trials.superblock import SIGNATURE

Reader = Callable[[Path, str], ForeignTrial]
READERS: dict[str, tuple[tuple[str, ...], Reader]] = {
    "aedat4": ((".aedat4",), read_aedat4),
    "dsec": ((".h5", ".hdf5"), read_dsec),
    "lab-hdf5": ((".h5", ".hdf5"), read_lab_hdf5),
    "raw": ((".raw", ".dat"), read_prophesee),
    "es": ((".es",), read_es),
    "mcap": ((".mcap",), read_mcap),
    "rosbag": ((".bag", ".db3"), read_bag),
}
SALVAGE: dict[str, Reader] = {
    "aedat4": salvage_aedat4,
    "dsec": salvage_dsec,
    "lab-hdf5": salvage_lab_hdf5,
    "raw": salvage_prophesee,
    "es": salvage_es,
    "mcap": salvage_mcap,
    "rosbag": salvage_bag,
}
"""Readers of what stands whole before the damage in a file, by format."""
LAB_PICKLES = "lab-pickles"
DATA_SETS: dict[str, Callable[[Path], Iterator[ForeignTrial]]] = {
    "croissant": read_publication,
    "lerobot": read_lerobot,
}
"""Readers of folders that are one data set, by format."""
KINDS = (*READERS, LAB_PICKLES, *DATA_SETS)
MIXED = "mixed"
"""Files of several formats in one folder."""
_UNSAFE = re.compile(r"[^A-Za-z0-9=,._+-]+")
_RESERVED = re.compile(r"(?i:con|prn|aux|nul|com\d|lpt\d)(?:\..*)?")
"""Names that no file has on Windows."""
_LONGEST_NAME, _HASH = 200, 8


def kind_of(path: Path) -> str:
    """Return the format of a file, or of the files in a folder; `MIXED` for several.

    Raises:
        InputError: none of them is known, or one is damaged.
    """
    if (whole := _data_set(path)) is not None:
        return whole
    found = _sort(path)
    if not found:
        said = [(file, what) for file in _files(path) if (what := unread(file)) is not None]
        if said:
            raise InputError(said[0][0], "", None, said[0][1])
        raise InputError(
            path, "", None, f"contains no known file format; name one of {', '.join(KINDS)}"
        )
    kinds = {kind for _, kind, _ in found}
    return kinds.pop() if len(kinds) == 1 else MIXED


def _data_set(path: Path) -> str | None:
    """Return the format of a folder that is one data set; None for any other path."""
    if publication_at(path) is not None:
        return "croissant"
    return "lerobot" if is_lerobot(path) else None


def trials_in(path: Path, kind: str, *, salvage: bool = False) -> Iterator[ForeignTrial]:
    """Yield the trials of a file or folder, in the order of their names.

    Args:
        kind: the format, or `MIXED`: that of each file.
        salvage: of a file that is damaged already where it begins to be read, yield what stands
            whole.

    Raises:
        InputError: it does not exist, a file is damaged, or faery is missing.
        ModuleNotFoundError: the extra `publish` is missing, for MCAP files.
    """
    if kind in DATA_SETS:
        if not path.is_dir():
            raise InputError(path, "", None, f"is no folder; {kind} is a folder of files")
        yield from DATA_SETS[kind](path)
        return
    manifest = None
    if kind != LAB_PICKLES and path.is_dir():
        manifest = _read_manifest(path)
    if manifest is not None:
        for item in manifest["trials"]:
            file, fault = path / item["file"], None
            of = kind
            if file.is_symlink() or not file.is_file():
                fault = "is missing or not a regular file"
            elif (of := (_kind(file) or "") if kind == MIXED else kind) not in READERS:
                fault = f"is of no known format ({', '.join(READERS)})"
            if fault is not None:
                yield broken(item["trial"], item["file"], InputError(file, "", None, fault))
                continue
            found = _read(of, file, item["trial"], salvage)
            yield _as_exported(found, item, manifest["simulated"])
        return
    wanted = _sort(path) if kind == MIXED else _of_kind(path, kind)
    _check_libraries(wanted)
    run = run_folder(path)
    files: dict[str, list[str]] = {}
    for name, _, file in wanted:
        files.setdefault(name, []).append(file.name if isinstance(file, Path) else str(file))
    yield from (_several(path, name, files[name]) for name in files if len(files[name]) > 1)
    for name, of, file in wanted:
        if len(files[name]) > 1:
            continue
        stem = file.stem if isinstance(file, Pair) else _stem(file)
        if isinstance(file, Pair):
            found = _read_lab(of, file, name, salvage)
        else:
            found = check_polarity(_read(of, file, name, salvage), stem)
        yield with_run(found, stem, run)


def _read_lab(kind: str, pair: Pair, name: str, salvage: bool) -> ForeignTrial:
    """Return a recording of the lab: of its stream, or else of its pickles."""
    note = ""
    try:
        if pair.stream is not None:
            try:
                found = read_file(kind, pair.stream, name, salvage)
                return described(compare(found, pair), pair.stem)
            except FormatError as error:
                if pair.on is None and pair.off is None:
                    raise FormatError(str(error), pair.stream) from None
                note = f"{pair.stream.name} is not imported: {error}"
        found = replace(read_pair(pair, name), kind=LAB_PICKLES)
    except (FormatError, InputError) as error:
        if isinstance(error, FormatError):
            first = next(path for path in (pair.stream, pair.on, pair.off) if path is not None)
            error = refusal(error.file or first, error)
        return broken(name, str(pair), error)
    return replace(found, notes=lambda: (*((note,) if note else ()), *found.notes()))


def skipped_in(path: Path, kind: str) -> list[Skipped]:
    """Return what `trials_in` leaves out of a folder, by name.

    Raises:
        InputError: as `trials_in`.
    """
    if not path.is_dir() or kind in DATA_SETS or is_bag_folder(path):
        return []
    manifest = _read_manifest(path) if kind != LAB_PICKLES else None
    taken: set[str | None] = {EXPORT_MANIFEST}
    if manifest is not None:
        taken.add(REGISTRATIONS)
        taken |= {item["file"] for item in manifest["trials"]}
        other = f"is not in {EXPORT_MANIFEST}"
    else:
        for _, _, file in _sort(path) if kind == MIXED else _of_kind(path, kind):
            taken |= file.names() if isinstance(file, Pair) else {file.name}
        known = ", ".join(KINDS)
        other = f"is of no known format ({known})" if kind == MIXED else f"is no {kind} file"
    run = run_folder(path)
    entries = sorted(path.iterdir())
    if run == path:
        entries = [entry for entry in entries if not is_of_run(run, entry)]
        entries += sorted((run / EVENTS_FOLDER).iterdir())
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


Wanted = tuple[str, str, "Path | Pair"]
"""Name of a trial, its format, and its file or files."""


def _sort(path: Path) -> list[Wanted]:
    """Return what is known in a file or folder, each with its own format, by name."""
    kinds = {file: _kind(file) for file in _files(path)}
    lab = pairs([file for file, kind in kinds.items() if kind is None or _is_stream(file, kind)])
    taken = {pair.stream for pair in lab}
    found: list[Wanted] = [
        (_stem(file), kind, file)
        for file, kind in kinds.items()
        if kind is not None and file not in taken
    ]
    found += [(pair.stem, LAB_PICKLES if pair.stream is None else "lab-hdf5", pair) for pair in lab]
    found = found or [(pair.stem, LAB_PICKLES, pair) for pair in unnamed(list(kinds))]
    return sorted(_named(found), key=lambda item: item[0])


def _named(found: list[Wanted]) -> list[Wanted]:
    """Return recordings with the names of their trials in place of those of their files."""
    names = unique_names([stem for stem, _, _ in found])
    return [(name, kind, file) for name, (_, kind, file) in zip(names, found, strict=True)]


def _is_stream(file: Path, kind: str | None) -> bool:
    return kind in {"lab-hdf5", "dsec"} and is_stream(file)


def _of_kind(path: Path, kind: str) -> list[Wanted]:
    """Return what a file or folder holds of one format.

    Raises:
        InputError: that is nothing.
    """
    files = _files(path)
    if kind == LAB_PICKLES:
        found = pairs([file for file in files if not is_stream(file)]) or unnamed(files)
        if not found:
            raise InputError(path, "", None, "holds no NAME_events_on or NAME_events_off")
        return _named([(pair.stem, kind, pair) for pair in found])
    wanted = [file for file in files if kind in _possible(file)] if path.is_dir() else files
    lab = [pair for pair in pairs(files) if kind == "lab-hdf5" and pair.stream is not None]
    if not (wanted or lab):
        endings = " or ".join(READERS[kind][0])
        raise InputError(path, "", None, f"holds no {kind} file; such files end in {endings}")
    taken = {pair.stream for pair in lab}
    recordings: list[Wanted] = [(_stem(file), kind, file) for file in wanted if file not in taken]
    return _named([*recordings, *((pair.stem, kind, pair) for pair in lab)])


def _check_libraries(wanted: list[Wanted]) -> None:
    """Check that the libraries for these files are installed."""
    for _, kind, file in wanted:
        if kind == "es" and isinstance(file, Path):
            check_faery(file)
        if isinstance(file, Path) and (needed := _needs(kind, file)) is not None:
            raise ModuleNotFoundError(f"No module named {needed!r}", name=needed)


def _several(path: Path, name: str, files: Sequence[str]) -> ForeignTrial:
    """Return a trial that several files are named after, of which none is imported.

    They are mostly one recording in two formats, which must not count twice.
    """
    error = InputError(
        path, "", None,
        f"holds {len(files)} files for the trial {name}: {', '.join(files)}; keep one of them, "
        "rename the others, or import one format alone: sliplab import KIND PATH",
    )  # fmt: skip
    return broken(name, ", ".join(files), error)


def _needs(kind: str, file: Path) -> str | None:
    """Return the module that a file needs and that is not installed."""
    needed = "mcap" if kind == "mcap" else None
    if kind == "rosbag" and file.is_file() and read_head(file).startswith(BAG):
        needed = "rosbags"
    return needed if needed is not None and util.find_spec(needed) is None else None


def name_of(stem: str) -> str:
    """Make the name of a trial from a file's name.

    Letters that are not Latin are transliterated, other characters become ``_``. Where that, or the
    length, loses what tells names apart, the beginning of a hash of the file's name follows. Forms
    of one text (Unicode's NFC and NFD) have one name.
    """
    text = unicodedata.normalize("NFC", stem)
    plain = text
    if not text.isascii():
        plain = slugify(
            text, entities=False, decimal=False, hexadecimal=False, lowercase=False, separator="_",
            regex_pattern=_UNSAFE.pattern,
        )  # fmt: skip
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
    """Return the trial in a file, or what stands whole of it.

    Raises:
        FormatError: it is damaged, or of another format.
    """
    if (what := unread(file)) is not None:
        raise FormatError(what)
    _, reader = READERS[kind]
    again = partial(SALVAGE[kind], file, name) if kind in SALVAGE else None
    try:
        return replace(reader(file, name), kind=kind, salvage=again)
    except Damage as error:
        if again is None:
            raise
        return replace(before_damage(again, error, salvage), kind=kind)


def _read(kind: str, file: Path, name: str, salvage: bool) -> ForeignTrial:
    try:
        return read_file(kind, file, name, salvage)
    except FormatError as error:
        return broken(name, file.name, refusal(error.file or file, error))


def _stem(file: Path) -> str:
    """Return a file's name without its ending; a name without one may have dots in it."""
    known = {ending for endings, _ in READERS.values() for ending in endings}
    return file.stem if file.suffix.lower() in known else file.name


def _files(path: Path) -> list[Path]:
    """List plain files, and folders of one recording of ROS 2 each.

    Links are left out, for they may lead anywhere.
    """
    if path.is_dir() and not is_bag_folder(path):
        folder = path if (run := run_folder(path)) is None else run / EVENTS_FOLDER
        found = sorted(
            file
            for file in folder.iterdir()
            if (file.is_file() or is_bag_folder(file)) and not file.is_symlink()
        )
    elif path.is_dir() or path.is_file():
        found = [path]
    elif path.exists():
        raise InputError(path, "", None, "is neither a file nor a folder")
    else:
        raise InputError(path, "", None, "no such file or folder")
    return found


def _possible(file: Path) -> tuple[str, ...]:
    """Return the formats that a file may have: by its first bytes, else by its name's ending."""
    if file.is_dir():
        return ("rosbag",)
    head = read_head(file)
    if head.startswith(LINE):
        return ("aedat4",)
    if head.startswith(MAGIC):
        return ("mcap",)
    if head.startswith((SQLITE, BAG)):
        return ("rosbag",)
    if head.startswith(SIGNATURE):
        return ("dsec", "lab-hdf5")
    if head.startswith(EVENT_STREAM):
        return ("es",)
    if is_prophesee(head):
        return ("raw",)
    suffix = file.suffix.lower()
    return tuple(kind for kind, (endings, _) in READERS.items() if suffix in endings)


def _kind(file: Path) -> str | None:
    kinds = () if unread(file) is not None else _possible(file)
    if "dsec" in kinds:
        with suppress(FormatError):  # its reader finds the same fault
            return "lab-hdf5" if is_lab_hdf5(file) else "dsec"
    return kinds[0] if kinds else None


def _read_manifest(folder: Path) -> Json | None:
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
