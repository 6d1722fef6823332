"""Rules of the house that no single test sees."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGES = ("protocols", "rigs", "storage", "analysis", "flows")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def test_only_error_reports_read_the_simulations_truth() -> None:
    """Stored by the session, handed on by the recording, read where label errors are reckoned."""
    readers = {
        path.relative_to(ROOT).as_posix()
        for path in SOURCES
        if "simulation_truth" in path.read_text()
    }
    assert readers == {
        "flows/collecting/session.py",
        "storage/trials/recording.py",
        "storage/schema/trial.py",
        "analysis/labels/label_errors.py",
        "flows/ui/view.py",  # drawn beside the label, and called simulated
    }


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_every_module_and_public_name_says_what_it_is_for(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree), "no module docstring"
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{node.name} has no docstring"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_time_is_passed_by_sleeping(path: Path) -> None:
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    named = {getattr(call.func, "attr", getattr(call.func, "id", "")) for call in calls}
    assert "sleep" not in named
