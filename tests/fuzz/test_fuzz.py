"""A short `python -m tests.fuzz`, in processes of its own."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT

pytestmark = pytest.mark.programs


@pytest.mark.parametrize("files", [500, pytest.param(1500, marks=pytest.mark.long)])
def test_a_short_fuzz_test(files: int) -> None:
    options = ["--files", str(files), "--seed", "3", "--jobs", "1"]
    command = [sys.executable, "-m", "tests.fuzz", *options]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False
    )
    found = json.loads(done.stdout)
    assert found["wrong"] == []
    assert done.returncode == 0
    assert sum(sum(counts.values()) for counts in found["outcomes"].values()) == files
