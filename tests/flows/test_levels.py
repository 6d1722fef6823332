"""Labels from tracks against labels from the video of the same trial, and both against truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sliplab.analysis.labels.label import Label
from sliplab.analysis.labels.labelling import label_recording
from sliplab.flows.planning.run_request import make_request
from sliplab.storage.trials.checksums import write_sums
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT
from tests.flows.conftest import at_rig, take_all, tiny, tiny_gravity, write

FRAME_MS = 10.0


def kinematic() -> dict[str, Any]:
    """One slide, short and fast."""
    data = tiny()
    data["collection"]["factors"]["direction"]["values"] = [60]
    data["collection"]["motion"][2] = {"phase": "hold", "settle": "0.5 s", "duration": "0.6 s"}
    data["collection"]["motion"][3]["distance"] = "5 mm"
    data["analysis"]["split"] = {"method": "ranked"}
    return data


def gravity() -> dict[str, Any]:
    """One retraction."""
    data = tiny_gravity()
    data["collection"]["factors"]["mass"]["values"] = [0.245]
    data["collection"]["motion"][5] = {"phase": "hold", "settle": "1 s", "duration": "0.6 s"}
    return data


def take(folder: Path, data: dict[str, Any], **camera: Any) -> tuple[Recording, float]:
    """The one trial of a protocol on the mock rig with another camera; bytes of a frame."""
    folder.mkdir()
    rig_path = folder / "rig.yaml"
    base = str(ROOT / "rigs" / "mock.yaml")
    rig_path.write_text(yaml.safe_dump({"extends": base, "mock": {"frame_camera": camera}}))
    run_request = make_request(write(folder / "p.yaml", data), rig_path, folder / "store")
    work, campaign = at_rig(run_request)
    take_all(work)
    assert verify(TrialStore.open(folder / "store")) == []
    with_plate = run_request.plan.protocol.collection.plate is not None
    (recording,) = campaign.recordings()
    return recording, run_request.rig.frame_bytes(with_plate)


def label(recording: Recording, data: dict[str, Any]) -> Label:
    """Its label by the rule of its protocol."""
    from sliplab.protocols.labelling import Labelling

    return label_recording(recording, Labelling.model_validate(data["analysis"]["labelling"]))


def errors_ms(found: Label, recording: Recording) -> list[float]:
    """Incipient and gross onset against the simulation's truth."""
    truth = recording.simulation_truth()
    pairs = [
        (found.onsets.incipient_ns, truth["incipient_ns"]),
        (found.onsets.gross_ns, truth["gross_ns"]),
    ]
    assert all(a is not None and b is not None for a, b in pairs)
    return [(a - b) / 1e6 for a, b in pairs]


@pytest.mark.long
@pytest.mark.parametrize("make", [kinematic, pytest.param(gravity, marks=pytest.mark.long)])
def test_tracks_label_as_the_video_does(make: Any, tmp_path: Path) -> None:
    data = make()
    recordings, labels, expected = [], [], []
    for level in ("video", "tracks"):
        recording, frame_bytes = take(tmp_path / level, data, level=level)
        found = label(recording, data)
        assert recording.frame_source == found.source == found.document().source == level
        assert found.displacement_px.shape == (len(found.frame_ns), 19)
        assert found.places.plate_lost == 0
        # the first frame over the threshold: up to a frame late, early by noise only; where a plate
        # hangs, tips creep before they go, and the noise of its marker counts for more
        errors = errors_ms(found, recording)
        early = 3.0 if make is kinematic else FRAME_MS + 3.0
        assert all(-early < error < FRAME_MS + 5.0 for error in errors), errors
        expected.append(frame_bytes * len(found.frame_ns))
        recordings.append(recording)
        labels.append(found)
    video, tracks = labels
    files = [recording.folder / "data.h5" for recording in recordings]
    movie = (recordings[0].folder / "frames.mkv").stat().st_size
    assert movie == pytest.approx(expected[0], rel=0.25)
    # the same file otherwise, with the tracks on top
    more = files[1].stat().st_size - files[0].stat().st_size
    assert more == pytest.approx(expected[1], rel=0.35)
    assert recordings[0].simulation_truth() == recordings[1].simulation_truth()
    assert video.frame_ns.tolist() == tracks.frame_ns.tolist()
    for a, b in (
        (video.onsets.incipient_ns, tracks.onsets.incipient_ns),
        (video.onsets.gross_ns, tracks.onsets.gross_ns),
    ):
        # the same frame, or the next one where a twentieth of a pixel decides
        assert abs(a - b) / 1e6 <= 1.05 * FRAME_MS
    assert abs(video.end_ns - tracks.end_ns) / 1e6 <= 1.05 * FRAME_MS
    recording, found = recordings[1], tracks
    assert found.document().end_ns == found.end_ns
    if make is kinematic:
        assert found.end_ns == recording.step("slide")[1]
    else:
        # the fall is fastest just before the stop, in the last frame or the last but one
        places = recording.tracks().plate_px
        assert places is not None
        fastest = int(np.hypot(*np.diff(places, axis=0).T).argmax())
        after = (found.end_ns - int(found.frame_ns[fastest])) / 1e6
        assert 0 < after <= 2.05 * FRAME_MS
        assert found.onsets.gross_ns < found.end_ns < recording.step("retract")[1]


@pytest.mark.long
def test_mild_reflections_leave_the_labels_right(tmp_path: Path) -> None:
    data = kinematic()
    recording, _ = take(tmp_path / "r", data, reflections={"count": 8, "level": 10})
    first = recording.frame(0)
    # far from the skin and its noise there is light on the dark ground
    assert first[:60, :60].max() > 25 or first[-60:, -60:].max() > 25 or first[:, :40].max() > 25
    found = label(recording, data)
    assert found.markers_lost == 0
    assert all(abs(error) < 30.0 for error in errors_ms(found, recording))


def test_a_trial_without_video_and_tracks_cannot_be_labelled(tmp_path: Path) -> None:
    data = kinematic()
    recording, _ = take(tmp_path / "t", data, level="tracks")
    data_file = recording.folder / "data.h5"
    import h5py

    with h5py.File(data_file, "a") as file:
        del file["tracks"]
    write_sums(recording.folder, ("data.h5", "record.json"))
    with pytest.raises(ValueError, match="has neither video nor tracks to label from"):
        label(Recording(recording.folder), data)
