"""Table of all committed trials of a store, with units in the column names.

An index caches the last table, so that 100,000 trials need not be read each time. The trials'
folders remain the source of truth; the index only saves reading unchanged ones. A trial is known by
its folder's inode and the time of the folder's last change, which a rename, a new file and a
deleted one all move, and by the file with its refitted clocks. Bytes that were changed inside a
file are for `sliplab verify` to find. An index that is missing, damaged, or of another version of
this module is rebuilt; it is among the derived results and may be deleted at any time.
"""

from __future__ import annotations

import ast
import hashlib
import io
import json
import math
import os
import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sliplab.protocols.errors import InputError
from sliplab.protocols.later import Later, installed, need
from sliplab.protocols.plan import condition_columns
from sliplab.storage.files import make_folder, write_bytes
from sliplab.storage.streams import I64
from sliplab.storage.trials.checksums import incomplete
from sliplab.storage.trials.hdf5_writer import STREAMS
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import STORE, Campaign, StoreError, TrialStore

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq
else:
    pa = Later("pyarrow")
    pq = Later("pyarrow.parquet")

VERSION = 5
"""Of the index and of the catalogue's rows: a change of either counts on."""
FRESH_NS = 2_000_000_000
"""Age below which a change may not show in a time stamp: some disks count in seconds."""
_NAME, _ROW, _INODE, _CHANGED, _SYNC = (
    f"index.{name}" for name in ("name", "row", "inode", "changed", "sync")
)
_META = b"sliplab"
UNREAD = "unread_bytes"
"""Column of a catalogue with salvaged trials: the number of unread bytes of their files."""
DROPPED = "rows_lost"
"""Column of a catalogue with trials some rows of which were left out: how many."""
NO_CLOCK = "no_clock"
"""Column of a catalogue with trials some streams of which have no clock: their names."""


def catalogue(store: TrialStore, unreadable: list[str] | None = None) -> pd.DataFrame:
    """One row a committed trial: campaign, id, condition and context, counts, quality.

    Conditions and context become columns by name; levels with a unit are numbers, the unit is in
    the column's name (``depth_mm``), a slash in it as ``_per_``. Trials that have not changed since
    the catalogue was last read are not read again.

    Args:
        unreadable: gets a line for every trial that is damaged; without it, one is an error.

    Raises:
        StoreError: a trial is damaged.
    """
    return catalogue_so_far(store, unreadable, math.inf)[0]


def catalogue_so_far(
    store: TrialStore, unreadable: list[str] | None, within_s: float
) -> tuple[pd.DataFrame, int]:
    """Return the catalogue of what can be read in a time, and the number of trials that are left.

    What was read is in the index, so that the next call goes on where this one ended.

    Args:
        unreadable: as of `catalogue`, which it otherwise is.
        within_s: no trial but the first is begun later, or as long as listing the store took where
            that is more; in a large store, writing the index takes some seconds more.
    """
    began_ns, began = time.time_ns(), time.monotonic()
    found = [(campaign, _Listing.of(campaign)) for campaign in store.campaigns()]
    known = _read_index(store) or _Index(_typed([]))
    listed = time.monotonic()
    parts, problems, end = [], [], listed + max(within_s, listed - began)
    for campaign, listing in found:
        part = _CampaignRows(campaign, listing, known)
        parts.append(part)
        problems += part.look(unreadable is None, end)
    names, left = [campaign.name for campaign, _ in found], sum(part.left for part in parts)
    table, stored = known.table, True
    if names != list(known.bounds) or any(part.changed for part in parts):
        table, stored = _rebuilt(store, parts, known, began_ns)
    if left and not stored:  # the next call would begin anew
        return catalogue_so_far(store, unreadable, math.inf)
    if unreadable is not None:
        unreadable += problems
    return table, left


def query(table: pd.DataFrame, expression: str, argument: str = "where") -> pd.DataFrame:
    """Return the rows for which a pandas expression holds.

    Args:
        expression: such as ``depth_mm > 2.8 and events > 1000``.
        argument: that gave it.

    Raises:
        InputError: the expression cannot be read, or names something besides columns.
    """
    if fault := _expression_fault(expression):
        raise InputError(argument, "", expression, fault)
    try:
        return table.query(expression, engine="python", local_dict={}, global_dict={})
    except Exception as error:
        text = f"cannot be read ({error}); the columns are {', '.join(map(str, table.columns))}"
        raise InputError(argument, "", expression, text) from None


