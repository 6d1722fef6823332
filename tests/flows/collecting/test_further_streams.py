"""Trials of a rig with further cameras and a thermometer: stored, timed, gated, resumed."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from sliplab.analysis.clocks.refit import fit_again
from sliplab.flows.api import open_store
from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.preflight import check
from sliplab.flows.planning.size_estimate import trial_bytes
from sliplab.plugins.simulation.further_settings import Thermometer
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.plugins.simulation.thermometer import MockThermometer
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.plugins.view import view
from sliplab.protocols import InputError
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials.catalogue import catalogue
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import answer, here
from tests.conftest import ROOT
from tests.flows.collecting.test_faults import slides
from tests.flows.collecting.test_session import checksums, short
from tests.flows.collecting.test_session import session as plain_session
from tests.flows.conftest import take_all, write
from tests.patching import loose
from tests.plugins.view.test_view import Read

TRACKS = {"level": "tracks"}
SIDE = {
    "kind": "events",
    "timing": {"drift_ppm": 50},
    "mock": {"width": 320, "height": 240, "px_per_mm": 7, "threshold": 0.3, "clock_ppm": 40},
}
BACK = {
    "kind": "frames",
    "scale_px_per_mm": 4,
    "region_px": [160, 160],
    "timing": {"resolution_us": 0},
    "mock": {"px_per_mm": 4, "clock_ppm": 20},
}
FREE = {
    **BACK,
    "rate_hz": 60,
    "timing": {"grade": "device time stamps", "resolution_us": 0},
    "mock": {"px_per_mm": 4, "rate_hz": 60, "level": "tracks"},
}
HEARD = {
    **BACK,
    "rate_hz": 50,
    "timing": {"grade": "host arrival", "delay": {"shortest_us": 3000, "longest_us": 9000}},
    "mock": FREE["mock"] | {"rate_hz": 50, "latency_us": 4000, "arrival_jitter_us": 4000},
}
WARM = {
    "kind": "scalar",
    "unit": "degC",
    "timing": {"delay": {"shortest_us": 0, "longest_us": 4000}},
    "mock": {"ambient": 22, "above": 2, "rate_hz": 40},
}
WRIST = {
    "kind": "wrench",
    "timing": {"delay": {"shortest_us": 0, "longest_us": 4000}},
    "mock": {"noise_n": 0.01, "rate_hz": 500},
}
TWIN = {"kind": "events", "mock": {}}
"""As the rig's first event camera, with pixels and a clock of its own."""
ALL = {"side": SIDE, "twin": TWIN, "back": BACK, "free": FREE, "heard": HEARD}
ALL |= {"wrist": WRIST, "warm": WARM}


def session(
    folder: Path,
    streams: dict[str, Any],
    *,
    data: dict[str, Any] | None = None,
    cameras: tuple[str, ...] | list[str] = ("events", "frames"),
    **mock: Any,
) -> tuple[TrialCollector, Campaign]:
    """A connected session on a mock rig with further devices."""
    shipped = parse_yaml((ROOT / "rigs" / "mock.yaml").read_text(), "mock.yaml")
    rig = {"streams": streams, "cameras": list(cameras), "timing": shipped["timing"]}
    return plain_session(folder, data or short(), rig, **mock)


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """One slide with five further devices; its store is whole."""
    folder = tmp_path_factory.mktemp("streams") / "a"
    work, campaign = session(folder, ALL)
    work.take(pending_trials(work.plan, campaign)[:1])
    assert verify(TrialStore.open(folder / "store")) == []
    (recording,) = campaign.recordings()
    return recording


def test_every_stream_is_stored_and_counted(taken: Recording) -> None:
    record = taken.record
    assert {name: stream.kind for name, stream in record.streams.items()} == {
        name: stream["kind"] for name, stream in ALL.items()
    }
    seconds = record.recorded_s
    side, back = record.streams["side"], record.streams["back"]
    assert side.rows == len(taken.events(stream="side")) > 1000
    assert side.rows != record.counts.events
    assert (side.size_px, back.size_px, back.px_per_mm) == ((320, 240), (160, 160), 4)
    assert side.pulses == pytest.approx(record.counts.pulses, abs=12)
    for name, rate_hz, within in (("back", 100, 0.15), ("free", 60, 0.2), ("heard", 50, 0.25)):
        assert record.streams[name].rows == pytest.approx(rate_hz * seconds, rel=within)
    images = list(taken.frames(stream="back"))
    assert len(images) == back.rows
    assert images[0].shape == (160, 160)
    assert images[0].max() > 100  # white markers on a dark ground
    assert taken.video("free") is None
    events = taken.events(stream="side")
    assert events.x.max() < 320
    assert events.y.max() < 240


