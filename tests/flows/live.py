"""Fixtures for tests on a loopback rig: a short trial, a rig file, sessions on its fakes."""

from __future__ import annotations

import copy
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.planning.run_request import RunRequest, describe_campaign, make_request
from sliplab.plugins.loopback.client import Loopback
from sliplab.plugins.loopback.rig import loopback_rig
from sliplab.plugins.simulation.settings import scene_of
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore
from tests.conftest import ROOT, SMALL
from tests.flows.conftest import at_rig, take_all, write
from tests.rigs.waiting import own_address


def quick(
    distance_mm: float = 7.0, speed_mm_s: float = 6.0, trials: int = 1, repetitions: int = 1
) -> dict[str, Any]:
    """Slides that are over in three or four seconds, pressing and letting go included."""
    data = copy.deepcopy(SMALL)
    data["name"] = "quick"
    collection = data["collection"]
    collection["repetitions"] = repetitions
    for factor, values in (("depth", [2.4]), ("speed", [speed_mm_s]), ("direction", [0, 180])):
        collection["factors"][factor]["values"] = values[:trials]
    collection["motion"] = [
        {"phase": "approach", "clearance": "1 mm", "speed": "20 mm/s"},
        {"phase": "press", "depth": "$depth", "speed": "6 mm/s"},
        {"phase": "hold", "settle": "0.2 s", "duration": "0.5 s"},
        {
            "phase": "slide",
            "distance": f"{distance_mm} mm",
            "speed": "$speed",
            "direction": "$direction",
        },
        {"phase": "release", "clearance": "1 mm", "speed": "10 mm/s"},
        {"phase": "return", "speed": "20 mm/s"},
    ]
    collection["maintenance"] = {}
    data["analysis"]["split"] = {"method": "ranked"}
    return data


def rig_yaml(folder: Path, **changes: Any) -> Path:
    """The shipped loopback rig with a fake arm at an address of its own, near the plate."""
    data = {
        "extends": str(ROOT / "rigs" / "loopback.yaml"),
        "name": "loopback",
        "devices": {"arm": {"host": own_address()}},
        "mock": {"arm": {"start_xyz_mm": [397, 0, 300]}},
    }
    if changes:
        data = {"extends": str(write(folder / "base.yaml", data)), "name": "loopback", **changes}
    return write(folder / "rig.yaml", data)


def request_in(folder: Path, data: dict[str, Any], rig: Path) -> RunRequest:
    """Request a run: this protocol on that rig, into a store of the folder's own."""
    folder.mkdir(exist_ok=True)
    return make_request(write(folder / "p.yaml", data), rig, folder / "store")


@contextmanager
def stage_of(file: RigFile) -> Iterator[Loopback]:
    """Fakes for a rig file, which outlive the rigs that are built on them."""
    assert file.devices is not None
    stage = Loopback(scene_of(file), file.timing, file.devices, file.streams)
    try:
        yield stage
    finally:
        stage.close()


@contextmanager
def at_work(
    run_request: RunRequest, stage: Loopback, file: RigFile | None = None
) -> Iterator[tuple[TrialCollector, Campaign]]:
    """One session, as the same command begins and ends it: drivers are built anew each time."""
    campaign = describe_campaign(TrialStore.create(run_request.store), run_request)
    rig = loopback_rig(file or run_request.rig, stage)
    try:
        rig.connect()
        yield TrialCollector(run_request.plan, file or run_request.rig, rig, campaign), campaign
    finally:
        rig.close()


def only_trial(run_request: RunRequest, file: RigFile | None = None) -> Recording:
    """The only trial of a request, taken on its simulated rig."""
    work, campaign = at_rig(run_request, file)
    take_all(work)
    (recording,) = campaign.recordings()
    return recording


def free_udp_port() -> int:
    """A UDP port that nobody has now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def with_values(path: Path, **values: Any) -> Path:
    """A YAML file with other values at its top."""
    return write(path, {**yaml.safe_load(path.read_text()), **values})
