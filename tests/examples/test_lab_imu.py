"""A kind of stream of another package is recorded, timed, verified, shown and exported."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sliplab
from sliplab.flows.api import open_store
from sliplab.flows.exports import ExportRequest, check_export
from sliplab.plugins.driver_kit.conformance import cases
from sliplab.plugins.driver_kit.rule import NotTried
from sliplab.plugins.view import view
from sliplab.protocols import InputError
from sliplab.rigs.core.driver import SensorDriver
from sliplab.rigs.core.host_clock import HostClock
from sliplab.rigs.core.registry import find_driver
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.errors import StoreError
from sliplab.storage.streams import NullSink
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import answer, here
from tests.conftest import ROOT
from tests.examples.conftest import install as install_example
from tests.flows.collecting.test_session import short
from tests.flows.conftest import write
from tests.rigs.core.test_registry import forget
from tests.rigs.test_further_drivers import built, real_rig

GRAVITY = [0.0, 0.0, 9.81]


DEVICE = {"kind": "imu", "device": {"driver": "lab_imu"}}


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The package, installed by what an installer writes."""
    with pytest.MonkeyPatch.context() as patch:
        install_example("lab-imu", tmp_path_factory.mktemp("site"), patch)
        forget()
        yield
    forget()


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """One slide on a simulated rig with an inertial sensor, by `sliplab collect`."""
    folder = tmp_path_factory.mktemp("imu")
    timing = {"delay": {"shortest_us": 0, "longest_us": 2000}}
    data = {"extends": str(ROOT / "rigs" / "mock.yaml"), "name": "imu"}
    data |= {"mock": {"frame_camera": {"level": "tracks"}}, "streams": {"imu": DEVICE}}
    data["streams"]["imu"] |= {"timing": timing}
    rig, protocol = write(folder / "rig.yaml", data), write(folder / "protocol.yaml", short())
    done = here("collect", protocol, "--rig", rig, "--store", folder / "store", "--trials", 1)
    assert done.returncode == 0, done.stderr
    return next(TrialStore.open(folder / "store").campaigns()[0].recordings())


def store_of(recording: Recording) -> Path:
    return recording.folder.parents[3]


def test_named_in_a_rig_file(tmp_path: Path) -> None:
    stream = real_rig(tmp_path, {"wrist": DEVICE}).streams["wrist"]
    device, got = built("wrist", stream), []

    class Sink(NullSink):
        def add(self, device: str, chunk: Any) -> None:
            got.append((device, chunk.KIND.name))

    device.connect()
    device.start()
    device.finish(Sink())
    assert (device.about.kind, device.through_host, got) == ("imu", True, [("wrist", "imu")])


@pytest.mark.parametrize(
    ("change", "rig", "wrong"),
    [
        ({"kind": "scalar", "unit": "V"}, "ur5", "must be imu, which the driver lab_imu sends"),
        ({"kind": "imo"}, "ur5", "must be one of events, frames, wrench, scalar"),
        ({"mock": {}}, "mock", "mock = {}: must be left out: the driver of its device simulates"),
        ({"device": None}, "mock", "wrist.device: is needed by driver: mock"),
    ],
)
def test_refused_in_a_rig_file(
    tmp_path: Path, change: dict[str, Any], rig: str, wrong: str
) -> None:
    data = {"extends": str(ROOT / "rigs" / f"{rig}.yaml"), "streams": {"wrist": DEVICE | change}}
    with pytest.raises(InputError, match=wrong) as raised:
        load_rig_file(write(tmp_path / "rig.yaml", data), stored=True)
    assert len(raised.value.faults) == 1


@pytest.mark.parametrize("rig", ["mock", "loopback"])
def test_a_driver_that_simulates_nothing_is_refused_once(
    tmp_path: Path, rig: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = {"extends": str(ROOT / "rigs" / f"{rig}.yaml"), "streams": {"wrist": DEVICE}}
    path = write(tmp_path / "rig.yaml", data)
    assert load_rig_file(path)[0].simulated
    lab = importlib.import_module("lab_imu")
    monkeypatch.setattr(lab, "DRIVER", replace(lab.DRIVER, simulate=None))
    forget()
    with pytest.raises(InputError, match=f"no `simulate`, which driver: {rig} needs") as raised:
        load_rig_file(path)
    assert len(raised.value.faults) == 1
    monkeypatch.undo()
    forget()


def test_recorded_without_a_rig(tmp_path: Path) -> None:
    file = write(tmp_path / "streams.yaml", {"streams": {"imu": DEVICE}})
    words = ("--store", tmp_path / "store", "--campaign", "still", "--for", "0.3s")
    assert answer("record", file, *words)["trials"] == ["000001"]
    with sliplab.record([file], tmp_path / "store", "still") as recording, recording.trial():
        HostClock().wait(0.1)
    assert verify(TrialStore.open(tmp_path / "store")) == []
    for trial in sliplab.open_store(tmp_path / "store").trials()["trial"]:
        found = sliplab.open_store(tmp_path / "store").trial(trial)
        assert (found.recording.samples("imu")["acceleration"] == GRAVITY).all(axis=None)


def test_conformance_names_what_the_driver_lacks() -> None:
    driver = find_driver("lab_imu", SensorDriver)
    case = cases(driver, driver.settings())[0]
    with pytest.raises(NotTried, match="lab_imu declares no `fake` and `reach`"):
        case()


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
    assert list(table) == ["trial", "t_ns", *values, "temperature", "simulated"]
    assert (table[values] == GRAVITY).all(axis=None)
    assert table["t_ns"].tolist() == taken.samples("imu")["t"].tolist()
