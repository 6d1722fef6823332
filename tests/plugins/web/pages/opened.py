"""The web application of a store as a browser gets it that has opened one of its links."""

from __future__ import annotations

from starlette.testclient import TestClient

from sliplab.flows.running.same_origin import SameOrigin
from sliplab.plugins.web.pages.access import Access, Viewer
from sliplab.plugins.web.pages.app import application
from sliplab.plugins.web.pages.web import Web
from sliplab.plugins.web.review.trial_list import TrialList
from sliplab.plugins.web.server.links import Role
from sliplab.storage.trials.store import TrialStore

ACCESS = Access({"operator": "o" * 40, "reader": "r" * 40})


def opened(
    store: TrialStore,
    reviews: TrialList | None = None,
    role: Role | None = "operator",
    port: int | None = None,
) -> TestClient:
    """A browser that opened the link of a role, or none; behind the gate of a port, if any."""
    app = application(Web(store, ACCESS, reviews=reviews))
    if port is None:
        found = TestClient(app, follow_redirects=False)
    else:
        gate = SameOrigin(app, port)
        found = TestClient(gate, base_url=f"http://127.0.0.1:{port}", follow_redirects=False)
    if role is not None:
        assert found.get(f"/enter?token={ACCESS.tokens[role]}").status_code == 200
    return found


def csrf(browser: TestClient, address: str = "") -> str:
    """The token of a browser's forms at an address."""
    viewer = ACCESS.viewer(dict(browser.cookies), address)
    assert isinstance(viewer, Viewer)
    return viewer.csrf