def test_every_clock_holds_its_uncertainty_against_the_truth(taken: Recording) -> None:
    clocks, truth = taken.record.clocks.streams, (taken.simulation_truth() or {})["clocks"]
    grades = {name: (clock.grade, clock.kind) for name, clock in clocks.items()}
    assert grades == (
        dict.fromkeys(("side", "twin"), ("trigger input", "95 %"))
        | dict.fromkeys(("heard", "warm"), ("host arrival", "hard bound"))
        | {"back": ("hardware trigger", "95 %"), "free": ("device time stamps", "hard bound")}
        | {"wrist": ("host time", "hard bound")}
    )
    for name, most_ns in (("free", 1e6), ("wrist", 3e6)):
        pairs = np.array(truth[name])
        error = np.abs(np.asarray(clocks[name].map.to_reference(pairs[:, 0])) - pairs[:, 1])
        assert error.max() <= (clocks[name].uncertainty_ns or 0) < most_ns
    for name in ("side", "twin", "back"):
        # the true clock is a straight line; within the stretch of the pulses
        pairs, clock = np.array(truth[name]), clocks[name]
        shares = np.array([0.25, 0.5, 0.75])
        device, reference = (pairs[0, k] + shares * (pairs[-1, k] - pairs[0, k]) for k in (0, 1))
        mapped = np.asarray(clock.map.to_reference(np.round(device).astype(np.int64)))
        error = np.abs(mapped - reference)
        assert error.max() <= (clock.uncertainty_ns or 0)
        assert (clocks[name].uncertainty_ns or 0) < 1e4
    # what the host times by arrival is a delay older than its own clock says
    for name, shortest, longest in (("heard", 4e6, 8e6), ("warm", 1e6, 3e6)):
        pairs = np.array(truth[name])
        mid = (taken.record.streams[name].mid_exposure_ns or 0) if name == "heard" else 0
        mapped = np.asarray(clocks[name].map.to_reference(pairs[:, 0]))
        age = pairs[:, 1] - mapped - mid
        bound = clocks[name].uncertainty_ns or 0
        assert np.all(age >= shortest - bound)
        assert np.all(age <= longest + bound)
    # each clock is its own
    offsets = {name: truth[name][0][0] for name in ("side", "back", "free", "event_camera", "arm")}
    assert len(set(offsets.values())) == 5


def test_both_event_cameras_see_the_same_motion(taken: Recording) -> None:
    # little moves in the hold, much in the slide after it
    start, end = taken.step("hold")[0], taken.motion_ns[1]
    edges = np.arange(start, end, 10_000_000)
    rates = []
    for name in ("events", "twin"):
        found = taken.events(start, end, name)
        times = np.asarray(taken.clock(name).to_reference(found.t_us * 1000))
        rates.append(np.histogram(times, edges)[0])
    assert np.corrcoef(rates)[0, 1] > 0.98
    # one bin later they would not agree
    assert np.corrcoef(rates[0][1:], rates[1][:-1])[0, 1] < np.corrcoef(rates)[0, 1] - 0.02
    assert not np.array_equal(taken.events().x[:500], taken.events(stream="twin").x[:500])


def test_the_thermometer_shows_a_cooling_body(taken: Recording) -> None:
    warm = taken.scalars("warm")
    assert warm.unit == "degC"
    assert len(warm) == pytest.approx(40 * taken.record.recorded_s, rel=0.25)
    assert np.all((warm.value > 21.8) & (warm.value < 24.2))
    assert np.allclose(warm.value / 0.0625, np.round(warm.value / 0.0625))
    half = len(warm) // 2
    assert warm.value[:half].mean() > warm.value[half:].mean()
    figures = taken.record.streams["warm"].figures
    assert figures["min"] <= figures["mean"] <= figures["max"]
    assert figures["max"] == warm.value.max()


