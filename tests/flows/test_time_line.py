"""From clocks that drift and pulses that fail to labels and events on one time line.

The simulation knows what every clock showed. Whatever a trial's record says must agree with that,
within a millisecond where devices are wired and within what is stated where they are not. The same
checks fail when streams are lined up by their first stamps, as labs do it today.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.clocks.synchronise import synchronise_recording
from sliplab.analysis.labels.labelling import label_recording
from sliplab.protocols.labelling import Labelling
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.trials.recording import Recording
from tests.flows.collecting.test_session import session
from tests.flows.conftest import take_all, tiny

DEVICES = {"events": "event_camera", "arm": "arm", "frames": "frame_camera"}
MS = 1_000_000
BAD = [
    {"kind": "pulses_lost", "at_s": 0.4, "count": 12, "device": "event_camera"},
    {"kind": "pulses_lost", "at_s": 2.1, "count": 7, "device": "arm"},
    {"kind": "pulses_late", "at_s": 1.2, "count": 6, "seconds": 0.0017, "device": "event_camera"},
    {"kind": "pulses_late", "at_s": 3.0, "count": 4, "seconds": 0.0009, "device": "arm"},
    {"kind": "pulses_duplicated", "at_s": 1.8, "count": 8, "device": "arm"},
    {"kind": "pulses_duplicated", "at_s": 2.6, "count": 8, "device": "event_camera"},
]
CLOCKS = ("arm", "event_camera", "frame_camera", "sync_box")
DRIFTING = {f"{name}_ppm": 190.0 for name in CLOCKS} | {"pulse_jitter_us": 5.0}
EXACT = {"arm_controller": {"resolution_us": 0}, "frame_camera": {"resolution_us": 0}}
"""As it is in the simulation: only the event camera and the box cut their stamps."""
TIMINGS: dict[str, dict[str, Any]] = {
    "code": {},
    "irregular, exposure line": {"code": "irregular", "frames": "exposure line"},
    "regular with a start marker": {"code": "regular"},
    "clocks read by the host": {"frames": "device time stamps", "arm": "host time"},
    "arrival": {"frames": "host arrival", "arm": "host time", "code": "irregular"},
}


def slides() -> dict[str, Any]:
    """Three slides of three seconds."""
    data = tiny()
    data["collection"]["factors"]["direction"]["values"] = [0, 120, 240]
    data["collection"]["motion"][3]["distance"] = "5 mm"
    data["analysis"]["split"] = {"method": "ranked"}
    data["collection"]["maintenance"] = {}
    return data


def truth(recording: Recording, device: str) -> ClockMap:
    """Return the true readings of a device's clock and of the box's."""
    pairs = recording.record.simulation_truth["clocks"][DEVICES[device]]
    return ClockMap.through(*zip(*pairs, strict=True))


def apart_ns(recording: Recording, device: str, fitted: ClockMap) -> int:
    """Return the largest error of a clock map over the recording, ns."""
    pairs = np.array(recording.record.simulation_truth["clocks"][DEVICES[device]])
    return int(np.abs(fitted.to_reference(pairs[:, 0]) - pairs[:, 1]).max())


def onsets(recording: Recording, maps: dict[str, ClockMap], monkeypatch: Any) -> list[int]:
    """A trial's labels as they would be with other clock maps, ns of the box."""
    with monkeypatch.context() as patch:
        patch.setattr(Recording, "clock", lambda self, device: maps[device])
        label = label_recording(recording, Labelling())
    return [int(t) for t in (label.onsets.incipient_ns, label.onsets.gross_ns) if t is not None]


def first_stamps(recording: Recording) -> dict[str, ClockMap]:
    """Every stream begins with its first stamp, and at the same time: what labs do today."""
    with recording.open() as reader:
        begin = {
            "events": int(reader.events().t_us[0]) * 1000,
            "arm": int(reader.column("poses/t")[0]),
            "frames": int(reader.column("frames/t")[0]),
        }
        zero = int(reader.pulses("sync_pulses")[0])
    return {device: ClockMap.line(start, zero) for device, start in begin.items()}


@pytest.mark.parametrize(
    "timing",
    [
        pytest.param(timing, id=name, marks=pytest.mark.long if number else ())
        for number, (name, timing) in enumerate(TIMINGS.items())
    ],
)
def test_every_accepted_trial_agrees_with_the_truth(
    tmp_path: Path, timing: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = [
        fault for fault in BAD if fault["device"] != "arm" or timing.get("arm") != "host time"
    ]
    timing = {**EXACT, **timing}
    work, campaign = session(tmp_path, slides(), {"timing": timing}, clocks=DRIFTING, faults=faults)
    take_all(work)
    recordings = list(campaign.recordings())
    assert len(recordings) == 3
    wrong = []
    for recording in recordings:
        clocks = recording.record.clocks.devices()
        fitted = {device: recording.clock(device) for device in DEVICES}
        for device in DEVICES:
            if clocks[device].grade == "host arrival":
                continue  # its map is from arrivals to exposures, of which no clock tells
            error, stated = apart_ns(recording, device, fitted[device]), clocks[device]
            assert error <= 1.5 * stated.uncertainty_ns
            assert error < MS or stated.kind == "hard bound"
        exact = {device: truth(recording, device) for device in DEVICES}
        limit = MS if clocks["frames"].kind == "95 %" else clocks["frames"].uncertainty_ns
        if clocks["frames"].grade == "host arrival":
            delay = 500 * (50_000 + 0) + recording.record.timing.mid_exposure_ns
            exact["frames"] = ClockMap.line(delay, 0).then(exact["frames"])
        found, right = (onsets(recording, maps, monkeypatch) for maps in (fitted, exact))
        assert len(found) == len(right) == 2
        assert max(abs(a - b) for a, b in zip(found, right, strict=True)) <= limit
        naive = first_stamps(recording)
        wrong.append(max(apart_ns(recording, device, naive[device]) for device in DEVICES))
        # what was stored is enough to fit again
        assert synchronise_recording(recording).record() == recording.record.clocks
    # lined up by their first stamps, streams are not on one time line
    assert max(wrong) > MS


def test_every_grade_is_named_with_its_gate(tmp_path: Path) -> None:
    for number, timing in enumerate(TIMINGS.values()):
        work, campaign = session(tmp_path / str(number), slides(), {"timing": timing})
        work.take(list(work.plan)[:1])
        limits = work.plan.protocol.collection.gates.sync_uncertainty
        (recording,) = campaign.recordings()
        clocks, gates = recording.record.clocks, recording.record.quality.gates
        assert clocks.code == timing.get("code", "lfsr")
        assert clocks.events.grade == "trigger input"
        for device, default in (("frames", "hardware trigger"), ("arm", "digital input")):
            grade = timing.get(device, default)
            assert clocks.devices()[device].grade == grade
            gate = gates[f"sync_uncertainty_{device}_s"]
            assert gate.grade == grade
            assert gate.limit == pytest.approx(limits.limit_s(grade))


def test_a_clock_that_begins_anew_is_fitted_in_pieces_and_the_trial_taken_again(
    tmp_path: Path,
) -> None:
    fault = {"kind": "clock_restart", "trial": 1, "at_s": 2.0, "device": "event_camera"}
    work, campaign = session(tmp_path, slides(), faults=[fault])
    take_all(work)
    assert len(campaign.committed()) == 3
    (failed,) = campaign.quarantined()
    assert "its clock fell back" in failed["cause"]
