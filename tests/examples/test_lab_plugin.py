"""A package of somebody else's: installed, found, and a campaign run with nothing but its files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT

pytestmark = pytest.mark.programs
PLUGIN = ROOT / "examples" / "lab-plugin"
_OFFLINE = ("--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--no-compile")
LIMIT_S = 420


class Lab:
    """A computer with SlipLab and the package, and a folder with the package's two YAML files."""

    def __init__(self, folder: Path) -> None:
        self._folder, site, source = folder / "work", folder / "site", folder / "source"
        shutil.copytree(PLUGIN, source)  # a build leaves files beside what it builds
        self._folder.mkdir()
        for name in ("rig.yaml", "protocol.yaml"):
            shutil.copy(PLUGIN / name, self._folder)
        self._environment = {
            **os.environ, "PYTHONPATH": str(site), "SLIPLAB_RUNTIME": str(folder / "runtime"),
        }  # fmt: skip
        self._call(sys.executable, "-m", "pip", "install", *_OFFLINE, "--target", site, source)

    def __call__(self, *words: str) -> Any:
        """Run a command of SlipLab; what it prints as JSON."""
        return json.loads(self._call(sys.executable, "-m", "sliplab", *words, "--json"))

    def _call(self, *words: object) -> str:
        done = subprocess.run(
            [str(word) for word in words], cwd=self._folder, env=self._environment,
            capture_output=True, text=True, timeout=LIMIT_S,
        )  # fmt: skip
        assert done.returncode == 0, f"{words}\n{done.stdout}{done.stderr}"
        return done.stdout


def checkout() -> str:
    """State of the checkout, with untracked and ignored files, but for what Python leaves."""
    status = subprocess.run(
        ["git", "status", "--porcelain", "--ignored"], cwd=ROOT, capture_output=True, text=True,
        check=True,
    ).stdout  # fmt: skip
    left = ("__pycache__", ".pytest_cache", ".hypothesis", "build/", ".egg-info", "_cache/")
    return "\n".join(line for line in status.splitlines() if not any(x in line for x in left))


def test_a_package_outside_the_checkout_runs_a_campaign(tmp_path: Path) -> None:
    before = checkout()
    sliplab = Lab(tmp_path)

    drivers = {found["name"]: found for found in sliplab("rigs", "--drivers")["drivers"]}
    for name in ("lab_stage", "lab_camera"):
        assert drivers[name]["package"] == "lab-plugin 0.1.0"
        assert drivers[name]["simulated_on_loopback"]
    (rig,) = sliplab("rigs", "rig.yaml")["rigs"]
    assert rig["arm"] == "Lab stage, fake"
    assert rig["cameras"].startswith("Lab camera")

    on = ("protocol.yaml", "--rig", "rig.yaml", "--store", "store")
    checks = sliplab("check", *on)["checks"]
    assert all(check["passed"] for check in checks), checks
    found = " ".join(check["finding"] for check in checks)
    assert "stage-3-fake" in found
    assert "lab camera" in found

    taken = sliplab("collect", *on)
    assert (taken["planned"], taken["committed"]) == (4, 4)
    assert taken["simulated"] is True
    trials = sliplab("trials", "store", "--where", "suction_kPa > 10")["trials"]
    assert len(trials) == 2
    assert all("depth=2.3876mm" in trial["trial"] for trial in trials)  # 94 mil

    assert sliplab("label", "store")["done"] == 4
    for step in ("train", "evaluate", "report"):
        sliplab(step, "store")
    page = tmp_path / "work" / "store" / "report" / "index.html"
    assert "simulated" in page.read_text()
    assert checkout() == before
