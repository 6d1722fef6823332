"""Versions of the installed packages that recorded data and figures depend on."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version

RECORDING = ("sliplab", "numpy", "numba", "h5py", "hdf5plugin", "av")
"""Packages that record trials."""
FIGURES = (
    "sliplab",
    "numpy",
    "numba",
    "scipy",
    "torch",
    "sinabs",
    "prefect",
    "pandas",
    "h5py",
    "opencv-contrib-python-headless",
    "scikit-learn",
)
"""Packages that compute figures."""


def installed_versions(names: Iterable[str]) -> dict[str, str]:
    """Return the version of each package that is installed, by name."""
    found = {}
    for name in names:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
