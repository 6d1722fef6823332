"""Disk space that stays free, and the check before a campaign that its trials fit."""

from __future__ import annotations

import shutil
from pathlib import Path

from sliplab.protocols import InputError

RESERVE = 200_000_000
"""Bytes that must stay free: other programs use the disk, too."""


def check_space(folder: Path, needed: float) -> int:
    """Return the free bytes where `folder` is or will be.

    Raises:
        InputError: `needed` and a reserve do not fit.
    """
    there = folder.resolve()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free
    if needed + RESERVE > free:
        raise InputError(
            "--store",
            "",
            str(folder),
            f"the plan needs {needed / 1e9:.1f} GB and {RESERVE / 1e9:.1f} GB in reserve, the disk "
            f"has {free / 1e9:.1f} GB free; free space or choose another folder",
        )
    return free
