"""Shared by all tests: where the shipped files are, and small protocols to change."""

from __future__ import annotations

import atexit
import copy
import ctypes
import functools
import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Generator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import typer.main
import yaml
from hypothesis import settings

from tests.patching import loose

ROOT = Path(__file__).parents[1]
settings.register_profile("sliplab", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("sliplab")

MEMORY, ROOM_GB = Path("/dev/shm"), 16

# what one worker or program has compiled, the others need not
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def _write_in_memory() -> None:
    """Keep what tests write in memory, where there is room: a disk must answer each fsync.

    The workers of pytest-xdist inherit the folder, which goes with the process that made it. With
    ``TMPDIR`` given it is there instead, and files of tests that failed stay.
    """
    if "TMPDIR" in os.environ or not MEMORY.is_dir():
        return
    if shutil.disk_usage(MEMORY).free < ROOM_GB * 2**30:
        return
    folder = tempfile.mkdtemp("", "", MEMORY)  # short: names of sockets have a limit
    os.chmod(folder, 0o755)  # PostgreSQL runs as a user of its own
    os.environ["TMPDIR"] = tempfile.tempdir = folder  # pytest has asked for the folder before
    atexit.register(shutil.rmtree, folder, ignore_errors=True)


_write_in_memory()
# tests that run at the same time have stand-ins of their own, at the same addresses
os.environ["SLIPLAB_RUNTIME"] = tempfile.mkdtemp(prefix="sliplab-rigs-")
atexit.register(shutil.rmtree, os.environ["SLIPLAB_RUNTIME"], ignore_errors=True)

# commands run in this process: their signatures are read once, not again for each command
typer.main.get_params_from_function = functools.cache(typer.main.get_params_from_function)

SHARED = {"ran", "served"}
"""Fixtures that several files use and that take long to make."""
SMALL: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "pilot.yaml").read_text())


@pytest.fixture(scope="session")
def rig_path() -> Path:
    """The shipped rig for rehearsals: tracks in place of videos, which take most of the time."""
    return ROOT / "rigs" / "rehearsal.yaml"


@pytest.fixture(scope="session")
def ran(tmp_path_factory: pytest.TempPathFactory, rig_path: Path) -> Any:
    """Both small campaigns, run once through every step; who changes the store puts it back."""
    from tests.flows.conftest import run_small_study

    return run_small_study(tmp_path_factory.mktemp("study"), rig_path)


@pytest.fixture(scope="module")
def own_study(ran: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A copy of the small study, which a module may change."""
    from sliplab.storage.trials.store import TrialStore

    return TrialStore.open(
        shutil.copytree(ran[0][0].store, tmp_path_factory.mktemp("own") / "store")
    )


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Test networks are too small to share: beside other work, waiting threads cost the most."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import files without the mark that ``-m 'MARK and ...'`` requires."""
    mark = config.option.markexpr.split(" and ")[0]
    if mark not in {"realtime", "programs"} or collection_path.suffix != ".py":
        return None
    return f"mark.{mark}" not in collection_path.read_text() or None


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep the tests of a file, and all files that use one study or service, in one worker.

    What they share is made once then. Tests in real time name their groups themselves.
    """
    _leave_further_cases(items)
    shared = {
        item.path: name
        for item in items
        for name in SHARED.intersection(getattr(item, "fixturenames", ()))
    }
    for item in items:
        if item.get_closest_marker("realtime") is None:
            group = shared.get(item.path, str(item.path))
            item.add_marker(pytest.mark.xdist_group(group))


def _leave_further_cases(items: list[pytest.Item]) -> None:
    """Of a test with the mark ``quick(n)``, mark all but `n` cases as long."""
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("quick") is not None:
            cases.setdefault(item.nodeid.split("[")[0], []).append(item)
    for found in cases.values():
        (few,) = loose(found[0].get_closest_marker("quick")).args
        for number, item in enumerate(found):
            if number * few % len(found) >= few:
                item.add_marker(pytest.mark.long)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any, ids: list[str]) -> None:
    """Stop where pytest-xdist has not put the groups behind the tests' names, as it reads them."""
    grouped = any(_without_group(name) != name for name in ids)
    if node.config.option.dist == "loadgroup" and ids and not grouped:
        pytest.exit("pytest-xdist cannot group tests under this pytest: install pytest<9.2", 3)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Keep what failed by its name without the group, as `--last-failed` looks for it."""
    if hasattr(report, "node"):  # from a worker
        report.nodeid = _without_group(report.nodeid)


def _without_group(name: str) -> str:
    at = name.rfind("@")
    return name[:at] if at > name.rfind("]") else name  # one in brackets is a parameter's


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Spare the collector all that is imported: what tests leave behind goes at once then.

    With a million objects to look through it comes so rarely that a worker grows to gigabytes.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.collect()
        gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Give freed memory back after each file: the C library keeps gigabytes of it otherwise."""
    if nextitem is not None and nextitem.path == item.path:
        return
    with suppress(OSError, AttributeError):  # another C library keeps less, or cannot be asked
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture
def small() -> dict[str, Any]:
    """The pilot protocol as data, to be changed at will."""
    return copy.deepcopy(SMALL)
