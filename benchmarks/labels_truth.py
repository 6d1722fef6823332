"""Labels against the simulation's truth: random trials drawn as pictures, nuisances on.

`python -m benchmarks.labels_truth` prints its tables, of which docs/labels.md has excerpts (60
slides, 12 falls and 24 slides with glare, hidden markers and a trembling camera);
`python -m benchmarks labels_truth` gives the same numbers as figures. Clocks are perfect, so that
what is measured is the labelling. Nothing is stored: frames go straight to the trackers, which see
what a stored video would show them (it is lossless). True centres come from a second run that draws
nothing.
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.labels_summary import FRAME_MS, Checked, summary, tables, verdicts
from benchmarks.measure import SEED, Figures
from sliplab.analysis.labels.label import Label
from sliplab.analysis.labels.labelling import label_places
from sliplab.analysis.labels.markers import FrameMarkers, MarkerTracker, stack_tracks
from sliplab.analysis.labels.places import from_tracks
from sliplab.analysis.labels.plate_tracking import PlatePose, PlateTracker, bridge
from sliplab.analysis.sweeps.runner import sample_trials
from sliplab.plugins.simulation.scene_runs import MOTION, changed, with_true_times
from sliplab.plugins.simulation.settings import scene_of
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.labelling import Labelling
from sliplab.protocols.plan import load_plan
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.faults import MarkerOccluded
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.storage.streams import Chunk, FrameChunk, Json

ROOT = Path(__file__).parents[1]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
NUISANCES = {"count": 6, "level": 10.0}
GLARE = {"count": 6, "level": 40.0}
HIDDEN, JITTER_PX = 3, 1.0


@dataclass
class _Eye:
    """A sink that tracks frames as they come, or keeps the places that it is handed."""

    layout: F64
    plate: bool
    jitter: np.random.Generator | None = None
    t_ns: list[I64] = field(default_factory=list)
    markers: list[FrameMarkers] = field(default_factory=list)
    poses: list[PlatePose] = field(default_factory=list)
    places: list[F64] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._markers = MarkerTracker(self.layout)
        self._plate = PlateTracker() if self.plate else None

    def add(self, device: str, chunk: Chunk) -> None:
        """Look at frames in order; every other stream goes nowhere."""
        if not isinstance(chunk, FrameChunk):
            return
        self.t_ns.append(chunk.t_ns)
        if chunk.markers_px is not None:
            self.places.append(chunk.markers_px.astype(np.float64))
            return
        for image in chunk.images:
            if self.jitter is not None:
                dx, dy = self.jitter.uniform(-JITTER_PX, JITTER_PX, 2)
                move = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
                image = np.asarray(
                    cv2.warpAffine(image, move, image.shape[::-1], borderMode=cv2.BORDER_REPLICATE),
                    np.uint8,
                )
            self.markers.append(self._markers.update(image))
            if self._plate is not None:
                self.poses.append(self._plate.update(image))


def check(job: tuple[RigFile, Plan, PlannedTrial, dict[str, Any], bool]) -> Checked:
    """Simulate, track and label one trial, and hold it against the truth."""
    rig, plan, trial, camera, stressed = job
    draw = np.random.default_rng(hash_integer(trial.seed, "labels truth", SEED) % 2**63)
    kinematic = plan.protocol.collection.experiment == "kinematic"
    rig = changed(
        with_true_times(rig),
        {
            "frame_camera": {"reflections": camera},
            "event_camera": {"noise_hz": 0.0, "hot_pixels": 0},
        },
    )
    true, truth, start_ns = _run(changed(rig, {"frame_camera": _TRACKS}), plan, trial, None)
    if stressed:
        rig = changed(rig, {"faults": _hidden(truth, draw)})
    eye, _, _ = _run(rig, plan, trial, draw if stressed else None)
    frame_ns = np.concatenate(eye.t_ns) - start_ns
    markers = stack_tracks(eye.markers, len(eye.layout))
    plate = None if kinematic else bridge(eye.poses)
    size = rig.frame_px(plan)
    assert size is not None
    label = label_places(
        from_tracks(markers, plate, size),
        frame_ns,
        (0, int(frame_ns[-1])),
        Labelling(),
        centre=0,
        exposure_ns=2 * scene_of(rig).frame_camera.exposure_us * 500,
        source="video",
    )
    off = markers.xy - np.concatenate(true.places)
    speed = next(float(str(level)) for name, level in trial.condition if name == "speed")
    crossings, slips = (_since(truth, name) for name in ("per_papilla_ns", "slip_per_papilla_ns"))
    last = float(frame_ns[-1])
    crossings[crossings > last], slips[slips > last] = np.nan, np.nan
    found = _times(label.paper.per_marker_ns)
    return Checked(
        speed=speed,
        error_px=float(np.sqrt(np.nanmean(off**2))),
        swaps=int((np.hypot(*np.moveaxis(off, -1, 0)) > 10.0).any(axis=0).sum()),
        crossed_ms=(found - crossings) / 1e6,
        paper_ms=(found - slips) / 1e6,
        slip_ms=(_times(label.slips.at_ns) - slips) / 1e6,
        low_ms=(_times(label.slips.low_ns) - slips) / 1e6,
        high_ms=(_times(label.slips.high_ns) - slips) / 1e6,
        wrong=_verdicts(label, crossings, slips),
    )


_TRACKS = {"level": "tracks", "centroid_noise_px": 0.0, "plate_noise_px": 0.0}


def _run(
    rig: RigFile, plan: Plan, trial: PlannedTrial, jitter: np.random.Generator | None
) -> tuple[_Eye, Json, int]:
    """Frames as seen, the truth, and the start of the motion on the cameras' (true) clock."""
    layout = np.array(rig.skin.layout_mm()) * rig.frame_camera.scale_px_per_mm * [1.0, -1.0]
    built = build_rig(rig)
    built.connect()
    try:
        size = rig.frame_px(plan)
        for task in plan.changeovers(None, trial):
            built.operator.ask(task.request, task.prompt, task.expected)
        eye = _Eye(layout, plan.protocol.collection.plate is not None, jitter)
        rate_hz = plan.protocol.collection.recording.sync_rate
        done = built.run_trial(
            plan.program(trial), eye, hash_integer(trial.seed, SEED), size, rate_hz
        )
    finally:
        built.close()
    start_ns = next(step.start_ns for step, _ in done.steps if step.phase in MOTION)
    return eye, done.truth or {}, start_ns


