"""The tutorial runs as it is printed."""

from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.docs.walk import walk

pytestmark = pytest.mark.programs


def test_the_tutorial_runs_as_printed(tmp_path: Path) -> None:
    assert walk(ROOT / "docs" / "tutorial.md", tmp_path) == 17
