"""One trial through the real drivers, in real time: what is kept, and what the mock makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.labels.labelling import label_recording
from sliplab.plugins.abb_socket.settings import AbbSocketSettings
from sliplab.plugins.devices.abb.settings import AbbSettings
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.flows.conftest import take_all
from tests.flows.live import (
    at_work,
    free_udp_port,
    only_trial,
    quick,
    request_in,
    rig_yaml,
    stage_of,
)
from tests.rigs.waiting import own_address

pytestmark = [pytest.mark.realtime, pytest.mark.xdist_group("scene")]

LABELS_AGREE_MS = 20.0
"""Tolerance between the onsets of one trial through real drivers and in the mock rig."""


@dataclass(frozen=True)
class Taken:
    """One committed trial, what its fakes sent, and the trial that the mock made of it."""

    recording: Recording
    by_mock: Recording
    sent: dict[str, int]
    events_sent: int
    run_request: Any


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Taken:
    folder = tmp_path_factory.mktemp("loopback")
    run_request = request_in(folder / "live", quick(), rig_yaml(folder))
    with stage_of(run_request.rig) as stage, at_work(run_request, stage) as (work, campaign):
        take_all(work)
        assert (work.taken, work.retaken) == (1, 0)
        (recording,) = campaign.recordings()
        with recording.open() as reader:
            event_us = reader.event_times()
        sent = dict(stage.sent())
        events_sent = stage.events_between(int(event_us[0]), int(event_us[-1]))
    mock = request_in(folder / "mock", quick(), folder / "rig.yaml")
    file = run_request.rig.model_copy(update={"driver": "mock", "devices": None})
    return Taken(recording, only_trial(mock, file), sent, events_sent, run_request)


def test_a_trial_through_real_drivers_is_committed(taken: Taken) -> None:
    record = taken.recording.record
    assert record.simulated is True
    assert record.attempt == 0
    assert record.quality.passed
    gates = record.quality.gates
    assert gates["sync_uncertainty_frames_s"].grade == "hardware trigger"
    assert gates["sync_uncertainty_arm_s"].grade == "digital input"
    assert gates["frames_lost"].value == 0
    assert verify(TrialStore.open(taken.run_request.store)) == []


def test_its_labels_are_those_of_the_mock(taken: Taken) -> None:
    settings = taken.run_request.plan.protocol.analysis.labelling
    after_ms = []
    for recording in (taken.recording, taken.by_mock):
        onsets = label_recording(recording, settings).onsets
        start_ns = recording.step("slide")[0]
        assert onsets.incipient_ns is not None
        assert onsets.gross_ns is not None
        after_ms.append([(t - start_ns) / 1e6 for t in (onsets.incipient_ns, onsets.gross_ns)])
    live, mock = after_ms
    print(f"simulated onsets after the slide's start, ms: drivers {live}, mock {mock}")
    assert live == pytest.approx(mock, abs=LABELS_AGREE_MS)


def test_nothing_that_was_sent_is_lost(taken: Taken) -> None:
    with taken.recording.open() as reader:
        stored = {
            "frames": len(reader.column("frames/t")),
            "event_pulses": len(reader.pulses("event_pulses")),
            "box_pulses": len(reader.pulses("sync_pulses")),
        }
        assert len(reader.pulses("arm_pulses")) == stored["box_pulses"]
        assert len(reader.event_times()) == taken.events_sent
    assert stored == {name: taken.sent[name] for name in stored}
    assert taken.recording.record.counts.events == taken.events_sent


# -- other arms ----------------------------------------------------------------------------


def with_arm(file: RigFile, kind: str) -> RigFile:
    """The same rig with an ABB arm, whose times are known by their arrival only."""
    given = file.devices.arm
    common = {"host": own_address(), "tool": given.tool, "limits": given.limits}
    arm: AbbSettings | AbbSocketSettings
    if kind == "abb":
        arm = AbbSettings(**common, rws_port=8080, egm_port=free_udp_port(), egm_bind="127.0.0.1")
    else:
        arm = AbbSocketSettings(**common)
    return file.model_copy(
        update={
            "devices": file.devices.model_copy(update={"arm": arm}),
            "timing": file.timing.model_copy(update={"arm": "host time"}),
        }
    )


@pytest.mark.long
@pytest.mark.parametrize("kind", [pytest.param("abb", marks=pytest.mark.long), "abb_socket"])
def test_a_trial_with_an_abb_arm_passes_its_gates(tmp_path: Path, kind: str) -> None:
    run_request = request_in(tmp_path / "live", quick(), rig_yaml(tmp_path))
    file = with_arm(run_request.rig, kind)
    with stage_of(file) as stage, at_work(run_request, stage, file) as (work, campaign):
        take_all(work)
    assert [failed["cause"] for failed in campaign.quarantined()] == []
    (recording,) = campaign.recordings()
    assert recording.record.attempt == 0
    gates = recording.record.quality.gates
    assert gates["sync_uncertainty_arm_s"].grade == "host time"
    assert gates["sync_uncertainty_frames_s"].grade == "hardware trigger"
    # what is true is told from when this slide was asked for, by whatever clock the arm has
    truth = recording.simulation_truth()
    assert -50_000_000 < recording.step("slide")[0] - truth["reference_ns"] < 1_000_000_000
