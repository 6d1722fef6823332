"""A skin that is logged in mid-campaign: in trials, tables, references, splits and the report."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

import sliplab
from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.page import render_section
from sliplab.analysis.report.skins import skin_section
from sliplab.flows.collecting import preparation
from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.collecting.supervisor import CollectionSupervisor
from sliplab.flows.log import add_note, log_entries
from sliplab.flows.planning import preflight
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.status import StatusReader
from sliplab.protocols import InputError
from sliplab.rigs.rig_file import same_rig
from sliplab.storage.errors import StoreError
from sliplab.storage.trials import control
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.context import LoggedContext
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import answer, here
from tests.conftest import ROOT
from tests.flows.collecting.test_session import session, short
from tests.flows.collecting.test_watches import begin, with_references
from tests.flows.conftest import write
from tests.storage.trial_files import campaign as plain_campaign


def logging(work: TrialCollector, campaign: Campaign, store: TrialStore) -> TrialCollector:
    """Let a session read the log, as `open_session` does."""
    work.context = LoggedContext(store, campaign.name).read
    return work


@pytest.fixture
def two_skins(tmp_path: Path) -> tuple[TrialStore, Campaign]:
    """One trial with the rig file's skin; two with 0043, the last of them of another session."""
    work, campaign = session(tmp_path, short())
    store = TrialStore.open(tmp_path / "store")
    logging(work, campaign, store)
    trials = pending_trials(work.plan, campaign)
    work.take(trials[:1])
    add_note(store, "torn", who="anna", context={"skin": "0043", "temperature": "24 degC"})
    work.take(trials[1:2])  # the session runs on
    resumed, campaign = session(tmp_path, short())
    logging(resumed, campaign, store).take(trials[2:])
    return store, campaign


def test_every_trial_from_then_on_has_the_skin(two_skins: tuple[TrialStore, Campaign]) -> None:
    store, campaign = two_skins
    first, *others = (campaign.recording(t.id) for t in Collected(campaign).plan)
    assert "context" not in json.loads((first.folder / "record.json").read_text())
    assert first.context == {"skin": "simulated-1"}
    for recording in others:
        assert recording.record.context == {"skin": "0043", "temperature": "24 degC"}
        assert campaign.provenance(recording).skin == "0043"
    table = catalogue(store).set_index("trial")
    assert list(table.loc[[r.trial_id for r in (first, *others)], "skin"]) == [
        "simulated-1",
        "0043",
        "0043",
    ]
    assert table["temperature_degC"].count() == 2
    assert verify(store) == []
    trial = next(iter(sliplab.open_store(store.folder)))
    assert trial.to_dict()["attrs"]["skin"] in {"simulated-1", "0043"}


def test_depth_zero_is_found_again_with_another_skin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, campaign = session(tmp_path, short())
    store = TrialStore.open(tmp_path / "store")
    logging(work, campaign, store)
    zeros: list[int] = []
    found = preparation.rezero

    def rezero(*given: Any) -> Any:
        zeros.append(len(campaign.committed()))
        return found(*given)

    monkeypatch.setattr(preparation, "rezero", rezero)
    trials = pending_trials(work.plan, campaign)
    work.take(trials[:2])
    add_note(store, "", context={"temperature": "24 degC"})
    work.take(trials[2:3])
    assert zeros == [0]  # a temperature touches nothing
    add_note(store, "", context={"skin": "0043"})
    control.again(campaign, [trials[2].id], {"why": "torn"})
    work.take(trials[2:3])
    assert zeros == [0, 2]


def test_the_log_and_the_status_name_the_skin_and_what_it_asks_for(
    two_skins: tuple[TrialStore, Campaign],
) -> None:
    store, _ = two_skins
    (entry,) = (each for each in log_entries(store) if each.what == "context")
    assert (entry.who, entry.text) == ("anna", "skin 0043, temperature 24 degC, torn")
    assert entry.campaign == "tiny"
    (item,) = StatusReader(store).read().campaigns
    assert item.skins == {"simulated-1": 1, "0043": 2}
    assert item.context == {"skin": "0043", "temperature": "24 degC"}
    assert item.repeat == [f"labels of 2 trials: `sliplab label {store.folder}`"]