def test_a_further_force_sensor_feels_what_the_first_one_feels(tmp_path: Path) -> None:
    work, campaign = session(tmp_path / "a", {"wrist": WRIST}, force={})
    work.take(pending_trials(work.plan, campaign)[:1])
    (recording,) = campaign.recordings()
    trial = open_store(tmp_path / "a" / "store").trial(recording.trial_id)
    first, wrist = trial.forces(), trial.forces("wrist")
    start, end = trial.step("slide")
    shown = [found.between(start, end).normal_n.mean() for found in (first, wrist)]
    assert shown[0] > 1.0
    assert shown[0] == pytest.approx(shown[1], rel=0.05)
    assert not np.array_equal(first.normal_n[:50], wrist.normal_n[:50])
    figures = {name: recording.record.streams[name].figures for name in ("force", "wrist")}
    assert figures["wrist"].keys() == figures["force"].keys() - {"pressed_mm"}
    gate = recording.record.quality.gates["sync_uncertainty_wrist_s"]
    assert (gate.grade, gate.passed) == ("host time", True)
    # the first sensor's own rows are those of a rig without the second one
    alone, other = session(tmp_path / "b", {}, force={})
    alone.take(pending_trials(alone.plan, other)[:1])
    (without,) = other.recordings()
    for name, values in vars(without.wrenches()).items():
        assert np.array_equal(getattr(recording.wrenches(), name), values)


def test_gates_and_catalogue_know_them(taken: Recording) -> None:
    gates = taken.record.quality.gates
    assert {f"sync_uncertainty_{name}_s" for name in ALL} <= gates.keys()
    assert {f"frames_lost_{name}" for name in ("back", "free", "heard")} <= gates.keys()
    assert {"event_gap_side_s", "event_burst_side"} <= gates.keys()
    assert all(gate.passed for gate in gates.values())
    row = catalogue(TrialStore.open(taken.folder.parents[3])).iloc[0]
    assert row["side_events"] == taken.record.streams["side"].rows
    assert row["back_frames"] == taken.record.streams["back"].rows
    assert 22 < row["warm_mean"] < 24
    assert row["wrist_normal_peak_n"] == taken.record.streams["wrist"].figures["normal_peak_n"]


def test_clocks_are_fitted_again_to_the_same(taken: Recording) -> None:
    found, residuals = fit_again(taken, None)
    assert "clocks" not in found
    assert {"side_us", "back_us"} <= residuals.keys()


def test_the_public_interface_puts_them_on_one_time_line(taken: Recording) -> None:
    trial = open_store(taken.folder.parents[3]).trial(taken.trial_id)
    start, end = trial.step("slide")
    assert len(trial.events(start, end, "side")) > 100
    inside = (trial.frame_times("back") >= start) & (trial.frame_times("back") < end)
    assert np.count_nonzero(inside) == pytest.approx((end - start) / 1e7, abs=1)
    times = trial.scalars("warm").t_ns
    assert np.all(np.diff(times) >= 0)
    assert times[0] < start < end < times[-1] + 100_000_000


def test_the_first_cameras_are_as_on_a_rig_without_them(tmp_path: Path) -> None:
    alone, campaign = plain_session(tmp_path / "a", slides(1), frame_camera=TRACKS)
    take_all(alone)
    # an identical rig, its two further cameras on the wire
    both, more = session(tmp_path / "b", {"side": SIDE, "back": BACK}, data=slides(1))
    take_all(both)
    (with_them,) = more.recordings()
    without = campaign.recording(with_them.trial_id)
    one, other = ((r.folder / "data.h5").read_bytes() for r in (with_them, without))
    assert one == other
    assert not list(without.folder.glob("stream-*"))
    assert "streams" not in without.record.to_json()
    assert with_them.record.simulation_truth is not None


def test_a_campaign_in_pieces_is_the_campaign_in_one(tmp_path: Path) -> None:
    streams, data = {"side": SIDE, "warm": WARM}, slides(2)
    whole, campaign = session(tmp_path / "a", streams, data=data)
    take_all(whole)
    expected = checksums(campaign)
    part, pieces = session(tmp_path / "b", streams, data=data)
    part.take(pending_trials(part.plan, pieces)[:1])
    # killed in the second trial: its files stay behind, and go to quarantine
    trial = pending_trials(part.plan, pieces)[0]
    writer = pieces.begin(trial.id, None, 100)
    writer.add("side", whole.rig.further[0].device.read())
    assert (writer.folder / "stream-side.h5").exists()
    again, pieces = session(tmp_path / "b", streams, data=data)
    take_all(again)
    assert checksums(pieces) == expected
    assert any(path.name.startswith(trial.id) for path in (pieces.folder / "quarantine").iterdir())
    assert verify(TrialStore.open(tmp_path / "b" / "store")) == []


