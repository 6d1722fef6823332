"""Every deviation of a campaign from its registration is listed by itself, and nothing else is."""

from __future__ import annotations

import copy
import functools
import os
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.registration import RegistrationDeviation, campaign_deviations
from sliplab.flows.register import register
from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import load_rig_file, rig_hash
from sliplab.storage.files import json_text, read_json, write_json
from sliplab.storage.schema.campaign_end import STOPPING, CampaignEnd
from sliplab.storage.schema.trial import Provenance
from sliplab.storage.trials.control import again, skip
from sliplab.storage.trials.registration import registrations
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.versions import FIGURES, RECORDING, installed_versions
from tests.storage.trial_files import FRAME, fail, fill, record

Json = dict[str, Any]
CLAIMS = [
    {"figure": "first_slip", "at_most": "90 ms"},
    {"figure": "slip_duration", "statistic": "p05", "at_least": "30 ms"},
]
BY = {"who": "Ada", "when": "2026-01-01", "why": "the skin was wet"}


@pytest.fixture
def protocol(small: Json) -> Json:
    """The pilot with two claims; 36 trials."""
    small["collection"]["stopping"] = {"claims": CLAIMS, "error": 0.1}
    return small


def begun(
    folder: Path, data: Json, rig: str | None = None, enable: tuple[str, ...] = ()
) -> Campaign:
    """A registered campaign, with its description as `collect` writes it."""
    path = folder / "pilot.yaml"
    path.write_text(yaml.safe_dump(data))
    where, _ = register(path, folder / "store", rig=None if rig is None else Path(rig))
    describe(where, data, enable=enable)
    return where


def describe(
    where: Campaign, data: Json, rig: str = "rehearsal", enable: tuple[str, ...] = ()
) -> None:
    """Write what a collection under a protocol writes of its campaign."""
    text = load_rig_file(Path(rig))[1]
    info: Any = {"name": where.name, "simulated": True, "experiment": "kinematic", "rig": rig}
    info |= {"rig_hash": rig_hash(text), "enabled": list(enable), "collection_hash": ""}
    where.update(info, yaml.safe_dump(data), text)


def take(where: Campaign, trials: list[str], **provenance: Any) -> None:
    """Commit trials."""
    here = installed_versions(RECORDING)
    for trial in trials:
        writer = where.begin(trial, FRAME, 100)
        fill(writer, 100)
        later = {"started": "2999-01-01T00:00:00+00:00", "versions": here}
        made = Provenance(**later | provenance)
        counts = {"events": 100, "frames": 12, "poses": 10, "pulses": 10}
        writer.commit(record(trial, counts=counts), made)


def ids(data: Json, folder: Path) -> list[str]:
    """The trials of a protocol."""
    path = folder / "ids.yaml"
    path.write_text(yaml.safe_dump(data))
    return [trial.id for trial in load_plan(path)]


def found(where: Campaign) -> list[RegistrationDeviation]:
    """All deviations from the first registration."""
    path, first = registrations(where)[0]
    return list(campaign_deviations(Collected(where), first, path))


def named(where: Campaign) -> dict[str, RegistrationDeviation]:
    """Deviations by name, without missing trials: most tests take none."""
    listed = [each for each in found(where) if each.what != "fewer trials than registered"]
    by_name = {each.what: each for each in listed}
    assert len(by_name) == len(listed)
    return by_name


def test_campaign_as_registered_has_no_deviation(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol, "rehearsal")
    take(where, ids(protocol, tmp_path))
    assert found(where) == []


def test_comment_is_a_change_of_the_text_alone(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol)
    where.update(where.info, where.protocol_file.read_text() + "# later\n", "")
    assert [*named(where)] == ["text of the protocol"]


