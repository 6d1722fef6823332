"""Rigs with one camera collect, and nothing is expected of the camera that is not there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sliplab.analysis.campaigns import collected
from sliplab.flows.collect import collect
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.train import train
from sliplab.protocols.errors import InputError
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT


def write_yaml(path: Path, data: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(data))
    return path


WORDS = {"events": "event camera", "frames": "frame camera"}
OTHER = {"events": "frames", "frames": "events"}


def take(camera: str, folder: Path, **recording: object) -> None:
    """One short trial of the pilot on the simulated rig that has only this camera."""
    protocol = yaml.safe_load((ROOT / "protocols" / "pilot.yaml").read_text())
    protocol["collection"]["motion"][2] |= {"settle": "0.2 s", "duration": "0.5 s"}
    protocol["collection"]["motion"][3]["distance"] = "2 mm"
    protocol["collection"]["recording"]["region"] = {"width": "36 mm", "height": "36 mm"}
    protocol["collection"]["recording"].update(recording)
    path = write_yaml(folder / "pilot.yaml", protocol)
    request = make_request(path, ROOT / "rigs" / f"mock_{camera}.yaml", folder / "store", most=1)
    assert collect(request)["taken"] == 1


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders with the trial of each camera; nothing here changes them."""
    folders = {camera: tmp_path_factory.mktemp(camera) for camera in WORDS}
    for camera, folder in folders.items():
        take(camera, folder)
    return folders


def only(folder: Path) -> Recording:
    """The trial in a folder's store."""
    campaign = TrialStore.open(folder / "store").campaign("pilot")
    return campaign.recording(*campaign.committed())


@pytest.mark.quick(1)
@pytest.mark.parametrize("camera", ["events", "frames"])
def test_one_camera_is_enough_to_collect(camera: str, taken: dict[str, Path]) -> None:
    found = only(taken[camera])
    record, other = found.record, OTHER[camera]
    counts = record.counts.model_dump()
    assert counts[camera] > 300
    assert counts[other] == 0
    assert record.quality.passed
    assert sorted(record.clocks.devices()) == sorted([camera, "arm"])
    assert record.clocks.refused == {}
    assert (record.geometry.event_px is None) == (camera == "frames")
    assert (record.geometry.frame_px is None) == (camera == "events")
    gates = set(record.quality.gates)
    assert gates.isdisjoint({"event_gap_s", "event_burst"}) == (camera == "frames")
    assert ("frames_lost" in gates) == (camera == "frames")
    # its clock is right: the arm's poses say when the slide began, and the truth agrees
    assert found.step("slide")[1] > found.step("slide")[0]
    store = TrialStore.open(taken[camera] / "store")
    assert verify(store) == []
    with pytest.raises(StoreError, match="has no label yet"):
        train(store, collected(store))


@pytest.mark.long
def test_the_camera_that_is_there_sees_what_it_saw_beside_the_other(
    taken: dict[str, Path], tmp_path: Path
) -> None:
    one, both = only(taken["events"]), ROOT / "rigs" / "mock.yaml"
    collect(make_request(taken["events"] / "pilot.yaml", both, tmp_path / "store", most=1))
    other = only(tmp_path)
    assert other.trial_id == one.trial_id
    with one.open() as a, other.open() as b:
        assert np.array_equal(a.events().t_us, b.events().t_us)
        assert np.array_equal(a.column("poses/xyz"), b.column("poses/xyz"))


@pytest.mark.parametrize("camera", ["events", "frames"])
def test_a_protocol_that_names_a_stream_needs_a_rig_that_has_it(
    camera: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as caught:
        take(camera, tmp_path, streams=["events", "frames", "poses"])
    assert caught.value.key == "collection.recording.streams"
    assert caught.value.value == OTHER[camera]
    assert f"mock-{camera} has no {WORDS[OTHER[camera]]}" in caught.value.expected
    assert not (tmp_path / "store" / "campaigns").exists()


def test_a_rig_without_an_event_camera_says_so_when_asked_to_touch_off() -> None:
    from sliplab.rigs.build import build_rig
    from sliplab.rigs.core.surface_search import touch_off

    rig = build_rig(load_rig_file(ROOT / "rigs" / "mock_frames.yaml")[0])
    rig.connect()
    with pytest.raises(RigError, match="event camera: the rig mock-frames has none"):
        touch_off(rig, 0.5, 1.5, 1)
    rig.close()


@pytest.mark.parametrize("cameras", [[], ["events", "events"], ["video"]])
def test_cameras_are_events_or_frames_or_both(cameras: list[str], tmp_path: Path) -> None:
    rig = yaml.safe_load((ROOT / "rigs" / "mock.yaml").read_text())
    path = write_yaml(tmp_path / "rig.yaml", {**rig, "cameras": cameras})
    with pytest.raises(InputError) as caught:
        load_rig_file(path)
    assert caught.value.key.startswith("cameras")
