"""Rules of the house that no single test sees."""

from __future__ import annotations

import ast

import pytest

from tests.conftest import ROOT

PACKAGES = ("protocols", "rigs", "storage", "analysis", "flows", "plugins")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def test_only_error_reports_read_the_simulations_truth() -> None:
    """Stored by the session, handed on by the recording, read where label errors are reckoned."""

    def named_in(name: str) -> set[str]:
        return {p.relative_to(ROOT).as_posix() for p in SOURCES if name in p.read_text()}

    assert named_in("simulation_truth") == {
        "flows/collecting/session.py",
        "storage/trials/recording.py",
        "storage/schema/trial.py",
        "analysis/labels/label_errors.py",
        "plugins/view/view.py",  # drawn beside the label, and called simulated
    }
    assert named_in("true_onset_ns") == {
        "analysis/labels/label_errors.py",
        "analysis/detectors/onset_references.py",  # judges decisions that are made
    }


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    """Syntax trees of all sources, by their place in the checkout."""
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in SOURCES}


def test_every_module_and_public_name_says_what_it_is_for(trees: dict[str, ast.Module]) -> None:
    assert [name for name, tree in trees.items() if not ast.get_docstring(tree)] == []
    silent = [
        f"{name}: {node.name}"
        for name, tree in trees.items()
        for node in tree.body
        if isinstance(node, (ast.FunctionDef, ast.ClassDef))
        if not node.name.startswith("_") and not ast.get_docstring(node)
    ]
    assert silent == []


def test_no_time_is_passed_by_sleeping(trees: dict[str, ast.Module]) -> None:
    sleeping = [
        name
        for name, tree in trees.items()
        for call in ast.walk(tree)
        if isinstance(call, ast.Call)
        if getattr(call.func, "attr", getattr(call.func, "id", "")) == "sleep"
    ]
    assert sleeping == []
