"""Trials, review and report of the web application: filters, data, decisions, files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from starlette.testclient import TestClient

from sliplab.plugins.web.pages.gates import gate_texts
from sliplab.plugins.web.pages.trial_curves import MOST_POINTS, thinned
from sliplab.storage.schema.trial import Gate
from sliplab.storage.trials import review
from sliplab.storage.trials.store import TrialStore
from tests.analysis.labels.reviewable import (
    FRAMES,
    NAME,
    STEP_NS,
    Reviewable,
    displacements,
    label,
)
from tests.plugins.web.pages.opened import csrf, opened

TRIALS = 130


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Reviewable:
    return Reviewable(tmp_path_factory.mktemp("web") / "store", TRIALS)


@pytest.fixture
def made(whole: Reviewable, tmp_path: Path) -> Reviewable:
    return whole.copied(tmp_path / "store")


def address(trial: str) -> str:
    return f"{NAME}/{quote(trial)}"


def decision(made: Reviewable, trial: str, **changes: Any) -> dict[str, Any]:
    """What the review page sends to accept a label."""
    known = label()
    lines = {kind: str(known[kind]) for kind in ("incipient_ns", "gross_ns")}
    asked = {"campaign": NAME, "trial": trial, "verdict": "accept", "lines": lines}
    return {**asked, "label": made.keys[trial], "seen": 0, "who": "anna", "why": "", **changes}


def send(browser: TestClient, asked: dict[str, Any]) -> tuple[int, str]:
    """Status and text of the answer to a decision."""
    headers = {"x-csrf-token": csrf(browser)}
    answer = browser.post("/review/decision", content=json.dumps(asked), headers=headers)
    json_type = answer.headers["content-type"].startswith("application/json")
    return answer.status_code, answer.json()["stated"] if json_type else answer.text


def test_catalogue_is_filtered_sorted_and_paged(made: Reviewable) -> None:
    page = opened(made.store, role="reader")
    first = page.get("/trials").text
    assert f"{TRIALS} trials (simulated)" in first
    assert "page 1 of 2" in first
    assert page.get("/trials?page=2").text.count("/trials/kinematic/") == TRIALS - 100
    assert "page 2 of 2" in page.get("/trials?page=999").text  # one that is not there: the last
    trial = made.ids[3]
    assert page.get("/trials", params={"text": trial}).text.count("/trials/kinematic/") == 1
    where = "depth_mm > 1000"
    assert f"0 of {TRIALS} trials" in page.get("/trials", params={"where": where}).text
    down = page.get("/trials?sort=-trial&columns=all").text
    assert down.index(quote(max(made.ids))) < down.index(quote(sorted(made.ids)[-2]))
    assert "frame_source" in down
    assert "frame_source</a>" not in first


@pytest.mark.parametrize("where", ["depth_mm >", "__import__('os')", "nothing == 1", "<script>"])
def test_condition_that_cannot_be_read_is_named(made: Reviewable, where: str) -> None:
    page = opened(made.store).get("/trials", params={"where": where})
    assert page.status_code == 200
    assert 'role="alert"' in page.text
    assert "<script>" not in page.text.split("<main", 1)[1]


def test_empty_store_has_no_trials_and_nothing_to_review(tmp_path: Path) -> None:
    page = opened(TrialStore.create(tmp_path / "store"))
    assert "No trial was committed yet" in page.get("/trials").text
    assert page.get("/review").status_code == 200
    assert page.get("/review/rows").json()["rows"] == []
    report = page.get("/report").text
    assert "No page was made yet" in report
    assert f"sliplab evaluate {tmp_path / 'store'}" in report


def test_trial_has_gates_files_and_neighbours_of_the_choice(made: Reviewable) -> None:
    page = opened(made.store, role="reader")
    order = sorted(made.ids)
    found = page.get(f"/trials/{address(order[5])}").text
    assert "frames lost <span>0 of 0 allowed</span>" in found
    assert "simulated" in found
    for name in (order[4], order[6]):
        assert f"/trials/{NAME}/{quote(name)}" in found
    alone = page.get(f"/trials/{address(order[5])}", params={"text": order[5]}).text
    assert quote(order[4]) not in alone
    checked = page.get(f"/trials/{address(order[5])}/files").json()
    assert {state for _, state in checked} == {"intact"}
    for path in (f"/trials/{NAME}/none", "/trials/none/none", f"/trials/{NAME}/..%2Fx"):
        assert page.get(path).status_code == 404
        assert page.get(f"{path}/curves").status_code == 404


def test_damaged_file_is_named(made: Reviewable) -> None:
    trial = made.ids[1]
    path = made.recording(trial).folder / "record.json"
    text = path.read_text()
    path.unlink()  # the others link to the same file
    path.write_text(text.replace("0", "1", 1))
    checked = dict(opened(made.store).get(f"/trials/{address(trial)}/files").json())
    assert checked["record.json"] == "does not match its checksum"
    assert checked["data.h5"] == "intact"


def test_curves_are_those_of_the_recording(made: Reviewable) -> None:
    found = opened(made.store).get(f"/trials/{address(made.ids[0])}/curves").json()
    panels = {panel["name"]: panel for panel in found["panels"]}
    assert list(panels) == ["displacement", "events", "speed of the tool"]
    moved = np.array([curve["y"] for curve in panels["displacement"]["curves"]]).T
    assert moved[:, -2] == pytest.approx(displacements()[:, 1], abs=1e-3)  # slips first
    assert moved[:, -1] == pytest.approx(displacements()[:, 0], abs=1e-3)  # the centre
    assert found["frames"] == FRAMES
    assert found["onsets"]["label"]["gross_ns"] == str(label()["gross_ns"])


def test_reviewer_does_not_see_the_simulations_truth(made: Reviewable) -> None:
    page, one = opened(made.store), address(made.ids[0])
    truth = made.recording(made.ids[0]).record.simulation_truth
    assert truth is not None
    for path in (f"/review/{one}", f"/trials/{one}", f"/trials/{one}/curves"):
        assert str(truth["incipient_ns"]) not in page.get(path).text
        assert "truth" not in page.get(path).text


def test_frame_is_found_by_number_and_by_time(made: Reviewable) -> None:
    page, one = opened(made.store, role="reader"), f"/trials/{address(made.ids[0])}/frame"
    found = page.get(f"{one}?time=0.1051").text
    assert "data-frame='10'" in found
    assert "data:image/png;base64," in found
    assert found == page.get(f"{one}?frame=10").text
    assert found.count("<circle") == 7
    assert page.get(f"{one}?frame={FRAMES}").status_code == 404
    assert page.get(f"{one}?frame=-1").status_code == 404
    assert page.get(f"{one}?time=nan").status_code == 200
    assert page.get(f"{one}?frame=x").status_code == 422


def test_long_curve_retains_its_extremes() -> None:
    time_s = np.arange(100_003) / 1000
    values = np.zeros((len(time_s), 2))
    values[70_001, 0], values[-1, 1], values[5, 1] = 9.0, -4.0, np.nan
    short_s, short = thinned(time_s, values)
    assert len(short_s) <= MOST_POINTS + 2
    assert (np.diff(short_s) >= 0).all()
    assert short[:, 0].max() == 9.0
    assert short[:, 1].min() == -4.0
    assert short_s[short[:, 0].argmax()] == pytest.approx(70.001, abs=0.06)


def test_gates_say_their_unit_and_limit() -> None:
    gates = {
        "sync_uncertainty_arm_s": Gate(passed=True, value=2.4e-6, limit=0.003),
        "event_burst": Gate(passed=True, value=12_000, limit=50_000),
        "hold_force_n": Gate(passed=False, value=1.25, limit=2.0),
        "sync_uncertainty_frames_s": Gate(passed=False, value="no pulses", limit=None),
        "frames_lost_side": Gate(passed=True, value=-1, limit=0),
        "sync_unvouched_s": Gate(passed=True, value=9.9996e-7, limit=0.3),
    }
    assert [f"{gate.name} {gate.text}" for gate in gate_texts(gates)] == [
        "normal force in the hold 1.25 N, at least 2 N needed",
        "frames clock no pulses",
        "arm clock 2.4 µs of 3 ms allowed",
        "most events in 10 ms 12,000 of 50,000 allowed",
        "frames lost by side unknown of 0 allowed",
        "recording beyond the clocks' sync pulses 1 µs of 300 ms allowed",
    ]


def test_rows_come_again_only_when_they_changed(made: Reviewable) -> None:
    page = opened(made.store)
    found = page.get("/review/rows?first=on").json()
    assert [row[1] for row in found["rows"]] == made.ids
    since = f"/review/rows?first=on&since={found['changes']}"
    assert page.get(since).status_code == 204
    made.decide(made.ids[0], "accept")
    again = page.get(since).json()
    assert again["rows"][-1][:3] == [NAME, made.ids[0], "accepted"]
    only = page.get("/review/rows?state=accepted").json()["rows"]
    assert [row[1] for row in only] == [made.ids[0]]


def test_decision_is_stored_to_the_nanosecond(made: Reviewable) -> None:
    page, trial, known = opened(made.store), made.ids[7], label()
    shown = page.get(f"/review/{address(trial)}").json()
    assert (shown["seen"], shown["able"], shown["label"]) == (0, True, made.keys[trial])
    lines = {"incipient_ns": "251200000", "gross_ns": str(known["gross_ns"])}
    assert send(page, decision(made, trial, verdict="adjust", lines=lines))[0] == 200
    stored = review.last(made.store, NAME, trial)
    assert stored is not None
    assert (stored.who, stored.verdict, stored.label) == ("anna", "adjust", made.keys[trial])
    assert stored.new == review.ReviewedOnsets(251_200_000, known["gross_ns"])
    again = page.get(f"/review/{address(trial)}").json()
    assert again["lines"] == lines
    assert again["curves"]["onsets"]["review"] == lines
    assert "adjusted by anna" in " ".join(again["html"].split())


def test_reader_reviews_nothing(made: Reviewable) -> None:
    reader, trial = opened(made.store, role="reader"), made.ids[2]
    assert "data-verdict" not in reader.get("/review").text
    assert reader.get(f"/review/{address(trial)}").status_code == 200
    assert send(reader, decision(made, trial))[0] == 403
    body = json.dumps(decision(made, trial))
    assert opened(made.store).post("/review/decision", content=body).status_code == 403
    assert review.history(made.store, NAME, trial) == []


@pytest.mark.quick(3)
@pytest.mark.parametrize(
    ("changes", "status", "text"),
    [
        ({"who": " "}, 422, "needs the name"),
        ({"verdict": "reject"}, 422, "needs a reason"),
        ({"verdict": "guess"}, 422, "verdict"),
        ({"label": "of an older label"}, 409, "has changed"),
        ({"seen": 0}, 409, "newer decision"),
        ({"seen": 99}, 409, "is there no longer"),
        ({"seen": -1}, 422, "seen"),
        ({"seen": "0"}, 422, "seen"),
        ({"trial": "none"}, 503, "is not in the list"),
        ({"verdict": "adjust", "lines": {"incipient_ns": "9" * 12, "gross_ns": None}}, 422, "out"),
        ({"verdict": "adjust", "lines": {"incipient_ns": None, "gross_ns": "1"}}, 422, "gross"),
        ({"verdict": "adjust", "lines": []}, 422, "lines"),
    ],
)
def test_decision_that_cannot_be_is_refused(
    made: Reviewable, changes: dict[str, Any], status: int, text: str
) -> None:
    trial = made.ids[4]
    page = opened(made.store)
    if "seen" in changes:
        made.decide(trial, "accept")
    before = review.history(made.store, NAME, trial)
    code, stated = send(page, {**decision(made, trial), **changes})
    assert (code, stated.startswith("Not saved: ")) == (status, True)
    assert text in stated
    assert review.history(made.store, NAME, trial) == before


def test_report_serves_its_own_files_only(made: Reviewable) -> None:
    folder = made.store.folder / "report"
    (folder / "tables").mkdir(parents=True)
    (folder / "index.html").write_text("<title>Pilot &amp; more</title><script>alert(1)</script>")
    (folder / "tables" / "power.html").write_text("<p>no title")
    (folder / "tables" / "power.csv").write_text("a,b")
    (folder / "notes.exe").write_text("x")
    (folder / "out.html").symlink_to(made.store.folder / "store.json")
    page = opened(made.store, role="reader")
    listed = page.get("/report").text
    assert "Pilot &amp; more" in listed
    assert listed.index("report/index.html") < listed.index("report/tables/power.html")
    found = page.get("/report/index.html")
    assert found.status_code == 200
    assert "default-src 'none'" in found.headers["content-security-policy"]
    assert "script-src" not in found.headers["content-security-policy"]
    assert page.get("/report/tables/power.csv").text == "a,b"
    for path in ("notes.exe", "..%2Fstore.json", "out.html", "none.html", "tables", "%00.html"):
        assert page.get(f"/report/{path}").status_code == 404


def test_looking_changes_no_file(made: Reviewable) -> None:
    def stamps() -> dict[str, tuple[int, int]]:
        files = (path for path in made.store.folder.rglob("*") if path.is_file())
        known = {path: path.stat() for path in files}
        return {
            str(path): (status.st_size, status.st_mtime_ns)
            for path, status in known.items()
            if "derived/catalogue" not in str(path)  # the index of the catalogue
        }

    before, page, one = stamps(), opened(made.store, role="reader"), address(made.ids[0])
    time_s = STEP_NS / 1e9
    for path in ("/trials", f"/trials/{one}", f"/trials/{one}/curves", f"/trials/{one}/files"):
        assert page.get(path).status_code == 200
    for path in ("/review", "/review/rows", f"/review/{one}", f"/trials/{one}/frame?time={time_s}"):
        assert page.get(path).status_code == 200
    assert page.get("/report").status_code == 200
    assert stamps() == before
