"""A package of somebody else's: installed, found, and a campaign run with nothing but its files."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.examples.conftest import Lab, checkout

# the rig is a stand-in in real time: beside programs that compute it would be late
pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]

ANALYSE = """
import sliplab
store = sliplab.open_store("store")
print(store.label()["done"])
for step in (store.train, store.evaluate, store.report):
    step()
print(store.summary()["simulated"])
"""


def test_a_package_outside_the_checkout_runs_a_campaign(tmp_path: Path) -> None:
    before = checkout()
    sliplab = Lab(tmp_path, "lab-plugin")

    drivers = {found["name"]: found for found in sliplab("rigs", "--drivers")["drivers"]}
    for name in ("lab_stage", "lab_camera"):
        assert drivers[name]["package"] == "lab-plugin 0.1.0"
        assert drivers[name]["simulated_on_loopback"]
    (rig,) = sliplab("rigs", "rig.yaml")["rigs"]
    assert rig["arm"] == "Lab stage, fake"
    assert rig["cameras"].startswith("Lab camera")

    on = ("protocol.yaml", "--rig", "rig.yaml", "--store", "store")
    checks = sliplab("check", *on)["checks"]
    assert all(check["passed"] for check in checks), checks
    found = " ".join(check["finding"] for check in checks)
    assert "stage-3-fake" in found
    assert "lab camera" in found

    taken = sliplab("collect", *on)
    assert (taken["planned"], taken["committed"]) == (4, 4)
    assert taken["simulated"] is True
    trials = sliplab("trials", "store", "--where", "suction_kPa > 10")["trials"]
    assert len(trials) == 2
    assert all("depth=2.3876mm" in trial["trial"] for trial in trials)  # 94 mil

    assert sliplab.python(ANALYSE).splitlines() == ["4", "True"]
    page = sliplab.folder / "store" / "report" / "index.html"
    assert "simulated" in page.read_text()
    assert checkout() == before
