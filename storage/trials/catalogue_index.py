"""What the catalogue was when it was last asked for, so that 100,000 trials need not be read again.

The truth is the trials' folders. This file only spares reading those that have not changed: a trial
is known by its folder's inode and the time of the folder's last change, which a rename, a new file
and a deleted one all move, and by the file with its refitted clocks. Bytes that were changed inside
a file are for `sliplab verify` to find. A file that is missing, damaged, or of another version of
this module is made anew; it stands among the derived results and may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from sliplab.storage.files import make_folder, write_bytes
from sliplab.storage.streams import I64, Json
from sliplab.storage.trials.store import SYNC, Campaign, Store

VERSION = 1
"""Of this file and of the catalogue's rows: whoever changes either counts on."""
FRESH_NS = 2_000_000_000
"""What changed so lately may change again without its time moving: some disks count in seconds."""
_NAME, _ROW, _INODE, _CHANGED, _SYNC = (
    f"index.{name}" for name in ("name", "row", "inode", "changed", "sync")
)
_META = b"sliplab"


@dataclass
class Listing:
    """The folders among a campaign's committed trials as they are now, by name."""

    names: list[str]
    keys: I64
    """Inode and time of the last change, ns since 1970, shape (n, 2)."""
    sync: str
    """What stands for the folder with refitted clocks; empty for one that changed just now."""

    @staticmethod
    def of(campaign: Campaign) -> Listing:
        """What is there now."""
        names: list[str] = []
        inodes: list[int] = []
        changed: list[int] = []
        with suppress(FileNotFoundError, NotADirectoryError):
            handle = os.open(campaign.folder / "trials", os.O_RDONLY | os.O_DIRECTORY)
            try:
                with os.scandir(handle) as entries:
                    for entry in entries:
                        if entry.is_dir(follow_symlinks=False):
                            told = entry.stat(follow_symlinks=False)
                            names.append(entry.name)
                            inodes.append(told.st_ino)
                            changed.append(told.st_ctime_ns)
            finally:
                os.close(handle)
        order = sorted(range(len(names)), key=names.__getitem__)
        keys = np.array([inodes, changed], np.int64).T[order].reshape(-1, 2)
        return Listing([names[k] for k in order], keys, _stamp(sync_folder(campaign)))

    def settled(self, now_ns: int) -> I64:
        """The keys, with zeros for what changed just now."""
        keys = self.keys.copy()
        keys[keys[:, 1] > now_ns - FRESH_NS] = 0
        return keys


@dataclass
class Known:
    """The catalogue as it was, a row a trial, and from which folders it came."""

    table: pd.DataFrame
    names: list[str] = field(default_factory=list)
    keys: I64 = field(default_factory=lambda: np.empty((0, 2), np.int64))
    bounds: dict[str, tuple[int, int, str]] = field(default_factory=dict)
    """Of each campaign: its first row, its last but one, and its stamp of refitted clocks."""
    data: bytes = b""

    def rows(self) -> list[Json]:
        """What the table was made of."""
        return [json.loads(each) for each in self._column(_ROW)]

    def sync(self) -> list[str]:
        """What stands for each trial's refitted clocks."""
        return self._column(_SYNC)

    def _column(self, name: str) -> list[str]:
        if not self.data:
            return []
        found: list[str] = pq.read_table(io.BytesIO(self.data), columns=[name])[name].to_pylist()
        return found


def sync_folder(campaign: Campaign) -> Path:
    """Where the campaign's refitted clocks stand, if there are any."""
    return campaign.folder.parent.parent / "derived" / SYNC / campaign.name


def sync_key(campaign: Campaign, name: str) -> str:
    """What stands for the file with a trial's refitted clocks; empty where there is none."""
    return _stamp(sync_folder(campaign) / f"{name}.json", settled=True)


def _stamp(path: Path, settled: bool = False) -> str:
    try:
        told = path.stat()
    except OSError:
        return "none"
    if not settled and told.st_mtime_ns > time.time_ns() - FRESH_NS:
        return ""
    return f"{told.st_ino} {told.st_mtime_ns} {told.st_size}"


def _path(store: Store) -> Path:
    return store.folder / "derived" / "catalogue" / "index"


def read(store: Store) -> Known | None:
    """What is known; None where there is nothing that can be used."""
    try:
        whole = _path(store).read_bytes()
    except OSError:
        return None
    digest, data = whole[:32], whole[32:]
    return _parse(data) if hashlib.sha256(data).digest() == digest else None


def _parse(data: bytes) -> Known | None:
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
        return Known(frame, table[_NAME].to_pylist(), keys, bounds, data)
    except (ValueError, KeyError, TypeError, pa.ArrowException):
        return None


def write(
    store: Store, table: pd.DataFrame, rows: list[Json], sync: list[str], known: Known
) -> None:
    """Keep what is known now, where that can be written and read again as it is."""
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
        return  # something that Parquet cannot keep as it is: it will be read again each time
    with suppress(OSError):  # a store that is only read from
        path = _path(store)
        make_folder(path.parent)
        write_bytes(path, hashlib.sha256(data).digest() + data)
