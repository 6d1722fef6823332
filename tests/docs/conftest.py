"""A checkout to work in as the how-to guides do, with a store of two trials."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

# Prefect at home in a folder of the tests, before anything imports it
import tests.flows.conftest  # noqa: F401
from tests.conftest import ROOT

PACKAGES = ("protocols", "rigs", "storage", "analysis", "flows", "plugins")


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `checkout` copies."""
    from tests.docs.walk import run

    folder = tmp_path_factory.mktemp("checkout")
    for package in ("sliplab", *PACKAGES):  # with what is compiled already
        shutil.copytree(ROOT / package, folder / package)
    line = "sliplab collect protocols/pilot.yaml --rig rehearsal --store data --trials 2"
    done = run(line, folder)
    assert done.code == 0, done.said
    return folder


@pytest.fixture
def checkout(prepared: Path, tmp_path: Path) -> Path:
    """The packages and a store `data` that holds two trials of the pilot."""
    folder = tmp_path / "checkout"
    shutil.copytree(prepared, folder)
    (folder / "docs").symlink_to(ROOT / "docs")
    for package in PACKAGES:  # as an editable install of this checkout would find them
        (folder / "sliplab" / package).symlink_to(folder / package)
    return folder
