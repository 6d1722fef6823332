"""A sensor's clock by taps that another one felt, in recorded trials."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import push
from sliplab.protocols.errors import InputError
from sliplab.storage.streams import F64
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

pytestmark = pytest.mark.realtime  # a process that waits for a core pushes too late to be bounded

APART_NS = 77_000_000_000
"""What the glove's clock is behind the host's."""


def recorded(
    folder: Path, glove_at: list[float], force_at: list[float], mark_s: float
) -> Recording:
    """Record two seconds of both sensors, with taps at some times of each, and a mark, s."""
    sources = [
        push("glove", {"ax": "m/s2", "ay": "m/s2"}, clock="own"),
        push("pull", {"f": "N"}, uncertainty_ms=0.5),
    ]
    rng, since = np.random.default_rng(5), np.arange(0, 2, 0.002)
    with (
        record(sources, folder, "taps", tap=("glove", "pull")) as recorder,
        recorder.trial() as trial,
    ):
        t_ns = time.monotonic_ns() + np.rint(since * 1e9).astype(np.int64)

        def felt(taps: list[float]) -> F64:
            past = since[:, None] - np.array(taps)
            peaks = np.where(past >= 0, np.exp(-np.abs(past) / 0.02), 0.0).sum(axis=1)
            found: F64 = 50 * peaks + rng.normal(0, 0.05, since.size)
            return found

        glove, force = felt(glove_at), felt(force_at)
        trial.mark("tap", int(t_ns[0]) + round(mark_s * 1e9))
        for part in np.array_split(np.arange(since.size), 200):
            while time.monotonic_ns() < t_ns[part[-1]]:
                time.sleep(0.001)  # the sensors measure in real time
            trial.push("glove", t_ns[part] - APART_NS, glove[part], np.zeros(part.size))
            trial.push("pull", t_ns[part], force[part])
    (recording,) = TrialStore.open(folder).campaign("taps").recordings()
    return recording


def test_a_tap_near_its_mark_times_a_sensor_closer_than_its_arrivals(tmp_path: Path) -> None:
    found = recorded(tmp_path, [0.5, 1.9], [0.5], 0.5)  # the glove alone is hit a second time
    clock = found.clocks.streams["glove"]
    assert clock.grade == "tap"
    assert clock.uncertainty_ns < 10e6
    t_ns = found.samples("pull")["t"]
    off = np.abs(clock.map.to_reference(t_ns - APART_NS) - t_ns)
    assert off.max() <= clock.uncertainty_ns


def test_without_a_common_tap_the_arrivals_bound_the_clock_and_the_record_says_so(
    tmp_path: Path,
) -> None:
    found = recorded(tmp_path, [0.6, 1.2], [0.6], 0.9)
    assert found.clocks.streams["glove"].grade == "host time"
    assert any("by taps: A shows 2 taps, B 1" in note for note in found.record.imported.warnings)


def test_where_taps_and_arrivals_contradict_each_other_neither_is_believed(tmp_path: Path) -> None:
    found = recorded(tmp_path, [0.5], [1.2], 0.8)
    assert "glove" not in found.clocks.streams
    assert "from where its arrivals do: one of both is wrong" in found.clocks.refused["glove"]


@pytest.mark.parametrize(
    ("tap", "said"),
    [
        (("glove", "glove"), "must be two different sensors of glove, pull, hand"),
        (("pull", "glove"), "has no clock of its own"),
        (("glove", "none"), "must be two different sensors"),
        (("glove", "pull", "hand"), "must be two different sensors"),
        (("glove", "hand"), "must say how far its times may be off"),
        ("glove,pull", "must be a tuple of names"),
    ],
)
def test_what_cannot_be_aligned_by_taps_is_refused(tmp_path: Path, tap: Any, said: str) -> None:
    sources = [
        push("glove", {"a": "m/s2"}, clock="own"),
        push("pull", {"f": "N"}, uncertainty_ms=1),
        push("hand", {"f": "N"}),
    ]
    with pytest.raises(InputError, match=f"tap.*{said}"):
        record(sources, tmp_path, "taps", tap=tap).__enter__()
    assert not list(tmp_path.iterdir())
