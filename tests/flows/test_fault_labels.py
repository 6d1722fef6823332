"""Labels of trials in which a marker, a papilla or the plate failed: right, or refused and why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.labels.label import Label
from sliplab.analysis.labels.labelling import label_recording
from sliplab.protocols.labelling import Labelling
from sliplab.storage.schema.label import OnsetDoubts
from sliplab.storage.trials.recording import Recording
from tests.flows.collecting.test_session import session
from tests.flows.conftest import take_all, tiny, tiny_gravity

TRACKS = {"level": "tracks"}


def one_slide(
    folder: Path, faults: list[dict[str, Any]], distance: str = "7 mm", level: str = "tracks"
) -> tuple[Label, Recording]:
    """Collect and label one slide, which by default goes on until everything slips."""
    data = tiny()
    data["collection"]["motion"][3]["distance"] = distance
    data["collection"]["factors"]["direction"]["values"] = [60]
    data["collection"]["maintenance"] = {}
    data["analysis"]["split"] = {"method": "ranked"}
    work, campaign = session(folder, data, faults=faults, frame_camera={"level": level})
    take_all(work)
    (recording,) = campaign.recordings()
    return label_recording(recording, Labelling()), recording


def errors_ms(label: Label, recording: Recording) -> dict[str, float | None]:
    """Onsets as kept, less the truth; None where the label has none."""
    truth, kept = recording.simulation_truth(), label.document().to_json()
    assert truth is not None
    return {
        name: None if kept[name] is None else (kept[name] - truth[name]) / 1e6
        for name in ("incipient_ns", "gross_ns")
    }


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> tuple[Label, Recording]:
    return one_slide(tmp_path_factory.mktemp("sound"), [])


def first_slip_s(sound: tuple[Label, Recording]) -> float:
    """Return the first marker's slip time, seconds into the recording."""
    return sound[0].onsets.incipient_ns / 1e9


def test_a_sound_trial_leaves_no_doubt(sound: tuple[Label, Recording]) -> None:
    assert sound[0].document().doubts == OnsetDoubts(incipient=None, gross=None)
    errors = errors_ms(*sound)
    assert all(value is not None and abs(value) <= 30 for value in errors.values())


@pytest.mark.long
@pytest.mark.parametrize("kind", ["papilla_torn", "marker_occluded"])
@pytest.mark.parametrize("lead_s", [0.5, 0.2, -0.1])
def test_no_lost_marker_makes_a_label_wrong(
    tmp_path: Path, sound: tuple[Label, Recording], kind: str, lead_s: float
) -> None:
    """The very marker that slips first is lost a little before, or just after it did."""
    first = sound[0].onsets.first_marker
    fault = {"kind": kind, "papilla": first, "at_s": first_slip_s(sound) - lead_s}
    label, recording = one_slide(tmp_path, [fault])
    kept, errors = label.document().to_json(), errors_ms(label, recording)
    if lead_s > 0 and (kind == "papilla_torn" or lead_s < 0.3):
        assert kept["incipient_ns"] is kept["gross_ns"] is None
        assert kept["doubts"]["incipient"].startswith(f"marker {first} could not be followed")
    else:  # it came back in time, or was there when it slipped
        assert kept["doubts"] == {"incipient": None, "gross": None}
        assert all(value is not None and abs(value) <= 30 for value in errors.values())


@pytest.mark.parametrize("kind", ["papilla_torn", "marker_occluded"])
def test_without_the_centre_gross_slip_is_unknown(
    tmp_path: Path, sound: tuple[Label, Recording], kind: str
) -> None:
    gross = sound[0].onsets.gross_ns
    fault = {"kind": kind, "papilla": 0, "at_s": gross / 1e9 - 0.2}
    label, recording = one_slide(tmp_path, [fault])
    kept = label.document().to_json()
    assert kept["gross_ns"] is None
    assert kept["doubts"]["gross"].startswith("the centre marker could not be followed from")
    assert kept["doubts"]["incipient"] is None
    error = errors_ms(label, recording)["incipient_ns"]
    assert error is not None
    assert abs(error) <= 30


@pytest.mark.long
def test_a_marker_hidden_on_video_is_not_taken_for_another(
    tmp_path: Path, sound: tuple[Label, Recording]
) -> None:
    first = sound[0].onsets.first_marker
    fault = {"kind": "marker_occluded", "papilla": first, "at_s": first_slip_s(sound) - 0.2}
    label, _ = one_slide(tmp_path, [fault], "3 mm", "video")
    kept = label.document()
    assert kept.incipient_ns is None
    assert str(kept.doubts.incipient).startswith(f"marker {first} could not be")


def one_fall(folder: Path, faults: list[dict[str, Any]]) -> tuple[Label, Recording]:
    """Collect and label one gravity trial."""
    data = tiny_gravity()
    data["collection"]["maintenance"] = {}
    work, campaign = session(folder, data, faults=faults, frame_camera=TRACKS)
    work.take(list(work.plan)[:1])
    (recording,) = campaign.recordings()
    return label_recording(recording, Labelling()), recording


def test_a_plate_that_is_stuck_gives_no_gross_slip(tmp_path: Path) -> None:
    label, recording = one_fall(tmp_path, [{"kind": "plate_stuck"}])
    truth = recording.simulation_truth()
    assert truth["gross_ns"] is None
    assert label.document().gross_ns is None
    assert label.doubts.gross is None  # it is known that there was none


@pytest.mark.long
def test_an_occluded_plate_leaves_a_right_label_or_none(tmp_path: Path) -> None:
    sound = one_fall(tmp_path / "sound", [])
    assert sound[0].document().doubts == OnsetDoubts(incipient=None, gross=None)
    assert all(v is not None and abs(v) <= 30 for v in errors_ms(*sound).values())
    first = first_slip_s(sound)
    # hidden for 0.3 s once it moves: back before the first slip, or not
    for number, (lead_s, known) in enumerate([(0.45, True), (0.15, False)]):
        fault = {"kind": "marker_occluded", "plate": True, "at_s": first - lead_s}
        label, recording = one_fall(tmp_path / str(number), [fault])
        errors = errors_ms(label, recording)
        assert (errors["incipient_ns"] is not None) == known
        assert all(value is None or abs(value) <= 30 for value in errors.values())
