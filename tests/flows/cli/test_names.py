"""Names that no file or store can have: one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.storage.trials.store import NoStore, TrialStore
from tests.command_line import here

LONG = "k" * 300
URL = "is a URL, not a folder; give a folder, then `sliplab push"


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


def test_a_folder_in_place_of_a_file_is_wrong_input(tmp_path: Path) -> None:
    done = here("schema", "protocol", "--out", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"{tmp_path}: is a folder; give a file" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("command", ["collect", "check", "register"])
def test_a_url_is_no_folder_of_a_store(
    command: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    rig = () if command == "register" else ("--rig", "mock")
    done = here(command, "pilot", *rig, "--store", "s3://bucket/store")
    assert done.returncode == 2, done.stderr
    assert URL in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_store_is_not_created_at_a_url(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NoStore, match=URL):
        TrialStore.create(Path("s3://bucket/store"))
    assert list(tmp_path.iterdir()) == []
