"""Reader of bags: ROS 1's `.bag`, ROS 2's `.db3`, and the folder of a recording of ROS 2.

A `.bag` is read by rosbags, the extra `formats`; a `.db3` is an SQLite database with the tables
`topics` and `messages`; an `.mcap` file in a folder is read as one alone. A folder is one
recording, whatever the number of its files; its `metadata.yaml` gives their order.
"""

from __future__ import annotations

import re
import sqlite3
import struct
from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from importlib import util
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from sliplab.plugins.formats.ros.mcap import MAGIC, mcap_source
from sliplab.plugins.formats.ros.recording import MessageSource, recording
from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.storage.formats.foreign import Damage, ForeignTrial, FormatError, read_head
from sliplab.storage.formats.format import Format
from sliplab.storage.schema.trial import Lost

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader

SQLITE, BAG = b"SQLite format 3\x00", b"#ROSBAG V"
"""First bytes of a `.db3` and of a `.bag`."""
METADATA = "metadata.yaml"
_INFORMATION = "rosbag2_bagfile_information"
_ZSTD = b"\x28\xb5\x2f\xfd"
_MOST_MESSAGE = _MOST_UNPACKED = 1 << 28
"""Bytes of a message, and of a chunk of a `.bag`."""
_LEAST_ROW = 8
"""Bytes of a row of a database, at least."""
_ENDING = re.compile(r"\.(db3|mcap)(\.zstd)?$")
_FAULTS = (Exception,)
"""Exceptions of rosbags for a damaged file: its own, Python's and failed assertions."""


def is_bag_folder(path: Path) -> bool:
    """Return whether a path is the folder of a recording of ROS 2."""
    metadata = path / METADATA
    if not path.is_dir() or not metadata.is_file() or metadata.is_symlink():
        return False
    return _INFORMATION.encode() in read_head(metadata)


def read_bag(path: Path, name: str) -> ForeignTrial:
    """Read a `.bag`, a `.db3` or the folder of a recording.

    Raises:
        FormatError: it is damaged, or holds neither events nor frames that can be read.
        ModuleNotFoundError: rosbags, or for a folder of MCAP files the extra `publish`, is missing.
    """
    return recording(path, name, _folder(path) if path.is_dir() else _file(path))


def salvage_bag(path: Path, name: str) -> ForeignTrial:
    """Read the intact part of a truncated `.db3`, and any other recording as it is.

    Raises:
        FormatError: as `read_bag`.
    """
    lost = _cut(path) if path.is_file() and read_head(path).startswith(SQLITE) else None
    if lost is None:
        return read_bag(path, name)
    return replace(recording(path, name, _sqlite(path, whole=False)), lost=lost)


def _file(path: Path) -> MessageSource:
    head = read_head(path)
    if head.startswith(SQLITE):
        return _sqlite(path)
    if head.startswith(MAGIC):
        return mcap_source(path)
    if head.startswith(BAG):
        return _bag(path)
    if head.startswith(_ZSTD):
        return _packed(path)
    raise FormatError("is neither a .bag nor an SQLite file of ROS 2", path)


def _folder(path: Path) -> MessageSource:
    """Join the files of a recording, in the order that its metadata give."""
    stated = []
    try:
        text = (path / METADATA).read_text()
        named = parse_yaml(text, path / METADATA)[_INFORMATION]["relative_file_paths"]
        files = [path / PurePath(one).name for one in named]
    except (InputError, OSError, ValueError, KeyError, TypeError):
        files = sorted((file for file in path.iterdir() if _ENDING.search(file.name)), key=_order)
        stated.append(f"has a damaged {METADATA}: its files are read in the order of their names")
    there = [file for file in files if file.is_file() and not file.is_symlink()]
    if not there:
        raise FormatError(f"lacks its files, {', '.join(file.name for file in files) or 'none'}")
    sources = []
    for file in there:
        try:
            sources.append(_file(file))
        except FormatError as error:
            raise Damage(str(error), error.file or file) from None
    topics: dict[str, str] = {}
    for source in sources:
        topics = {**source.topics, **topics}

    def read(topic: str) -> Iterator[bytes | FormatError]:
        for file, source in zip(there, sources, strict=True):
            if topic in source.topics:
                try:
                    yield from source.read(topic)
                except FormatError as error:
                    raise Damage(str(error), error.file or file) from None

    missing = [
        f"lacks {file.name}, a part of the recording that {METADATA} names"
        for file in files
        if file not in there
    ]
    ros1 = {topic for source in sources for topic in source.ros1}
    warnings = (*stated, *missing, *(line for source in sources for line in source.warnings))
    return MessageSource(topics, read, ros1, warnings)


