"""`sliplab check` and `sliplab rigs`: devices, clocks and the camera's region, each by name."""

from __future__ import annotations

import json
import re
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sliplab.flows.cli.app import app
from sliplab.flows.planning.preflight import check_devices, check_region
from sliplab.flows.planning.run_request import RunRequest, make_request
from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import parse_yaml
from tests.conftest import ROOT


def request_of(folder: Path, rig: dict[str, Any] | None = None, **recording: Any) -> RunRequest:
    """The pilot on a mock rig, with changes to the rig's file and to the recording."""
    folder.mkdir(exist_ok=True)
    pilot = parse_yaml((ROOT / "protocols" / "pilot.yaml").read_text(), "pilot.yaml")
    pilot["collection"]["recording"].update(recording)
    mock = parse_yaml((ROOT / "rigs" / "mock.yaml").read_text(), "mock.yaml")
    for name, data in (("p.yaml", pilot), ("rig.yaml", {**mock, **(rig or {})})):
        text = json.dumps(data, default=lambda v: float(v) if isinstance(v, Decimal) else str(v))
        (folder / name).write_text(text)
    return make_request(folder / "p.yaml", folder / "rig.yaml", folder / "store")


def test_every_clock_is_fitted_as_a_trials_would_be(tmp_path: Path) -> None:
    found = {item.name: item for item in check_devices(request_of(tmp_path))}
    assert set(found) == {"arm", "clock: events", "clock: arm"}
    assert all(item.passed for item in found.values())
    assert found["clock: events"].finding.endswith("(trigger input)")
    assert found["clock: arm"].finding.endswith("(digital input)")


def test_a_clock_that_cannot_be_fitted_fails_by_name(tmp_path: Path) -> None:
    # an arm that looks at its input every 8 ms, which the rig file does not say
    mock = {"seed": 1, "arm": {"input_sampling_us": 8_000}}
    run_request = request_of(tmp_path, {"mock": mock})
    found = {item.name: item for item in check_devices(run_request)}
    assert found["clock: events"].passed
    assert not found["clock: arm"].passed


WEAK = {"timing": {"arm": "host time", "pose_delay": {"shortest_us": 0, "longest_us": 1_300_000}}}


def test_a_clock_beyond_the_protocols_gate_fails_with_gate_and_delays(tmp_path: Path) -> None:
    found = {item.name: item for item in check_devices(request_of(tmp_path, WEAK))}
    arm = found["clock: arm"]
    assert not arm.passed
    assert "gates.sync_uncertainty.host_time is 15000 us" in arm.finding
    seen = re.search(r"took (\d+) us more than the fastest, .* allows (\d+) us", arm.finding)
    assert 0 < int(seen[1]) < 20_000  # what the simulated arm's poses take
    assert int(seen[2]) == 1_300_000
    assert found["clock: events"].passed


def test_a_clock_within_its_gate_passes_as_the_trials_do(tmp_path: Path) -> None:
    delay = {"pose_delay": {"shortest_us": 0, "longest_us": 20_000}, "arm": "host time"}
    found = {item.name: item for item in check_devices(request_of(tmp_path, {"timing": delay}))}
    assert found["clock: arm"].passed


def test_scatter_beyond_a_quarter_of_a_tick_is_refused_before_anything_runs(tmp_path: Path) -> None:
    timing = {"arm_controller": {"jitter_us": 5000}}
    with pytest.raises(InputError, match=r"timing.arm_controller.jitter_us = 5000.* at most 2500"):
        request_of(tmp_path, {"timing": timing})


def test_the_region_must_cover_the_centre_marker(tmp_path: Path) -> None:
    (wide,) = check_region(request_of(tmp_path / "a"))
    assert wide.passed
    assert "to spare" in wide.finding
    small = {"width": "12 mm", "height": "12 mm"}
    (narrow,) = check_region(request_of(tmp_path / "b", region=small))
    assert not narrow.passed
    assert "widen recording.region by" in narrow.finding
    middle = {"width": "20 mm", "height": "20 mm"}
    (near,) = check_region(request_of(tmp_path / "c", region=middle))
    assert near.passed
    assert "leave it on the longest" in near.finding


def test_rigs_lists_what_ships_and_says_what_is_wrong_with_a_file(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["rigs", "--json"])
    assert done.exit_code == 0
    found = {item["name"]: item for item in json.loads(done.stdout)["rigs"]}
    assert {"mock", "loopback", "ur5", "irb120"} <= set(found)
    assert found["ur5"]["simulated"] is False
    assert found["loopback"]["answer"] == "simulated: always there"
    broken = tmp_path / "broken.yaml"
    broken.write_text("extends: " + str(ROOT / "rigs" / "ur5.yaml") + "\ndriver: mock\n")
    done = CliRunner().invoke(app, ["rigs", str(broken), "--json"])
    assert done.exit_code == 2
    assert "needed by driver: mock" in json.loads(done.stdout)["rigs"][0]["answer"]


@pytest.mark.realtime
def test_rigs_asks_the_devices_of_a_real_rig() -> None:
    done = CliRunner().invoke(app, ["rigs", "ur5", "--ask", "--json"])
    assert done.exit_code == 1
    (found,) = json.loads(done.stdout)["rigs"]
    assert "sync box" in found["silent"]
