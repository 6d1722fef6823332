"""The simulated force sensor: the contact's true forces, and what a transducer makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.clocks.synchronise import streams_of, synchronise
from sliplab.analysis.force import step_ns
from sliplab.plugins.simulation.devices import build_mock
from sliplab.plugins.simulation.force import MockForceSensor
from sliplab.plugins.simulation.physics import plate_wrench
from sliplab.plugins.simulation.settings import MockSettings, scene_of
from sliplab.protocols.timing import Delay
from sliplab.protocols.yaml_file import validate
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import ForceSensor, RigError, Segment
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.storage.streams import WrenchChunk
from sliplab.storage.trials.checksums import DATA
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.writer import TrialWriter
from tests.rigs.core.test_rig import FRAME_PX, RIG, Memory, run, short_plan

QUIET: dict[str, Any] = dict.fromkeys(("noise_n", "noise_nm", "drift_n_per_min"), 0.0)
QUIET |= {"drift_nm_per_min": 0.0, "cross_talk_share": 0.0, "bias": "never"}
PERIOD_NS = 1_000_000


def force_rig(*, force: dict[str, Any] | None, **mock: Any) -> Rig:
    """The mock rig with tracks in place of pictures, with a force sensor or without."""
    mock = {**RIG["mock"], "frame_camera": {"level": "tracks"}, "force": force, **mock}
    rig = build_rig(validate(RigFile, {**RIG, "mock": mock}, "test"))
    rig.connect()
    return rig


def taken(rig: Rig, seed: int = 7) -> Memory:
    sink = Memory()
    run(rig, short_plan(), sink, seed)
    return sink


def test_it_is_a_force_sensor() -> None:
    rig = force_rig(force={})
    assert isinstance(rig.force, ForceSensor)


def test_a_rig_without_a_sensor_records_what_it_did() -> None:
    """Nothing of the other streams changes by a sensor that looks on."""
    plain, with_sensor = taken(force_rig(force=None)), taken(force_rig(force={}))
    assert not any("force" in name for name in plain.parts)
    assert {"force times", "force forces"} <= with_sensor.parts.keys()
    for name in plain.parts:
        assert np.array_equal(plain.all(name), with_sensor.all(name)), name


def test_a_rig_without_a_sensor_sums_nothing_up() -> None:
    rig = force_rig(force=None)
    assert rig.force is None
    taken(rig)
    devices = build_mock(MockSettings())
    assert devices.force is None
    assert devices.world.physics.wrench is None


def test_a_trial_taken_again_is_the_same() -> None:
    rig = force_rig(force={})
    first, again = taken(rig), taken(rig)
    for name in ("force times", "force forces"):
        assert np.array_equal(first.all(name), again.all(name))


@pytest.mark.parametrize("wait_s", [0.01, 0.0337, 0.4])
def test_it_is_the_same_in_any_pieces(wait_s: float) -> None:
    found = []
    for step_s in (1.0, wait_s):
        devices = build_mock(MockSettings(force={}))
        go_to(devices, 2.4)
        devices.force.start()
        parts = []
        for _ in range(round(2.0 / step_s)):
            devices.clock.wait(step_s)
            parts.append(devices.force.read())
        found.append(WrenchChunk.concatenate(parts))
    n = min(map(len, found))
    assert n > 1900
    for whole, pieces in zip(*map(columns, found), strict=True):
        assert np.array_equal(whole[:n], pieces[:n])


def test_without_faults_it_shows_the_sum_of_the_tips() -> None:
    devices = build_mock(MockSettings(force={**QUIET, "rate_hz": 500}))
    world, sensor = devices.world, devices.force
    assert isinstance(sensor, MockForceSensor)
    go_to(devices, 2.4)
    loads = world.keep_loads()
    sensor.start()
    move(devices, 3.0, 2.4, 2.0)
    found = sensor.read()
    times = sensor.clock.to_device(found.t_ns)
    track = world.physics.track.at(times)
    assert len(found) > 500
    expected = plate_wrench(track, loads.at(times))
    # forces lie on straight lines between two rows; torques are sums of products of two such
    assert np.allclose(found.force_n, expected[:, :3], atol=1e-9)
    assert np.allclose(found.torque_nm, expected[:, 3:], atol=1e-6)
    normal = loads.at(times)[:, 2::3].sum(axis=1)
    assert np.allclose(found.force_n[:, 2], normal)
    assert found.force_n[:, 2].min() > 1.0
    # friction on the plate acts along the sensor's motion, below the cone's edge
    assert found.force_n[-1, 0] > 0.3
    assert np.all(np.hypot(*found.force_n[:, :2].T) < 1.1 * found.force_n[:, 2])


def go_to(devices: Any, depth_mm: float) -> None:
    """Press at the plate's centre."""
    devices.arm.connect()
    move(devices, 0.0, -2.0, 20.0)
    move(devices, 0.0, depth_mm, 20.0)


def move(devices: Any, x_mm: float, depth_mm: float, speed_mm_s: float) -> None:
    devices.arm.start([Segment(devices.world.plane.pose(x_mm, 0.0, depth_mm), speed_mm_s)])
    while not devices.arm.progress().done:
        devices.clock.wait(0.05)
    devices.clock.wait(0.1)


