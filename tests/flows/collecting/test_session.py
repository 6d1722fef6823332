"""Collection below Prefect: gates, retakes, quarantine, changeovers, and data that never vary."""

from __future__ import annotations

import json
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.collecting.session import TrialCollector, open_session
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import make_request
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.rigs.core.capabilities import RigError, Segment
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.trials.store import Campaign, StoreError, TrialStore
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT
from tests.flows.conftest import at_rig, requested, take_all, tiny, tiny_gravity, write
from tests.patching import put


def short() -> dict[str, Any]:
    """Three slides that are over in a second: for collection only."""
    data = tiny()
    data["collection"]["factors"]["direction"]["values"] = [0, 120, 240]
    data["collection"]["motion"][3]["distance"] = "1.6 mm"
    data["collection"]["motion"][2] = {"phase": "hold", "settle": "0.2 s", "duration": "0.5 s"}
    data["collection"]["maintenance"]["rezero"]["search"] = "0.5 mm"
    data["analysis"]["split"] = {"method": "ranked"}
    return data


def session(
    folder: Path, data: dict[str, Any], rig: dict[str, Any] | None = None, **mock: Any
) -> tuple[TrialCollector, Campaign]:
    """A connected session on a mock rig with other mock settings, and other keys.

    The frame camera makes tracks, not videos, which take most of the time.
    """
    folder.mkdir(exist_ok=True)
    mock.setdefault("frame_camera", {"level": "tracks"})
    rig_data = parse_yaml((ROOT / "rigs" / "mock.yaml").read_text(), "mock.yaml")
    text = json.dumps(
        {**rig_data, "mock": {**rig_data["mock"], **mock}, "timing": {}, **(rig or {})},
        default=lambda v: float(v) if isinstance(v, Decimal) else str(v),
    )
    (folder / "rig.yaml").write_text(text)
    write(folder / "p.yaml", data)
    return at_rig(requested(folder))


STEPS = [
    "starting the fakes of 0 devices ...",
    "touching off, warming up the skin ...",
    "touching off: depth zero ...",
]


def checksums(campaign: Campaign) -> dict[str, str]:
    """One hash a committed trial."""
    return {recording.trial_id: recording.checksum for recording in campaign.recordings()}


def test_steps_before_the_first_trial_are_said_in_real_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    session(tmp_path / "a", short())
    for in_virtual_time in (True, False):
        monkeypatch.setattr(RigFile, "in_virtual_time", in_virtual_time)
        with open_session(requested(tmp_path / "a")) as opened:
            opened.collector.rig.connect()
            opened.collector.take(opened.trials[:1])
        said = [line for line in capsys.readouterr().err.splitlines() if line.endswith(" ...")]
        assert said == ([] if in_virtual_time else STEPS)


@pytest.mark.long
def test_a_campaign_in_pieces_is_the_campaign_in_one(tmp_path: Path) -> None:
    video, data = {"level": "video"}, short()
    data["collection"]["recording"]["region"] = {"width": "12 mm", "height": "12 mm"}
    whole, campaign = session(tmp_path / "a", data, frame_camera=video)
    take_all(whole)
    expected = checksums(campaign)
    assert len(expected) == 3
    pieces: Campaign | None = None
    for _ in range(3):
        part, pieces = session(tmp_path / "b", data, frame_camera=video)
        part.take(pending_trials(part.plan, pieces)[:1])
        assert part.taken == 1
    assert pieces is not None
    assert checksums(pieces) == expected
    assert verify(TrialStore.open(tmp_path / "b" / "store")) == []


