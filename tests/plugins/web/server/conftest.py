"""A service that serves the tests of several files: each takes half a minute to start."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.conftest import ROOT
from tests.flows.conftest import prefect_server
from tests.plugins.web.server.serving import Service, serving, until

__all__ = ["prefect_server"]  # a fixture


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """`sliplab serve` with its own server and its page; who starts runs puts up with those."""
    folder = tmp_path_factory.mktemp("served")
    rig = ROOT / "rigs" / "rehearsal.yaml"
    with serving(folder / "store", rig, "served", None, folder / "serve.log") as page:
        found = Service(page, folder / "store")
        until("the page", lambda: found.ask("GET", "/log")[0] == 401)
        yield found


@pytest.fixture(scope="module", autouse=True)
def on_a_server(prefect_server: None) -> None:
    """As `prefect_server`: commands of the tests talk to it as a user's do."""