def test_one_list_names_what_belongs_to_the_old_skin(tmp_path: Path) -> None:
    data = with_references()
    data["collection"]["maintenance"].pop("rezero")
    _, campaign = session(tmp_path, data)
    store = TrialStore.open(tmp_path / "store")
    rig = json.loads((campaign.folder / "rig.yaml").read_text())
    rig["calibration"]["depth_zero"] = {
        "zero": "0.01 mm",
        "taught": "2026-11-22",
        "residual": "0.01 mm",
        "method": "events",
    }
    (campaign.folder / "rig.yaml").write_text(json.dumps(rig))
    models = store.folder / "models"
    models.mkdir()
    (models / "old.pt").write_bytes(b"x")
    os.utime(models / "old.pt", (0, 0))
    done = answer("log", store.folder, "--skin", "0043", "--who", "anna")
    texts = done["repeat"]["tiny"]
    assert [text.partition(" ")[0] for text in texts] == [
        "calibration.depth_zero,",
        "clocks",
        "reference",
        "networks",
    ]
    assert "teach zero --rig RIG" in texts[0]
    assert "old" in texts[3]


def test_a_check_names_what_the_new_skin_lacks(two_skins: tuple[TrialStore, Campaign]) -> None:
    store, _ = two_skins
    folder = store.folder.parent
    found = preflight.check(folder / "p.yaml", folder / "rig.yaml", store.folder, ())
    (item,) = (each for each in found if each.name == "skin")
    assert (item.passed, item.caution) == (True, True)
    assert item.finding.startswith("labels of 2 trials")


def test_references_are_compared_within_a_skin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, campaign, run_request = begin(tmp_path / "a", with_references())
    store = TrialStore.open(run_request.store)
    logging(work, campaign, store)
    work.supervisor = CollectionSupervisor(run_request, store, campaign)
    references = [trial.id for trial in run_request.plan if trial.role == "reference"]
    rates = dict(zip(references, (1000.0, 2000.0, 2900.0), strict=True))
    monkeypatch.setattr(
        "sliplab.analysis.references.hold_rate", lambda recording: rates[recording.trial_id]
    )
    trials = pending_trials(work.plan, campaign)
    work.take(trials[:2])
    add_note(store, "", context={"skin": "0043"})
    work.take(trials[2:4])  # twice the rate, with another skin
    work.supervisor = CollectionSupervisor(run_request, store, campaign)
    work.supervisor.begin()
    with pytest.raises(sliplab.CampaignStopped, match=r"had 2,000 \(\+45.0 %"):
        work.take(trials[4:])


def test_a_split_holds_out_a_logged_skin_and_the_report_says_where_skins_mix(
    two_skins: tuple[TrialStore, Campaign],
) -> None:
    store, campaign = two_skins
    mixed = Collected(campaign)
    section = skin_section([mixed])
    assert section is not None
    assert section.skins == ["simulated-1", "0043"]
    html = render_section(section, simulated=True).html
    assert "Trials of 2 skins are pooled" in html
    data = short()
    before = mixed.plan.analysis_hash
    data["analysis"]["split"] = {"method": "ranked", "held_out": {"skin": ["0043"]}}
    write(campaign.protocol_file, data)
    held = Collected(campaign)
    assert held.plan.analysis_hash != before
    assert held.plan.collection_hash == mixed.plan.collection_hash
    parts = {recording.context["skin"]: trial.split for trial, recording in held.trials}
    assert parts["0043"] == "test"
    assert parts["simulated-1"] in {"train", "validation"}
    section = skin_section([held])
    assert section is not None
    assert (section.mixed, section.unseen) == ([], ["0043"])
    assert "never saw" in render_section(section, simulated=True).html
    assert store.simulated


@pytest.mark.parametrize(
    ("context", "says"),
    [
        ({"depth": "3 mm"}, "is planned trial by trial by collection.factors.depth"),
        ({"Skin": "1"}, "must be small letters"),
        ({"trial": "1"}, "no column of every table"),
        ({"skin": "a b"}, "a number with its unit"),
        ({"skin": ""}, "must be a text"),
    ],
)
def test_what_cannot_be_logged_is_refused(
    tmp_path: Path, context: dict[str, str], says: str
) -> None:
    session(tmp_path, short())
    store = TrialStore.open(tmp_path / "store")
    with pytest.raises(ValueError, match=says):
        add_note(store, "", context=context)
    assert log_entries(store) == []


