"""Trials, labels and decisions as the review page lists and shows them."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.flows.label import report_states
from sliplab.plugins.web.review.doubt import reasons_for_doubt
from sliplab.plugins.web.review.trial_list import TrialList, filtered_rows
from sliplab.plugins.web.trial_data import load_trial
from sliplab.protocols.errors import InputError
from sliplab.storage.formats.import_trials import import_trials
from sliplab.storage.formats.recognition import trials_in
from sliplab.storage.schema.label import LABELS as STEP
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.review import ReviewedOnsets
from tests.analysis.labels.reviewable import EVENTS, NAME, Reviewable, displacements, label, places
from tests.storage.formats.files import lab_hdf5


@pytest.fixture
def made(tmp_path: Path) -> Reviewable:
    """Twelve trials."""
    return Reviewable(tmp_path / "s", 12)


def test_a_decision_on_a_label_that_changed_is_stale_and_not_applied(
    made: Reviewable, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = made.ids[0]
    made.keys[trial] = "of an older label"
    made.decide(trial, "adjust")
    labels = StoreLabels(made.store, reviewed=True)
    found = labels.read(made.item, made.recording(trial))
    assert found.incipient_ns == label()["incipient_ns"]
    assert report_states(labels, [made.item])["reviewed"]["stale"] == 1
    assert report_states(StoreLabels(made.store), [made.item]) == {}
    assert (
        "decisions on 1 trial were made on labels that have changed since"
        in capsys.readouterr().err
    )
    rows = TrialList(made.store).rows
    assert rows[0].state == "stale"
    assert filtered_rows(rows, state="stale") == [rows[0]]


def test_the_list_shows_a_damaged_decision(made: Reviewable) -> None:
    made.decide(made.ids[0], "adjust")
    (made.store.folder / "review" / NAME / made.ids[0] / "000001.json").write_text("{")
    assert "000001.json" in TrialList(made.store).rows[0].problem


def test_imported_campaigns_beside_it_are_left_out(made: Reviewable, tmp_path: Path) -> None:
    path = tmp_path / "slide.h5"
    lab_hdf5(path)
    import_trials(made.store, "theirs", trials_in(path, "lab-hdf5"), path, "lab-hdf5")
    assert [row.trial for row in TrialList(made.store).rows] == made.ids
    with pytest.raises(InputError, match="theirs: was imported"):
        TrialList(made.store, ["theirs"])


def test_the_list_follows_the_store(made: Reviewable) -> None:
    trials = TrialList(made.store)
    assert [row.trial for row in trials.rows] == made.ids
    assert {(row.label, row.state, row.severity) for row in trials.rows} == {("fresh", "open", 0)}
    assert not trials.refresh()
    made.decide(made.ids[3], "adjust")  # by another program
    assert trials.refresh()
    assert (trials.rows[3].state, trials.rows[3].who) == ("adjusted", "anna")
    derived = Derived.of(made.store, STEP, NAME)
    derived.write(made.ids[5], "other", {**label(), "gross_ns": None, "flags": ["knocked"]})
    (derived.folder / f"{made.ids[6]}.json").unlink()
    assert trials.refresh()
    assert [row.label for row in trials.rows[4:7]] == ["fresh", "stale", "missing"]
    assert trials.rows[5].reasons == ("no gross slip was found", "knocked")
    first = filtered_rows(trials.rows)
    assert first[0] == trials.rows[5]
    assert first[-1] == trials.rows[3]
    assert [row.trial for row in filtered_rows(trials.rows, doubtful_first=False)] == made.ids
    assert filtered_rows(trials.rows, state="doubtful") == [trials.rows[5]]


def test_doubts_are_told_once_and_gravest_first() -> None:
    data = {"incipient_ns": None, "gross_ns": None, "end_ns": 1, "markers_lost": 2}
    data |= {"plate_lost": 1, "doubts": {"incipient": None, "gross": "hidden"}}
    assert [text for _, text in reasons_for_doubt(TrialLabel.model_validate(data))] == [
        "gross: hidden",
        "no slip was found",
        "2 times a marker was not seen",
        "the plate's marker was not seen in 1 frame",
    ]


def test_what_is_shown_is_what_was_stored(made: Reviewable) -> None:
    trials = TrialList(made.store)
    shown = load_trial(made.store, made.item, made.ids[0])
    assert shown.displacement_px == pytest.approx(displacements(), abs=1e-6)
    assert shown.xy_px is not None
    assert (shown.xy_px == places()).all()
    assert 0 < shown.rate.sum() / 100 <= EVENTS
    assert shown.rate[:19].sum() / 100 <= 200
    assert shown.motion_s == (0.2, 0.6)
    assert shown.frame_at(0.2551) == 25
    picture = shown.picture(25)
    assert picture.shape == (120, 120)
    assert picture[60, 60] == 220
    # without a label there are still events and frames to see
    Derived.of(made.store, STEP, NAME).folder.joinpath(f"{made.ids[1]}.json").unlink()
    assert trials.refresh()
    bare = load_trial(made.store, made.item, made.ids[1])
    assert bare.displacement_px.shape == (60, 0)
    assert bare.suggested == ReviewedOnsets()


def test_a_port_that_is_taken_and_a_campaign_that_is_not_there(made: Reviewable) -> None:
    from sliplab.flows.cli.app import command_line

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for arguments, said in (["--port", port], "--port"), (["--campaign", "x"], "are kinematic"):
            with pytest.raises(InputError, match=said):
                command_line()(
                    ["review", str(made.store.folder), *arguments], standalone_mode=False
                )
