"""Labels from events against the simulation's truth and the labels from frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sliplab.analysis.campaigns import collected
from sliplab.analysis.labels.event_labels import onsets_by_events
from sliplab.analysis.labels.label import Label
from sliplab.analysis.labels.labelling import label_recording
from sliplab.flows.collect import collect
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import make_request
from sliplab.plugins.web.pages.trial_curves import frame_html
from sliplab.plugins.web.trial_data import load_trial
from sliplab.protocols.labelling import Labelling
from sliplab.storage.schema.label import KINDS, TrialLabel
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT


def take(rig: str, folder: Path, protocol: str = "pilot", **factors: list[float]) -> TrialStore:
    """Slides of the pilot at the corners of its grid, on a simulated rig."""
    data = yaml.safe_load((ROOT / "protocols" / f"{protocol}.yaml").read_text())
    for name, values in factors.items():
        data["collection"]["factors"][name] |= {"values": values}
    path = folder / "protocol.yaml"
    path.write_text(yaml.safe_dump(data))
    collect(make_request(path, ROOT / "rigs" / f"{rig}.yaml", folder / "store"))
    return TrialStore.open(folder / "store")


CORNERS = {"depth": [2.4, 3.4], "speed": [0.6, 1.6], "direction": [90.0]}


@pytest.fixture(scope="module")
def slides(tmp_path_factory: pytest.TempPathFactory) -> list[Recording]:
    """Four slides with events and tracks: shallow and deep, slow and fast."""
    store = take("rehearsal", tmp_path_factory.mktemp("slides"), **CORNERS)
    return list(store.campaign("pilot").recordings())


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """One slide of a rig without a frame camera, not labelled."""
    folder = tmp_path_factory.mktemp("unseen")
    return take("mock_events", folder, depth=[2.8], speed=[1.6], direction=[0.0])


class WithOtherEvents:
    """A recording whose events come out of a function of them."""

    def __init__(
        self, recording: Recording, change: Callable[[EventChunk, int], EventChunk]
    ) -> None:
        self._recording, self._change = recording, change

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def events(self) -> EventChunk:
        """The changed events."""
        truth = self._recording.simulation_truth() or {}
        gross_us = int(self.clock("events").to_device(truth["gross_ns"])) // 1000
        return self._change(self._recording.events(), gross_us)


def thinned(share: float, from_s: float, to_s: float) -> Callable[[EventChunk, int], EventChunk]:
    """Lose a share of the events over a time after gross slip."""

    def change(events: EventChunk, gross_us: int) -> EventChunk:
        since_s = (events.t_us - gross_us) * 1e-6
        lost = (since_s > from_s) & (since_s < to_s)
        lost &= np.random.default_rng(1).random(len(events)) < share
        return events[~lost]

    return change


def by_events(recording: Any) -> Label:
    return onsets_by_events(recording, Labelling())


def errors_ms(recording: Recording, found: Label) -> dict[str, float]:
    """Onsets of the paper's rule less the true crossings, of those that are not in doubt."""
    truth = recording.simulation_truth()
    assert truth is not None
    known = {}
    for kind in KINDS:
        if getattr(found.paper_doubts, kind) is None and found.paper_doubts.incipient is None:
            at = getattr(found.paper, f"{kind}_ns")
            known[kind] = (at - truth[f"{kind}_ns"]) / 1e6
    return known


def test_onsets_are_within_their_interval_and_close_to_those_from_frames(
    slides: list[Recording],
) -> None:
    known = 0
    for recording in slides:
        found, frames = by_events(recording), label_recording(recording, Labelling())
        truth = recording.simulation_truth() or {}
        for kind, error in errors_ms(recording, found).items():
            low, high = getattr(found.intervals, f"{kind}_ns")
            assert low <= truth[f"{kind}_ns"] <= high
            assert abs(error) < 100.0
            seen = getattr(frames.paper, f"{kind}_ns")
            assert abs(getattr(found.paper, f"{kind}_ns") - seen) / 1e6 < 110.0
            known += 1
        # the beginning of each papilla's slip, the outermost first
        began = np.array([np.nan if t is None else t for t in truth["slip_per_papilla_ns"]])
        slipped = found.slips.at_ns >= 0
        assert slipped.sum() >= 17
        off_ms = (found.slips.at_ns[slipped] - began[slipped]) / 1e6
        assert np.nanmedian(np.abs(off_ms)) < 15.0
    assert known >= 6


@pytest.mark.long
def test_tracks_are_near_the_truth(slides: list[Recording]) -> None:
    """The distance slid is the displacement in the frames, which see the tips from outside."""
    for recording in slides:
        found, frames = by_events(recording), label_recording(recording, Labelling())
        seen = np.stack(
            [
                np.interp(found.frame_ns, frames.frame_ns, column)
                for column in frames.displacement_px.T
            ],
            axis=1,
        )
        moving = (found.frame_ns > frames.start_ns)[:, None] & (seen < 4.0)
        off = (found.displacement_px - seen)[moving]
        # a px is 0.05 mm
        assert np.nanmedian(np.abs(off)) < 0.4
        assert np.nanquantile(np.abs(off), 0.95) < 1.6
        z = (np.abs(off) / found.places.sigma[moving])[np.isfinite(off)]
        assert (z < 3.0).mean() > 0.9


