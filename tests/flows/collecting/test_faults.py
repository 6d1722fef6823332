"""A campaign survives every fault: gates see it, nothing committed is lost, and it goes on."""

from __future__ import annotations

import errno
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.flows.collecting.session import TrialCollector, open_session
from sliplab.rigs.core.capabilities import ArmFault, RigError
from sliplab.rigs.core.rig import Rig
from sliplab.storage.errors import disk_full
from sliplab.storage.files import write_json
from sliplab.storage.schema.trial import TrialRecord
from sliplab.storage.trials.store import Campaign, StoreError, TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import here
from tests.flows.collecting.test_session import checksums, session, short
from tests.flows.conftest import requested, take_all
from tests.patching import put

TRACKS = {"level": "tracks"}


def slides(count: int) -> dict[str, Any]:
    """A few short slides and nothing else, so that the first trial is trial 1 of the rig."""
    data = short()
    data["collection"]["factors"]["direction"]["values"] = [0, 120, 240][:count]
    data["collection"]["maintenance"] = {}
    return data


def begin(
    folder: Path, faults: list[dict[str, Any]], data: dict[str, Any] | None = None
) -> tuple[TrialCollector, Campaign]:
    """A session on a rig with faults."""
    return session(folder, data or slides(2), faults=faults, frame_camera=TRACKS)


def goes_on(folder: Path, kept: dict[str, str], data: dict[str, Any] | None = None) -> None:
    """The same campaign without the fault is completed; what was committed stays as it was."""
    again, campaign = begin(folder, [], data)
    take_all(again)
    assert len(campaign.committed()) == len(again.plan)
    assert kept.items() <= checksums(campaign).items()
    assert verify(TrialStore.open(folder / "store")) == []


# -- faults that end a stretch of work -----------------------------------------------------


def test_a_full_disk_ends_the_stretch_and_loses_nothing(tmp_path: Path) -> None:
    work, campaign = begin(tmp_path, [{"kind": "disk_full", "trial": 2, "at_s": 0.7}])
    with pytest.raises(StoreError, match=r"campaigns/tiny: its disk is full .* make room"):
        take_all(work)
    kept = checksums(campaign)
    assert len(kept) == 1
    assert "No space left on device" in campaign.quarantined()[0]["cause"]
    depth = work.rig.plate_frame.position(work.rig.arm.pose().xyz_mm).depth_mm
    assert depth == pytest.approx(-5.0, abs=1e-3)  # clear of the plate
    goes_on(tmp_path, kept)


def test_a_rig_is_closed_where_the_disk_is_full_before_the_first_trial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session(tmp_path, short())
    closed: list[Rig] = []
    close = Rig.close
    monkeypatch.setattr(Rig, "close", lambda rig: (closed.append(rig), close(rig))[1])

    def full(campaign: Campaign, data: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Campaign, "add_bench_record", full)
    with pytest.raises(StoreError, match="disk is full"), open_session(requested(tmp_path)):
        pass
    assert len(closed) == 1


def test_a_disk_too_full_for_the_cause_is_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, campaign = begin(tmp_path, [{"kind": "disk_full", "trial": 2, "at_s": 0.7}])

    def no_room(path: Path, data: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("sliplab.storage.trials.store.write_json", no_room)
    with pytest.raises(StoreError, match="its disk is full"):
        take_all(work)
    monkeypatch.undo()
    assert campaign.quarantined() == []
    assert len(list((campaign.folder / "incoming").iterdir())) == 1
    goes_on(tmp_path, checksums(campaign))
    assert campaign.quarantined()[0]["cause"] == "interrupted"


def test_a_disk_that_fills_up_at_the_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, campaign = begin(tmp_path, [])

    def no_room(path: Path, data: Any) -> None:
        if path.name == "checksums.json" and campaign.committed():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write_json(path, data)

    monkeypatch.setattr("sliplab.storage.trials.writer.write_json_aside", no_room)
    with pytest.raises(StoreError, match="its disk is full"):
        take_all(work)
    monkeypatch.undo()
    kept = checksums(campaign)
    assert len(kept) == 1
    goes_on(tmp_path, kept)


def test_a_full_disk_is_known_through_what_it_caused() -> None:
    full = OSError(errno.EDQUOT, "over quota")
    encoder = RuntimeError("the video encoder failed")
    encoder.__cause__ = full
    assert disk_full(full)
    assert disk_full(encoder)
    assert not disk_full(OSError(errno.EIO, "broken"))
    assert not disk_full(None)


def test_collect_says_which_disk_is_full_and_goes_on(tmp_path: Path) -> None:
    _, campaign = begin(tmp_path, [{"kind": "disk_full", "trial": 2, "at_s": 0.7}])
    store = tmp_path / "store"
    protocol, rig = tmp_path / "p.yaml", tmp_path / "rig.yaml"
    ended = here("collect", protocol, "--rig", rig, "--store", store)
    assert ended.returncode == 1
    # a terminal's lines break anywhere
    assert f"error:{store}/campaigns/tiny:itsdiskisfull" in "".join(ended.stderr.split())
    assert "Traceback" not in ended.stderr
    committed = list((campaign.folder / "trials").iterdir())
    times = {path: path.stat().st_mtime_ns for path in committed}
    assert len(committed) == 1
    goes_on(tmp_path, checksums(campaign))
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())


