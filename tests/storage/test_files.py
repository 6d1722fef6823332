"""The project's own JSON writer produces the same text as the standard library."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.storage.errors import StoreError
from sliplab.storage.files import json_text, read_json, read_plain, safe_name, write_json

LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
FINITE = LEAVES.filter(lambda value: value not in (float("inf"), float("-inf")))
TREES = st.recursive(
    FINITE,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(st.text(), inner, max_size=4)
        | st.dictionaries(st.integers(), inner, max_size=4)
    ),
    max_leaves=30,
)


@given(data=TREES)
def test_json_is_that_of_the_standard_library(data: object) -> None:
    expected = json.dumps(data, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False)
    assert json_text(data) == expected + "\n"


def test_json_comes_back(tmp_path: Path) -> None:
    data = {"b": [1, 2.5, {"c": []}], "a": {"ä": None}}
    write_json(tmp_path / "a.json", data)
    assert read_json(tmp_path / "a.json") == data


@pytest.mark.parametrize("bad", [float("nan"), [1.0, float("inf")], {"a": {"b": [float("nan")]}}])
def test_json_has_no_word_for_these(bad: object) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        json_text(bad)


@pytest.mark.parametrize("text", ["1e999", "-1e999", "NaN", "Infinity", "[1e400]"])
def test_no_file_brings_in_what_no_file_may_hold(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(f'{{"a": {text}}}')
    with pytest.raises(ValueError, match=r"a\.json: is not JSON: .*number"):
        read_json(path)


def test_only_a_regular_file_of_bounded_size_is_read_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    path.write_bytes(b"12345")
    assert read_plain(path) == b"12345"
    with pytest.raises(OSError, match="over 0 MiB"):
        read_plain(path, most=4)
    os.mkfifo(tmp_path / "pipe")
    for wrong in (Path("/dev/zero"), tmp_path / "pipe"):
        for read in (read_plain, read_json):
            with pytest.raises(OSError, match="not a regular file"):
                read(wrong)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("x" * 252, "'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx... (252 characters)' cannot"),
        (".x", "'.x' cannot be"),
        ("a..b", "'a..b' cannot be"),
        ("a/b", "'a/b' cannot be"),
    ],
)
def test_every_rule_of_a_name_is_in_its_message(name: str, said: str) -> None:
    assert safe_name("x" * 251) == "x" * 251
    with pytest.raises(StoreError) as caught:
        safe_name(name)
    assert said in str(caught.value)
    assert "up to 251 letters, digits and . _ - = , + without two points in a row" in str(
        caught.value
    )
    assert "a letter or digit is the first" in str(caught.value)
