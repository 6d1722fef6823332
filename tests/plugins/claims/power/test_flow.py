"""`sliplab power` on a small store: figures, draws, page, learning curve, and wrong input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.study import StudyOutcome
from sliplab.plugins.claims import trial_figures
from sliplab.plugins.claims.power import flow as power
from sliplab.plugins.claims.power import learning
from sliplab.plugins.claims.power.document import PowerRecord
from sliplab.plugins.claims.power.flow import sessions_of
from sliplab.protocols.plan import load_plan
from sliplab.storage.schema.trial import Provenance
from tests.command_line import answer, here
from tests.flows.conftest import tiny, write

DURATION = "{figure: slip_duration, within: 400 ms}"
ACCURACY = "{figure: accuracy, at_least: 1 %}"
Ran = tuple[list[RunRequest], StudyOutcome]


@pytest.fixture
def protocol(tmp_path: Path) -> Path:
    """The small campaign's own protocol, with many repetitions."""
    data = tiny()
    data["collection"]["repetitions"] = 20
    return write(tmp_path / "wanted.yaml", data)


def error_of(*words: object) -> dict[str, Any]:
    done = here("power", *words, "--json")
    assert done.returncode == 2, done.stderr
    error: dict[str, Any] = json.loads(done.stdout)["error"]
    return error


