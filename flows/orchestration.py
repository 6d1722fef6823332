"""Prefect as this project runs it: embedded by default, at home in the store, silent off-line.

`prepare` must run before Prefect is imported, because Prefect reads its settings then. A server
that the user names with PREFECT_API_URL is used instead of the embedded one.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Generic, TypeVar

T = TypeVar("T")


class Parcel(Generic[T]):
    """Carries any object into a flow or task without Prefect validating, walking or storing it."""

    def __init__(self, content: T) -> None:
        self.content = content


_DEFAULTS = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_ALLOW_EPHEMERAL_MODE": "true",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    "PREFECT_RESULTS_PERSIST_BY_DEFAULT": "false",
    "PREFECT_CLI_PROMPT": "false",
}


def prepare(store: Path) -> None:
    """Point Prefect at the store's own home, unless the user has set one; the store must exist."""
    home = store.resolve() / ".prefect"
    home.mkdir(exist_ok=True)
    os.environ.setdefault("PREFECT_HOME", str(home))
    for name, value in _DEFAULTS.items():
        os.environ.setdefault(name, value)