_LONGEST = 1000
"""Characters of an expression; with what it may contain, that bounds its time and memory."""
_ALLOWED = (
    ast.Expression,
    ast.BoolOp,
    ast.boolop,
    ast.UnaryOp,
    ast.unaryop,
    ast.BinOp,
    ast.Add,
    ast.Sub,
    ast.Mult,
    ast.Div,
    ast.FloorDiv,
    ast.Mod,
    ast.BitAnd,
    ast.BitOr,
    ast.Compare,
    ast.cmpop,
    ast.Name,
    ast.Load,
    ast.Constant,
    ast.List,
    ast.Tuple,
    ast.Call,
    ast.Attribute,
)
_METHODS = frozenset(
    {"str", "startswith", "endswith", "contains", "isin", "isna", "notna", "isnull", "notnull"}
)
_ASSIGNS = re.compile(r"(?<![=<>!])=(?!=)")
_REPEATS = frozenset("*+{")
"""In a pattern; nested ones may take for ever."""


def _expression_fault(expression: str) -> str | None:
    """Return what an expression must not contain, if it does: it may come from anywhere."""
    if len(expression) > _LONGEST:
        return f"must have at most {_LONGEST} characters"
    if "@" not in expression and "__" not in expression:
        try:
            tree = ast.parse(re.sub("`[^`]*`", "name", expression.strip()), mode="eval")
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            hint = "; == compares" if _ASSIGNS.search(expression) else ""
            return f"cannot be read ({error}){hint}"
        if all(map(_may_stand, ast.walk(tree))):
            return None
    return (
        "may contain only columns, numbers, text, + - * / // %, comparisons, in, and, or, not, "
        f"and the methods {', '.join(sorted(_METHODS))}"
    )


def _may_stand(node: ast.AST) -> bool:
    if not isinstance(node, _ALLOWED):
        return False
    if isinstance(node, ast.BinOp):  # text and lists times a number grow without bound
        return not any(
            isinstance(side, ast.List | ast.Tuple)
            or (isinstance(side, ast.Constant) and isinstance(side.value, str | bytes))
            for side in (node.left, node.right)
        )
    if isinstance(node, ast.Call):
        return (
            isinstance(node.func, ast.Attribute)
            and not node.keywords
            and not (
                node.func.attr == "contains"
                and any(_REPEATS & set(ast.unparse(each)) for each in node.args)
            )
        )
    return not isinstance(node, ast.Attribute) or node.attr in _METHODS


def write_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table atomically in the format that its name ends in.

    Raises:
        InputError: it ends in something else than .csv, .parquet or .json.
        ModuleNotFoundError: what writes Parquet is not installed.
    """
    _check_suffix(path)
    kinds: dict[str, Callable[[], bytes]] = {
        ".csv": lambda: table.to_csv(index=False).encode(),
        ".parquet": lambda: _parquet(table),
        ".json": lambda: json.dumps(table_records(table), allow_nan=False).encode(),
    }
    make_folder(path.parent)
    write_bytes(path, kinds[path.suffix.lower()]())


def table_records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows for JSON, with all digits: pandas' own JSON rounds to at most 15 decimals.

    What is missing, not a number or infinite becomes None.
    """
    finite = table.notna() & ~table.isin([math.inf, -math.inf])
    found: list[dict[str, Any]] = table.astype(object).where(finite, None).to_dict("records")
    return found


def check_table_path(path: Path) -> None:
    """Check that a table can be written to a path that a person named.

    Raises:
        InputError: it ends in something else than .csv, .parquet or .json, or is a file of a store.
        ModuleNotFoundError: what writes Parquet is not installed.
    """
    refuse_store_file(path, "--output")
    _check_suffix(path)


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in (".csv", ".parquet", ".json"):
        raise InputError("--output", "", str(path), "must end in .csv, .parquet or .json")
    if path.suffix.lower() == ".parquet":
        need("pyarrow")