def _order(file: Path) -> tuple[int, str]:
    """Return the sort key of the numbered parts of a recording."""
    number = re.search(r"_(\d{1,9})\.", file.name)
    return int(number[1]) if number else 0, file.name


def _packed(path: Path) -> MessageSource:
    """Return the messages of a file that the recorder compressed whole, as `.db3.zstd`."""
    import zstandard

    @contextmanager
    def unpacked() -> Iterator[MessageSource]:
        with TemporaryDirectory() as folder:
            file = Path(folder) / path.stem
            try:
                with path.open("rb") as packed, file.open("wb") as out:
                    zstandard.ZstdDecompressor().copy_stream(packed, out)
            except zstandard.ZstdError as error:
                raise Damage(f"is damaged or cut short: {error}", path) from None
            yield _file(file)

    def read(topic: str) -> Iterator[bytes | FormatError]:
        with unpacked() as source:
            yield from source.read(topic)

    with unpacked() as source:
        return MessageSource(source.topics, read, source.ros1, source.warnings)


# -- ROS 2's SQLite files ------------------------------------------------------------------


def _sqlite(path: Path, *, whole: bool = True) -> MessageSource:
    """Return the messages of a `.db3`, which are read in the order in which they were written.

    Args:
        whole: refuse one that is cut short.
    """
    if whole and (lost := _cut(path)) is not None:
        raise Damage(lost.reason, path)
    with _opened_sqlite(path) as database:
        found = database.execute(
            "SELECT count(*) FROM sqlite_master"
            " WHERE type = 'table' AND name IN ('topics', 'messages')"
        ).fetchone()
        if found[0] != 2:
            raise FormatError(
                "is an SQLite file without the tables `topics` and `messages` of ROS 2", path
            )
        rows = database.execute(
            "SELECT name, type, serialization_format FROM topics ORDER BY id"
        ).fetchall()
    topics = {str(topic): str(kind) if form == "cdr" else "" for topic, kind, form in rows}

    def read(topic: str) -> Iterator[bytes | FormatError]:
        with _opened_sqlite(path) as database:
            for row in _rows(database, topic, path, whole):
                # one at a time: what is damaged costs no other
                try:
                    found = database.execute(
                        "SELECT data FROM messages WHERE id = ?", (row,)
                    ).fetchone()
                except sqlite3.Error as error:
                    found = (FormatError(f"is in a damaged page: {error}"),)
                if found is None or not isinstance(found[0], (bytes, FormatError)):
                    found = (FormatError("is in a damaged row of the database"),)
                yield found[0]

    warnings = [
        f"lies next to {path.name}{ending}, in which its recorder left messages that are not in it "
        f"yet: open it once with `sqlite3 {path.name} vacuum`, and import it again"
        for ending in ("-wal", "-journal")
        if _size(path.with_name(path.name + ending))
    ]
    return MessageSource(topics, read, warnings=tuple(warnings))


def _rows(database: sqlite3.Connection, topic: str, path: Path, whole: bool) -> Iterator[int]:
    """Yield the numbers of the messages of a topic, and those of which nothing is known."""
    topics = {row for (row,) in database.execute("SELECT id FROM topics WHERE name = ?", (topic,))}
    last = 0
    try:
        for last, of in database.execute("SELECT id, topic_id FROM messages ORDER BY id"):
            if of in topics:
                yield last
        return
    except sqlite3.DatabaseError:  # a page in between is damaged: each row is tried by itself
        if not whole:  # there are none behind it
            return
        (end,) = database.execute("SELECT max(id) FROM messages").fetchone()
    most = last + path.stat().st_size // _LEAST_ROW
    for row in range(last + 1, min(end, most) + 1):
        try:
            of = database.execute("SELECT topic_id FROM messages WHERE id = ?", (row,)).fetchone()
        except sqlite3.DatabaseError:
            yield row
        else:
            if of is not None and of[0] in topics:
                yield row