def test_a_context_with_one_level_may_change_in_its_unit(tmp_path: Path) -> None:
    data = short()
    data["collection"]["context"] = {"width": {"unit": "mm", "values": [40]}}
    work, campaign = session(tmp_path, data)
    store = TrialStore.open(tmp_path / "store")
    with pytest.raises(InputError, match="number with a unit"):
        add_note(store, "", context={"width": "41"})
    add_note(store, "", context={"width": "4.1 cm"})
    logging(work, campaign, store).take(pending_trials(work.plan, campaign)[:1])
    (recording,) = campaign.recordings()
    assert (recording.record.condition["width"], recording.described["width"]) == ("40 mm", "41 mm")
    assert list(catalogue(store)["width_mm"]) == [41.0]


def test_without_a_campaign_there_is_nothing_to_change(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    with pytest.raises(ValueError, match="no campaign has begun"):
        add_note(store, "", context={"skin": "0043"})
    plain_campaign(tmp_path / "t", "c")
    with pytest.raises(InputError, match="is no campaign"):
        add_note(TrialStore.open(tmp_path / "t"), "", context={"skin": "1"}, campaigns=["d"])


def test_a_damaged_log_stops_a_collection_that_cannot_know_its_skin(tmp_path: Path) -> None:
    work, campaign = session(tmp_path, short())
    store = TrialStore.open(tmp_path / "store")
    add_note(store, "", context={"skin": "0043"})
    (store.folder / "log" / "000001.json").write_text("{")
    logging(work, campaign, store)
    with pytest.raises(StoreError, match="log the skin again"):
        work.take(pending_trials(work.plan, campaign))
    assert campaign.committed() == set()


MOCK = (ROOT / "rigs" / "mock.yaml").read_text()


def test_a_rig_file_may_name_the_logged_skin_and_what_was_measured_on_it() -> None:
    other = MOCK.replace("serial: simulated-1", "serial: '0043'")
    other = other.replace("made: 2026-11-01, ", "")
    other = other.replace("touch_depth: 0.34", "touch_depth: 0.30")
    assert other != MOCK
    assert not same_rig(MOCK, other)
    assert same_rig(MOCK, other, skin="0043")
    assert not same_rig(MOCK, other, skin="0044")
    lens = other.replace("scale_px_per_mm: 20,", "scale_px_per_mm: 20.02,")
    assert not same_rig(MOCK, lens, skin="0043")


def test_a_rig_file_with_a_skin_that_was_not_logged_is_named(tmp_path: Path) -> None:
    session(tmp_path, short())
    rig = tmp_path / "rig.yaml"
    rig.write_text(rig.read_text().replace('"serial": "simulated-1"', '"serial": "0043"'))
    asked = tmp_path / "p.yaml", rig, tmp_path / "store"
    with pytest.raises(StoreError, match=r"log it with `sliplab log .* --skin 0043`"):
        make_request(*asked)
    add_note(TrialStore.open(tmp_path / "store"), "", context={"skin": "0043"})
    assert make_request(*asked).rig.skin.serial == "0043"


def test_the_command_refuses_what_it_cannot_keep(tmp_path: Path) -> None:
    TrialStore.create(tmp_path / "s")
    for given, says in (
        (("x", "--who", ""), "--who = '': must be a name"),
        (("x\ny",), "must be one line without control characters"),
        (("\x1b[31mred",), "must be one line without control characters"),
        (("--context", "skin"), "must be NAME=VALUE"),
        (("x", "--campaign", "c"), "needs --skin or --context"),
        (("--who", "anna"), "is valid only with a note, --skin or --context"),
        (("--skin", "a b"), "--context: skin = a b: must be a text"),
        (("--campaign", "c"), "--campaign = c: is not there: no campaign has begun"),
    ):
        done = here("log", tmp_path / "s", *given)
        assert done.returncode == 2, given
        assert says in done.stderr


def test_a_notebook_logs_a_skin(tmp_path: Path) -> None:
    session(tmp_path, short())
    entries = sliplab.open_store(tmp_path / "store").log("torn", skin="0043", who="anna")
    assert [(e.what, e.who, e.text) for e in entries] == [("context", "anna", "skin 0043, torn")]