def test_a_trial_that_fails_every_time_is_set_aside(tmp_path: Path) -> None:
    data = short()
    data["collection"]["gates"]["retakes"] = 1
    fault = {"kind": "event_gap", "at_s": 0.6, "seconds": 0.2}
    work, campaign = session(tmp_path / "a", data, faults=[fault])
    take_all(work)
    assert campaign.committed() == set()
    assert len(campaign.quarantined()) == 6
    assert pending_trials(work.plan, campaign) == []
    counts = requested(tmp_path / "a").counts(campaign)
    assert counts["planned"] == counts["committed"] + counts["missing"] == 3
    assert len(counts["set_aside"]) == 3


def test_a_person_changes_the_plate_once_a_block(tmp_path: Path) -> None:
    data = tiny_gravity()
    data["collection"]["motion"][6]["distance"] = "0.5 mm"
    work, campaign = session(tmp_path / "a", data)
    asked: list[str] = []
    operator = work.rig.operator

    class Asked:
        def ask(self, task: str, prompt: str, expected: str) -> bool:
            asked.append(expected)
            return operator.ask(task, prompt, expected)

    work.rig.operator = Asked()
    take_all(work)
    assert asked == ["0.165 kg", "0.245 kg"]
    assert len(campaign.committed()) == 2


def test_a_change_that_was_not_made_is_noticed(tmp_path: Path) -> None:
    work, campaign = session(tmp_path / "a", tiny_gravity())

    class Absent:
        def ask(self, task: str, prompt: str, expected: str) -> bool:
            return True

    work.rig.operator = Absent()
    with pytest.raises(RigError, match="detects another mass"):
        take_all(work)
    assert campaign.committed() == set()


def test_no_warm_up_presses_deeper_than_asked_for_where_the_plane_was_taught_too_deep(
    tmp_path: Path,
) -> None:
    data = short()
    upkeep = data["collection"]["maintenance"]
    upkeep["warm_up"] = {
        "presses": 2,
        "depth": "2.8 mm",
        "speed": "2 mm/s",
        "clearance": "5 mm",
    }
    upkeep["rezero"]["search"] = "1.5 mm"
    work, campaign = session(tmp_path / "a", data)
    surface = work.rig.plate_frame  # of the plane as it is
    deepest: list[float] = []
    start = work.rig.arm.start

    def sent(path: list[Segment]) -> None:
        (segment,) = path
        if segment.speed_mm_s == 2.0:  # a touch creeps
            deepest.append(surface.position(segment.to.xyz_mm).depth_mm)
        start(path)

    put(work.rig.arm, "start", sent)
    work.rig.plate_frame = replace(surface, origin=surface.origin + 1.4 * surface.axes[2])
    work.take(pending_trials(work.plan, campaign)[:1])
    assert max(deepest) == pytest.approx(2.8, abs=0.1)  # so much do touches differ
    assert len(campaign.committed()) == 1


def test_another_collection_or_rig_is_refused_and_new_trials_are_not(tmp_path: Path) -> None:
    work, _ = session(tmp_path / "a", short())
    take_all(work)
    store, rig = tmp_path / "a" / "store", tmp_path / "a" / "rig.yaml"
    data = short()
    data["analysis"]["detection"]["margin"] = 5
    data["collection"]["factors"]["direction"]["values"].append(300)
    run_request = make_request(write(tmp_path / "more.yaml", data), rig, store)
    assert len(pending_trials(run_request.plan, TrialStore.open(store).campaign("tiny"))) == 1
    data["collection"]["motion"][1]["speed"] = "1 mm/s"
    with pytest.raises(StoreError, match="another `collection:` section"):
        make_request(write(tmp_path / "other.yaml", data), rig, store)
    fewer = short()
    fewer["collection"]["factors"]["direction"]["values"] = [0, 120]
    with pytest.raises(StoreError, match="may only add trials"):
        make_request(write(tmp_path / "fewer.yaml", fewer), rig, store)
    for other in ("mock", "ur5"):  # a real one has no simulated scene, whose level was kept
        with pytest.raises(StoreError, match="another rig file"):
            make_request(tmp_path / "more.yaml", ROOT / "rigs" / f"{other}.yaml", store)