def refuse_store_file(path: Path, option: str, *, again: bool = False) -> None:
    """Refuse an output, a file or a folder, that would change a store or lie among its trials.

    Args:
        again: a folder that an earlier export made may be written again, but among the trials.

    Raises:
        InputError: it would.
    """
    there = path.resolve()
    for store in (there, *there.parents):
        if (store / STORE).is_file() and (
            (there.exists() and not again) or there.is_relative_to(store / "campaigns")
        ):
            text = f"belongs to the store {store}; give a path outside of it"
            raise InputError(option, "", str(path), text)


def _parquet(table: pd.DataFrame) -> bytes:
    made = io.BytesIO()
    table.to_parquet(made, index=False, engine="pyarrow")
    return made.getvalue()


class _CampaignRows:
    """A campaign's part of the catalogue: rows of the index, and trials that have to be read.

    Attributes:
        kept: numbers of the index's rows that are still valid, by trial.
        sync: stamp of each trial's refitted clocks, taken before they are read.
        fresh: rows that were read now, by trial.
        left: number of trials that were not read for want of time.
    """

    def __init__(self, campaign: Campaign, listing: _Listing, known: _Index) -> None:
        self.campaign, self.listing = campaign, listing
        low, high, stamp = known.bounds.get(campaign.name, (0, 0, ""))
        names, keys = known.names[low:high], known.keys[low:high]
        self.retained = dict(zip(names, range(low, high), strict=True))
        if names != listing.names or not np.array_equal(keys, listing.keys):
            now = dict(zip(listing.names, map(tuple, listing.keys.tolist()), strict=True))
            before = zip(names, map(tuple, keys.tolist()), strict=True)
            self.retained = {
                name: self.retained[name] for name, key in before if now.get(name) == key
            }
        same_clocks = bool(stamp) and stamp == listing.sync
        self.sync: dict[str, str] = {}
        if not same_clocks:
            old = known.sync()
            self.sync = {name: _sync_key(campaign, name) for name in self.retained}
            self.retained = {n: at for n, at in self.retained.items() if self.sync[n] == old[at]}
        self.fresh: dict[str, Row] = {}
        self.left = 0
        self.changed = len(self.retained) != high - low or not same_clocks

    def look(self, strict: bool, end: float) -> list[str]:
        """Read the trials that are not in the index; return a line for each that is damaged.

        Args:
            end: `time.monotonic()` after which none but the first is read.

        Raises:
            StoreError: one is, and it is to be `strict`.
        """
        damaged, broken = [], []
        for name in self.listing.names:
            if name in self.retained:
                continue
            if self.fresh and time.monotonic() > end:
                self.left += 1
                continue
            folder = self.campaign.folder / "trials" / name
            if (cause := incomplete(folder)) is not None:
                damaged.append(f"{name}: {cause}")
                continue
            self.sync.setdefault(name, _sync_key(self.campaign, name))
            try:
                recording = Recording(folder, self.campaign.sync_file(name), self.campaign.fetch)
                self.fresh[name] = _row(self.campaign.name, recording)
            except StoreError as error:
                if strict:
                    raise
                broken.append(str(error))
        self.changed = self.changed or bool(self.fresh)
        return damaged + broken


def _rebuilt(
    store: TrialStore, parts: list[_CampaignRows], known: _Index, began_ns: int
) -> tuple[pd.DataFrame, bool]:
    """Return the table from the index and the rows that were read; write it as the index.

    Returns:
        The table, and whether the index was written.
    """
    old_rows, old_sync = known.rows(), known.sync()
    rows: list[Row] = []
    sync: list[str] = []
    keys: list[Any] = []
    new = _Index(pd.DataFrame())
    for part in parts:
        first = len(rows)
        for name, key in zip(part.listing.names, part.listing.settled(began_ns), strict=True):
            at = part.retained.get(name)
            if at is None and name not in part.fresh:
                continue  # damaged, or not read yet
            rows.append(part.fresh[name] if at is None else old_rows[at])
            sync.append(part.sync[name] if at is None else old_sync[at])
            new.names.append(name)
            keys.append(key)
        new.bounds[part.campaign.name] = (first, len(rows), part.listing.sync)
    table = _typed(rows)
    if not rows:
        return table, False
    new.keys = np.array(keys, np.int64).reshape(-1, 2)
    return table, _write_index(store, table, rows, sync, new)