def record_calls(rig: Rig, called: list[str]) -> None:
    """Note in what order a rig's devices are stopped and closed."""
    devices = {"arm": rig.arm, "events": rig.event_camera, "sync": rig.sync}
    devices |= {device.name: device.device for device in rig.further}
    for name, what in itertools.product(devices, ("stop", "close")):
        done = getattr(devices[name], what)

        def noted(call: str = f"{what} {name}", done: Any = done) -> None:
            called.append(call)
            done()

        setattr(getattr(devices[name], "_target", devices[name]), what, noted)


@pytest.mark.quick(2)
@pytest.mark.parametrize("name", ["side", "back", "wrist", "warm"])
def test_a_device_lost_in_a_trial_stops_the_arm_first(name: str, tmp_path: Path) -> None:
    streams = {"side": SIDE, "back": BACK, "wrist": WRIST, "warm": WARM}
    fault = {"kind": "stream_gone", "stream": name, "trial": 1, "at_s": 0.3}
    work, campaign = session(tmp_path / "a", streams, data=slides(1), faults=[fault])
    called: list[str] = []
    record_calls(work.rig, called)
    text = rf"{name} \(further device\): does not answer \(simulated fault\)"
    with pytest.raises(RigError, match=text):
        take_all(work)
    assert called[0] == "stop arm"
    assert campaign.committed() == set()
    (aside,) = campaign.quarantined()
    assert "does not answer" in aside["cause"]
    called.clear()
    work.rig.close()
    others = [call for call in called if call.startswith("close")]
    assert others[0] == "close arm"
    assert set(others[-2:]) <= {f"close {stream}" for stream in streams}
    repaired, campaign = session(tmp_path / "a", streams, data=slides(1))
    take_all(repaired)
    assert len(campaign.committed()) == 1


def test_a_camera_that_falls_silent_fails_a_gate(tmp_path: Path) -> None:
    class Silent:
        """An event camera that sends nothing more after its first blocks."""

        def __init__(self, camera: Any) -> None:
            self._camera, self._reads = camera, 0

        def __getattr__(self, name: str) -> Any:
            return getattr(self._camera, name)

        def read(self) -> Any:
            self._reads += 1
            chunk = self._camera.read()
            return chunk if self._reads < 3 else type(chunk).empty()

    data = short()
    data["collection"]["gates"] = {"retakes": 0}
    work, campaign = session(tmp_path / "a", {"side": SIDE}, data=data)
    (side,) = work.rig.further
    work.rig.further = (type(side)(side.name, Silent(side.device), side.about),)
    work.take(pending_trials(work.plan, campaign)[:1])
    assert campaign.committed() == set()
    (aside,) = campaign.quarantined()
    assert "event_gap_side_s" in aside["cause"]
    assert "event_gap_s =" not in aside["cause"]


def test_the_viewer_shows_them(taken: Recording, tmp_path: Path) -> None:
    store = TrialStore.open(taken.folder.parents[3])
    counts = view.save(view.find(store, taken.trial_id), tmp_path / "t.rrd")
    for shown in ("side_events", "back_frames", "wrist_wrench", "warm_scalar"):
        assert counts[shown] == taken.record.streams[shown.partition("_")[0]].rows
    read = Read(tmp_path / "t.rrd")
    times, values = read.curve("/streams/warm")
    assert values == list(taken.scalars("warm").value)
    assert times == list(taken.clock("warm").to_reference(taken.scalars("warm").t_ns))
    pictures, _ = read["/streams/back", "EncodedImage:blob"]
    assert pictures == list(taken.frame_times("back"))
    assert len(read["/streams/side/on", "Points2D:positions"][0]) > 10


def timed(stream: dict[str, Any], name: str = "side", **timing: Any) -> dict[str, Any]:
    """Streams of a rig file: one with another timing."""
    return {name: {**stream, "timing": timing}}


