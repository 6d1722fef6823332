"""Tables as other programs write them."""

from __future__ import annotations

import gzip

import pytest

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.tables import rows_of_csv, table_text


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
