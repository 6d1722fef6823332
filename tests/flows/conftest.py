"""A small campaign that goes through every step, and Prefect at home in a folder of the tests."""

from __future__ import annotations

import atexit
import copy
import functools
import math
import os
import shutil
import ssl
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.command_line import answer
from tests.conftest import ROOT, SMALL

# Prefect reads these when it is imported, which happens when a test module imports a flow
_HOME = tempfile.mkdtemp(prefix="sliplab-prefect-")
atexit.register(shutil.rmtree, _HOME, ignore_errors=True)
os.environ["PREFECT_HOME"] = _HOME

from sliplab.analysis.report.sources import report_folder  # noqa: E402
from sliplab.flows.collect import collect  # noqa: E402
from sliplab.flows.collecting.session import TrialCollector  # noqa: E402
from sliplab.flows.planning.campaign_trials import pending_trials  # noqa: E402
from sliplab.flows.planning.run_request import (  # noqa: E402
    RunRequest,
    describe_campaign,
    make_request,
)
from sliplab.flows.running import orchestration, parallel_map, run_records, stopping  # noqa: E402
from sliplab.flows.running.embedded_server import ServerError  # noqa: E402
from sliplab.flows.running.orchestration import configure_prefect  # noqa: E402
from sliplab.flows.study import StudyOutcome, study  # noqa: E402
from sliplab.rigs.build import build_rig  # noqa: E402
from sliplab.rigs.rig_file import RigFile  # noqa: E402
from sliplab.storage.files import read_json  # noqa: E402
from sliplab.storage.trials.store import Campaign, TrialStore  # noqa: E402

Ran = tuple[list[RunRequest], StudyOutcome]
"""What the fixture `ran` gives: the runs of the small study, and how they ended."""

configure_prefect(Path(_HOME))
# each of Prefect's clients would read this computer's certificates anew; no server here has one
ssl.create_default_context = functools.cache(ssl.create_default_context)
# other tests have the other cores; in a fresh clone the first trial takes that long by its kernels
parallel_map.START_S = math.inf


class NoServer:
    """In place of the embedded server: flows run as they do when it is lost, and say nothing.

    A server costs a worker of the tests minutes of a processor. What it is told is tested by those
    in `tests/flows/running` and `tests/plugins/web/server`, and by whole programs.
    """

    alive = answers = True
    address = orchestration.NOWHERE

    def settings(self) -> dict[Any, str]:
        """Prefect's settings, which there are none of."""
        raise ServerError("tests have none unless they ask for it")

    def stop(self) -> None:
        """End nothing."""


_no_server: Any = NoServer()
orchestration._servers[_HOME] = _no_server
orchestration._lost_servers.add(run_records.EMBEDDED)
_real: dict[str, Any] = {}
"""This worker's server, once a test has asked for it."""


@pytest.fixture(scope="module")
def prefect_server() -> Iterator[None]:
    """Flows of the module's tests run on an embedded server."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(orchestration, "_servers", _real)
        patch.setattr(orchestration, "_lost_servers", set())
        yield


@pytest.fixture(autouse=True)
def forget() -> Iterator[None]:
    """No stop request outlives its test."""
    yield
    with stopping.signals():
        pass


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A detector's calibration for the skin of the rig `rehearsal`."""
    out = tmp_path_factory.mktemp("skin") / "skin.json"
    answer("calibrate", "detector", "--rig", "rehearsal", "--out", out, "--hold", 5, "--yes")
    return out


def tiny() -> dict[str, Any]:
    """Six fast slides: two of each split."""
    data = copy.deepcopy(SMALL)
    data["name"] = "tiny"
    collection = data["collection"]
    collection["factors"]["depth"]["values"] = [2.4]
    collection["factors"]["speed"]["values"] = [1.6]
    collection["factors"]["direction"]["values"] = [0, 60, 120, 180, 240, 300]
    collection["motion"][3]["distance"] = "7 mm"
    collection["motion"][2] = {"phase": "hold", "settle": "0.5 s", "duration": "1.5 s"}
    collection["recording"]["region"] = {"width": "36 mm", "height": "36 mm"}
    collection["maintenance"]["rezero"]["every"] = 3
    data["analysis"]["split"] = {
        "method": "leave_conditions_out",
        "validation_levels": {"direction": ["120 deg", "180 deg"]},
        "test_levels": {"direction": ["240 deg", "300 deg"]},
    }
    data["analysis"]["training"] = {"epochs": 2}
    return data


def summary_json(store: TrialStore) -> dict[str, Any]:
    """The last report's numbers, as they stand in the file."""
    return read_json(report_folder(store) / "summary.json")


def shape_of(data: Any) -> Any:
    """Keys in their order and types of JSON data; a list is what its first item is."""
    if isinstance(data, dict):
        return {key: shape_of(value) for key, value in data.items()}
    if isinstance(data, list):
        return [shape_of(data[0])] if data else []
    return type(data).__name__


def six_trials(folder: Path, rig: Path) -> Path:
    """A store with the six slides, shortened, and nothing derived from them."""
    data = tiny()
    data["collection"]["motion"][3]["distance"] = "5 mm"
    collect(make_request(write(folder / "tiny.yaml", data), rig, folder / "store"))
    return folder / "store"


def tiny_gravity() -> dict[str, Any]:
    """Two plates, one fast retraction each."""
    data: dict[str, Any] = yaml.safe_load((ROOT / "protocols" / "pilot_gravity.yaml").read_text())
    data["name"] = "tiny_gravity"
    data["collection"]["factors"]["speed"]["values"] = [0.7]
    data["collection"]["repetitions"] = 1
    data["collection"]["motion"][6]["distance"] = "2 mm"
    return data


def write(path: Path, data: dict[str, Any]) -> Path:
    """`data` as a YAML file."""
    path.write_text(yaml.dump(data, Dumper=yaml.CSafeDumper))
    return path


def requested(folder: Path) -> RunRequest:
    """Request a run of the folder's protocol on its rig, into its store."""
    return make_request(folder / "p.yaml", folder / "rig.yaml", folder / "store")


def at_rig(run_request: RunRequest, file: RigFile | None = None) -> tuple[TrialCollector, Campaign]:
    """A connected session on the request's rig, or on that of another file."""
    campaign = describe_campaign(TrialStore.create(run_request.store), run_request)
    file = file or run_request.rig
    rig = build_rig(file)
    rig.connect()
    return TrialCollector(run_request.plan, file, rig, campaign), campaign


def take_all(work: TrialCollector) -> None:
    """Take what is pending."""
    work.take(pending_trials(work.plan, work.campaign))


def run_small_study(folder: Path, rig_path: Path) -> tuple[list[RunRequest], StudyOutcome]:
    """Run both small campaigns through every step."""
    protocols = [
        write(folder / "tiny.yaml", tiny()),
        write(folder / "tiny_gravity.yaml", tiny_gravity()),
    ]
    run_requests = [make_request(protocol, rig_path, folder / "store") for protocol in protocols]
    return run_requests, study(run_requests)