CASES = {
    "half lost before gross": thinned(0.5, -0.8, -0.3),
    "half lost at gross": thinned(0.5, -0.15, 0.15),
    "all lost for 50 ms before gross": thinned(1.0, -0.3, -0.25),
    "all lost for 0.3 s long before gross": thinned(1.0, -1.6, -1.3),
}


@pytest.mark.quick(1)
@pytest.mark.parametrize("case", CASES)
def test_lost_events_leave_the_gross_onset_right_or_in_doubt(
    case: str, slides: list[Recording]
) -> None:
    doubted = 0
    for recording in slides:
        found = by_events(WithOtherEvents(recording, CASES[case]))
        assert all(abs(error) < 100.0 for error in errors_ms(recording, found).values())
        doubted += found.paper_doubts.gross is not None
    assert doubted >= (1 if "long" in case else len(slides))


@pytest.mark.long
def test_a_camera_that_loses_a_third_of_all_events_is_still_right_or_in_doubt(
    slides: list[Recording],
) -> None:
    known = 0
    for recording in slides:
        found = by_events(WithOtherEvents(recording, thinned(0.33, -60.0, 60.0)))
        errors = errors_ms(recording, found)
        assert all(abs(error) < 150.0 for error in errors.values())
        known += len(errors)
    assert known >= 4


@pytest.mark.long
def test_twists_are_labelled_too(tmp_path: Path) -> None:
    """The centre turns on the spot, makes no event, and is in nobody's way."""
    store = take("rehearsal", tmp_path, "press_twist", depth=[2.8], speed=[12.0], angle=[40.0])
    for recording in store.campaign("press_twist").recordings():
        found = by_events(recording)
        errors = errors_ms(recording, found)
        assert "incipient" in errors
        assert all(abs(error) < 150.0 for error in errors.values())
        began = (recording.simulation_truth() or {})["slip_per_papilla_ns"]
        slipped = np.flatnonzero(found.slips.at_ns >= 0)
        off = [abs(found.slips.at_ns[k] - began[k]) / 1e6 for k in slipped if began[k] is not None]
        assert len(off) >= 15
        assert np.median(off) < 20.0
        assert found.displacement_px[-1, 0] == 0.0


def test_without_events_everything_is_in_doubt(slides: list[Recording]) -> None:
    def none(events: EventChunk, gross_us: int) -> EventChunk:
        return EventChunk.empty()

    found = by_events(WithOtherEvents(slides[0], none))
    assert "not found" in found.paper_doubts.incipient
    assert found.paper.incipient_ns is None


def test_the_document_says_that_it_is_from_events(unseen: TrialStore) -> None:
    recording = next(iter(unseen.campaign("pilot").recordings()))
    found = label_recording(recording, Labelling())
    document = TrialLabel.model_validate(found.document().to_json())
    assert document.source == "events"
    low, high = document.intervals.incipient_ns or (0, 0)
    assert low <= document.incipient_ns <= high
    assert document.change_point is not None
    arrays = found.as_arrays()
    assert arrays["displacement_px"].shape == (len(arrays["frame_ns"]), 19)
    assert np.diff(arrays["frame_ns"]).tolist() == [5_000_000] * (len(arrays["frame_ns"]) - 1)
    # the centre slips last and then slides with the sensor, 20 px/mm
    assert 20.0 < arrays["displacement_px"][-1, 0] < 180.0


def test_a_reviewer_sees_the_markers_where_the_event_camera_does(unseen: TrialStore) -> None:
    store = unseen
    (item,) = collected(store)
    trial = item.trials[0][1].trial_id
    assert load_trial(store, item, trial).displacement_px.shape == (0, 0)
    label(store, [item])
    shown = load_trial(store, item, trial)
    found = frame_html(shown, 1000)
    assert "viewBox='-0.5 -0.5 640 480'" in found
    assert "as the event camera sees the markers" in found
    assert shown.places(1000)[0] == pytest.approx([319.5, 239.5], abs=60.0)


@pytest.mark.long
def test_a_plate_that_moves_is_not_seen(tmp_path: Path) -> None:
    store = take("mock_events", tmp_path, "pilot_gravity", speed=[0.7])
    recording = next(iter(store.campaign("pilot_gravity").recordings()))
    document = label_recording(recording, Labelling()).document()
    assert (document.incipient_ns, document.gross_ns) == (None, None)
    for doubt in (document.doubts.incipient, document.doubts.gross):
        assert "the plate moves by itself" in str(doubt)