MEDIAN = "median incipient onset after the motion's start at most {} ms"
LENGTH = "median true length of incipient slip known within +-5 ms"
CHANGES: tuple[tuple[str, Json, tuple[str, str, str]], ...] = (
    (
        "collection.stopping",
        {"error": 0.2},
        ("error level of claims: collection.stopping.error", "0.1", "0.2"),
    ),
    ("collection.stopping", {"most": 20}, ("collection.stopping.most", "null", "20")),
    ("collection.stopping", {"claims": CLAIMS[1:]}, ("claim removed", MEDIAN.format(90), "–")),
    (
        "collection.stopping",
        {"claims": [*CLAIMS, {"figure": "slip_duration", "within": "5 ms"}]},
        ("claim added", "–", LENGTH),
    ),
    (
        "collection.stopping",
        {"claims": [{"figure": "first_slip", "at_most": "95 ms"}, CLAIMS[1]]},
        ("claim changed", MEDIAN.format(90), MEDIAN.format(95)),
    ),
    ("analysis", {"training": {"epochs": 3}}, ("analysis.training.epochs", "8", "3")),
    ("analysis", {"detection": {"margin": 7}}, ("analysis.detection.margin", "8.0", "7.0")),
    ("collection", {"repetitions": 2}, ("collection.repetitions", "1", "2")),
    ("collection", {"order": "listed"}, ("collection.order", "shuffled", "listed")),
)


def test_each_changed_setting_is_listed(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol)
    for part, change, deviation in CHANGES:
        data = copy.deepcopy(protocol)
        functools.reduce(dict.__getitem__, part.split("."), data).update(change)
        describe(where, data)
        assert found(where)[1:-1] == [deviation]  # between the text and the missing trials


def test_order_of_claims_is_no_deviation_of_theirs(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol)
    protocol["collection"]["stopping"]["claims"] = CLAIMS[::-1]
    describe(where, protocol)
    assert [*named(where)] == ["text of the protocol"]


def test_claims_of_a_protocol_without_any_are_added(tmp_path: Path, small: Json) -> None:
    where = begun(tmp_path, small)
    small["collection"]["stopping"] = {"claims": CLAIMS}
    describe(where, small)
    what = [each.what for each in found(where)]
    assert what.count("claim added") == 2
    assert "error level of claims: collection.stopping.error" in what
    describe(where, {**small, "collection": {**small["collection"], "stopping": None}})
    assert [*named(where)] == ["text of the protocol"]


def test_trials_outside_the_registered_plan_and_missing_ones_are_counted(
    tmp_path: Path, protocol: Json
) -> None:
    where = begun(tmp_path, protocol)
    registered = ids(protocol, tmp_path)
    protocol["collection"]["repetitions"] = 2
    describe(where, protocol)
    (more, *_) = sorted({*ids(protocol, tmp_path)} - {*registered})
    take(where, [*registered[:3], more])
    by_name = {each.what: each for each in found(where)}
    assert by_name["more trials than registered"].found == f"1 other: {more}"
    fewer = by_name["fewer trials than registered"]
    assert (fewer.registered, fewer.found) == ("36 trials", "3")


def test_end_by_claims_is_said_of_missing_trials(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol)
    done = CampaignEnd(simulated=True, section="", model=None, verdict="settled")
    write_json(where.folder / STOPPING, done.to_json())
    assert "ended by its claims" in found(where)[-1].found


def test_earlier_trials_and_attempts_are_listed(tmp_path: Path, protocol: Json) -> None:
    store = TrialStore.create(tmp_path / "store")
    where = store.campaign("pilot")
    describe(where, protocol)
    one, two, three, *_ = ids(protocol, tmp_path)
    take(where, [one], started="2020-01-01T00:00:00.000+00:00")
    fail(where, two, 0)
    info: Any = {**where.info, "collection_hash": load_plan(tmp_path / "ids.yaml").collection_hash}
    write_json(where.folder / "campaign.json", info)
    begun(tmp_path, protocol)
    take(where, [three])
    early = named(where)["trials taken before the registration"]
    assert early.found == (
        f"registered after 1 trial and 1 other attempt; 1 trial: {one} began before that time"
    )


def test_trials_that_began_before_by_their_own_time_are_listed(
    tmp_path: Path, protocol: Json
) -> None:
    """Trials that were merged into the store later, as by a pull."""
    where = begun(tmp_path, protocol)
    one, two, *_ = ids(protocol, tmp_path)
    take(where, [one], started="2020-01-01T00:00:00.000+00:00")
    take(where, [two])
    early = named(where)["trials taken before the registration"]
    assert one in early.found
    assert two not in early.found


