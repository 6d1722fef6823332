"""Compiled kernels are kept on disk, and compiled again when anything changes that is in them."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from sliplab.storage import kernels

CALLER = """
from sliplab.storage.kernels import njit
from sliplab.made_callee import FACTOR, twice
@njit(cache=True)
def made(x):
    return FACTOR * twice(x)
"""
CALLEE = """
from sliplab.storage.kernels import njit
from sliplab.made_constants import BASE
FACTOR = {factor}
@njit(cache=True)
def twice(x):
    return {twice} * x + BASE
"""


def load(folder: Path, name: str, text: str) -> ModuleType:
    """Write a module of the package and run it anew, as another program would."""
    module = ModuleType(f"sliplab.{name}")
    module.__file__ = str(folder / f"{name}.py")
    Path(module.__file__).write_text(text)
    sys.modules[module.__name__] = module
    exec(compile(text, module.__file__, "exec"), module.__dict__)
    return module


def run(folder: Path, *, factor: int = 1, twice: int = 2, base: int = 0) -> tuple[int, int]:
    """Return what the caller gives of 10, and how many kernels came from disk."""
    kernels._folder.cache_clear()
    load(folder, "made_constants", f"BASE = {base}\n")
    callee = load(folder, "made_callee", CALLEE.format(factor=factor, twice=twice))
    caller = load(folder, "made_caller", CALLER)
    result = caller.made(10)
    callee.twice(10)
    kept = [sum(it.stats.cache_hits.values()) for it in (caller.made, callee.twice)]
    return result, sum(kept)


@pytest.fixture(autouse=True)
def _as_of_another_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield
    for name in [name for name in sys.modules if name.startswith("sliplab.made_")]:
        del sys.modules[name]


def test_a_kernel_is_compiled_again_when_another_file_changes(tmp_path: Path) -> None:
    assert run(tmp_path) == (20, 0)
    assert run(tmp_path) == (20, 2)
    assert run(tmp_path, twice=3) == (30, 0)
    assert run(tmp_path, factor=5) == (100, 0)
    # a constant two files away
    assert run(tmp_path, base=1) == (21, 0)
    assert run(tmp_path, base=1) == (21, 2)


def test_another_checkout_takes_what_one_has_compiled(tmp_path: Path) -> None:
    for name, kept in (("one", 0), ("other", 2)):
        (tmp_path / name).mkdir()
        assert run(tmp_path / name) == (20, kept)
    assert sorted(it.name for it in tmp_path.iterdir() if it.name != "cache") == ["one", "other"]
    assert not list(tmp_path.glob("o*/__pycache__"))


def test_kernels_that_nobody_uses_are_deleted(tmp_path: Path) -> None:
    for twice in (2, 3):
        run(tmp_path, twice=twice)
    folders = {it.name for it in (tmp_path / "cache/sliplab/kernels").iterdir()}
    assert len(folders) == 4
    for folder in (tmp_path / "cache/sliplab/kernels").iterdir():
        os.utime(folder, (0, time.time() - kernels._KEPT_S - 60))
    assert run(tmp_path, twice=2) == (20, 2)
    left = {it.name for it in (tmp_path / "cache/sliplab/kernels").iterdir()}
    assert len(left) == 2
    assert left < folders
    assert {name.rpartition("-")[0] for name in left} == {
        "sliplab.made_callee",
        "sliplab.made_caller",
    }


def test_a_folder_that_is_named_keeps_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "named"))
    assert run(tmp_path) == (20, 0)
    assert run(tmp_path) == (20, 2)
    assert not (tmp_path / "cache").exists()
    assert len(list((tmp_path / "named").glob("sliplab.made_*"))) == 2


def test_a_user_without_a_place_keeps_them_beside_the_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert run(tmp_path) == (20, 0)
    assert run(tmp_path) == (20, 2)
    assert len(list((tmp_path / "__pycache__").glob("sliplab.made_*"))) == 2
