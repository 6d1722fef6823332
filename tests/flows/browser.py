"""Debian's Chromium for tests of pages; without it or playwright they are skipped."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import pytest

_CHROMIUM = "/usr/bin/chromium"
_ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
needs_browser = pytest.mark.skipif(
    not (shutil.which(_CHROMIUM) and find_spec("playwright")),
    reason=f"no browser at {_CHROMIUM} (Debian's package chromium), or no playwright",
)
PATIENCE_MS = 30_000


def expect(*what: Any) -> Any:
    """Playwright's own, imported where a page is looked at: most workers have none."""
    from playwright import sync_api

    return sync_api.expect(*what)


@contextmanager
def launched() -> Iterator[Any]:
    """Chromium, which finds nobody outside this computer."""
    from playwright import sync_api

    sync_api.expect.set_options(timeout=PATIENCE_MS)
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=_CHROMIUM, args=list(_ARGUMENTS))
        yield browser
        browser.close()