def _hidden(truth: Json, draw: np.random.Generator) -> tuple[MarkerOccluded, ...]:
    """Up to three markers hidden for a while about the time at which each or the first slips."""
    slips = _since(truth, "per_papilla_ns")
    chosen = draw.choice(len(slips), int(draw.integers(1, HIDDEN + 1)), replace=False)
    hold_s = 2.0
    faults = []
    for papilla in chosen.tolist():
        own, first = slips[papilla], np.nanmin(slips)
        about = own if np.isfinite(own) and draw.uniform() < 0.5 else first
        at = max(hold_s + about / 1e9 + float(draw.uniform(-0.6, 0.2)), 0.1)
        faults.append(
            MarkerOccluded(
                kind="marker_occluded",
                papilla=papilla,
                at_s=at,
                seconds=float(draw.uniform(0.1, 0.8)),
            )
        )
    return tuple(faults)


def _since(truth: Json, name: str) -> F64:
    """Times after the start of the motion, ns; NaN for none."""
    return np.array(
        [np.nan if t is None else float(t - truth["reference_ns"]) for t in truth[name]]
    )


def _times(times: I64) -> F64:
    return np.where(times == -1, np.nan, times.astype(np.float64))


def _verdicts(label: Label, crossings: F64, slips: F64) -> dict[str, str]:
    result = {}
    for rule, onsets, doubts, true in (
        ("paper", label.paper, label.paper_doubts, crossings),
        ("change_point", label.slips.onsets, label.slip_doubts, slips),
    ):
        for kind, value, at, doubt in (
            ("incipient", onsets.incipient_ns, _first(true), doubts.incipient),
            ("gross", onsets.gross_ns, true[0], doubts.gross or doubts.incipient),
        ):
            result[f"{rule} {kind}"] = _verdict(value, at, doubt)
    return result


def _first(times: F64) -> float:
    return float(np.nanmin(times)) if np.isfinite(times).any() else np.nan


def _verdict(found: int | None, true: float, doubt: str | None) -> str:
    if doubt is not None:
        return "doubted"
    if found is None or not np.isfinite(true):
        return "right" if found is None and not np.isfinite(true) else "wrong"
    return "right" if abs(found - true) <= 2 * FRAME_MS * 1e6 else "wrong"


def run_checks(slides: int, falls: int, stressed: int) -> tuple[list[Checked], ...]:
    """All three sets, on all cores."""
    rig, _ = load_rig_file(ROOT / "rigs" / "mock.yaml")
    kinematic, gravity = (
        load_plan(ROOT / "protocols" / f"{name}.yaml") for name in ("kinematic", "gravity")
    )
    sets: list[list[tuple[RigFile, Plan, PlannedTrial, dict[str, Any], bool]]] = [
        [(rig, kinematic, trial, NUISANCES, False) for trial in sample_trials(kinematic, slides)],
        [(rig, gravity, trial, NUISANCES, False) for trial in sample_trials(gravity, falls)],
        [(rig, kinematic, trial, GLARE, True) for trial in sample_trials(kinematic, stressed)],
    ]
    sets[0], sets[1], sets[2] = sets[0][:slides], sets[1][:falls], sets[2][:stressed]
    jobs = [job for jobs in sets for job in jobs]
    workers = min(os.cpu_count() or 1, len(jobs))
    if workers <= 1 or len(jobs) < 4:
        found = [check(job) for job in jobs]
    else:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            found = list(pool.map(check, jobs))
    first, second = len(sets[0]), len(sets[0]) + len(sets[1])
    return found[:first], found[first:second], found[second:]


def measure(slides: int = 60, falls: int = 12, stressed: int = 24) -> Figures:
    """All figures, of slides without a prefix."""
    clean, fallen, hard = run_checks(slides, falls, stressed)
    figures = summary(clean)
    for prefix, trials in (("falls_", fallen), ("stressed_", hard)):
        if trials:
            figures |= {f"{prefix}{name}": value for name, value in summary(trials).items()}
            wrong = sum(counts["wrong"] for counts in verdicts(trials).values())
            figures[f"{prefix}wrong_not_doubted"] = float(wrong)
    return figures


if __name__ == "__main__":
    sizes = [int(text) for text in sys.argv[1:4]] or [60, 12, 24]
    print(tables(run_checks(*sizes)))
