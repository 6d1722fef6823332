"""The drivers of the example packages keep the rules for drivers, on their fakes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from sliplab_prophesee import DRIVER, PropheseeSettings

from sliplab.testing import conformance
from tests.examples.conftest import EXAMPLES

pytestmark = pytest.mark.realtime
LIMIT_S = 120

test_prophesee = conformance(DRIVER, PropheseeSettings(source="stream", stall_s=0.4))


@pytest.mark.programs
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
