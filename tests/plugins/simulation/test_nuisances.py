"""Nuisances on the simulated rig, against closed forms and counts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.simulation.devices import build_mock
from sliplab.plugins.simulation.fault_book import FaultBook
from sliplab.plugins.simulation.nuisances import DAMPING, Shake, brushing, faults_of, swept
from sliplab.protocols import InputError, load_plan
from sliplab.protocols.nuisances import SHIPPED, TrialNuisances
from sliplab.rigs.core.faults import Knock, Shaking, SkinBrushed
from sliplab.rigs.rig_file import check_plan, load_rig_file
from tests.plugins.simulation.driving import SMALL, Trial, same, slide, with_faults

SECOND = 1_000_000_000


def book(*faults: Any) -> FaultBook:
    """Faults of a trial with a recording from its start on."""
    made = FaultBook(faults, 1)
    made.recording_ns = 0
    return made


def disturbed(seed: int, chunk_s: float, *names: str) -> Trial:
    """A slide under nuisances."""
    nuisances = TrialNuisances(tuple(SHIPPED[name] for name in names), 10.0)
    return slide(build_mock(SMALL), seed, chunk_s=chunk_s, nuisances=nuisances)


def test_a_knock_rings_as_a_damped_sine() -> None:
    faults = book(Knock(kind="knock", at_s=1.0, um=80.0, hz=25.0))
    t_ns = np.array([0, SECOND, SECOND + 10_000_000, SECOND + 30_000_000, 3 * SECOND], np.int64)
    moved = Shake(faults, 5).at(t_ns)
    # a quarter and three quarters of a turn of 40 ms later; none before
    quarter = 0.08 * np.exp(-DAMPING * np.pi / 2)
    third = 0.08 * np.exp(-DAMPING * 3 * np.pi / 2)
    assert np.linalg.norm(moved, axis=1)[:4] == pytest.approx([0, 0, quarter, third], abs=1e-12)
    assert np.linalg.norm(moved[4]) < 1e-8
    assert moved[2] / quarter == pytest.approx(-moved[3] / third)


def test_a_sweep_has_one_peak_speed_at_all_frequencies() -> None:
    shaking = Shaking(kind="shaking", mm_s=0.5, low_hz=1.0, high_hz=200.0, sweep_s=10.0)
    t = np.arange(0, 10, 1e-5)
    moved = swept(shaking, t)
    speed = np.abs(np.gradient(moved, 1e-5))
    for begin in range(2, 10):  # before, a period takes a second
        assert speed[(t >= begin) & (t < begin + 1)].max() == pytest.approx(0.5, rel=0.02)
    # half periods between zeros: the frequency is 1 x 200^(t / 10)
    zeros = t[1:][np.diff(np.signbit(moved)) != 0]
    middle, hz = (zeros[1:] + zeros[:-1]) / 2, 0.5 / np.diff(zeros)
    late = middle > 5
    assert np.median(np.abs(hz[late] / 200.0 ** (middle[late] / 10) - 1)) < 0.01
    assert swept(shaking, np.array([-1.0, 0.0, 10.0, 20.0])) == pytest.approx(0, abs=1e-12)


def test_a_brush_passes_over_each_papilla_once_and_along_its_way() -> None:
    brush = SkinBrushed(
        kind="skin_brushed", at_s=1.0, newtons=0.05, mm_s=20.0, width_mm=2.0, direction_deg=90.0
    )
    layout = np.array([[0.0, 0.0], [3.0, -6.0], [0.0, 6.0]])
    t_ns = np.arange(0, 4 * SECOND, 2_000_000, dtype=np.int64)
    force = brushing(book(brush), layout, 1, t_ns)
    assert np.abs(force[:, :, 0]).max() < 1e-15  # upwards only
    assert not force[t_ns < SECOND].any()
    assert force[:, :, 1].max(axis=0) == pytest.approx(0.05, rel=1e-3)
    peaks = t_ns[force[:, :, 1].argmax(axis=0)] / SECOND
    # 8 mm of tail and the skin's reach come before the centre; 6 mm more are 0.3 s
    reach = np.hypot(3, 6)
    assert peaks == pytest.approx(
        [1 + (8 + reach) / 20, 1 + (2 + reach) / 20, 1 + (14 + reach) / 20], abs=2e-3
    )
    assert brushing(book(brush), layout, 1, t_ns[t_ns > 3 * SECOND]) is None


def test_times_are_the_trials_own_and_inside_the_recording() -> None:
    nuisances = TrialNuisances((SHIPPED["tap_arm"], SHIPPED["lost_packets"]), 30.0)
    first, again, other = (faults_of(nuisances, SMALL.event_camera, seed) for seed in (1, 1, 2))
    assert first == again != other
    times = [fault.at_s for fault in first if isinstance(fault, Knock)]
    assert 10 <= len(times) <= 29  # every 2 s, 1 to 3 s apart
    assert np.diff([0.0, *times]).min() >= 1.0
    assert np.diff(times).max() <= 3.0
    assert max(times) < 30.0


def test_what_a_trial_shows_does_not_depend_on_how_it_is_read() -> None:
    names = ("tap_arm", "vibration", "brush", "lost_packets", "hot_pixels", "warm_camera")
    same(disturbed(7, 0.5, *names), disturbed(7, 0.043, *names))


def test_the_undisturbed_trial_is_as_ever() -> None:
    same(disturbed(7, 0.5), slide(build_mock(SMALL), 7))


def test_hot_pixels_are_the_cameras_own_and_have_their_rate() -> None:
    plain = slide(build_mock(SMALL), 7)
    hot = {"kind": "event_noise", "hz": 200.0, "pixels": 40, "positive": 1.0}
    seen = []
    for seed in (7, 8):
        trial = slide(with_faults(hot), seed)
        where = trial.events["x"].astype(np.int64) << 16 | trial.events["y"]
        count = np.bincount(np.unique(where, return_inverse=True)[1])
        seconds = (trial.events["t_us"][-1] - trial.events["t_us"][0]) / 1e6
        often = np.unique(where)[count > 100 * seconds]
        assert len(often) == 40
        total = np.isin(where, often).sum()
        assert total == pytest.approx(40 * 200 * seconds, abs=5 * np.sqrt(40 * 200 * seconds) + 400)
        seen.append(set(often.tolist()))
    assert seen[0] == seen[1]
    assert len(trial.events["x"]) > len(plain.events["x"])


def test_warmth_multiplies_the_noise() -> None:
    """20 degrees more are 2^2.5 times the noise, by events of a still sensor clear of the plate."""
    counts = []
    for names in ((), ("warm_camera",)):
        devices = build_mock(SMALL)
        nuisances = TrialNuisances(tuple(SHIPPED[name] for name in names), 10.0)
        devices.arm.connect()
        devices.begin_trial(3, nuisances)
        devices.sync.start(100.0, 1)
        devices.events.start()
        devices.clock.wait(4.0)
        counts.append(len(devices.events.read().t_us))
    hot = 4 * SMALL.event_camera.hot_pixels * SMALL.event_camera.hot_hz
    assert (counts[1] - hot) / (counts[0] - hot) == pytest.approx(2**2.5, rel=0.25)


def test_flicker_behind_a_low_pass_is_refused(tmp_path: Path) -> None:
    (tmp_path / "slow.yaml").write_text(
        "extends: rehearsal\nname: slow\nmock: {event_camera: {cutoff_hz: 300}}\n"
    )
    rig, _ = load_rig_file(tmp_path / "slow.yaml")
    with pytest.raises(InputError, match=r"mock.event_camera.cutoff_hz = 300.*must be 0 for the"):
        check_plan(rig, load_plan(Path("nuisances")), "slow.yaml")
