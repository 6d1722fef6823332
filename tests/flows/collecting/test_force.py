"""Trials of a rig with a force sensor: stored, counted, on the time line, and gated."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.force import force_figures, has_forces, plate_forces
from sliplab.analysis.labels.labelling import label_results
from sliplab.analysis.labels.reviewed import label_key
from sliplab.analysis.report.forces import force_section
from sliplab.analysis.report.page import render_section
from sliplab.flows.api import open_store
from sliplab.flows.collecting.requests import CampaignStopped
from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.collecting.supervisor import CollectionSupervisor
from sliplab.plugins.view import view
from sliplab.protocols import InputError, Protocol, make_plan
from sliplab.protocols.labelling import Labelling
from sliplab.protocols.yaml_file import parse_yaml, validate
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.reacting import run_watched
from sliplab.rigs.rig_file import RigFile, check_plan, load_rig_file
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.streams import Chunk, NullSink, WrenchChunk
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.conftest import ROOT
from tests.flows.collecting.test_faults import slides
from tests.flows.collecting.test_session import session, short
from tests.flows.conftest import requested, take_all, tiny, tiny_gravity
from tests.patching import put
from tests.plugins.view.test_view import Read

TIMING = {"force": {"grade": "host time", "delay": {"shortest_us": 0, "longest_us": 4000}}}
TRACKS = {"level": "tracks"}


def felt(
    folder: Path, data: dict[str, Any], force: dict[str, Any] | None = None, **mock: Any
) -> tuple[TrialCollector, Campaign]:
    """A session on a rig with a force sensor."""
    return session(
        folder / "a", data, {"timing": TIMING}, force=force or {}, frame_camera=TRACKS, **mock
    )


def gated(**gates: Any) -> dict[str, Any]:
    """A slide with these gates in place of the protocol's."""
    data = slides(1)
    data["collection"]["gates"] = gates
    return data


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """One slide to 0 degrees, with forces that hold their gates."""
    folder = tmp_path_factory.mktemp("force")
    work, campaign = felt(folder, gated(normal_force="5 N", hold_force="1 N"))
    take_all(work)
    assert verify(TrialStore.open(folder / "a" / "store")) == []
    (recording,) = campaign.recordings()
    return recording