def _cut(path: Path) -> Lost | None:
    """Return the missing part of a database by its header's page count; None if complete."""
    size = path.stat().st_size
    page, pages = struct.unpack(">16xH10xI", read_head(path)[:32].ljust(32, b"\0"))
    whole = (page if page > 1 else 1 << 16) * pages
    if size >= whole:
        return None
    reason = f"is cut short: it has {size:,} of {whole:,} bytes"
    return Lost(at_byte=size, unread_bytes=0, reason=reason)


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


@contextmanager
def _opened_sqlite(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database read-only. Raises Damage for faults that sqlite finds."""
    # no files are written next to the database: the disk may be read-only
    address = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(address, uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_MESSAGE)
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA cell_size_check = ON")
            # without this, sqlite opens none that is cut short
            database.execute("PRAGMA writable_schema = ON")
            yield database
    except sqlite3.Error as error:
        raise Damage(f"is damaged or cut short: {error}", path) from None


# -- ROS 1 ---------------------------------------------------------------------------------


def _bag(path: Path) -> MessageSource:
    with _opened_bag(path) as reader:
        topics = {one.topic: one.msgtype for one in reader.connections}

    def read(topic: str) -> Iterator[bytes | FormatError]:
        with _opened_bag(path) as reader:
            wanted = [one for one in reader.connections if one.topic == topic]
            for part in _by_chunk(reader, {one.id for one in wanted}):
                # one chunk at a time: what is damaged costs no other
                reader.indexes = part
                left = sum(map(len, part.values()))
                try:
                    for _, _, data in reader.messages(wanted):
                        yield data
                        left -= 1
                except _FAULTS as error:
                    fault = FormatError(f"is in a damaged chunk: {_text(error)}")
                    yield from [fault] * left

    return MessageSource(topics, read, set(topics))


def _by_chunk(reader: Reader, wanted: set[int]) -> list[dict[int, list[Any]]]:
    """Return the entries of an index by connection, for each chunk in the order of the file."""
    found: dict[int, dict[int, list[Any]]] = {}
    for number in wanted:
        for entry in reader.indexes[number]:
            parts = found.setdefault(entry.chunk_pos, {one: [] for one in wanted})
            parts[number].append(entry)
    return [found[place] for place in sorted(found)]


@contextmanager
def _opened_bag(path: Path) -> Iterator[Reader]:
    """Open a `.bag`. Raises Damage where rosbags cannot read its index."""
    from rosbags.rosbag1 import Reader

    reader = Reader(path)
    try:
        reader.open()
    except _FAULTS as error:
        text = _text(error)
        if "not indexed" in text:
            text = "its recorder was stopped before it wrote the index; `rosbag reindex` writes one"
        raise Damage(f"is damaged or cut short: {text}", path) from None
    try:
        for place, chunk in reader.chunks.items():
            # rosbags itself unpacks without a bound
            reader.chunks[place] = chunk._replace(decompressor=_bounded(chunk.decompressor))
        yield reader
    finally:
        reader.close()


def _text(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _bounded(unpack: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Return a function that unpacks a chunk as `unpack` does, up to a bound."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1.reader import decompressors

    makers = {decompressors["bz2"]: BZ2Decompressor, decompressors["lz4"]: LZ4FrameDecompressor}
    if unpack not in makers:
        return unpack

    def bounded(data: bytes) -> bytes:
        found: bytes = makers[unpack]().decompress(data, _MOST_UNPACKED)
        if len(found) == _MOST_UNPACKED:
            raise FormatError(f"unpacks to more than {_MOST_UNPACKED >> 20} MiB")
        return found

    return bounded


def _check_library(path: Path) -> None:
    """Check that rosbags is installed, which a `.bag` needs."""
    is_bag = path.is_file() and read_head(path).startswith(BAG)
    if is_bag and util.find_spec("rosbags") is None:
        raise ModuleNotFoundError("No module named 'rosbags'", name="rosbags")


ROSBAG = Format(
    suffixes=(".bag", ".db3"),
    sniff=lambda path, head: head.startswith((SQLITE, BAG)) or is_bag_folder(path),
    read=read_bag,
    salvage=salvage_bag,
    check=_check_library,
)
