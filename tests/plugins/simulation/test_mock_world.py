"""The devices together: one world, one virtual time, and bytes that only the trial decides."""

from typing import Any

import numpy as np
import pytest

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.rigs.core.capabilities import (
    Arm,
    Clock,
    EventCamera,
    FrameCamera,
    Operator,
    Plate,
    SyncBox,
)
from sliplab.rigs.core.pulse_code import code_bits
from tests.plugins.simulation.driving import CODE, SMALL, Trial, same, slide


@pytest.fixture(scope="module")
def devices() -> MockDevices:
    return build_mock(SMALL)


@pytest.fixture(scope="module")
def trial(devices: MockDevices) -> Trial:
    return slide(devices, seed=11)


def test_devices_can_do_what_a_rig_needs(devices: MockDevices) -> None:
    for device, capability in (
        (devices.clock, Clock),
        (devices.arm, Arm),
        (devices.events, EventCamera),
        (devices.frames, FrameCamera),
        (devices.sync, SyncBox),
        (devices.plate, Plate),
        (devices.operator, Operator),
    ):
        assert isinstance(device, capability)


def test_a_trial_depends_on_settings_seed_and_program_alone(trial: Trial) -> None:
    fresh = build_mock(SMALL)
    slide(fresh, seed=5, distance=1.0)
    slide(fresh, seed=6, distance=0.5, depth=3.0)
    same(slide(fresh, seed=11), trial)


@pytest.mark.parametrize("chunk_s", [0.0021, 0.033, 30.0])
def test_chunks_do_not_matter(devices: MockDevices, trial: Trial, chunk_s: float) -> None:
    same(slide(devices, seed=11, chunk_s=chunk_s), trial)


def test_another_seed_is_another_trial_on_the_same_rig(devices: MockDevices, trial: Trial) -> None:
    other = slide(devices, seed=12)
    assert other.truth["incipient_ns"] != trial.truth["incipient_ns"]
    assert abs(other.events["t_us"][0] - trial.events["t_us"][0]) > 1_000_000
    assert len(other.frames["number"]) == len(trial.frames["number"])


def test_another_rig_has_another_skin(trial: Trial) -> None:
    other = build_mock(SMALL.model_copy(update={"seed": 2}))
    assert not np.array_equal(other.world.skin.gap_mm, build_mock(SMALL).world.skin.gap_mm)


def test_streams_have_the_shapes_and_types_of_the_contract(trial: Trial) -> None:
    n = len(trial.events["t_us"])
    assert n > 10_000
    assert [trial.events[k].dtype for k in ("x", "y", "p", "t_us")] == [
        np.uint16,
        np.uint16,
        np.uint8,
        np.int64,
    ]
    assert np.all(np.diff(trial.events["t_us"]) >= 0)
    assert trial.events["x"].max() < 640
    assert trial.events["y"].max() < 480
    assert set(trial.events["p"].tolist()) == {0, 1}
    images = trial.frames["images"]
    assert images.shape == (len(trial.frames["number"]), 180, 180)
    assert images.dtype == np.uint8
    assert trial.frames["number"].tolist() == list(range(len(images)))
    assert trial.poses["xyz_mm"].shape == (len(trial.poses["t_ns"]), 3)
    assert np.all(np.diff(trial.poses["t_ns"]) == 2_000_000)
    assert np.all(trial.poses["t_ns"] % 2_000_000 == 0)
    assert np.all(trial.event_pulses % 1000 == 0)


def test_frames_carry_the_code_of_their_tick(trial: Trial) -> None:
    assert np.array_equal(trial.frames["sync"], code_bits(CODE, len(trial.frames["sync"])))
    spacing = np.diff(trial.frames["t_ns"])
    assert spacing.mean() == pytest.approx(10_000_000, rel=1e-4)
    assert spacing.std() < 5_000


def test_every_device_sees_the_same_pulses_on_its_own_clock(devices: Any, trial: Trial) -> None:
    bits = code_bits(CODE, len(trial.frames["sync"]))
    count = int(bits.sum())
    expected = np.flatnonzero(bits) * 10_000_000
    assert np.array_equal(trial.sync_pulses[:count], expected)
    for pulses, limit_ppm in ((trial.event_pulses, 45), (trial.arm_pulses, 65)):
        assert len(pulses) == len(trial.sync_pulses)
        drift = np.polyfit(expected, (pulses - pulses[0])[:count] - expected, 1)[0]
        assert abs(drift) < limit_ppm * 1e-6
        residual = (pulses - pulses[0])[:count] - expected * (1 + drift)
        assert residual.std() == pytest.approx(2_000, rel=0.4)


def test_clocks_count_from_other_days(trial: Trial) -> None:
    starts = [trial.events["t_us"][0] * 1000, trial.frames["t_ns"][0], trial.poses["t_ns"][0]]
    assert min(starts) > 1_000_000_000
    assert min(abs(a - b) for a in starts for b in starts if a is not b) > 1_000_000_000


def test_poses_say_where_the_arm_was(devices: MockDevices, trial: Trial) -> None:
    xyz = trial.poses["xyz_mm"]
    way = np.linalg.norm(xyz[-1] - xyz[0])
    assert way == pytest.approx(4.0, abs=0.02)
    speed = np.linalg.norm(xyz[500:1000:100] - xyz[400:900:100], axis=1) / 0.2
    assert speed == pytest.approx(np.full(5, 2.0), rel=1e-2)
    assert np.all(trial.poses["host_ns"] > 0)
    assert np.all(np.diff(trial.poses["host_ns"]) > 0)


def test_the_picture_shows_slip_when_the_truth_says_so(devices: MockDevices, trial: Trial) -> None:
    images = trial.frames["images"].astype(float) - 25
    images[images < 40] = 0
    limit = trial.truth["threshold_mm"] * 4.0
    times = np.arange(len(images)) * 10_000_000 + 1_000_000
    first = int(np.searchsorted(times, trial.truth["reference_ns"]))
    found = []
    for place in devices.world.skin.layout_mm[7:]:
        # an outer tip's slip at first stays within a window that its neighbours do not reach
        column, row = 89.5 + 4 * place[0], 89.5 - 4 * place[1]
        ys, xs = np.mgrid[int(row) - 10 : int(row) + 12, int(column) - 10 : int(column) + 12]
        window = images[:, ys, xs]
        centre = (window * xs).sum((1, 2)) / window.sum((1, 2))
        moved = centre - centre[first - 3 : first + 1].mean()
        found.append(times[np.argmax(moved > limit)])
    assert min(found) == pytest.approx(trial.truth["incipient_ns"], abs=15_000_000)


def test_truth_is_in_order_and_on_the_sync_clock(trial: Trial) -> None:
    truth = trial.truth
    assert truth["simulated"] is True
    assert truth["reference_ns"] == pytest.approx(400_000_000, rel=1e-4)
    assert truth["first_slip_ns"] < truth["incipient_ns"] <= min(truth["per_papilla_ns"][1:])
    assert truth["gross_ns"] == truth["per_papilla_ns"][0]
    for slip, seen in zip(truth["slip_per_papilla_ns"], truth["per_papilla_ns"], strict=True):
        assert slip is None or seen is None or slip < seen


def test_waiting_backwards_is_refused(devices: MockDevices) -> None:
    for seconds in (-1.0, float("nan")):
        with pytest.raises(ValueError, match="seconds"):
            devices.clock.wait(seconds)