@pytest.mark.parametrize("device", ["arm", "event_camera", "frame_camera", "sync_box"])
def test_a_device_that_goes_ends_the_stretch(tmp_path: Path, device: str) -> None:
    fault = {"kind": "device_gone", "trial": 2, "at_s": 0.8, "device": device}
    work, campaign = begin(tmp_path, [fault])
    words = device.replace("_", " ")
    with pytest.raises(RigError, match=f"{words}: does not answer .* run the same command"):
        take_all(work)
    work.rig.close()  # whatever is left of it
    kept = checksums(campaign)
    assert len(kept) == 1
    assert f"{words}: does not answer" in campaign.quarantined()[0]["cause"]
    assert campaign.failed_attempts() == {}
    goes_on(tmp_path, kept)


def test_a_protective_stop_at_a_point_ends_the_stretch(tmp_path: Path) -> None:
    work, campaign = begin(tmp_path, [{"kind": "arm_protective_stop", "trial": 2, "at_mm": 0.8}])
    with pytest.raises(ArmFault, match="protective stop in the phase 'slide'; the arm stays"):
        take_all(work)
    at = work.rig.plate_frame.position(work.rig.arm.pose().xyz_mm)
    # the slide of 1.6 mm is centred on the plate
    assert (at.x_mm, at.y_mm, at.depth_mm) == pytest.approx((0.0, 0.0, 2.4), abs=1e-3)
    (failed,) = campaign.quarantined()
    assert failed["cause"].startswith("ArmFault: arm: protective stop")
    assert campaign.failed_attempts() == {}
    kept = checksums(campaign)
    assert len(kept) == 1
    goes_on(tmp_path, kept)


# -- faults that a gate sees ---------------------------------------------------------------

JUMP, DRIFT = "clock_jump", "clock_drift"
SEEN: list[tuple[dict[str, Any], str]] = [
    ({"kind": "arm_off_path", "mm": 0.3, "seconds": 0.5}, "path_deviation_mm"),
    ({"kind": "frames_lost"}, "frames_lost"),
    ({"kind": "frame_late", "seconds": 60.0}, "frames_lost"),
    ({"kind": "event_gap"}, "event_gap_s"),
    ({"kind": "event_stall", "seconds": 60.0}, "event_gap_s"),
    ({"kind": "event_burst", "seconds": 0.02}, "event_burst"),
    ({"kind": JUMP, "device": "arm", "seconds": 0.25}, "sync_uncertainty_arm_s"),
    ({"kind": JUMP, "device": "event_camera", "seconds": -0.25}, "sync_uncertainty_events_s"),
    ({"kind": JUMP, "device": "frame_camera", "seconds": -5000}, "sync_uncertainty_frames_s"),
    ({"kind": JUMP, "device": "sync_box", "seconds": 0.0013}, "sync_uncertainty_arm_s"),
    ({"kind": DRIFT, "device": "event_camera", "ppm": 2000}, "sync_uncertainty_events_s"),
    ({"kind": DRIFT, "device": "sync_box", "ppm": -2000}, "sync_uncertainty_frames_s"),
    ({"kind": "pulses_late", "count": 30, "device": "arm"}, "sync_uncertainty_arm_s"),
]


@pytest.mark.quick(6)
@pytest.mark.parametrize(
    ("fault", "gate"), SEEN, ids=[case[0]["kind"] + "-" + case[1] for case in SEEN]
)
def test_a_gate_sees_it_and_the_trial_is_taken_again(
    tmp_path: Path, fault: dict[str, Any], gate: str
) -> None:
    work, campaign = begin(tmp_path, [{**fault, "trial": 1, "at_s": 0.8}], slides(1))
    take_all(work)
    assert (work.taken, work.retaken) == (2, 1)
    (failed,) = campaign.quarantined()
    assert failed["cause"].startswith("gate: ")
    assert re.search(rf"{gate}(: | = )", failed["cause"])
    (recording,) = campaign.recordings()
    assert recording.record.attempt == 1
    assert recording.record.quality.passed
    assert verify(TrialStore.open(tmp_path / "store")) == []


