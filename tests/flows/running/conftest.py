"""These tests are about Prefect: their flows run on a server."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module", autouse=True)
def on_a_server(prefect_server: None) -> None:
    """As `prefect_server`."""
