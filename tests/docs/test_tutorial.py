"""The tutorial runs as it is printed."""

from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.docs.walk import walk


def test_the_tutorial_runs_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # a dozen trials in this process: starting others would take most of the test's time
    monkeypatch.setattr("flows.running.trial_work.FEW", 12)
    assert walk(ROOT / "docs" / "tutorial.md", tmp_path) == 17