Row = dict[str, str | int | float | None]
"""A trial of the catalogue: its cells by column."""
_TYPES = {
    **dict.fromkeys(("campaign", "trial", "experiment", "role"), "str"),
    **dict.fromkeys(("repetition", "block", "attempt"), "int64"),
    "simulated": "bool",
    "recorded_s": "float64",
    **dict.fromkeys(("events", "frames"), "int64"),
    "frame_source": "str",
    "sync_uncertainty_us": "float64",
    "passed": "bool",
}
"""Types of the columns that every catalogue has, also one of no trial."""


def _typed(rows: list[Row]) -> pd.DataFrame:
    """Return rows as a table, columns without any value as those of numbers that are missing."""
    table = pd.DataFrame(rows, columns=None if rows else list(_TYPES))
    empty = dict.fromkeys(table.columns[table.isna().all()], "float64") if rows else {}
    return table.astype({**empty, **_TYPES})


def _row(campaign: str, recording: Recording) -> Row:
    record, uncertainty_ns = recording.record, recording.clocks.against_events_ns("events")
    return {
        "campaign": campaign,
        "trial": record.trial,
        "experiment": record.experiment,
        "role": record.role,
        "repetition": record.repetition,
        "block": record.block,
        "attempt": record.attempt,
        "simulated": record.simulated,
        "recorded_s": record.recorded_s,
        "events": record.counts.events,
        "frames": record.counts.frames,
        "frame_source": recording.frame_source,
        "sync_uncertainty_us": None if uncertainty_ns is None else uncertainty_ns / 1000,
        "passed": record.quality.passed,
        **_missing(recording),
        **condition_columns(recording.described),
        **{
            f"{name}_{figure}": value
            for name, stream in record.streams.items()
            for figure, value in stream.figures.items()
        },
        **{
            f"{name}_{stream.kind}": stream.rows
            for name, stream in record.streams.items()
            if stream.kind not in STREAMS  # which have figures
        },
    }


def _missing(recording: Recording) -> Row:
    """Return the cells of a trial that is not all that was recorded; of others there are none."""
    lost, imported = recording.record.lost, recording.record.imported
    cells: Row = {} if lost is None else {UNREAD: lost.unread_bytes}
    if imported is not None and imported.dropped:
        cells[DROPPED] = sum(imported.dropped.values())
    if refused := recording.record.clocks.refused:
        cells[NO_CLOCK] = ", ".join(refused)
    return cells


@dataclass
class _Listing:
    """The folders among a campaign's committed trials as they are now, by name."""

    names: list[str]
    keys: I64
    """Inode and time of the last change, ns since 1970, shape (n, 2)."""
    sync: str
    """Stamp of the folder with refitted clocks; empty for one that changed just now."""

    @staticmethod
    def of(campaign: Campaign) -> _Listing:
        """List the folders that are there now."""
        names: list[str] = []
        inodes: list[int] = []
        changed: list[int] = []
        with suppress(FileNotFoundError, NotADirectoryError):
            handle = os.open(campaign.folder / "trials", os.O_RDONLY | os.O_DIRECTORY)
            try:
                with os.scandir(handle) as entries:
                    for entry in entries:
                        if entry.is_dir(follow_symlinks=False):
                            status = entry.stat(follow_symlinks=False)
                            names.append(entry.name)
                            inodes.append(status.st_ino)
                            changed.append(status.st_ctime_ns)
            finally:
                os.close(handle)
        order = sorted(range(len(names)), key=names.__getitem__)
        keys = np.array([inodes, changed], np.int64).T[order].reshape(-1, 2)
        return _Listing([names[k] for k in order], keys, _stamp(campaign.sync_folder))

    def settled(self, now_ns: int) -> I64:
        """Return the keys, with zeros for what changed just now."""
        keys = self.keys.copy()
        keys[keys[:, 1] > now_ns - FRESH_NS] = 0
        return keys


