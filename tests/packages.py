"""Packages that tests install by what an installer writes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path


def write_metadata(
    site: Path, name: str, points: Mapping[str, Mapping[str, str]], version: str = "1.0"
) -> None:
    """Write what Python reads of an installed package.

    Args:
        points: its entry points by group: name and place.
    """
    info = site / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [
        line
        for group, known in points.items()
        for line in (f"[{group}]", *(f"{point} = {place}" for point, place in known.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines))