def test_figures_are_made_once_and_the_page_says_simulated(
    ran: Ran, protocol: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (protocol, "--store", ran[0][0].store, "--out", tmp_path, "--draws", 10)
    found = answer("power", *words, "--claim", DURATION)
    record = PowerRecord.load(tmp_path / "power.json")
    assert found.pop("page") == str(tmp_path / "power.html")
    assert found == record.to_json()
    assert (record.simulated, record.pilot_trials, record.planned) == (True, 6, 120)
    assert record.pilots == ("tiny",)
    (claim,) = record.claims
    assert claim.holds + claim.refuted + claim.never == pytest.approx(1.0)
    assert len(record.ended) == 10
    page = (tmp_path / "power.html").read_text()
    assert "simulated pilot" in page
    assert claim.claim in page

    def fail(*_: object) -> None:
        raise AssertionError("made again")

    monkeypatch.setattr(trial_figures, "trial_figures", fail)
    assert answer("power", *words, "--claim", DURATION)["ended"] == list(record.ended)


@pytest.mark.long
def test_a_plan_says_it_with_its_hours(ran: Ran, protocol: Path) -> None:
    store = ran[0][0].store
    refused = here("plan", protocol, "--pilot", store, "--json")
    assert json.loads(refused.stdout)["error"]["key"] == "--pilot"
    data = tiny()
    data["collection"]["repetitions"] = 20
    data["collection"]["stopping"] = {"claims": [{"figure": "slip_duration", "within": "400 ms"}]}
    write(protocol, data)
    record = PowerRecord.model_validate(answer("plan", protocol, "--pilot", store)["claims"])
    assert (record.planned, record.pilot_trials, record.learning) == (120, 6, None)
    assert record.hours == pytest.approx(load_plan(protocol).total_seconds / 3600)
    done = here("plan", protocol, "--pilot", store)
    said = done.stdout + done.stderr
    assert "by 6 trials of a simulated pilot" in said
    assert f"{60 * record.expected_hours[1]:.0f} min of motion" in said


def test_a_claim_that_cannot_be_had_is_said_so(ran: Ran, protocol: Path, tmp_path: Path) -> None:
    done = here(
        "power",
        protocol,
        "--store",
        ran[0][0].store,
        "--out",
        tmp_path,
        "--draws",
        10,
        "--claim",
        "{figure: slip_duration, within: 1 ms}",
    )
    assert done.returncode == 0
    assert "cannot be had by this plan" in done.stderr
    assert "repetitions of each condition in place of 20" in done.stderr
    assert "Cannot be had by this plan" in (tmp_path / "power.html").read_text()


@pytest.mark.long
def test_a_network_is_not_asked_about_trials_that_trained_it(
    ran: Ran, protocol: Path, tmp_path: Path
) -> None:
    store = ran[0][0].store
    model = next((store / "models").glob("seed*.pt"))
    words = (protocol, "--store", store, "--claim", ACCURACY)
    assert error_of(*words)["key"] == "--model"
    error = error_of(*words, "--model", model)
    assert (error["key"], error["value"]) == ("--store", str(store))
    assert "has 2 test trials" in error["message"]
    other = shutil.copy(model, tmp_path / "other.pt")
    found = answer("power", *words, "--model", other, "--out", tmp_path, "--draws", 10)
    assert found["pilot_trials"] == 6
    assert found["learning"] is None
    assert any("no learning curve: it takes 8 training" in note for note in found["notes"])


@pytest.mark.long
def test_a_learning_curve_is_trained_once(
    ran: Ran, protocol: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = ran[0][0].store
    monkeypatch.setattr(power, "FEWEST", 2)
    monkeypatch.setattr(power, "FEWEST_TRAINING", 2)
    model = shutil.copy(next((store / "models").glob("seed*.pt")), tmp_path / "other.pt")
    words = (
        "power",
        protocol,
        "--store",
        store,
        "--claim",
        ACCURACY,
        "--model",
        model,
        "--out",
        tmp_path,
        "--draws",
        10,
    )
    curve = answer(*words)["learning"]
    assert [point["trials"] for point in curve["points"]] == [1, 1, 2, 2]
    assert (curve["test_trials"], curve["planned"]) == (2, 40)
    assert curve["low"] <= curve["expected"] <= curve["high"]
    assert "Training" in (tmp_path / "power.html").read_text()

    def fail(*_: object) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr(learning, "logistic_accuracy", fail)
    assert answer(*words)["learning"] == curve
    assert answer(*words, "--no-training")["learning"] is None


def test_sessions_are_drawn_and_printed(ran: Ran, protocol: Path, tmp_path: Path) -> None:
    words = (
        "power",
        protocol,
        "--store",
        ran[0][0].store,
        "--claim",
        DURATION,
        "--out",
        tmp_path,
        "--draws",
        10,
    )
    done = here(*words, "--sessions", 4, "--drift", 0.5)
    assert done.returncode == 0
    told = " ".join((done.stdout + done.stderr).split())
    assert "4 sessions are drawn, which differ by 0.30 (slip_duration)" in told
    assert "a pilot of one session cannot show how sessions differ" in told
    assert "a drift of 0.5 of the scatter between trials is drawn" in told
    record = PowerRecord.load(tmp_path / "power.json")
    assert (record.sessions, record.drift) == (4, 0.5)
    assert "4 sessions are drawn" in (tmp_path / "power.html").read_text()


@pytest.mark.parametrize(
    ("options", "key", "value"),
    [
        (("--between", 0.5), "--between", "0.5"),
        (("--sessions", 3, "--between", "nan"), "--between", "nan"),
        (("--drift", -1), "--drift", "-1"),
    ],
)
def test_wrong_sessions_name_option_and_value(
    options: tuple[object, ...], key: str, value: str, ran: Ran, protocol: Path
) -> None:
    error = error_of(protocol, "--store", ran[0][0].store, "--claim", DURATION, *options)
    assert (error["key"], error["value"]) == (key, value)


class Times:
    """A campaign of which only hours and skins of its trials are known."""

    name = "pilot"

    def provenance(self, recording: tuple[int, str]) -> Provenance:
        """Half an hour from a full one on."""
        hour, skin = recording
        began, ended = (f"2026-11-01T{hour:02}:{minute}:00+00:00" for minute in ("00", "30"))
        return Provenance(started=began, ended=ended, skin=skin)

    @property
    def campaign(self) -> Times:
        """Itself."""
        return self


def test_a_pause_or_another_skin_begins_a_session() -> None:
    trials = [(9, "a"), (10, "a"), (12, "a"), (12, "b"), (13, "a"), (13, "b")]
    pilot: Any = [(Times(), None, trial) for trial in trials]
    assert sessions_of(pilot).tolist() == [0, 0, 1, 2, 1, 2]


@pytest.mark.parametrize(
    ("claim", "key", "value"),
    [
        ("{figure: speed, within: 1 ms}", "--claim figure", "speed"),
        ("{figure: accuracy, within: 1 ms}", "--claim within", "1 ms"),
        ("{figure: accuracy}", "--claim", "{figure: accuracy}"),
        ("accuracy", "--claim", None),
        ("{figure: accuracy, within: 1 %, error: 0}", "--claim error", "0"),
        (
            "{figure: lead, at_least: 1 ms, between: {factor: skin, levels: [a, b]}}",
            "--claim between.factor",
            "skin",
        ),
        (
            "{figure: lead, at_least: 1 ms, between: {factor: direction, levels: [0, 17]}}",
            "--claim between.levels[1]",
            "17",
        ),
    ],
)
def test_a_wrong_claim_names_option_key_and_value(
    claim: str, key: str, value: str | None, ran: Ran, protocol: Path
) -> None:
    error = error_of(protocol, "--store", ran[0][0].store, "--claim", claim)
    assert (error["key"], error["value"]) == (key, value)


def test_claim_given_twice_is_refused(ran: Ran, protocol: Path) -> None:
    words = (protocol, "--store", ran[0][0].store)
    error = error_of(*words, "--claim", DURATION, "--claim", DURATION)
    assert error["key"] == "--claim collection.stopping.claims[1]"
    assert "is the same as claims[0]" in error["message"]


def test_a_protocol_without_claims_and_levels_outside_are_refused(
    ran: Ran, protocol: Path, tmp_path: Path
) -> None:
    store = ran[0][0].store
    assert error_of(protocol, "--store", store)["key"] == "--claim"
    data = tiny()
    data["collection"]["factors"]["depth"]["values"] = [2.8]
    other = write(tmp_path / "deeper.yaml", data)
    error = error_of(other, "--store", store, "--claim", DURATION)
    assert (error["file"], error["key"], error["value"]) == (
        str(other),
        "collection.factors.depth",
        "2.8 mm",
    )