def test_the_deviation_that_a_gate_measures_is_the_arms(tmp_path: Path) -> None:
    fault = {"kind": "arm_off_path", "trial": 1, "mm": 0.3, "seconds": 0.5, "at_s": 0.8}
    work, campaign = begin(tmp_path, [fault], slides(1))
    take_all(work)
    failed = TrialRecord.load(campaign.folder / "quarantine" / _only(campaign) / "record.json")
    found = {"bad": failed, "good": next(campaign.recordings()).record}
    values = {k: v.quality.gates["path_deviation_mm"].value for k, v in found.items()}
    assert values["bad"] == pytest.approx(0.3, abs=0.015)
    assert values["good"] < 0.015  # noise of the poses


@pytest.mark.quick(1)
@pytest.mark.parametrize("part", [1.0, 0.4])
def test_an_arm_slower_than_it_was_told_is_taken_again(tmp_path: Path, part: float) -> None:
    """At half its speed, all the way or in its last part, and "done" for all that it says."""
    work, campaign = begin(tmp_path, [], slides(1))
    start, slowed = work.rig.arm.start, [False]

    def slow(path: Any) -> None:
        (segment,) = path
        if segment.speed_mm_s != 1.6 or slowed[0]:
            start(path)
            return
        slowed[0] = True
        here, there = np.array(work.rig.arm.pose().xyz_mm), np.array(segment.to.xyz_mm)
        x, y, z = (there - part * (there - here)).tolist()
        at = replace(segment, to=replace(segment.to, xyz_mm=(x, y, z)))
        slower = replace(segment, speed_mm_s=0.8)
        start([slower] if part == 1.0 else [at, slower])

    put(work.rig.arm, "start", slow)
    take_all(work)
    assert slowed == [True]
    assert (work.taken, work.retaken) == (2, 1)
    (failed,) = campaign.quarantined()
    assert "speed_deviation_percent = " in failed["cause"]
    bad = TrialRecord.load(campaign.folder / "quarantine" / _only(campaign) / "record.json")
    good = next(campaign.recordings()).record
    values = [r.quality.gates["speed_deviation_percent"].value for r in (bad, good)]
    assert values[0] == pytest.approx(50.0, abs=3.0)
    assert 0 <= values[1] < 2.0


def _only(campaign: Campaign) -> str:
    (failed,) = campaign.quarantined()
    return str(failed["folder"])


@pytest.mark.quick(3)
@pytest.mark.parametrize(
    "fault",
    [
        {"kind": "event_stall", "seconds": 0.3},
        {"kind": "pulses_lost", "count": 5},
        {"kind": "pulses_lost", "count": 5, "device": "sync_box"},
        {"kind": "pulses_duplicated", "count": 5, "device": "arm"},
        {"kind": "pulses_late", "count": 5, "device": "event_camera"},
        {"kind": "frame_late", "seconds": 0.05},
        {"kind": "clock_drift", "device": "event_camera", "ppm": 20},
    ],
    ids=lambda fault: fault["kind"],
)
def test_what_costs_nothing_is_kept(tmp_path: Path, fault: dict[str, Any]) -> None:
    work, campaign = begin(tmp_path / "a", [{**fault, "trial": 1, "at_s": 0.8}], slides(1))
    take_all(work)
    assert campaign.quarantined() == []
    sound, other = begin(tmp_path / "b", [], slides(1))
    take_all(sound)
    hit, plain = next(campaign.recordings()), next(other.recordings())
    if fault["kind"] == "event_stall":
        assert hit.checksum == plain.checksum
    # the time line is the same within what the fits say of themselves
    with plain.open() as reader:
        moments = {
            "events": int(reader.pulses("event_pulses")[-1]),
            "arm": int(reader.pulses("arm_pulses")[-1]),
            "frames": int(reader.column("frames/t")[-1]),
        }
    for device, t_ns in moments.items():
        times = [int(recording.clock(device).to_reference(t_ns)) for recording in (hit, plain)]
        known = [r.record.clocks.devices()[device].uncertainty_ns for r in (hit, plain)]
        drifted_ns = 20e-3 * 1e6 if (fault["kind"], device) == ("clock_drift", "events") else 0
        assert abs(times[0] - times[1]) <= sum(known) + drifted_ns