def at_rest(force: dict[str, Any], seconds: float, seed: int = 3) -> tuple[Any, WrenchChunk]:
    """Return the sensor's readings while nothing touches the plate."""
    devices = build_mock(MockSettings(force=force))
    devices.begin_trial(seed)
    devices.force.start()
    parts = []
    for _ in range(round(seconds)):
        devices.clock.wait(1.0)
        parts.append(devices.force.read())
    return devices, WrenchChunk.concatenate(parts)


def columns(chunk: WrenchChunk) -> tuple[np.ndarray, ...]:
    return chunk.t_ns, chunk.host_ns, chunk.force_n, chunk.torque_nm


def test_noise_is_what_its_settings_say() -> None:
    settings = {**QUIET, "noise_n": 0.02, "noise_nm": 0.0005}
    _, found = at_rest(settings, 20)
    assert found.force_n.std(axis=0) == pytest.approx(0.02, rel=0.03)
    assert found.torque_nm.std(axis=0) == pytest.approx(0.0005, rel=0.03)
    assert np.abs(found.force_n.mean(axis=0)).max() < 0.001


def test_zero_drifts_by_at_most_what_its_settings_say() -> None:
    slopes = []
    for seed in range(1, 13):
        _, found = at_rest({**QUIET, "drift_n_per_min": 0.6}, 3, seed)
        passed_min = (found.t_ns[-1] - found.t_ns[0]) / 60e9
        slopes.append((found.force_n[-1] - found.force_n[0]) / passed_min)
    size = np.abs(slopes)
    assert size.max() <= 0.6 * 1.001
    assert size.max() > 0.4
    assert len(np.unique(np.round(slopes, 9))) == 36


def test_cross_talk_shows_one_axis_on_another() -> None:
    matrix = np.zeros((6, 6))
    matrix[0, 2], matrix[4, 2] = 0.1, 0.002
    rows = tuple(tuple(row) for row in matrix.tolist())
    found = {}
    for name, more in (("plain", {}), ("mixed", {"cross_talk": rows})):
        devices = build_mock(MockSettings(force={**QUIET, **more}))
        go_to(devices, 2.4)
        devices.force.start()
        devices.clock.wait(0.2)
        found[name] = devices.force.read()
    plain, mixed = found["plain"], found["mixed"]
    assert np.allclose(mixed.force_n[:, 0], plain.force_n[:, 0] + 0.1 * plain.force_n[:, 2])
    assert np.allclose(mixed.torque_nm[:, 1], plain.torque_nm[:, 1] + 0.002 * plain.force_n[:, 2])
    assert np.allclose(mixed.force_n[:, 2], plain.force_n[:, 2])


def test_drawn_cross_talk_belongs_to_the_seed_and_keeps_its_share() -> None:
    def mix(**more: Any) -> np.ndarray:
        devices = build_mock(MockSettings(force={"cross_talk_share": 0.05, **more}))
        return devices.force._mix - np.eye(6)

    one = mix(seed=5)
    assert np.array_equal(one, mix(seed=5))
    assert not np.array_equal(one, mix(seed=6))
    assert np.all(np.diag(one) == 0)
    assert 0.01 < np.abs(one[:3, :3]).max() <= 0.05
    assert np.abs(one[3:, :3]).max() <= 0.05 * 0.02


def test_zero_takes_drift_and_load_away() -> None:
    rig = force_rig(force={**QUIET, "drift_n_per_min": 5.0, "bias": "trial"})
    force = rig.force
    assert force.zeroing == "trial"
    devices = build_mock(MockSettings(force={**QUIET, "bias": "trial"}))
    go_to(devices, 2.4)
    devices.force.start()
    devices.clock.wait(0.1)
    assert devices.force.read().force_n[-1, 2] > 1.0
    devices.force.zero()
    devices.clock.wait(0.1)
    assert np.abs(devices.force.read().force_n[-1]).max() < 0.05


def test_beyond_its_range_is_a_fault_that_stops_the_arm() -> None:
    rig = force_rig(force={"range_n": 2.0})
    with pytest.raises(RigError, match=r"force sensor: reads .* N, beyond its range of 2 N"):
        taken(rig)
    assert rig.arm.progress().done


def test_a_sensor_without_power_stops_the_arm() -> None:
    fault = {"kind": "device_gone", "device": "force_sensor", "at_s": 0.5, "trial": 1}
    rig = force_rig(force={}, faults=[fault])
    with pytest.raises(RigError, match="force sensor: does not answer"):
        taken(rig)
    assert rig.arm.progress().done


def test_its_delay_is_held_against_the_timing() -> None:
    with pytest.raises(ValueError, match=r"at most 4500.* timing.force.delay.longest_us = 5000"):
        force_rig(force={"arrival_jitter_us": 9000.0})
    with pytest.raises(ValueError, match=r"timing.force.drift_ppm = 200"):
        force_rig(force={"clock_ppm": 900.0})


