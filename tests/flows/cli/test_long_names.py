"""File names that no file can have: one line, exit code 2."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.command_line import here

LONG = "k" * 300


@pytest.mark.parametrize(
    "words",
    [
        ("plan", LONG),
        ("plan", "pilot", "--rig", LONG),
        ("verify", LONG),
        ("trials", LONG),
        ("report", LONG),
        ("import", LONG, "--store", "s", "--name", "a"),
        ("detect", "--rig", "mock", "--model", LONG),
        ("schema", "protocol", "--out", LONG),
        ("collect", "pilot", "--rig", "mock", "--store", f"x/{LONG}"),
        ("bench", f"{LONG}.onnx"),
    ],
    ids=" ".join,
)
def test_a_name_that_is_too_long_is_wrong_input(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    done = here(*words)
    assert done.returncode == 2, done.stderr
    last = done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert "too long" in last or "no such file" in last or "not one of the shipped" in last