@dataclass
class _Index:
    """The index: the catalogue as it was, a row a trial, and the folders that it came from."""

    table: pd.DataFrame
    names: list[str] = field(default_factory=list)
    keys: I64 = field(default_factory=lambda: np.empty((0, 2), np.int64))
    bounds: dict[str, tuple[int, int, str]] = field(default_factory=dict)
    """By campaign: its first row, the one after its last, and its stamp of refitted clocks."""
    data: bytes = b""

    def rows(self) -> list[Row]:
        """Return the rows that the table was made of."""
        return [json.loads(each) for each in self._column(_ROW)]

    def sync(self) -> list[str]:
        """Return the stamp of each trial's refitted clocks."""
        return self._column(_SYNC)

    def _column(self, name: str) -> list[str]:
        if not self.data:
            return []
        found: list[str] = pq.read_table(io.BytesIO(self.data), columns=[name])[name].to_pylist()
        return found


def _sync_key(campaign: Campaign, name: str) -> str:
    """Return the stamp of the file with a trial's refitted clocks."""
    return _stamp(campaign.sync_file(name), settled=True)


def _stamp(path: Path, settled: bool = False) -> str:
    try:
        status = path.stat()
    except OSError:
        return "none"
    if not settled and status.st_mtime_ns > time.time_ns() - FRESH_NS:
        return ""
    return f"{status.st_ino} {status.st_mtime_ns} {status.st_size}"


def _read_index(store: TrialStore) -> _Index | None:
    """Read the index; None if there is none that can be used, or nothing that reads Parquet."""
    if not installed("pyarrow"):
        return None
    try:
        content = _path(store).read_bytes()
    except OSError:
        return None
    digest, data = content[:32], content[32:]
    return _parse(data) if hashlib.sha256(data).digest() == digest else None


def _parse(data: bytes) -> _Index | None:
    try:
        file = pq.ParquetFile(io.BytesIO(data))
        meta = json.loads(file.schema_arrow.metadata[_META])
        if meta["version"] != VERSION:
            return None
        columns = [name for name in file.schema_arrow.names if name not in {_ROW, _SYNC}]
        table = file.read(columns=columns)
        keys = np.stack([table[_INODE].to_numpy(), table[_CHANGED].to_numpy()], axis=1)
        bounds = {name: (low, high, sync) for name, low, high, sync in meta["campaigns"]}
        frame = table.drop_columns([_NAME, _INODE, _CHANGED]).to_pandas()
        return _Index(frame, table[_NAME].to_pylist(), keys, bounds, data)
    except (ValueError, KeyError, TypeError, pa.ArrowException):
        return None


def _write_index(
    store: TrialStore, table: pd.DataFrame, rows: list[Row], sync: list[str], known: _Index
) -> bool:
    """Write the index, where it can be written and reads again as it is; False elsewhere."""
    if not installed("pyarrow"):
        return False
    frame = table.copy()
    frame[_NAME] = known.names
    frame[_ROW] = [json.dumps(each) for each in rows]
    frame[_INODE], frame[_CHANGED] = known.keys[:, 0], known.keys[:, 1]
    frame[_SYNC] = sync
    made = pa.Table.from_pandas(frame, preserve_index=False)
    campaigns = [[name, *about] for name, about in known.bounds.items()]
    meta = json.dumps({"version": VERSION, "campaigns": campaigns}).encode()
    made = made.replace_schema_metadata({**(made.schema.metadata or {}), _META: meta})
    buffer = io.BytesIO()
    pq.write_table(made, buffer, compression="zstd")
    data = buffer.getvalue()
    back = _parse(data)
    if (
        back is None
        or not back.table.equals(table)
        or list(back.table.dtypes) != list(table.dtypes)
    ):
        return False  # something that Parquet cannot keep as it is: it is read each time
    try:
        path = _path(store)
        make_folder(path.parent)
        write_bytes(path, hashlib.sha256(data).digest() + data)
    except OSError:  # a store that is only read from
        return False
    return True


def _path(store: TrialStore) -> Path:
    return store.folder / "derived" / "catalogue" / "index"
