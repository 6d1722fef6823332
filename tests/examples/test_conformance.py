"""The package of the guide for drivers keeps the rules for drivers by its own test."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.examples.conftest import EXAMPLES

pytestmark = [pytest.mark.realtime, pytest.mark.long]
LIMIT_S = 120


def test_the_lab_plugin_by_its_own_test() -> None:
    package = EXAMPLES / "lab-plugin"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull, "tests"],
        cwd=package,
        env={**os.environ, "PYTHONPATH": str(package)},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert done.returncode == 0, done.stdout
    assert "44 passed, 1 skipped" in done.stdout  # the stage cannot turn its tool
