"""A stream's clock by pulses that another one saw, in recorded trials."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import push
from sliplab.protocols.errors import InputError
from sliplab.storage.streams import F64, I64
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

APART_NS, DRIFT = 77_000_000_000, 100e-6
"""What the clock of the DAQ is behind the host's at the first pulse, and gains."""
PULSES, JITTER_NS, BIT_NS = 40, 20_000, 1_000_000
pytestmark = pytest.mark.realtime


def edges(how: str, rng: np.random.Generator) -> tuple[I64, F64]:
    """Return the times of rows since the first, ns, and their values."""
    gap = rng.integers(46, 64, PULSES) if how == "harp" else rng.uniform(25, 95, PULSES)
    rises = np.cumsum((gap * BIT_NS).astype(np.int64))
    if how == "id":
        return rises, np.arange(PULSES) + 7.0
    if how == "state":
        both = np.stack([rises, rises + 20 * BIT_NS], 1).ravel()
        return both, np.tile([1.0, 0.0], PULSES)
    if how == "sampled":
        at = np.arange(0, rises[-1] + 50 * BIT_NS, BIT_NS // 2)
        since = at - rises[np.maximum(np.searchsorted(rises, at, side="right") - 1, 0)]
        return at, ((since >= 0) & (since < 20 * BIT_NS)).astype(float)
    times, levels = [], []
    for second, start in enumerate(rises.tolist()):
        bits = [
            b
            for byte in (second + 300).to_bytes(4, "little")
            for b in (0, *((byte >> k) & 1 for k in range(8)), 1)
        ]
        line = np.array([1, *bits, 1])
        change = np.flatnonzero(np.diff(line))
        times += (start + change * BIT_NS).tolist()
        levels += line[change + 1].tolist()
    return np.array(times), np.array(levels, float)


def recorded(folder: Path, how: str, seeds: tuple[int, int], stated_ms: float | None) -> Recording:
    """Record pulses that a DAQ with a clock of its own and a box saw, and a sensor of the DAQ."""
    rng = np.random.default_rng(9)
    own, box = (edges(how, np.random.default_rng(seed)) for seed in seeds)
    columns = {"state" if how == "sampled" else how: ""}
    sources = [
        push("daq", columns, clock="own"),
        push("box", columns, uncertainty_ms=stated_ms),
        push("glove", {"pull": "N"}, clock="own"),
    ]
    with (
        record(sources, folder, "pulses", pulses=("daq", "box", "glove")) as recorder,
        recorder.trial() as trial,
    ):
        first = time.monotonic_ns()
        sent = [0, 0]
        while min(sent) < len(own[0]):
            threading.Event().wait(0.005)  # the streams' period
            now = time.monotonic_ns() - first
            for k, (name, (t_ns, values)) in enumerate((("daq", own), ("box", box))):
                end = int(np.searchsorted(t_ns, now))
                part = slice(sent[k], end)
                shaken = t_ns[part] + (t_ns[part] * DRIFT).astype(int) * (name == "daq")
                shaken = np.sort(shaken + rng.integers(-JITTER_NS, JITTER_NS, len(shaken)))
                trial.push(name, first + shaken - APART_NS * (name == "daq"), values[part])
                sent[k] = end
            trial.push("glove", int(first + now + now * DRIFT - APART_NS), 1.0)
        trial.mark("first", first)
    (recording,) = TrialStore.open(folder).campaign("pulses").recordings()
    return recording


@pytest.mark.parametrize("how", ["state", "sampled", "id", "harp"])
def test_pulses_time_a_stream_and_what_shares_its_clock(tmp_path: Path, how: str) -> None:
    found = recorded(tmp_path, how, (3, 3), 0.1)
    (mark,) = found.record.imported.marks
    known = found.clocks.streams.keys() & {"daq", "glove"}
    assert "daq" in known, found.record.imported.warnings
    for name in known:  # on a busy machine arrivals may say nothing of the glove
        clock = found.clocks.streams[name]
        assert clock.grade == "pulses", found.record.imported.warnings
        assert clock.kind == "95 %"
        assert clock.uncertainty_ns < 1e6
        since = np.linspace(1e8, 2e9, 20).astype(int)
        own = mark.t_ns + since + (since * DRIFT).astype(int) - APART_NS
        off = clock.map.to_reference(own) - mark.t_ns - since
        assert np.abs(off).max() <= clock.uncertainty_ns


def test_without_common_pulses_arrivals_bound_the_clock_and_the_record_says_so(
    tmp_path: Path,
) -> None:
    found = recorded(tmp_path, "state", (3, 4), 0.1)
    assert "daq" in found.clocks.refused or found.clocks.streams["daq"].grade == "host time"
    (said,) = [note for note in found.record.imported.warnings if "by pulses" in note]
    assert "pulses" in said


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("daq",), "must be two or more different sensors"),
        (("box", "daq"), "box has no clock|pulses = box"),
        (("daq", "box", "box"), "must be two or more different sensors"),
        (("a", "box"), "must be two or more different sensors"),
        (("daq", "unsure"), "must say how far its times may be off"),
        (("daq", "codes"), "have the columns state and id"),
        (("glove", "box"), "have the columns none and state"),
        ("daq,box", "must be a tuple of names"),
    ],
)
def test_streams_that_pulses_cannot_time_are_refused_before_anything_is_recorded(
    tmp_path: Path, names: Any, said: str
) -> None:
    sources = [
        push("daq", {"state": ""}, clock="own"),
        push("box", {"state": ""}, uncertainty_ms=1),
        push("unsure", {"state": ""}),
        push("codes", {"id": ""}, uncertainty_ms=1),
        push("glove", {"pull": "N"}, clock="own"),
    ]
    with pytest.raises(InputError, match=said):
        record(sources, tmp_path, "pulses", pulses=names).__enter__()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("late_ms", [0.0, 400.0])
def test_rows_that_come_later_than_their_delay_are_refused_by_pulses(
    tmp_path: Path, late_ms: float
) -> None:
    """Arrivals alone cannot know how late all of them are."""
    own = edges("state", np.random.default_rng(3))
    sources = [
        push("daq", {"state": ""}, clock="own"),
        push("box", {"state": ""}, uncertainty_ms=0.1),
        push("told", {"state": ""}, clock="own", delay_ms=1000),
    ]
    with (
        record(sources, tmp_path, "late", pulses=("daq", "box", "told")) as recorder,
        recorder.trial() as trial,
    ):
        first, sent = time.monotonic_ns(), 0
        while sent < len(own[0]):
            threading.Event().wait(0.005)  # the streams' period
            end = int(np.searchsorted(own[0], time.monotonic_ns() - first - 1e6 * late_ms))
            for name in ("daq", "box", "told"):
                t_ns = first + own[0][sent:end] - APART_NS * (name != "box")
                trial.push(name, t_ns, own[1][sent:end])
            sent = end
    (recording,) = TrialStore.open(tmp_path).campaign("late").recordings()
    found = recording.clocks
    if late_ms:
        assert "they put it" in found.refused["daq"]
        assert "do rows come later than delay_ms" in found.refused["daq"]
    for name in found.streams.keys() & {"daq", "told"}:
        off = found.streams[name].map.to_reference(first - APART_NS) - first
        assert abs(off) <= found.streams[name].uncertainty_ns, name