NO_MEANING = "has no meaning with driver: mock"


@pytest.mark.parametrize(
    ("changes", "key", "text"),
    [
        ({"events": SIDE}, "streams.events", "is the name of one of a rig's first devices"),
        ({"Side": SIDE}, "streams.Side", "a stream's name must match"),
        ({"side": {"kind": "pictures"}}, "streams.side.kind", "must be one of events, frames"),
        ({"side": {"kind": "events"}}, "streams.side.mock", "is needed by driver: mock"),
        ({"side": {**SIDE, "device": {"driver": "dvxplorer"}}}, "streams.side.device", NO_MEANING),
        ({"side": {**SIDE, "mock": {"pixels": 5}}}, "streams.side.mock.pixels", "unknown key"),
        (timed(SIDE, grade="host arrival"), "streams.side.timing.grade", "must be trigger input"),
        (
            {"back": {**BACK, "region_px": [160, 2000]}},
            "streams.back.region_px",
            "exceeds mock.height = 1200",
        ),
        ({"back": {**BACK, "scale_px_per_mm": 5}}, "streams.back.scale_px_per_mm", "must be mock"),
        ({"free": {**FREE, "rate_hz": None}}, "streams.free.rate_hz", "is needed with"),
        ({"back": {**BACK, "rate_hz": 50}}, "streams.back.rate_hz", "has no meaning with"),
        (
            timed(SIDE, drift_ppm=50, jitter_us=1),
            "mock.clocks.pulse_jitter_us",
            "must be at most streams.side.timing.jitter_us = 1",
        ),
        (
            timed(SIDE, drift_ppm=20),
            "streams.side.mock.clock_ppm",
            "must be at most timing.drift_ppm = 20",
        ),
        (
            timed(WARM, "warm", delay={"shortest_us": 0, "longest_us": 2000}),
            "streams.warm.mock.arrival_jitter_us",
            "must be at most 1000",
        ),
    ],
)
def test_a_wrong_stream_is_named_by_its_key(
    changes: dict[str, Any], key: str, text: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=re.escape(text)) as raised:
        session(tmp_path / "a", changes)
    assert raised.value.key == key


def test_a_fault_of_an_unknown_stream_is_refused(tmp_path: Path) -> None:
    fault = {"kind": "stream_gone", "stream": "other"}
    with pytest.raises(InputError, match="is no further device of the rig; it has: side"):
        session(tmp_path / "a", {"side": SIDE}, faults=[fault])


def test_the_shipped_rig_passes_its_check(tmp_path: Path) -> None:
    rig = ROOT / "rigs" / "mock_two_cameras.yaml"
    file, _ = load_rig_file(rig)
    assert set(file.streams) == {"side_events", "back_frames", "plate_temperature"}
    found = check(write(tmp_path / "p.yaml", short()), rig, tmp_path / "s", ())
    assert all(item.passed for item in found)
    names = {item.name for item in found}
    assert {f"clock: {name}" for name in file.streams} <= names


@pytest.mark.long
def test_sync_shows_the_clock_of_each(taken: Recording) -> None:
    store = taken.folder.parents[3]
    devices = answer("sync", store)["campaigns"]["tiny"]["devices"]
    assert list(devices) == ["events", "frames", "arm", *sorted(ALL)]
    assert (devices["side"]["pulses"]["missed"], devices["warm"]["pulses"]) == (0, None)
    assert [devices[name]["grade"] for name in ("side", "wrist")] == ["trigger input", "host time"]
    page = (store / "report" / "sync.html").read_text()
    assert "side, trigger input" in page
    assert "heard, host arrival" in page


def test_the_events_of_a_further_camera_are_exported_by_its_name(
    taken: Recording, tmp_path: Path
) -> None:
    store = taken.folder.parents[3]
    for form in ("aedat4", "dsec"):
        folder = tmp_path / form
        where = ("export", store, taken.trial_id, "--output", folder)
        found = answer(*where, "--format", form, "--stream", "side")
        assert found["events"] == taken.record.streams["side"].rows
        assert found["triggers"] == taken.record.streams["side"].pulses
        (path,) = folder.glob(f"*.{'h5' if form == 'dsec' else form}")
        assert path.stat().st_size > 1000
    with h5py.File(next((tmp_path / "dsec").glob("*.h5"))) as file:
        assert int(file["events/x"][:].max()) < 320
    said = here("export", store, taken.trial_id, "--output", tmp_path / "x", "--stream", "back")
    assert said.returncode == 2
    assert "has the streams of events: events, side, twin" in said.stderr


