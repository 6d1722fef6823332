"""A package of somebody else's: installed, found, and a campaign run with nothing but its files."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.storage.files import read_json
from tests.examples.conftest import Lab, checkout

# the rig is a stand-in in real time: beside programs that compute it would be late
pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]


@pytest.mark.long
def test_a_package_outside_the_checkout_runs_a_campaign(tmp_path: Path) -> None:
    before = checkout()
    sliplab = Lab(tmp_path, "lab-plugin")

    on = ("protocol.yaml", "--rig", "rig.yaml", "--store", "store")
    listed, rigs, checked, taken, trials, labelled, *_ = sliplab(
        ("rigs", "--drivers"),
        ("rigs", "rig.yaml"),
        ("check", *on),
        ("collect", *on),
        ("trials", "store", "--where", "suction_kPa > 10"),
        *((step, "store") for step in ("label", "train", "evaluate", "report")),
    )
    drivers = {found["name"]: found for found in listed["drivers"]}
    for name in ("lab_stage", "lab_camera"):
        assert drivers[name]["package"] == "lab-plugin 0.1.0"
        assert drivers[name]["simulated_on_loopback"]
    (rig,) = rigs["rigs"]
    assert rig["arm"] == "Lab stage, fake"
    assert rig["cameras"].startswith("Lab camera")

    checks = checked["checks"]
    assert all(check["passed"] for check in checks), checks
    found = " ".join(check["finding"] for check in checks)
    assert "stage-3-fake" in found
    assert "lab camera" in found

    assert (taken["planned"], taken["committed"]) == (4, 4)
    assert taken["simulated"] is True
    assert len(trials["trials"]) == 2
    assert all("depth=2.3876mm" in trial["trial"] for trial in trials["trials"])  # 94 mil

    assert labelled["done"] == 4
    report = sliplab.folder / "store" / "report"
    assert read_json(report / "summary.json")["simulated"] is True
    assert "simulated" in (report / "index.html").read_text()
    assert checkout() == before
