"""A store that SlipLab 0.1.0 made, when the five packages were top-level ones.

Four labelled slides, a network and a report:
``sliplab study store --protocol small.yaml --rig rehearsal --check-labels 0``.
"""

from __future__ import annotations

import tarfile
from pathlib import Path

_ARCHIVE = Path(__file__).parent / "fixtures" / "store-0.1.0.tar.xz"


def older_store(folder: Path) -> Path:
    """Unpack the store into `folder`, which it makes."""
    with tarfile.open(_ARCHIVE) as archive:
        archive.extractall(folder, filter="data")
    return folder
