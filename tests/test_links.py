"""Links in `.links` show the packages as they are installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.conftest import ROOT


def test_links_show_every_package_and_file() -> None:
    links = {path.name: path.resolve() for path in (ROOT / ".links" / "sliplab").iterdir()}
    top = {path.name: path for path in (ROOT / "sliplab").iterdir() if path.is_file()}
    below = {
        name: ROOT / name
        for name in ("protocols", "storage", "rigs", "analysis", "flows", "plugins")
    }
    links.pop("__pycache__", None)
    assert links == top | below


def test_clone_called_sliplab_in_the_working_folder_hides_nothing(tmp_path: Path) -> None:
    """Python's path of an editable install, without its packages."""
    (tmp_path / "sliplab").symlink_to(ROOT)
    links = str(ROOT / ".links")
    code = f"import sys; sys.path += [{links!r}]; import sliplab; print(sliplab.__file__)"
    done = subprocess.run(
        [sys.executable, "-S", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(ROOT / ".links" / "sliplab" / "__init__.py")


def test_packages_are_found_from_the_root_of_a_checkout() -> None:
    code = (
        "import sys; sys.path.insert(0, ''); import sliplab.protocols.units as u; print(u.TABLE[0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "mm" in done.stdout
