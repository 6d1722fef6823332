"""`sliplab reflex`: how many drops a reflex prevents on a simulated rig, and how fast it is.

The plate of gravity trials hangs on the sensor, which retracts. Every trial is run without a
reflex, and with each detector and reflex. Results are stored in `OUT/reflex.json`, each as soon as
its trial is over, so a stopped study resumes. Nothing is recorded, and the rig does not go to its
safe state.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.detector import Detector, Evidence, StreamDetector
from sliplab.analysis.detectors.registry import contents
from sliplab.analysis.sweeps.runner import ResultFile, Sweep
from sliplab.flows.detect import BuildRig, detect
from sliplab.flows.detecting.request import DetectRequest, make_detect_request, make_reflex
from sliplab.flows.detecting.sources import NamedSource, Source
from sliplab.flows.running import console
from sliplab.flows.store_detectors import detectors_of
from sliplab.plugins.reflex.document import ReactionParts, ReflexStudy, ReflexTrial
from sliplab.plugins.reflex.rows import dropped, extra_force_n, reflex_rows
from sliplab.protocols import InputError, Plan, PlannedTrial, load_plan
from sliplab.protocols.detection import Detection
from sliplab.protocols.hashing import hash_data, hash_text
from sliplab.protocols.program import ACTING, Move
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import PlateCourse, Truth
from sliplab.rigs.core.driver import RigDriver
from sliplab.rigs.core.registry import find_driver
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile, load_rig_file, rig_hash
from sliplab.storage.streams import EventChunk, Json

NAME = "reflex"
VERSION = 1
"""Version of the measurement; stored results of another version are measured again."""
HOLD_S = 1.0
"""Time for which the arm stays after a reflex; a plate that slides at its end has dropped."""
STEP_MS = 20
"""Step of the stored heights."""


class _Never(Detector):
    """Says nothing, for trials without a reflex."""

    def begin(self, width: int, height: int) -> None:
        """See `Detector`."""

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`."""
        return Evidence.of([], [])


@dataclass(frozen=True)
class ReflexCase:
    """One trial with a detector and a reflex, or without; a point of the sweep."""

    trial: PlannedTrial
    detector: str | None
    reflex: str | None
    key: str

    @property
    def name(self) -> str:
        """Trial, detector and reflex."""
        return f"{self.trial.id} {self.detector or 'none'} {self.reflex or 'none'}"

    @property
    def title(self) -> str:
        """The name."""
        return self.name


@dataclass(frozen=True)
class Request:
    """Request of a study, checked.

    Attributes:
        requests: one of each detector, without a reflex.
    """

    rig: RigFile
    plan: Plan
    requests: Mapping[str, DetectRequest]
    cases: Sequence[ReflexCase]
    out: Path


def request(
    place: Path,
    rig: Path,
    out: Path,
    protocol: Path = Path(NAME),
    reflexes: Sequence[str] = (),
    count: int = 1,
    detectors: Sequence[str] = (),
) -> Request:
    """Check a request.

    Args:
        reflexes: left out, all that the rig can do. detectors: left out, all of a store.
        count: trials of each condition.

    Raises:
        InputError: model, rig, protocol, detector or reflex; the message says what would be right.
        StoreError: a network of the store is missing or stale.
    """
    file, text = load_rig_file(rig)
    if not file.simulated:
        right = "must be a simulated rig: drops and forces are those of its scene"
        raise InputError("--rig", "", file.name, right)
    plan = load_plan(protocol)
    if plan.protocol.collection.plate is None:
        raise InputError("--protocol", "", protocol, "must be of gravity trials: no plate falls")
    trials = [it for it in plan if it.role == "measured" and it.repetition <= count]
    requests = {
        name: make_detect_request(
            rig,
            it.model,
            protocol=protocol,
            trial=trials[0].id,
            detector=it.detector,
            stride_ms=it.stride_ms,
        )
        for name, it in detectors_of(place, detectors).items()
    }
    if not reflexes:
        can_grip = () if file.gripper_range is None else ("grip:0.4",)
        reflexes = ("stop", "press:0.4", *can_grip)
    made = hash_data([VERSION, rig_hash(text), plan.protocol.model_dump(mode="json")])
    cases = []
    for trial in trials:
        cases.append(ReflexCase(trial, None, None, hash_data([made, trial.id])))
        for name, asked in requests.items():
            digest, rule = _identity(asked.source)
            for reflex in reflexes:
                make_reflex(reflex, file, plan, trial, HOLD_S)  # raises before anything moves
                key = hash_data([made, trial.id, digest, rule, reflex])
                cases.append(ReflexCase(trial, name, reflex, key))
    return Request(next(iter(requests.values())).rig, plan, requests, cases, out)


def _identity(source: Source) -> tuple[str, Json]:
    """Return the hash of what detects, and the numbers that it decides by."""
    if isinstance(source, NamedSource):
        store = None if source.store is None else str(source.store.resolve())
        return hash_data([source.name, contents(source.name)]), {"level": source.level, "of": store}
    detection = source.detection
    if isinstance(detection, Detection):
        return source.sha256, detection.model_dump(mode="json")
    text = json.dumps(asdict(detection), default=lambda array: array.tolist())
    return source.sha256, {"name": detection.name, "numbers": hash_text(text)}


