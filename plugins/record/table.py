"""Kinds of stream with columns that are only known at run time, and their chunks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sliplab.protocols.errors import InputError
from sliplab.storage.streams import (
    MOST_COLUMNS,
    SCALAR,
    STREAM_NAME,
    Chunk,
    Column,
    ScalarChunk,
    StreamKind,
    chunk_type,
)

TIMES = ("t", "host")
PULSES = ("state", "harp", "id")
"""Columns of a stream that sees pulses: a line's levels, a Harp clock's levels, or barcodes."""
MOST_NS = 2**62
"""Times beyond are none: the difference of two would not fit into int64."""


def table_kind(columns: Mapping[str, str]) -> StreamKind:
    """Return the kind of a stream of numbers.

    Args:
        columns: the unit of each, by its name.

    Raises:
        InputError: there is none, or too many; a name is no small identifier, or the times have it.
    """
    for name in columns or ("",):
        if not STREAM_NAME.fullmatch(name) or name in TIMES:
            text = f"a column's name must match {STREAM_NAME.pattern}, and be neither t nor host"
            raise InputError("columns", "", name, text)
    if len(columns) > (most := MOST_COLUMNS - 3):  # with the times
        raise InputError("columns", "", len(columns), f"must be {most} at most")
    values = {name: Column(name, "float64", (), unit) for name, unit in columns.items()}
    return StreamKind("table", {name: SCALAR.columns[name] for name in TIMES} | values)


def rows(kind: StreamKind, unit: str, arrays: Mapping[str, Any]) -> Chunk:
    """Return rows as a chunk of a kind.

    Args:
        unit: of a scalar stream. arrays: values by the column's stored name.
    """
    cast = {name: np.asarray(arrays[name], column.dtype) for name, column in kind.columns.items()}
    if kind == SCALAR:
        return ScalarChunk.from_columns(cast, unit=unit)
    return chunk_type(kind).from_columns(cast)
