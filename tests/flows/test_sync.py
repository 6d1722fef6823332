"""Clocks fitted again: the same as the record's, or new ones that every later step reads."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.campaigns import Collected, collected
from sliplab.analysis.clocks import synchronise
from sliplab.analysis.clocks.refit import fit_again, same_clocks
from sliplab.analysis.report.summary import sync_part
from sliplab.flows.collect import collect
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.sync import sync
from sliplab.storage.files import read_json, sha256, write_json
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.checksums import CHECKSUMS, RECORD
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer, here
from tests.flows.conftest import tiny, write

SHIFT_NS = 3_000_000


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, rig_path: Path) -> TrialStore:
    """Three slides, taken and not looked at yet."""
    folder = tmp_path_factory.mktemp("sync")
    data = tiny()
    data["collection"]["factors"]["direction"]["values"] = [0, 120, 240]
    for split, level in (("validation", "120 deg"), ("test", "240 deg")):
        data["analysis"]["split"][f"{split}_levels"] = {"direction": [level]}
    run_request = make_request(write(folder / "tiny.yaml", data), rig_path, folder / "store")
    collect(run_request)
    return TrialStore.open(folder / "store")


def recordings(store: TrialStore) -> list[Recording]:
    """The store's trials, freshly opened."""
    return list(store.campaign("tiny").recordings())


def results(store: TrialStore) -> list[dict[str, Any]]:
    """Return the stored clock fit of every trial."""
    kept = Derived.of(store, "sync", "tiny")
    return [kept.read(recording.folder.name) for recording in recordings(store)]


def as_if_fitted_worse(recording: Recording) -> None:
    """Commit a record whose events are off, as an older program might have."""
    record = read_json(recording.folder / RECORD)
    clock = record["clocks"]["events"]["map"]
    clock["reference_ns"] = [time + SHIFT_NS for time in clock["reference_ns"]]
    sums = read_json(recording.folder / CHECKSUMS)
    path = recording.folder / RECORD
    write_json(path, record)
    sums[RECORD] = {"sha256": sha256(path), "bytes": path.stat().st_size}
    write_json(recording.folder / CHECKSUMS, sums)


def test_a_refit_equals_the_record_and_changes_nothing(store: TrialStore) -> None:
    before = [recording.checksum for recording in recordings(store)]
    result = sync(store, collected(store))
    assert (result["done"], result["fresh"], result["changed"]) == (3, 0, 0)
    assert all("clocks" not in kept and kept["refused"] == {} for kept in results(store))
    for recording in recordings(store):
        assert recording.clocks == recording.record.clocks
        assert not recording.refitted
    assert [recording.checksum for recording in recordings(store)] == before
    known = result["campaigns"]["tiny"]
    assert (known["trials"], known["refitted"], known["refused"]) == (3, 3, 0)
    grades = {name: device["grade"] for name, device in known["devices"].items()}
    known = {"events": "trigger input", "frames": "hardware trigger", "arm": "digital input"}
    assert grades == known
    json.dumps(result, allow_nan=False)


def test_residuals_are_kept_over_the_time_of_the_trial(store: TrialStore) -> None:
    sync(store, collected(store))
    for recording in recordings(store):
        arrays = Derived.of(store, "sync", "tiny").arrays(recording.folder.name)
        for device in ("events", "frames", "arm"):
            time_s, residual_us = arrays[f"{device}_s"], arrays[f"{device}_us"]
            assert len(time_s) == len(residual_us) <= 200
            assert (np.diff(time_s) > 0).all()
            assert 0 <= time_s[0] < 1 < time_s[-1] < recording.record.recorded_s + 2
            most = recording.clocks.devices()[device].residual_max_ns / 1e3
            assert 0 < np.abs(residual_us).max() <= most + 1e-9


def test_a_second_run_does_nothing(store: TrialStore) -> None:
    first = sync(store, collected(store))
    page = Path(first["page"])
    written = page.stat().st_mtime_ns
    again = sync(store, collected(store))
    assert (again["done"], again["fresh"]) == (0, 3)
    assert page.stat().st_mtime_ns == written
    page.unlink()
    assert sync(store, collected(store))["done"] == 0
    assert page.exists()


