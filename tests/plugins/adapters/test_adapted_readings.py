"""Touch data without any camera: pressures, forces or poses alone make a campaign."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

# Prefect at home in a folder of the tests, before anything imports it
import tests.flows.conftest  # noqa: F401
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.protocols.adapter import Adapter
from sliplab.storage.formats.export_trials import export_trials
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import here
from tests.plugins.adapters.adapters import bring

TABLE = {"files": "{kind}/trial{n}.csv", "format": "csv", "unit": "s"}
VALUES = {**TABLE, "quantity_unit": "kPa"}
SENSORS = {f"sensor{k}": {**VALUES, "columns": {"t": "Time (s)", "value": f"S{k}"}} for k in (1, 2)}
PRESSURES: dict[str, Any] = {"adapter": 1, "name": "pressures", "experiment": "classes"}
PRESSURES |= {"trials": {"files": "{kind}/trial{n:number}.csv"}, "labels": {"class": "{kind}"}}
PRESSURES["streams"] = {"scalars": SENSORS}


def _data(folder: Path) -> None:
    for kind in ("slip", "hold"):
        (folder / kind).mkdir(parents=True)
        for number in range(4):
            rows = [f"{0.127 * k:.3f},{k},{number}" for k in range(30)]
            text = "\n".join(["Time (s),S1,S2", *rows])
            (folder / kind / f"trial{number}.csv").write_text(text + "\n")


@pytest.fixture
def campaign(tmp_path: Path) -> Campaign:
    """Eight trials of two pressures each."""
    _data(tmp_path / "set")
    return bring(PRESSURES, tmp_path / "set", tmp_path / "store")


def test_readings_alone_are_a_trial(campaign: Campaign) -> None:
    assert len(campaign.committed()) == 8
    found = campaign.recording("hold-trial3")
    readings = found.scalars("sensor1")
    assert readings.unit == "kPa"
    assert readings.value.tolist() == list(range(30))
    assert readings.t_ns.tolist() == [round(0.127 * k * 1000) * 10**6 for k in range(30)]
    assert found.clocks.reference == "sensor1"
    span = (0, 3_683_001_000)
    assert (found.record.imported.span_ns, recorded_span(found)) == (span, span)
    given = found.record.imported.given
    assert [(each.name, each.start_ns, each.end_ns) for each in given.spans] == [("hold", *span)]
    assert found.record.recorded_s == pytest.approx(3.683, abs=1e-5)


@pytest.mark.parametrize("kind", ["wrenches", "poses"])
def test_one_stream_of_any_kind_is_enough(tmp_path: Path, kind: str) -> None:
    _data(tmp_path / "set")
    axes = ("fx", "fy", "fz") if kind == "wrenches" else ("x", "y", "z")
    table = {**TABLE, "columns": {"t": 0, **dict.fromkeys(axes, "S1")}}
    streams = {kind: {"force": table} if kind == "wrenches" else table}
    found = bring({**PRESSURES, "streams": streams}, tmp_path / "set", tmp_path / "store")
    recording = found.recording("slip-trial0")
    assert recording.record.recorded_s == pytest.approx(3.683, abs=1e-5)


def test_an_adapter_without_any_stream_is_refused() -> None:
    with pytest.raises(ValueError, match="needs a stream: events, frames, poses, wrenches"):
        Adapter.model_validate({**PRESSURES, "streams": {}})


def test_trials_without_a_file_of_any_stream_are_skipped(tmp_path: Path) -> None:
    _data(tmp_path / "set")
    (tmp_path / "set" / "list.csv").write_text("kind,n\nslip,0\nslip,9\nhold,1\n")
    made = {**PRESSURES, "trials": {"table": "list.csv", "id": "{kind}{n}"}}
    campaign = bring(made, tmp_path / "set", tmp_path / "store")
    assert campaign.committed() == {"slip0", "hold1"}


def test_a_table_without_rows_costs_its_trial_only(tmp_path: Path) -> None:
    _data(tmp_path / "set")
    (tmp_path / "set" / "slip" / "trial2.csv").write_text("Time (s),S1,S2\n")
    (tmp_path / "a.yaml").write_text(json.dumps(PRESSURES))
    line = ("import", "--adapter", tmp_path / "a.yaml", tmp_path / "set")
    done = here(*line, "--store", tmp_path / "s", "--json")
    assert done.returncode == 1, done.stderr
    result = json.loads(done.stdout)
    assert len(result["imported"]) == 7
    ((trial, reason),) = [(one["trial"], one["reason"]) for one in result["failed"]]
    assert trial == "slip-trial2"
    assert "trial2.csv: streams.scalars.sensor1: contains no event" in reason


def test_counts_of_a_table_of_readings_say_what_to_write(tmp_path: Path) -> None:
    _data(tmp_path / "set")
    counts = {"format": "counts", "axes": ["step", "taxel"], "step_ms": 127}
    (tmp_path / "a.yaml").write_text(json.dumps({**PRESSURES, "streams": {"events": counts}}))
    line = ("import", "--adapter", tmp_path / "a.yaml", tmp_path / "set")
    done = here(*line, "--store", tmp_path / "store")
    assert done.returncode == 2
    assert "readings of pressures or forces are streams under scalars or wrenches" in done.stderr


@pytest.mark.long
def test_later_steps_give_a_result_or_one_line(campaign: Campaign, tmp_path: Path) -> None:
    store = tmp_path / "store"
    assert verify(TrialStore.open(store)) == []
    assert catalogue(TrialStore.open(store))["events"].tolist() == [0] * 8
    assert here("verify", store).returncode == 0
    for kind, said in (("aedat4", "neither events nor a video"), ("dsec", "has no events")):
        done = here("export", store, "pressures", "--output", tmp_path / kind, "--format", kind)
        assert (done.returncode, done.stderr.count("error: ")) == (2, 1)
        assert said in done.stderr
    done = here("train", store)
    assert done.returncode == 1
    assert "campaign 'pressures' was recorded without events" in done.stderr


def test_frames_alone_are_exported(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    levels = np.arange(4, dtype=np.uint8)[:, None, None] * np.ones((1, 6, 8), np.uint8)
    np.save(tmp_path / "set" / "a.npy", levels)
    frames = {"files": "{n}.npy", "format": "numpy", "rate_hz": 100}
    made = {**PRESSURES, "trials": {"files": "{n}.npy"}, "labels": {}}
    made["streams"] = {"frames": frames}
    campaign = bring(made, tmp_path / "set", tmp_path / "store")
    done = export_trials([campaign.recording("a")], tmp_path / "out", "aedat4", "pressures")
    assert (done["events"], done["frames"]) == (0, 4)


def test_view_shows_imported_trials_of_any_kind(campaign: Campaign, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun is not installed (sliplab[view])")
    from tests.storage.formats.files import lab_hdf5

    lab_hdf5(tmp_path / "plain.h5")
    done = here("import", tmp_path / "plain.h5", "--store", tmp_path / "plain", "--name", "x")
    assert done.returncode == 0
    for store, trial, said in (
        (tmp_path / "store", "slip-trial1", '"sensor1_scalar": 30'),
        (tmp_path / "plain", "plain", '"events": 50'),
    ):
        done = here("view", store, trial, "--save", tmp_path / f"{trial}.rrd", "--json")
        assert done.returncode == 0, done.stderr
        assert said in done.stdout
