"""Registrations in a report: options of the evaluation that took the place of the protocol's."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.campaigns import collected
from sliplab.analysis.report.page import render_section
from sliplab.analysis.report.registration import registration_key, registration_section
from sliplab.flows.register import register
from sliplab.storage.files import read_json, sha256, write_json
from sliplab.storage.trials.registration import registration_files
from sliplab.storage.trials.store import TrialStore
from tests.flows.older import older_store


def deviations(store: TrialStore) -> dict[str, tuple[str, str]]:
    """Registered and found by name, but for versions: the store is an older one's."""
    section = registration_section(store, collected(store))
    (campaign,) = section.campaigns
    assert campaign.after == "after 4 trials"
    return {
        what: (registered, found)
        for what, registered, found in campaign.deviations.rows
        if not what.startswith("version of ")
    }


@pytest.fixture(scope="module")
def registered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with an evaluation, registered as it is."""
    found = TrialStore.open(older_store(tmp_path_factory.mktemp("registered") / "store"))
    register(found.campaign("small").protocol_file, found.folder, campaign="small")
    return found.folder


@pytest.fixture
def store(registered: Path, tmp_path: Path) -> TrialStore:
    """A copy of it, to be changed at will."""
    return TrialStore.open(shutil.copytree(registered, tmp_path / "store"))


def evaluated(store: TrialStore, **changes: Any) -> None:
    """Change the evaluation as options do."""
    path = store.folder / "derived" / "evaluation" / "evaluation.json"
    data = read_json(path)
    detection = changes.pop("detection", {})
    data["detection"]["small"] |= detection
    write_json(path, data | changes)


def test_evaluation_by_the_protocol_is_no_deviation(store: TrialStore) -> None:
    assert [*deviations(store)] == ["trials taken before the registration"]


@pytest.mark.parametrize(
    ("detection", "found"),
    [({"margin": 5.0}, "smoothing 4, margin 5"), ({"smoothing": 2}, "smoothing 2, margin 8")],
)
def test_given_margin_or_smoothing_is_a_deviation(
    store: TrialStore, detection: dict[str, Any], found: str
) -> None:
    before = registration_key(store, collected(store))
    evaluated(store, detection=detection)
    listed = deviations(store)["evaluate --smoothing, --margin"]
    assert listed == ("smoothing 4, margin 8", found)
    assert registration_key(store, collected(store)) != before


def test_choice_by_the_protocol_is_no_deviation(store: TrialStore) -> None:
    evaluated(store, detection={"margin": 5.0, "choose": "validation"})
    assert "evaluate --smoothing, --margin" not in deviations(store)


def test_review_decisions_are_a_deviation(store: TrialStore) -> None:
    evaluated(store, reviewed={"accepted": 3, "corrected": 1})
    listed = deviations(store)["evaluate --reviewed"]
    assert listed[1] == "review decisions are applied: 3 accepted, 1 corrected"


def test_section_escapes_what_it_shows(store: TrialStore) -> None:
    campaign = store.campaign("small")
    text = campaign.protocol_file.read_text()
    campaign.update(campaign.info, f"{text}# <script>\n", "")
    section = registration_section(store, collected(store))
    assert section is not None
    made = render_section(section, simulated=True)
    page = made.html
    assert made.title == "Registration, and deviations from it"
    assert "text of the protocol" in page
    assert "<script>" not in page


@pytest.mark.parametrize("deleted", [False, True])
def test_changed_or_missing_registration_proves_nothing(store: TrialStore, deleted: bool) -> None:
    campaign = store.campaign("small")
    (path,) = registration_files(campaign)
    session = campaign.folder / "bench" / "0001.json"
    session.parent.mkdir(exist_ok=True)
    write_json(session, {"registration": sha256(path)})  # begun with it
    before = registration_key(store, collected(store))
    if deleted:
        path.unlink()
    else:
        path.chmod(0o644)
        path.write_text(path.read_text().replace("2026", "2025"))
    section = registration_section(store, collected(store))
    (shown,) = section.campaigns
    assert shown.after == "but its registrations are damaged, missing or changed"
    assert shown.deviations.rows[0][0] == "damaged registration"
    assert "missing or changed" in shown.deviations.rows[-1 if deleted else 1][2]
    assert registration_key(store, collected(store)) not in ([], before)