def test_the_rig_that_ships_has_it() -> None:
    file, _ = load_rig_file(Path("mock-force"))
    assert file.timing.force.grade == "host time"
    assert scene_of(file).force is not None
    plain, _ = load_rig_file(Path("mock"))
    assert plain.timing.force is None
    assert scene_of(plain).force is None


# -- one time line with the events ---------------------------------------------------------


TORN_S = 0.9


def torn_rig(seed: int, delay: Delay | None = None) -> Rig:
    """The shipped rig; in every recording a papilla tears off, which both streams show.

    Args:
        delay: what is promised of the sensor's delay in place of what the rig file says.
    """
    file, _ = load_rig_file(Path("mock-force"))
    fault = {"kind": "papilla_torn", "papilla": 0, "at_s": TORN_S}
    changes = {"faults": [fault], "frame_camera": {"level": "tracks"}, "seed": seed}
    scene = MockSettings.model_validate(scene_of(file).model_dump() | changes)
    timing = file.timing
    if delay is not None:
        force = timing.force.model_copy(update={"delay": delay})
        timing = timing.model_copy(update={"force": force})
    rig = build_rig(file.model_copy(update={"mock": scene, "timing": timing}))
    rig.connect()
    return rig


class Taken:
    """A trial on such a rig, its clocks fitted."""

    def __init__(self, rig: Rig, folder: Path, seed: int) -> None:
        writer = TrialWriter(folder, folder.with_name("none"), FRAME_PX, 100)
        plan = short_plan()
        done = rig.run_trial(plan.program(plan.trials[0]), writer, seed, FRAME_PX, 100)
        with StreamReader(writer.seal() / DATA) as reader:
            streams = streams_of(reader, rig.frames.mid_exposure_ns)
            self.events = reader.events()
            self.wrenches = reader.wrenches("force")
        self.sync = synchronise(streams, rig.timing, 100)
        self.truth = done.truth
        writer.discard()

    @property
    def force_step_ns(self) -> int:
        """When the force fell, on the time line."""
        device = step_ns(self.wrenches.t_ns, self.wrenches.force_n[:, 2])
        return int(self.sync.devices["force"].map.to_reference(device))

    @property
    def event_step_ns(self) -> int:
        """When the markers jumped, on the time line: the middle of the densest 3 ms of events."""
        t_us = self.events.t_us
        after = np.searchsorted(t_us, t_us + 3000)
        first = int(np.argmax(after - np.arange(len(t_us))))
        middle = float(np.median(t_us[first : after[first]]))
        return int(self.sync.devices["events"].map.to_reference(round(middle * 1e3)))

    @property
    def stated_ns(self) -> float:
        """Both clocks, and half a sample."""
        both = self.sync.against_events_ns("force")
        assert both is not None
        return both + PERIOD_NS / 2


def steps_within(
    folder: Path, trials: int, delay: Delay | None = None, most_ns: int = 4_000_000
) -> tuple[int, int]:
    """Trials whose force step is timed against events as stated; and whose clock map is."""
    steps = maps = 0
    rigs = [torn_rig(seed, delay) for seed in (1, 2)]
    for seed in range(1, trials + 1):
        found = Taken(rigs[seed % 2], folder / str(seed), seed)
        off = abs(found.force_step_ns - found.event_step_ns)
        steps += off <= found.stated_ns
        pairs = np.array(found.truth["clocks"]["force"])
        force = found.sync.devices["force"]
        error = np.abs(np.asarray(force.map.to_reference(pairs[:, 0])) - pairs[:, 1])
        maps += bool(error.max() <= force.uncertainty_ns)
        assert found.stated_ns < most_ns
    return steps, maps


@pytest.mark.long
def test_a_force_step_is_timed_against_the_events(tmp_path: Path) -> None:
    steps, maps = steps_within(tmp_path, 8)
    assert (steps, maps) == (8, 8)


@pytest.mark.long
def test_a_true_promise_of_the_delay_is_a_tight_bound(tmp_path: Path) -> None:
    """What is stated is a bound from the promise: its width is that of the promise."""
    delay = Delay(shortest_us=500, longest_us=1500)
    assert steps_within(tmp_path, 8, delay, 1_600_000) == (8, 8)


@pytest.mark.long
def test_a_force_step_is_timed_against_the_events_in_200_trials(tmp_path: Path) -> None:
    steps, maps = steps_within(tmp_path, 200)
    assert steps >= 190
    assert maps == 200


def test_a_step_is_dated_between_two_samples() -> None:
    t_ns = np.arange(100, dtype=np.int64) * PERIOD_NS
    rng = np.random.default_rng(0)
    for at in (30.0, 41.25, 60.5, 70.9):
        values = np.clip(np.arange(100) - at + 0.5, 0.0, 1.0) + rng.normal(0, 0.01, 100)
        for sign in (1.0, -1.0):
            assert step_ns(t_ns, sign * values) == pytest.approx(at * PERIOD_NS, abs=0.6e6)
    with pytest.raises(ValueError, match="5 samples; at least 22"):
        step_ns(t_ns[:5], values[:5])
