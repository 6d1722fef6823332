"""Is this trial good enough to keep? Clocks fitted, losses counted, gates applied.

Runs on the sealed files of a trial that is not committed yet, so that a doubtful trial is taken
again while the rig still stands there.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from analysis.clocks import ClockFit, ClockRefused, fit_clock
from protocols.conditions import Gates
from rigs.rig import TrialRun
from storage.hdf5 import StreamReader
from storage.streams import F64, I64
from storage.writer import DATA

GRADE = "hardware trigger"
"""How frames are timed: by the sync box's own ticks."""
BURST_US = 10_000
"""The stretch in which `gates.event_burst` counts events."""


@dataclass(frozen=True)
class Assessment:
    """Clock maps and gates of one attempt, as JSON data."""

    clocks: dict[str, Any]
    gates: dict[str, dict[str, Any]]
    counts: dict[str, int]

    @property
    def passed(self) -> bool:
        """Whether every gate is passed."""
        return all(bool(gate["passed"]) for gate in self.gates.values())

    @property
    def causes(self) -> str:
        """The failed gates in words."""
        failed = [
            f"{name} = {gate['value']} (limit {gate['limit']})"
            for name, gate in self.gates.items()
            if not gate["passed"]
        ]
        return "; ".join(failed)


def assess(
    folder: Path, run: TrialRun, gates: Gates, rate_hz: int, mid_exposure_ns: int | None
) -> Assessment:
    """Fit the clocks of a sealed trial and hold it against the protocol's gates.

    Args:
        mid_exposure_ns: from a frame's trigger to its time; None without a video.
    """
    video = mid_exposure_ns is not None
    with StreamReader(folder / DATA) as reader:
        reference = reader.pulses("sync_pulses")
        trains = {"events": reader.pulses("event_pulses"), "arm": reader.pulses("arm_pulses")}
        frame_times, frame_numbers = reader.column("frames/t"), reader.column("frames/number")
        if mid_exposure_ns is not None:
            trains["frames"] = frame_times[reader.column("frames/sync") > 0] - mid_exposure_ns
        event_us = reader.event_times()
        pose_ns, pose_mm = reader.column("poses/t"), reader.column("poses/xyz")
    clocks: dict[str, Any] = {"reference": "sync box", "grade": GRADE}
    limit = float(gates.sync_uncertainty)
    results: dict[str, dict[str, Any]] = {}
    for device, pulses in trains.items():
        name = f"sync_uncertainty_{device}_s"
        try:
            fit = fit_clock(pulses, reference, in_order=True)
        except ClockRefused as refusal:
            results[name] = {"value": str(refusal), "limit": limit, "passed": False}
            continue
        clocks[device] = _fit_json(fit)
        value = fit.uncertainty_ns / 1e9
        results[name] = {"value": value, "limit": limit, "passed": value <= limit}
    if video:
        lost = _frames_lost(frame_numbers, run, rate_hz)
        results["frames_lost"] = {
            "value": lost,
            "limit": gates.frames_lost,
            "passed": lost <= gates.frames_lost,
        }
    gap = _event_gap(event_us, clocks, run)
    gap_limit = float(gates.event_gap)
    results["event_gap_s"] = {"value": gap, "limit": gap_limit, "passed": 0 <= gap <= gap_limit}
    burst = _event_burst(event_us)
    results["event_burst"] = {
        "value": burst,
        "limit": gates.event_burst,
        "passed": burst <= gates.event_burst,
    }
    away, away_limit = _path_deviation(pose_ns, pose_mm, run), float(gates.path_deviation)
    results["path_deviation_mm"] = {
        "value": away,
        "limit": away_limit,
        "passed": 0 <= away <= away_limit,
    }
    return Assessment(
        clocks,
        results,
        {
            "events": len(event_us),
            "frames": len(frame_times),
            "poses": len(pose_ns),
            "pulses": len(reference),
        },
    )


def _fit_json(fit: ClockFit) -> dict[str, Any]:
    data = asdict(fit)
    data["map"] = fit.map.to_json()
    return data


def _frames_lost(numbers: I64, run: TrialRun, rate_hz: int) -> int:
    """Frames missing between the first and the last, and against the recorded time."""
    start, end = run.recorded_ns
    expected = int((end - start) / 1e9 * rate_hz)
    if not len(numbers):
        return expected
    gaps = int(numbers[-1]) + 1 - len(numbers)
    return max(gaps, expected - 1 - len(numbers), 0)


def _event_gap(event_us: I64, clocks: dict[str, Any], run: TrialRun) -> float:
    """Longest silence of the event camera while the arm moved in contact, seconds.

    -1 when it cannot be told, because a clock has no map or there are no events.
    """
    from storage.clockmap import ClockMap

    if "events" not in clocks or "arm" not in clocks or not len(event_us):
        return -1.0
    moving = next(step for step, _ in run.steps if step.phase in {"slide", "retract"})
    arm, events = (ClockMap.from_json(clocks[name]["map"]) for name in ("arm", "events"))
    start, end = (
        int(events.to_device(int(arm.to_reference(t)))) // 1000
        for t in (moving.start_ns, moving.end_ns)
    )
    inside = event_us[np.searchsorted(event_us, start) : np.searchsorted(event_us, end, "right")]
    edges = np.concatenate([[start], inside, [end]])
    return float(np.max(np.diff(edges))) / 1e6


@njit(cache=True, nogil=True)
def _event_burst(event_us):  # type: ignore[no-untyped-def]
    """Most events in any 10 ms that begin with an event."""
    most, end = 0, 0
    for begin in range(len(event_us)):
        while end < len(event_us) and event_us[end] < event_us[begin] + BURST_US:
            end += 1
        most = max(most, end - begin)
    return most


def _path_deviation(pose_ns: I64, pose_mm: F64, run: TrialRun) -> float:
    """How far the tool was, at most, from the ways of the recorded steps, mm, to a micrometre.

    Only across: along its way an arm may be early or late, as it gathers speed. -1 without poses
    in some step, or when the arm's clock is not to be believed.
    """
    worst = 0.0
    for way in run.ways:
        if way.end_ns <= way.start_ns:
            continue
        inside = (pose_ns >= way.start_ns) & (pose_ns <= way.end_ns)
        if not inside.any():
            return -1.0
        begin = np.asarray(way.begin_mm)
        along = np.asarray(way.end_mm) - begin
        from_begin = pose_mm[inside] - begin
        length_2 = float(along @ along)
        share = np.zeros(len(from_begin)) if length_2 == 0 else from_begin @ along / length_2
        across: F64 = from_begin - np.clip(share, 0.0, 1.0)[:, None] * along
        worst = max(worst, float(np.max(np.linalg.norm(across, axis=1))))
    return round(worst, 3)