@pytest.mark.long
def test_a_new_version_that_fits_alike_makes_nothing_else_stale(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync(store, collected(store))
    label(store, collected(store))
    with monkeypatch.context() as patched:
        patched.setattr(synchronise, "VERSION", synchronise.VERSION + 1)
        assert sync(store, collected(store))["done"] == 3
        assert label(store, collected(store))["done"] == 0
    assert sync(store, collected(store))["done"] == 3


@pytest.mark.long
def test_better_clocks_are_used_and_make_later_steps_stale(store: TrialStore) -> None:
    sync(store, collected(store))
    label(store, collected(store))
    first = recordings(store)[0]
    true = first.clock("events").to_reference(10**9)
    old = first.raw_checksum
    as_if_fitted_worse(first)
    worse = recordings(store)[0]
    assert worse.raw_checksum != old
    # what was fitted of other raw data is not used
    assert worse.clock("events").to_reference(10**9) == true + SHIFT_NS
    label(store, collected(store))

    campaigns = collected(store)
    opened = campaigns[0].campaign.recording(first.folder.name)
    result = sync(store, campaigns)
    assert (result["done"], result["changed"]) == (1, 1)
    assert opened.clock("events").to_reference(10**9) == true
    assert opened.refitted
    assert opened.checksum != opened.raw_checksum
    assert opened.record.clocks.events.map != opened.clocks.events.map
    sent = pickle.loads(pickle.dumps(opened))
    assert sent.clocks == opened.clocks
    assert label(store, campaigns)["done"] == 1
    assert label(store, collected(store))["done"] == 0
    text = Path(result["page"]).read_text()
    assert "<td>1</td>" in text  # one trial with refitted clocks


def test_a_refusal_keeps_the_record_and_is_told(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sync(store, collected(store))
    first = recordings(store)[0]
    found = synchronise.synchronise_recording(first)
    del found.devices["frames"]
    found.refused["frames"] = "ambiguous: it fits twice"
    monkeypatch.setattr(synchronise, "synchronise_recording", lambda recording: found)
    data, arrays = fit_again(first, None)
    assert "clocks" not in data
    assert "frames_us" not in arrays
    kept = Derived.of(store, "sync", "tiny")
    before = kept.read(first.folder.name)
    kept.write(first.folder.name, before["key"], data, arrays)
    result = sync(store, collected(store))
    assert (result["done"], result["campaigns"]["tiny"]["refused"]) == (0, 1)
    said = capsys.readouterr().err
    assert "frames cannot be fitted again (ambiguous: it fits twice)" in said
    assert recordings(store)[0].clocks == first.record.clocks
    (kept.folder / f"{first.folder.name}.json").unlink()
    assert sync(store, collected(store))["done"] == 1


def test_what_is_told_of_clocks_is_of_those_in_use(store: TrialStore) -> None:
    first = recordings(store)[0]
    path = Derived.of(store, "sync", "tiny").folder / f"{first.folder.name}.json"
    sync(store, collected(store))
    kept = read_json(path)
    clocks = first.record.clocks.to_json()
    clocks["events"]["uncertainty_ns"] = 77_000.0
    write_json(path, {**kept, "clocks": clocks})
    table = catalogue(store)
    assert table["sync_uncertainty_us"].max() == 77.0
    reported = sync_part(collected(store))
    assert reported.worst_against_events_us["events"] == 77.0
    write_json(path, kept)


def test_the_page_has_every_figure_and_stands_alone(store: TrialStore) -> None:
    text = Path(sync(store, collected(store))["page"]).read_text()
    titles = ("Residuals over a trial", "Drift over the campaign", "Pulses and frames")
    uncertainty = "Uncertainty of events against frames and arm"
    for name in (*titles, uncertainty, "The worst trials"):
        assert f"<h2>{name}" in text
    assert text.count("<figure>") == text.count(">simulated</text>") == 4
    for unit in ("residual (µs)", "drift (ppm)", "uncertainty (µs)", "missed pulses", "lost"):
        assert unit in text
    assert "cannot be separated from that of" in text
    assert "Every number and figure on this page is simulated" in text
    assert "src=" not in text
    for recording in recordings(store):
        assert recording.folder.name in text


def test_processors_may_differ_in_the_last_digit() -> None:
    clock = {"grade": "a", "drift_ppm": 12.5, "map": {"device_ns": [5], "drift": [10**13]}}
    close = {"device_ns": [5], "drift": [10**13 + 9]}
    near = {"grade": "a", "drift_ppm": 12.5 + 1e-13, "map": close}
    assert same_clocks(clock, near)
    for change in (
        {"grade": "b"},
        {"drift_ppm": 12.50001},
        {"map": {"device_ns": [6], "drift": [10**13]}},
    ):
        assert not same_clocks(clock, {**clock, **change})
    assert not same_clocks(clock, {"grade": "a"})


def test_the_command_prints_a_table_and_one_object(store: TrialStore, tmp_path: Path) -> None:
    done = here("sync", store.folder)
    assert done.returncode == 0
    for word in ("Clocks of tiny (simulated)", "hardware", "events", "sync.html"):
        assert word in done.stdout
    found = answer("sync", store.folder, "--campaign", "tiny")
    assert (found["step"], found["simulated"], found["fresh"]) == ("sync", True, 3)
    pulses = found["campaigns"]["tiny"]["devices"]["arm"]["pulses"]
    assert pulses.keys() == {"missed", "late", "spurious"}
    other = here("sync", store.folder, "--campaign", "other")
    assert (other.returncode, "there are tiny" in other.stderr) == (2, True)
    TrialStore.create(tmp_path / "store")
    empty = here("sync", tmp_path / "store")
    assert empty.returncode == 1
    assert "holds no campaign yet; run `sliplab collect` first" in empty.stderr


def test_a_campaign_without_trials_has_a_page_that_says_so(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Collected, "trials", [])
    result = sync(store, collected(store))
    assert (result["done"], result["fresh"]) == (0, 0)
    assert "have no committed trial" in Path(result["page"]).read_text()