def test_skipped_retaken_and_excluded_trials_are_listed(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol)
    one, two, three, four, *_ = ids(protocol, tmp_path)
    take(where, [one])
    skip(where, [two], BY)
    again(where, [one], BY)
    for attempt in range(5):
        fail(where, three, attempt)
    fail(where, four, 0)
    writer = where.begin(four, FRAME, 100)
    writer.abandon()
    where.sweep()
    listed = named(where)
    assert listed["trial skipped"].found == f"{two}: by Ada, 2026-01-01 (the skin was wet)"
    assert listed["trial retaken on request"].found.startswith(f"{one}: by Ada")
    gates = "; ".join(sorted([f"{three} (5 times)", four]))
    assert listed["attempts failed a gate"].found == f"2 trials: {gates}"
    assert listed["attempts quarantined: interrupted"].found == f"1 trial: {four}"
    assert listed["trials set aside"].found == f"1 trial: {three}"


def test_overruled_stopping_is_listed_even_if_the_record_has_changed(
    tmp_path: Path, protocol: Json
) -> None:
    where = begun(tmp_path, protocol)
    session: Any = {"began": "2026-01-02T03:04:05+00:00", "no_stopping": True}
    where.add_bench_record(session)
    assert "2026-01-02" in named(where)["stopping overruled"].found
    os.unlink(where.folder / "bench" / "0001.json")
    for verdict, listed in (("overruled", True), ("settled", False)):
        done = CampaignEnd(simulated=True, section="", model=None, verdict=verdict)
        write_json(where.folder / STOPPING, done.to_json())
        assert ("stopping overruled" in named(where)) == listed


def test_another_judging_network_is_listed(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol)
    done = CampaignEnd(simulated=True, section="", model="ab" * 32, verdict="open")
    write_json(where.folder / STOPPING, done.to_json())
    assert named(where)["network that judges the claims"][1:] == ("–", f"SHA-256 {'ab' * 8}")


def test_another_rig_is_listed_with_what_differs(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol, "rehearsal")
    assert named(where) == {}
    describe(where, protocol, "mock")
    listed = named(where)
    assert listed["rig file"].registered.startswith("rehearsal, SHA-256 ")
    assert listed["rig file"].found.startswith("mock, SHA-256 ")
    assert listed["rig.name"][1:] == ("rehearsal", "mock")


def test_other_versions_of_trials_are_counted(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol)
    one, two, three, *_ = ids(protocol, tmp_path)
    here = installed_versions(RECORDING)
    take(where, [one])
    take(where, [two, three], versions={**here, "sliplab": "99.0"})
    (listed,) = named(where).values()
    assert listed == ("version of sliplab", here["sliplab"], "99.0 in 2 trials")


def test_other_version_of_the_report_is_listed(
    tmp_path: Path, protocol: Json, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = begun(tmp_path, protocol)
    monkeypatch.setattr(
        "sliplab.analysis.registration.installed_versions", lambda names: {"scipy": "0.1"}
    )
    assert named(where)["version of scipy"].found == "0.1 in this report"
    assert "scipy" in FIGURES


def test_enabled_level_is_listed(tmp_path: Path, small: Json) -> None:
    small["collection"]["factors"]["speed"]["optional"] = [2.5]
    where = begun(tmp_path, small, enable=("speed=2.5",))
    listed = named(where)
    assert listed["enabled levels"][1:] == ("–", "speed=2.5")
    assert listed["collection.factors.speed.levels"].found.endswith("2.5]")


def test_registration_reads_the_same_after_a_round_trip(tmp_path: Path, protocol: Json) -> None:
    where = begun(tmp_path, protocol, "rehearsal")
    path, first = registrations(where)[0]
    assert json_text(first.to_json()).encode() == path.read_bytes()
    assert read_json(path)["stopping"]["error"] == 0.1
