"""Tells a running collection to stop. Loads next to nothing: the arm moves meanwhile."""

from __future__ import annotations

import signal
from pathlib import Path

from sliplab.storage.process import send
from sliplab.storage.streams import Json
from sliplab.storage.trials.lock import STORE_LOCK, Locked, exclusive


def holder_of(folder: Path) -> Json | None:
    """Who has the lock of the store in `folder`, None if nobody has."""
    try:
        with exclusive(folder / STORE_LOCK, "the store", brief=True):
            return None
    except Locked as error:
        return error.holder


def halt(folder: Path) -> tuple[Json | None, bool]:
    """Signal whoever collects into the store in `folder`.

    Returns:
        Who has the store, None if nobody has; and whether a signal reached a collection. It reaches
        none on another host, or of another user, and is never sent to what does not collect.
    """
    holder = holder_of(folder)
    if holder is None or not holder.get("collects"):
        return holder, False
    return holder, send(holder, signal.SIGTERM)
