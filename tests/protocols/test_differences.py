"""Differences of plain data: key, old and new value, with secrets masked."""

from __future__ import annotations

from sliplab.protocols.differences import MOST_CHANGES, differences, format_differences


def test_differences_name_key_old_and_new() -> None:
    old = {"a": 1, "b": [{"c": 1}, {"c": 2}], "d": [1, 2], "e": {"f": 1}, "g": None}
    new = {"a": 1, "b": [{"c": 1}, {"c": 3}, {"c": 4}], "d": [1, 3], "h": {"i": 1}, "g": 2}
    assert list(differences(old, new)) == [
        ("b[1].c", "2", "3"),
        ("b[2]", "not there", "{c: 4}"),
        ("d", "[1, 2]", "[1, 3]"),
        ("e", "{f: 1}", "not there"),
        ("g", "null", "2"),
        ("h", "not there", "{i: 1}"),
    ]
    assert format_differences(old, old) == ""
    many = {str(number): number for number in range(MOST_CHANGES + 3)}
    assert format_differences(many, {}).endswith("\n  and 3 more")


def test_a_changed_secret_is_masked() -> None:
    old, new = ({"arm": {"password": word, "port": 1}} for word in ("hunter2", "hunter3"))
    assert format_differences(old, new) == "\n  arm.password: **** -> ****"
    assert (
        format_differences({}, {"arm": new["arm"]})
        == "\n  arm: not there -> {password: ****, port: 1}"
    )
