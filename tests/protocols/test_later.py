"""Optional packages are imported when they are used, and are named when they are missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from sliplab.protocols.later import Later, installed, need

LOADED = """
import sys
from sliplab.protocols.later import Later
wave = Later("wave")
assert "wave" not in sys.modules
assert wave.open is __import__("wave").open
"""


def test_a_module_is_loaded_at_its_first_use() -> None:
    assert subprocess.run([sys.executable, "-c", LOADED], timeout=60, check=False).returncode == 0


def test_missing_modules_are_named_when_they_are_used() -> None:
    absent = Later("sliplab_has_no_such_module")
    assert not installed("sliplab_has_no_such_module")
    for use in (lambda: absent.open, lambda: need("sliplab_has_no_such_module")):
        with pytest.raises(ModuleNotFoundError) as found:
            use()
        assert found.value.name == "sliplab_has_no_such_module"


def test_modules_keep_their_own_errors() -> None:
    assert installed("json")
    need("json")
    with pytest.raises(AttributeError, match="json"):
        _ = Later("json").nothing
