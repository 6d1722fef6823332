"""A kind of stream of another package is recorded, timed, verified, shown and exported."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sliplab.flows.api import open_store
from sliplab.flows.exports import ExportRequest, check_export
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.plugins.view import view
from sliplab.protocols import InputError
from sliplab.protocols.timing import Delay, StreamTiming
from sliplab.rigs.core.device_stream import DeviceStream
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.trial import StreamRecord
from sliplab.storage.streams import NullSink
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.examples.conftest import EXAMPLES
from tests.flows.collecting.test_further_streams import session
from tests.rigs.core.test_registry import Install, install
from tests.rigs.test_further_drivers import built, real_rig

__all__ = ["install"]

GRAVITY = [0.0, 0.0, 9.81]


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """One slide on a rig with an inertial sensor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES / "lab-imu"))
        lab: Any = importlib.import_module("lab_imu")
    work, campaign = session(tmp_path_factory.mktemp("imu") / "a", {})
    delay = Delay(shortest_us=0, longest_us=2000)
    about = StreamRecord(kind=lab.IMU.name, rows=0, timing=StreamTiming(delay=delay))
    work.rig.further += (DeviceStream("imu", lab.Imu(work.rig.clock), about),)
    work.take(pending_trials(work.plan, campaign)[:1])
    (recording,) = campaign.recordings()
    return recording


def store_of(recording: Recording) -> Path:
    return recording.folder.parents[3]


def test_named_in_a_rig_file(install: Install, tmp_path: Path) -> None:
    source = (EXAMPLES / "lab-imu" / "lab_imu.py").read_text()
    install("lab_imu", source, "lab_imu = lab_imu:DRIVER")
    imu = {"kind": "imu", "device": {"driver": "lab_imu"}}
    stream = real_rig(tmp_path, {"wrist": imu}).streams["wrist"]
    device, got = built("wrist", stream), []

    class Sink(NullSink):
        def add(self, device: str, chunk: Any) -> None:
            got.append((device, chunk.KIND.name))

    device.connect()
    device.start()
    device.finish(Sink())
    assert (device.about.kind, device.through_host, got) == ("imu", True, [("wrist", "imu")])
    with pytest.raises(InputError, match="must be imu, which the driver lab_imu sends"):
        real_rig(tmp_path, {"wrist": {**imu, "kind": "scalar", "unit": "V"}})
    with pytest.raises(InputError, match="must be one of events, frames, wrench, scalar"):
        real_rig(tmp_path, {"wrist": {**imu, "kind": "imo"}})


def test_recorded_and_verified(taken: Recording) -> None:
    about, found = taken.record.streams["imu"], taken.samples("imu")
    assert (about.kind, about.rows) == ("imu", len(found["t"]))
    assert about.rows > 50
    assert set(found) == {"t", "acceleration", "temperature"}
    assert (found["acceleration"] == GRAVITY).all()
    assert found["temperature"].dtype == np.float32
    assert verify(TrialStore.open(store_of(taken))) == []
    with pytest.raises(StoreError, match="no samples 'force'; it has: imu"):
        taken.samples("force")


def test_timed(taken: Recording) -> None:
    assert taken.record.clocks.streams["imu"].grade == "host arrival"
    assert taken.record.quality.gates["sync_uncertainty_imu_s"].passed
    with taken.open() as reader:
        sent_ns = reader.stream("imu")["t"]
    assert np.array_equal(taken.samples("imu")["t"], taken.clock("imu").to_reference(sent_ns))


def test_listed(taken: Recording) -> None:
    store = TrialStore.open(store_of(taken))
    trial = open_store(store_of(taken)).trial(taken.folder.name)
    assert trial.streams()["imu"] == "imu"
    assert catalogue(store)["imu_imu"].tolist() == [taken.record.streams["imu"].rows]


def test_shown(taken: Recording, tmp_path: Path) -> None:
    chunks = pytest.importorskip("rerun.chunk", reason="Rerun is not installed (sliplab[view])")
    store = TrialStore.open(store_of(taken))
    counts = view.save(view.find(store, taken.folder.name), tmp_path / "a.rrd")
    assert counts["imu_imu"] == taken.record.streams["imu"].rows
    shown = {str(chunk.entity_path) for chunk in chunks.RrdReader(tmp_path / "a.rrd").stream()}
    parts = {*(f"acceleration/{axis}" for axis in range(3)), "temperature/0"}
    assert {f"/streams/imu/{part}" for part in parts} <= shown


def test_exported_as_a_table(taken: Recording, tmp_path: Path) -> None:
    output = tmp_path / "imu.parquet"
    trial = taken.folder.name
    request = ExportRequest(str(store_of(taken)), trial, "samples", output, {"stream": "imu"})
    check_export(request).write(request)
    table = pd.read_parquet(output)
    values = [f"acceleration_{axis}" for axis in range(3)]
    assert list(table) == ["trial", "t_ns", *values, "temperature"]
    assert (table[values] == GRAVITY).all(axis=None)
    assert table["t_ns"].tolist() == taken.samples("imu")["t"].tolist()
