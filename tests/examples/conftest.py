"""The example packages: importable from their folders, or installed as a lab would."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.command_line import MANY
from tests.conftest import ROOT
from tests.packages import write_metadata

EXAMPLES = ROOT / "examples"
sys.path.append(str(EXAMPLES / "prophesee"))
_OFFLINE = ("--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--no-compile")
LIMIT_S = 420


class Lab:
    """A computer with SlipLab and a package, and a folder with the package's two YAML files."""

    def __init__(self, folder: Path, package: str) -> None:
        self.folder, site, source = folder / "work", folder / "site", folder / "source"
        shutil.copytree(EXAMPLES / package, source)  # a build leaves files beside what it builds
        self.folder.mkdir()
        for name in ("rig.yaml", "protocol.yaml"):
            shutil.copy(source / name, self.folder)
        self._environment = {
            **os.environ,
            "PYTHONPATH": str(site),
            "SLIPLAB_RUNTIME": str(folder / "runtime"),
        }
        self._call(sys.executable, "-m", "pip", "install", *_OFFLINE, "--target", site, source)

    def __call__(self, *commands: Sequence[str]) -> list[Any]:
        """Run commands of SlipLab in one process; what each prints as JSON."""
        wanted = json.dumps([[*words, "--json"] for words in commands])
        found = []
        for words, (code, out, said) in zip(
            commands, json.loads(self._call(sys.executable, "-c", MANY, wanted)), strict=True
        ):
            assert code == 0, f"{words}\n{out}{said}"
            found.append(json.loads(out))
        return found

    def _call(self, *words: object) -> str:
        done = subprocess.run(
            [str(word) for word in words],
            cwd=self.folder,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
        assert done.returncode == 0, f"{words}\n{done.stdout}{done.stderr}"
        return done.stdout


def install(package: str, site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a package by what an installer writes, for one test."""
    project = tomllib.loads((EXAMPLES / package / "pyproject.toml").read_text())["project"]
    write_metadata(site, package, project["entry-points"], "0.1.0")
    for folder in (site, EXAMPLES / package):
        monkeypatch.syspath_prepend(str(folder))


def checkout() -> str:
    """State of the checkout, with untracked and ignored files, but for what Python leaves."""
    status = subprocess.run(
        ["git", "status", "--porcelain", "--ignored"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    left = ("__pycache__", ".pytest_cache", ".hypothesis", "build/", ".egg-info", "_cache/")
    return "\n".join(line for line in status.splitlines() if not any(x in line for x in left))
