"""Tables as other programs write them."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.data_folder import DataFolder
from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.formats.tables import read_columns, rows_of_csv, table_text


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_with_and_without_a_byte_order_mark_is_read(encoding: str) -> None:
    columns, rows = rows_of_csv(
        "t.csv", table_text("t.csv", "t_µs;skin\n1;Haut ü\n".encode(encoding))
    )
    assert columns == ["t_µs", "skin"]
    assert rows[0].values == {"t_µs": "1", "skin": "Haut ü"}


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (gzip.compress(b"t\n1\n", mtime=0), "save it as CSV"),
        (b"PK\x03\x04", "save it as CSV"),
        ("t\nü\n".encode("latin-1"), "byte 2: is not UTF-8"),
        (b"t\n\x00\n", "byte 2: is no text"),
    ],
)
def test_what_is_no_text_is_named(data: bytes, said: str) -> None:
    with pytest.raises(InputError, match=said):
        table_text("t.csv", data)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (gzip.compress(b"t\n1\n", mtime=0), "is a workbook or compressed: save it as CSV"),
        ("t,x\n1,2\n".encode("utf-16"), "is UTF-16 text: save it as UTF-8"),
        (b"t,x\r1,2\r", "has lines that end in CR alone"),
        (b"t,x\n\x00\n", "is no text"),
        (b"", "is empty; its first line names the columns"),
        (b" \r\n", "is empty; its first line names the columns"),
    ],
)
def test_what_is_no_long_table_is_named(data: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(data)
    with pytest.raises(FormatError, match=said):
        read_columns(DataFolder(tmp_path), "a.csv", "csv", {"t": "t"})


def test_lines_that_end_in_cr_are_named_in_a_small_table() -> None:
    with pytest.raises(InputError, match="has lines that end in CR alone"):
        rows_of_csv("t.csv", "t,x\r1,2\r")