@pytest.fixture(scope="module")
def unfelt(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """The same of a rig without a sensor."""
    folder = tmp_path_factory.mktemp("unfelt")
    work, campaign = session(folder / "a", slides(1), frame_camera=TRACKS)
    take_all(work)
    return campaign


def test_the_record_counts_and_times_the_forces(taken: Recording) -> None:
    record = taken.record
    stream = record.streams["force"]
    assert (stream.kind, stream.rows) == ("wrench", len(taken.wrenches()))
    assert stream.rows == pytest.approx(record.recorded_s * 1000, rel=0.2)
    assert stream.to_plate == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    clock = record.clocks.streams["force"]
    assert (clock.grade, clock.kind) == ("host time", "hard bound")
    gate = record.quality.gates["sync_uncertainty_force_s"]
    assert (gate.passed, gate.grade) == (True, "host time")
    assert all(record.quality.gates[name].passed for name in ("normal_force_n", "hold_force_n"))
    assert 0.001 < float(gate.value or 0) < 0.004
    assert record.timing.rig.force is not None
    truth = np.array((record.simulation_truth or {})["clocks"]["force"])
    error = np.abs(np.asarray(clock.map.to_reference(truth[:, 0])) - truth[:, 1])
    assert error.max() <= (clock.uncertainty_ns or 0)


def test_forces_stand_on_the_plate_and_on_the_time_line(taken: Recording) -> None:
    assert has_forces(taken)
    found = plate_forces(taken)
    assert found.simulated
    start, end = taken.step("slide")
    held, slid = found.between(*taken.step("hold")), found.between(start, end)
    assert np.all(np.diff(found.t_ns) > 0)
    assert len(slid.t_ns) == pytest.approx((end - start) / 1e6, abs=3)
    assert held.normal_n.mean() > 1.0
    # friction grows along the slide, below the edge of the cone
    assert held.tangential_n.mean() < 0.3
    assert slid.tangential_n[-50:].mean() > 0.5
    assert np.all(slid.tangential_n < 1.1 * slid.normal_n)
    assert 1e6 < found.uncertainty_ns < 4e6
    read = open_store(taken.folder.parents[3]).trial(taken.trial_id).forces()
    assert np.array_equal(read.t_ns, found.t_ns)
    assert read.normal_n.mean() > 0.5


def test_figures_of_the_forces_are_in_record_and_catalogue(taken: Recording) -> None:
    figures = taken.record.streams["force"].figures
    assert figures["normal_peak_n"] == pytest.approx(figures["normal_hold_n"], rel=0.15)
    assert 0.5 < figures["tangential_peak_n"] < figures["normal_peak_n"]
    assert 0.4 < figures["friction_peak"] < 1.0
    table = catalogue(TrialStore.open(taken.folder.parents[3]))
    row = table[table["trial"] == taken.trial_id].iloc[0]
    for name, value in figures.items():
        assert row[f"force_{name}"] == value


@pytest.mark.parametrize(
    ("gate", "said"),
    [({"normal_force": "0.5 N"}, "normal_force_n = "), ({"hold_force": "4 N"}, "hold_force_n = ")],
)
def test_gates_of_force_reject_a_trial(gate: dict[str, str], said: str, tmp_path: Path) -> None:
    work, campaign = felt(tmp_path, gated(retakes=0, **gate))
    take_all(work)
    assert campaign.committed() == set()
    assert all(said in failed["cause"] for failed in campaign.quarantined())


def test_a_gate_of_force_needs_a_sensor(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gates.normal_force = 5 N: needs a force sensor"):
        session(tmp_path / "a", gated(normal_force="5 N"), frame_camera=TRACKS)


@pytest.mark.quick(1)
@pytest.mark.parametrize("per_m", [0.0, -30.0])
def test_references_of_a_skin_that_wears_stop_a_campaign(per_m: float, tmp_path: Path) -> None:
    data = short()
    data["collection"]["motion"][3]["distance"] = "6 mm"
    condition = {"depth": 2.4, "speed": 1.6, "direction": 0}
    data["collection"]["references"] = {"every": 1, "condition": condition}
    data["collection"]["gates"]["reference"] = {"event_rate": "90 %", "friction": "10 %"}
    work, campaign = felt(tmp_path, data, faults=[{"kind": "skin_wear", "per_m": per_m}])
    run_request = requested(tmp_path / "a")
    store = TrialStore.open(run_request.store)
    work.supervisor = CollectionSupervisor(run_request, store, campaign)
    if per_m == 0.0:
        take_all(work)
        assert len(campaign.committed()) == 6
        return
    with pytest.raises(CampaignStopped) as stopped:
        take_all(work)
    # of its 6 mm a tip slides some 4: friction of the second falls by a fifth
    assert len(campaign.committed()) == 3
    message = str(stopped.value)
    assert re.search(r"has 0\.\d{3} N/N of friction in the slide, \S+ had 0\.\d{3} \(-", message)
    assert "gates.reference.friction = 10 %). Skin worn, or skin or plate dirty" in message


def test_a_gate_of_friction_needs_forces_and_a_slide(tmp_path: Path) -> None:
    data = short()
    condition = {"depth": 2.4, "speed": 1.6, "direction": 0}
    data["collection"]["references"] = {"every": 1, "condition": condition}
    data["collection"]["gates"]["reference"] = {"event_rate": "90 %"}
    rehearsed = make_plan(validate(Protocol, data, "p.yaml"), "p.yaml")
    plain = rehearsed.collection_hash
    data["collection"]["gates"]["reference"]["friction"] = "10 %"
    assert make_plan(validate(Protocol, data, "p.yaml"), "p.yaml").collection_hash != plain
    with pytest.raises(InputError, match=r"reference.friction = 10 %: needs a force sensor"):
        session(tmp_path / "a", data, frame_camera=TRACKS)
    falls = tiny_gravity()
    falls["collection"]["references"] = {"every": 2, "condition": {"mass": 0.165, "speed": 0.7}}
    falls["collection"]["gates"]["reference"] = data["collection"]["gates"]["reference"]
    with pytest.raises(InputError, match="needs a motion that slides"):
        validate(Protocol, falls, "p.yaml")


def test_a_rig_without_a_sensor_says_nothing_of_forces(unfelt: Campaign) -> None:
    recording = next(iter(unfelt.recordings()))
    text = (recording.folder / "record.json").read_text()
    data = json.loads(text)
    assert "streams" not in data
    assert "streams" not in data["clocks"]
    assert "force" not in text
    assert not has_forces(recording)
    with pytest.raises(StoreError, match="no wrench 'force'"):
        plate_forces(recording)
    store = TrialStore.open(unfelt.folder.parents[1])
    assert force_section(store, [Collected(unfelt)], None, simulated=True) is None
    label, _ = label_results(recording, Labelling())
    assert "force" not in label.to_json()
    ruled, _ = label_results(recording, Labelling(rule="force"))
    assert ruled.incipient_ns is None
    assert ruled.doubts.incipient == "the trial has no forces of a slide"


def test_a_clock_that_jumps_back_is_refused_and_the_trial_taken_again(tmp_path: Path) -> None:
    jump = {"kind": "clock_jump", "device": "force_sensor", "seconds": -2.0}
    work, campaign = felt(tmp_path, slides(1), faults=[{**jump, "at_s": 0.5, "trial": 1}])
    take_all(work)
    (failed,) = campaign.quarantined()
    assert "sync_uncertainty_force_s: its clock fell back" in failed["cause"]
    assert len(campaign.committed()) == 1


def test_figures_are_of_the_right_stretches() -> None:
    t_ns = np.arange(3000, dtype=np.int64) * 1_000_000
    force = np.zeros((3000, 3))
    force[:, 2] = 2.0
    force[1000:, 0] = np.linspace(0.0, 1.0, 2000)
    force[2500:, 2] = 9.0  # after the end
    found = force_figures(t_ns, force, (100_000_000, 1_000_000_000, 2_400_000_000))
    assert found == {
        "normal_peak_n": 2.0,
        "normal_hold_n": 2.0,
        "tangential_peak_n": pytest.approx(0.7, abs=0.01),
        "friction_peak": pytest.approx(0.35, abs=0.005),
    }
    assert force_figures(t_ns, force, (5_000_000_000, 6_000_000_000, 7_000_000_000)) == {}


def test_forces_are_seen_in_rerun(taken: Recording, tmp_path: Path) -> None:
    store = TrialStore.open(taken.folder.parents[3])
    path = tmp_path / "a.rrd"
    counts = view.save(view.find(store, taken.trial_id), path)
    forces = plate_forces(taken)
    assert counts["forces"] == len(forces.t_ns)
    times, values = Read(path).curve("/force/normal")
    assert times == forces.t_ns.tolist()
    assert np.allclose(values, forces.normal_n)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """Slides that are long enough to slip, labelled."""
    folder = tmp_path_factory.mktemp("labelled")
    data = tiny()
    data["collection"]["factors"]["direction"]["values"] = [0, 120]
    data["analysis"]["split"] = {"method": "ranked"}
    work, campaign = felt(folder, data)
    take_all(work)
    store = TrialStore.open(folder / "a" / "store")
    settings = work.plan.protocol.analysis.labelling
    for recording in campaign.recordings():
        label, arrays = label_results(recording, settings)
        key = label_key(recording, settings)
        derived = Derived.of(store, LABELS, campaign.name)
        derived.write(recording.trial_id, key, label.to_json(), arrays)
    return store


def test_the_label_has_onsets_by_force(labelled: TrialStore) -> None:
    (item,) = [Collected(campaign) for campaign in labelled.campaigns()]
    for _, recording in item.trials:
        label = Derived.of(labelled, LABELS, item.name).load(recording.trial_id, TrialLabel)
        truth = recording.simulation_truth() or {}
        assert label.rule == "paper"
        force = label.by_rule("force")
        assert abs(force.incipient_ns - truth["incipient_ns"]) < 30_000_000
        assert force.incipient_ns < force.gross_ns < truth["gross_ns"]


def test_the_force_may_rule(labelled: TrialStore) -> None:
    (item,) = [Collected(campaign) for campaign in labelled.campaigns()]
    recording = item.trials[0][1]
    settings = item.settings.labelling.model_copy(update={"rule": "force"})
    label, _ = label_results(recording, settings)
    assert (label.incipient_ns, label.gross_ns) == (label.force.incipient_ns, label.force.gross_ns)
    assert set(label.per_marker_ns) == {-1}


def test_the_report_shows_the_forces(labelled: TrialStore) -> None:
    items = [Collected(campaign) for campaign in labelled.campaigns()]
    section = force_section(labelled, items, None, simulated=True)
    assert section.trials == 2
    assert 0.5 < section.friction < 1.0
    page = render_section(section, simulated=True).html
    assert "friction cone" in page
    assert "simulated" in section.figure.svg
    rows = {(row[0], row[1]): row for row in section.rules.rows}
    assert rows["paper's rule", "incipient onset"][2] == "2"
    assert abs(float(rows["true crossing (simulated)", "incipient onset"][3])) < 30
    assert len(section.figures.rows) == 4


# -- presses to a force --------------------------------------------------------------------


def to_force(**press: Any) -> dict[str, Any]:
    """Slides that are pressed to a force, a factor of the protocol."""
    data = short()
    factors = data["collection"]["factors"]
    factors["load"] = {**factors.pop("depth"), "values": [1.0, 2.0], "unit": "N"}
    factors["direction"]["values"] = [0]
    data["collection"]["motion"][1] = {"phase": "press", "force": "$load", "speed": "1 mm/s"}
    data["collection"]["motion"][1] |= press
    return data


@pytest.mark.long
def test_a_plan_presses_to_a_force_in_place_of_a_depth(tmp_path: Path) -> None:
    work, campaign = felt(tmp_path, to_force(), {"noise_n": 0.002})
    take_all(work)
    assert campaign.quarantined() == []
    depths = {}
    for recording in campaign.recordings():
        load = float(str(recording.record.condition["load"]).split()[0])
        figures = recording.record.streams["force"].figures
        assert recording.trial_id.startswith("direction=0deg,load=")
        # the skin relaxes in the hold, by a fifth at most
        assert 0.75 * load < figures["normal_hold_n"] < 1.03 * load
        assert figures["normal_peak_n"] < 1.05 * load
        depths[load] = figures["pressed_mm"]
        poses = depth_of_poses(work, recording)
        slide = recording.step("slide")
        held = poses[(poses[:, 0] >= slide[0]) & (poses[:, 0] <= slide[1])]
        assert held[:, 1] == pytest.approx(figures["pressed_mm"], abs=0.02)
    assert 1.0 < depths[1.0] < depths[2.0] < 4.0


class Watch(NullSink):
    """A watcher that keeps the forces and never asks for a reflex."""

    armed = False

    def __init__(self) -> None:
        self.forces: list[WrenchChunk] = []

    def step(self, phase: str, acting: bool) -> None:
        """A step begins."""

    def add(self, device: str, chunk: Chunk) -> None:
        if isinstance(chunk, WrenchChunk):
            self.forces.append(chunk)


def test_a_watched_trial_presses_to_its_force_and_stays_as_deep(tmp_path: Path) -> None:
    """Live detection runs a program without a recording; the rule of a press is the same."""
    work, _ = felt(tmp_path, to_force())
    rig, trial = work.rig, work.plan.trials[0]
    level = float(work.plan.describe(trial)["load"].split()[0])
    sent: list[float] = []
    start = rig.arm.start

    def started(path: Any) -> None:
        sent.append(rig.plate_frame.position(path[0].to.xyz_mm).depth_mm)
        start(path)

    put(rig.arm, "start", started)
    watch = Watch()
    run_watched(rig, work.plan.program(trial), watch, 1, 100, None)
    held = np.concatenate([chunk.force_n[:, 2] for chunk in watch.forces[:20]])
    assert abs(np.abs(held).mean() - level) < 0.25 * level
    press = sent.index(max(sent))  # sent to its deepest place, and stopped
    assert 0 < sent[press + 1] < sent[press] - 0.2


def depth_of_poses(work: TrialCollector, recording: Recording) -> np.ndarray:
    """Time line (ns) and depth (mm) of every pose, (n, 2)."""
    with recording.open() as reader:
        poses = reader.poses()
    times = np.asarray(recording.clock("arm").to_reference(poses.t_ns))
    depth = [work.rig.plate_frame.position(xyz).depth_mm for xyz in poses.xyz_mm.tolist()]
    return np.column_stack([times, depth])


def test_a_press_that_meets_its_deepest_place_first_is_an_error(tmp_path: Path) -> None:
    work, campaign = felt(tmp_path, to_force(depth="1.2 mm"))
    with pytest.raises(RigError, match=r"deepest place, 1.2 mm, not the . N to press to"):
        take_all(work)
    assert work.rig.arm.progress().done
    assert campaign.committed() == set()


def test_a_limit_of_force_stops_the_arm_on_its_way(tmp_path: Path) -> None:
    work, campaign = felt(tmp_path, slides(1))
    work.rig.force_limit_n = 1.0
    clear: list[float] = []
    stop = work.rig.arm.stop

    def stopped() -> None:
        stop()
        clear.append(work.rig.position().depth_mm)

    put(work.rig.arm, "stop", stopped)
    with pytest.raises(RigError, match=r"above limits.force = 1 N of the rig; the arm was stopped"):
        take_all(work)
    # before the 2.4 mm to which the trial would press, and clear of the plate afterwards
    assert 0.5 < max(clear) < 2.0
    assert work.rig.position().depth_mm < 0
    assert campaign.committed() == set()


def test_a_rig_file_limits_forces_and_presses(tmp_path: Path) -> None:
    file, _ = load_rig_file(Path("mock-force"))
    data = parse_yaml((ROOT / "rigs" / "mock.yaml").read_text(), "mock.yaml")
    limits = {**data["limits"], "force": "3 N"}
    with pytest.raises(InputError, match=r"limits.force = 3 N: needs a force sensor"):
        validate(RigFile, {**data, "limits": limits}, "rig.yaml")
    mock = {**data["mock"], "force": {}}
    limited = validate(RigFile, {**data, "limits": limits, "mock": mock}, "rig.yaml")
    assert build_rig(limited).force_limit_n == 3.0
    assert build_rig(file).force_limit_n is None
    with pytest.raises(InputError, match="needs a force sensor, and the rig mock has none: press"):
        session(tmp_path / "a", to_force(), frame_camera=TRACKS)
    plan = make_plan(validate(Protocol, to_force(), "p.yaml"), "p.yaml")
    low = {**limits, "force": "1.5 N"}
    rig = validate(RigFile, {**data, "limits": low, "mock": mock}, "rig.yaml")
    with pytest.raises(InputError, match=r"2 N: exceeds limits.force = 1.5 N of the rig mock"):
        check_plan(rig, plan, "rig.yaml")


def test_a_press_needs_an_end(tmp_path: Path) -> None:
    data = short()
    del data["collection"]["motion"][1]["depth"]
    with pytest.raises(InputError, match="must have a 'depth', or a 'force'"):
        session(tmp_path / "a", data, frame_camera=TRACKS)


def test_protocols_without_it_keep_their_hash() -> None:
    plan = make_plan(validate(Protocol, short(), "p.yaml"), "p.yaml")
    (press,) = [p for p in plan.collection_data["motion"] if p["phase"] == "press"]
    assert "force" not in press
    assert {"normal_force", "hold_force"} & set(plan.collection_data["gates"]) == set()
    forced = make_plan(validate(Protocol, to_force(), "p.yaml"), "p.yaml")
    (press,) = [p for p in forced.collection_data["motion"] if p["phase"] == "press"]
    assert press["force"] == "$load"