def measure_reflexes(asked: Request) -> ReflexStudy:
    """Run what is not stored yet; return all results.

    Raises:
        RigError: a device failed; finished results are stored.
        KeyboardInterrupt: the user stopped it; the arm is stopped, finished results are stored.
    """
    head: Json = {
        "simulated": True,
        "rig": asked.rig.name,
        "protocol": asked.plan.name,
        "virtual_time": asked.rig.in_virtual_time,
        "detectors": {name: _identity(it.source)[0] for name, it in asked.requests.items()},
    }
    saved = ResultFile(asked.out / f"{NAME}.json", ReflexStudy, "trials", head)
    with ExitStack() as done:
        build = done.enter_context(_builder(asked.rig))
        detectors = {
            name: done.enter_context(it.source.running(None, it.rig.calibration.centre_px))
            for name, it in asked.requests.items()
        }
        sweep = Sweep(
            asked.cases, saved, lambda case, _: (measure(asked, case, detectors, build), None)
        )
        simulated = "simulated trials" if asked.rig.in_virtual_time else "trials in real time"
        bar = done.enter_context(console.bar(f"reflexes ({simulated})", len(sweep.pending)))
        sweep.run(bar.advance)
    known = saved.load().trials
    trials = {case.name: known[case.name] for case in asked.cases}
    rows = reflex_rows(trials.values())
    return ReflexStudy.model_validate({**head, "rows": rows, "trials": trials})


def _builder(file: RigFile) -> AbstractContextManager[BuildRig]:
    """Return what builds the rig of a trial; a loopback rig's fakes run for all."""
    builder = find_driver(file.driver, RigDriver).builder
    return nullcontext(build_rig) if builder is None else builder(file)


@dataclass
class Seen:
    """The simulation's own record of a trial's motion, until the sensor leaves the plate."""

    began_ns: int | None = None
    truth: Truth | None = None
    course: PlateCourse | None = None

    def look(self, rig: Rig, phase: str) -> None:
        """Look at the simulation as a step begins."""
        assert rig.simulation is not None
        if phase in ACTING and self.began_ns is None:
            rig.simulation.watch_plate()
            self.began_ns = rig.arm.now_ns()
        elif phase == "release" and self.began_ns is not None:
            self.truth = rig.simulation.truth(self.began_ns)
            self.course = rig.simulation.plate_course(self.began_ns)


def measure(
    asked: Request,
    case: ReflexCase,
    detectors: Mapping[str, StreamDetector],
    build: BuildRig = build_rig,
) -> ReflexTrial:
    """Run one trial.

    Args:
        detectors: by their names.
    """
    plan, trial = asked.plan, case.trial
    wanted = next(iter(asked.requests.values()))
    detector: StreamDetector = AtLevel(_Never(), 0.0)
    if case.detector is not None and case.reflex is not None:
        made = make_reflex(case.reflex, asked.rig, plan, trial, HOLD_S)
        wanted = replace(asked.requests[case.detector], reflex=made)
        detector = detectors[case.detector]
    seen = Seen()
    order = replace(wanted, trial=trial)
    summary = detect(order, detector=detector, build=build, on_step=seen.look, show=False)
    truth, course = seen.truth, seen.course
    assert truth is not None
    assert course is not None
    reference_ms = truth["reference_ns"] / 1e6
    slip, gross = (
        None if ns is None else ns / 1e6 - reference_ms
        for ns in (truth["first_slip_ns"], truth["gross_ns"])
    )
    parts = detected_ms = extra_n = None
    reflex = summary["reflex"]
    if reflex is not None and reflex["done"]:
        detected_ms = reflex["trial_s"] * 1e3 - reference_ms
        extra_n = extra_force_n(course["t_ms"], course["normal_n"], detected_ms)
        took = reflex["reaction_ms"]
        parts = ReactionParts(
            window=detected_ms - (0.0 if slip is None else slip),
            sensor=took["sensor"],
            network=took["network"],
            command=took["command"],
            actuator=took["actuator"],
        )
    heights = course["height_mm"]
    return ReflexTrial(
        trial=trial.id,
        mass_kg=plan.mass_kg(trial) or 0.0,
        speed_mm_s=_speed_mm_s(plan, trial),
        detector=case.detector,
        reflex=case.reflex,
        slip_ms=slip,
        detected_ms=detected_ms,
        gross_ms=gross,
        dropped=dropped(course["t_ms"], heights, course["stroke_mm"]),
        fallen_mm=heights[0] - heights[-1],
        extra_n=extra_n,
        parts=parts,
        heights_mm=tuple(round(mm, 4) for mm in heights[::STEP_MS]),
        step_ms=STEP_MS,
    )


def _speed_mm_s(plan: Plan, trial: PlannedTrial) -> float:
    """Speed of the trial's motion in contact."""
    moves = [it for it in plan.program(trial).steps if isinstance(it, Move) and it.phase in ACTING]
    return moves[0].speed_mm_s
