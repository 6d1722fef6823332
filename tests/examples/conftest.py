"""The example packages: importable from their folders, or installed as a lab would."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.conftest import ROOT

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
            **os.environ, "PYTHONPATH": str(site), "SLIPLAB_RUNTIME": str(folder / "runtime"),
        }  # fmt: skip
        self._call(sys.executable, "-m", "pip", "install", *_OFFLINE, "--target", site, source)

    def __call__(self, *words: str) -> Any:
        """Run a command of SlipLab; what it prints as JSON."""
        return json.loads(self._call(sys.executable, "-m", "sliplab", *words, "--json"))

    def python(self, code: str) -> str:
        """Run Python there; what it prints."""
        return self._call(sys.executable, "-c", code)

    def _call(self, *words: object) -> str:
        done = subprocess.run(
            [str(word) for word in words], cwd=self.folder, env=self._environment,
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
