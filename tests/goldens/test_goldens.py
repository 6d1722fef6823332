"""A change that means to change nothing leaves these as they are.

`python -m tests.goldens.test_goldens` writes the fixtures again, where a change is meant.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path

import pytest

from tests.flows.conftest import Ran, run_small_study
from tests.goldens.made import (
    FIXTURES,
    answers,
    checksums,
    help_text,
    processor,
    rounded_to,
    study_of,
)


@pytest.fixture(autouse=True)
def width(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")


def test_help_of_every_command() -> None:
    assert help_text() == (FIXTURES / "help.txt").read_text()


def test_answers_to_programs(tmp_path: Path) -> None:
    expected = json.loads((FIXTURES / "answers.json").read_text())
    found = answers(tmp_path)
    assert list(found) == list(expected)
    for words, answer in expected.items():
        assert rounded_to(12, found[words]) == rounded_to(12, answer), words


def test_bytes_of_simulated_trials(tmp_path: Path) -> None:
    assert checksums(tmp_path) == json.loads((FIXTURES / "checksums.json").read_text())


def test_figures_and_report_of_the_small_study(ran: Ran) -> None:
    file = FIXTURES / f"study-{processor()}.json"
    if not file.exists():
        pytest.skip(f"another kind of processor trains another network: there is no {file.name}")
    expected, found = json.loads(file.read_text()), study_of(ran[0][0].store)
    for name in expected["summary"].keys() | found["summary"].keys():
        assert found["summary"].get(name) == expected["summary"].get(name), name
    assert found["page"] == expected["page"]


def main() -> None:
    """Write the fixtures."""
    os.environ["COLUMNS"] = "100"
    FIXTURES.mkdir(exist_ok=True)
    (FIXTURES / "help.txt").write_text(help_text())
    with tempfile.TemporaryDirectory() as folder:
        for name, found in (("answers", answers), ("checksums", checksums)):
            (Path(folder) / name).mkdir()
            text = json.dumps(found(Path(folder) / name), indent=1)
            (FIXTURES / f"{name}.json").write_text(f"{text}\n")
        (Path(folder) / "study").mkdir()
        (run_request, *_), _ = run_small_study(Path(folder) / "study", Path("rehearsal"))
        text = json.dumps(study_of(run_request.store), indent=1)
        (FIXTURES / f"study-{processor()}.json").write_text(f"{text}\n")


if __name__ == "__main__":
    sys.exit(main())
