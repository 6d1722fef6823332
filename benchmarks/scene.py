"""Cost and accuracy of the simulation: whole trials, contact, events and images.

`tracks_x_realtime` (one core) and `video_x_realtime` (two cores) take whole trials of the kinematic
grid from the first motion to the commit, quality gates included; a trial's time is that of its
motion program. `contact_864_s` is the contact of all 864 trials at the default level of physics,
slips located exactly and forces told every millimetre of the way.
`ns_per_event` has noise, sorting and read-out in it, for a slide at 1 mm/s, whose markers hardly
move; `ns_per_event_busy` is the same where every marker moves at about 200 px/s.
`x_v2e` compares a second of a fast slide without noise with v2e's own emulator on frames at 1 kHz
(`benchmarks.emulator`; left out where v2e is not found), projection and drawing included;
`v2e_time_p50_us` and `v2e_time_p95_us` are how far its event times are from ours. `x_circuit` is
what pixels with thresholds of both signs cost in place of those with one, `x_circuit_low_pass` what
a bandwidth of 30 Hz costs on top of that. `event_time_p95_us` holds signal events, before the
read-out, against the same trial with contact steps 16 times as fine; `readout_p95_us` is what the
read-out adds. `peak_mb` is the most memory that a process held that took one trial with its video.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
from functools import partial
from typing import Any

import numpy as np

from benchmarks.emulator import FRAME_NS, emulate, find_emulator
from benchmarks.measure import RUNS, SEED, Figures, alternate, one_core, rate, ratio, spread
from benchmarks.one_slide import run_slide
from benchmarks.scene_tradeoff.error import match_events
from benchmarks.slides import CHUNK_S, HOLD_S, LENGTH_MM, loads_of_slide
from benchmarks.trials import open_session
from sliplab.plugins.simulation.physics import springs_of
from sliplab.plugins.simulation.scene.events import EventOptics, Events, MarkerSensor
from sliplab.plugins.simulation.settings import MockSettings, skin_of
from sliplab.storage.streams import F64, I64, EventChunk

TRIALS = 30
"""Random trials of the grid; the same for every run."""
FAST_MM_S = 1.6
FINER = 16
CIRCUITS: dict[str, dict[str, Any]] = {
    "thresholds": {"threshold_off_sigma": 0.03},
    "low_pass": {"threshold_off_sigma": 0.03, "cutoff_hz": 30.0},
}


def measure(
    runs: int = RUNS, trials: int = TRIALS, length_mm: float = LENGTH_MM, grid: int = 864
) -> Figures:
    """All figures; fewer `runs`, `trials` (0: none) and slides of the `grid` for a quick look."""
    whole = (
        {
            **_whole(runs, trials),
            "peak_mb": _peak_mb("mock"),
            "peak_tracks_mb": _peak_mb("rehearsal"),
        }
        if trials
        else {}
    )
    return {
        **whole,
        **_contact(runs, grid),
        **_events(runs, length_mm),
        **_precision(length_mm),
    }


def _whole(runs: int, trials: int) -> Figures:
    count = max(trials // runs, 1)
    seconds: dict[str, list[float]] = {"tracks": [], "video": []}
    # shares of the sample in turn, so that every trial is taken once and rounds can be compared
    with (
        open_session("rehearsal", count * (runs + 1)) as tracks,
        open_session("mock", runs + 1) as video,
    ):
        amounts: dict[str, list[float]] = {"tracks": [], "video": []}

        def one() -> None:
            with one_core():
                amounts["tracks"].append(tracks.take(count))

        def two() -> None:
            amounts["video"].append(video.take(1))

        taken = alternate(runs, tracks=one, video=two)
        for name, values in amounts.items():
            seconds[name] = [a / b for a, b in zip(values[1:], taken[name], strict=True)]
    return {
        **spread("tracks_x_realtime", seconds["tracks"]),
        **spread("video_x_realtime", seconds["video"]),
    }


def _contact(runs: int, grid: int) -> Figures:
    settings = MockSettings(seed=SEED)
    skin = skin_of(settings)
    conditions = list(
        itertools.product(
            (2.4, 2.6, 2.8, 3.0, 3.2, 3.4), (0.6, 0.8, 1.0, 1.2, 1.4, 1.6), range(0, 360, 45), "123"
        )
    )[:grid]

    def contact() -> None:
        for seed, (depth, speed, direction, _) in enumerate(conditions):
            run_slide(springs_of(settings, skin, seed), depth, speed, direction)

    with one_core():
        taken = alternate(runs, contact=contact)
    return spread(f"contact_{grid}_s", taken["contact"])


def _events(runs: int, length_mm: float) -> Figures:
    settings = MockSettings(seed=SEED)
    layout = skin_of(settings).layout_mm
    sensor = MarkerSensor(EventOptics(**settings.event_camera.model_dump()), layout, SEED)
    slow = loads_of_slide(settings, length_mm)
    t_ns = np.arange(2001, dtype=np.int64) * 1_000_000
    shake = 0.1 * np.sin(2 * np.pi * 5.0 * 1e-9 * t_ns)
    moved = np.repeat(slow[1][:1], 2001, axis=0)
    moved[:, ::3] += shake[:, None]
    busy = (t_ns, moved)
    quiet = EventOptics(
        **{**settings.event_camera.model_dump(), "noise_hz": 0.0, "hot_pixels": 0, "readout_hz": 0}
    )
    silent = MarkerSensor(quiet, layout, SEED)
    fast = _first_second(loads_of_slide(settings, length_mm, FAST_MM_S))
    circuits = {
        name: MarkerSensor(quiet.model_copy(update=changes), layout, SEED)
        for name, changes in CIRCUITS.items()
    }
    counts: dict[str, int] = {}

    def sense(name: str, device: MarkerSensor, rows: tuple[I64, F64]) -> None:
        counts[name] = sum(len(part[0]) for part in _sensed(device, rows))

    with one_core():
        taken = alternate(
            runs,
            slow=lambda: sense("slow", sensor, slow),
            busy=lambda: sense("busy", sensor, busy),
        )
        circuit = alternate(
            min(runs, 3),
            plain=lambda: sense("fast", silent, fast),
            **{name: partial(sense, name, device, fast) for name, device in circuits.items()},
        )
    return {
        **spread("ns_per_event", [value * 1e9 / counts["slow"] for value in taken["slow"]]),
        **spread("ns_per_event_busy", [value * 1e9 / counts["busy"] for value in taken["busy"]]),
        "events_per_slide": float(counts["slow"]),
        **ratio("x_circuit", circuit["thresholds"], circuit["plain"]),
        **ratio("x_circuit_low_pass", circuit["low_pass"], circuit["thresholds"]),
        **_against_v2e(runs, silent, fast),
    }


def _first_second(rows: tuple[I64, F64]) -> tuple[I64, F64]:
    """The rows of a hold and slide that are within a second after the hold."""
    t_ns, loads = rows
    begin_ns = t_ns[0] + HOLD_S * 1e9
    retained = (t_ns >= begin_ns) & (t_ns <= begin_ns + 1e9)
    return t_ns[retained], np.ascontiguousarray(loads[retained])


def _against_v2e(runs: int, silent: MarkerSensor, rows: tuple[I64, F64]) -> Figures:
    """Some rows of a slide by v2e, where it is to be had, and by our way."""
    emulator = find_emulator()
    if emulator is None:
        return {}
    # frames are drawn from the same path, at every millisecond
    every = np.arange(rows[0][0], rows[0][-1] + 1, FRAME_NS, dtype=np.int64)
    dense = np.stack([np.interp(every, rows[0], column) for column in rows[1].T], axis=1)
    found: dict[str, Events] = {}

    def ours() -> None:
        found["ours"] = _joined_events(_sensed(silent, rows))

    def theirs() -> None:
        path = np.ascontiguousarray(np.transpose(silent.path(dense), (2, 0, 1)))
        t_ns, x, y, p = emulate(emulator, path, silent.optics, silent.threshold)
        found["v2e"] = t_ns + every[0], x, y, p

    with one_core():
        taken = alternate(min(runs, 3), ours=ours, v2e=theirs)
    apart, shared = _apart_us(_chunk(found["ours"]), _chunk(found["v2e"]))
    return {
        **ratio("x_v2e", taken["v2e"], taken["ours"]),
        **rate("v2e_x_realtime", (every[-1] - every[0]) * 1e-9, taken["v2e"]),
        "v2e_events_share": len(found["v2e"][0]) / len(found["ours"][0]),
        "v2e_matched_share": shared,
        "v2e_time_p50_us": float(np.percentile(apart, 50)),
        "v2e_time_p95_us": float(np.percentile(apart, 95)),
    }


def _sensed(device: MarkerSensor, rows: tuple[I64, F64]) -> list[Events]:
    """A slide's events in chunks of about a tenth of a second, as a rig reads."""
    t_ns, loads = rows
    device.reset(loads[0], SEED)
    block = round(CHUNK_S * 1e9) // device.optics.block_ns * device.optics.block_ns
    borders = np.arange(t_ns[0] // block + 1, t_ns[-1] // block + 1) * block
    cuts = [0, *np.searchsorted(t_ns, borders).tolist(), len(t_ns) - 1]
    return [
        device.sense(loads[a : b + 1], t_ns[a : b + 1])
        for a, b in itertools.pairwise(sorted(set(cuts)))
    ]


def _precision(length_mm: float) -> Figures:
    """Event times against contact steps 16 times as fine, and what the read-out adds."""
    settings = MockSettings(seed=SEED)
    layout = skin_of(settings).layout_mm
    optics = {**settings.event_camera.model_dump(), "noise_hz": 0.0, "hot_pixels": 0}
    exact = MarkerSensor(EventOptics(**{**optics, "readout_hz": 0}), layout, SEED)
    usual, scanned = (
        loads_of_slide(settings, length_mm),
        MarkerSensor(EventOptics(**optics), layout, SEED),
    )
    fine = loads_of_slide(settings, length_mm, finer=FINER)
    seen = _joined(_sensed(exact, usual))
    error, shared = _apart_us(seen, _joined(_sensed(exact, fine)))
    late, _ = _apart_us(seen, _joined(_sensed(scanned, usual)))
    return {
        "event_time_p50_us": float(np.percentile(error, 50)),
        "event_time_p95_us": float(np.percentile(error, 95)),
        "events_matched_share": shared,
        "readout_p95_us": float(np.percentile(late, 95)),
    }


def _joined_events(parts: list[Events]) -> Events:
    t_ns, x, y, p = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return t_ns, x, y, p


def _chunk(events: Events) -> tuple[EventChunk, I64]:
    """Events as a chunk, and their times in ns, which a chunk would round."""
    t_ns, x, y, p = events
    return EventChunk(x, y, p, t_ns // 1000), t_ns


def _joined(parts: list[Events]) -> tuple[EventChunk, I64]:
    return _chunk(_joined_events(parts))


def _apart_us(a: tuple[EventChunk, I64], b: tuple[EventChunk, I64]) -> tuple[F64, float]:
    """Return the time between matched events, and the share of events that have a match."""
    pairs = match_events(a[0], b[0])
    apart: F64 = np.abs(a[1][pairs.first] - b[1][pairs.second]) * 1e-3
    return apart, 1.0 - (pairs.unmatched or 0.0)


def _peak_mb(rig: str) -> float:
    found = subprocess.run(
        [sys.executable, "-m", "benchmarks.trials", rig],
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    return float(found.stdout.split()[-1])