def test_readings_do_not_depend_on_how_often_they_are_read() -> None:
    def run(step_s: float) -> tuple[Any, Any]:
        file, _ = load_rig_file(ROOT / "rigs" / "mock_two_cameras.yaml")
        rig = build_rig(file)
        rig.connect()
        rig.simulation.begin_trial(3)
        side, _, warm = (further.device for further in rig.further)
        for device in (side, warm):
            device.start()
        rig.sync.start(100.0, 5, "lfsr")
        chunks = []
        while rig.clock.now_ns() < 2_000_000_000:
            rig.clock.wait(step_s)
            chunks.append((side.read(), warm.read()))
        events = np.concatenate([chunk.t_us for chunk, _ in chunks])
        readings = np.concatenate([chunk.value for _, chunk in chunks])
        return events, readings

    for one, other in zip(run(0.05), run(0.4), strict=True):
        assert len(one) > 20
        assert np.array_equal(one[: len(other)], other[: len(one)])


def test_a_cooling_body_follows_newtons_law() -> None:
    world = SimulatedWorld(MockSettings(seed=3))
    world.begin_trial(4)
    made = MockThermometer(world, Thermometer(ambient=20, above=5, time_constant_s=10), "w", "degC")
    times = np.array([0, 10_000_000_000, 20_000_000_000], np.int64)
    above = made.true_at(times) - 20
    assert 0 < above[0] <= 5
    assert above[1:] == pytest.approx(above[0] * np.exp([-1.0, -2.0]))


@pytest.mark.parametrize("cameras", [["events"], ["frames"]])
def test_a_rig_with_one_first_camera_has_further_ones(cameras: list[str], tmp_path: Path) -> None:
    work, campaign = session(tmp_path / "a", {"side": SIDE, "back": BACK}, cameras=cameras)
    work.take(pending_trials(work.plan, campaign)[:1])
    (recording,) = campaign.recordings()
    assert verify(TrialStore.open(tmp_path / "a" / "store")) == []
    assert recording.streams("events") == [*(["events"] if cameras == ["events"] else []), "side"]
    assert len(recording.events(stream="side")) > 100
    assert len(recording.frame_times("back")) > 50
    assert set(recording.record.clocks.streams) == {"side", "back"}
    found, _ = fit_again(recording, None)
    assert "clocks" not in found


def test_the_estimate_counts_further_cameras(tmp_path: Path) -> None:
    alone, _ = session(tmp_path / "a", {})
    more, _ = session(tmp_path / "b", {"side": SIDE, "back": BACK, "free": FREE, "warm": WARM})
    trial = next(iter(alone.plan))
    one, all_of_them = (trial_bytes(work.rig_file, work.plan, trial) for work in (alone, more))
    known, seconds = alone.rig_file.estimates, alone.plan.seconds(trial, recorded_only=True)
    first_px = alone.rig_file.frame_px(alone.plan)
    events = one - known.fixed_bytes - known.bytes_per_tracked_frame * seconds * 100
    back = known.bytes_per_frame * 160 * 160 / (first_px[0] * first_px[1]) * seconds * 100
    free = known.bytes_per_tracked_frame * seconds * 60
    assert all_of_them - one == pytest.approx(events + back + free)


PUBLISHED = ("--as", "croissant", "--licence", "CC-BY-4.0", "--creator", "Somebody")


def test_a_publication_has_their_files_and_describes_their_columns(
    taken: Recording, tmp_path: Path
) -> None:
    folder = tmp_path / "published"
    answer("export", taken.folder.parents[3], *PUBLISHED, "--output", folder)
    (trial,) = (folder / "campaigns" / "tiny" / "trials").iterdir()
    assert (trial / "stream-back.mkv").read_bytes() == loose(taken.video("back")).read_bytes()
    assert (trial / "stream-side.h5").is_file()
    card = (folder / "README.md").read_text()
    assert "mean of the stream warm, degC" in card
    assert "number of events of the camera side" in card
