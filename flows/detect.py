"""`sliplab detect`: a trained network on a rig's running event stream.

Without a protocol the arm stands and is only listened to. With one, a trial's motion is made (and
nothing of it is kept), and a reflex may cut it short. Whatever ends it, the arm is stopped first.

Latency is counted from a window's last event to its decision. Its first part, until the event was
read, runs on the rig's clock (virtual on the mock rig); its second part, until the decision, on
the real one.
"""

from __future__ import annotations

import json
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.analysis.detectors.live import (
    UNDECIDED,
    ClockFellBack,
    Counting,
    Decision,
    FreshestArrival,
    LiveDetector,
    TimedDecision,
    counting_of,
)
from sliplab.analysis.metrics.classification import CLASSES, INCIPIENT
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.training import Fitted
from sliplab.flows.running import stopping
from sliplab.flows.ui.detect_view import DetectView
from sliplab.protocols import InputError, Plan, Trial, load_plan
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.program import Move, Program
from sliplab.protocols.settings import AnalysisSettings, Detection
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import Clock, RigError
from sliplab.rigs.core.reacting import ACTING, Reaction, Reflex, SlipDetected, run_watched
from sliplab.rigs.core.rig import Rig, StopRequested
from sliplab.rigs.levels import with_level
from sliplab.rigs.rig_file import RigFile, check_plan, load_rig_file
from sliplab.rigs.rig_lock import held
from sliplab.storage.errors import translated_disk_errors
from sliplab.storage.files import sha256
from sliplab.storage.streams import EventChunk, NullSink, PulseChunk

POLL_S = 0.005
"""Period of reading the streams, s."""
SHOWN = 6
"""Conditions that a message names."""


@dataclass(frozen=True)
class DetectRequest:
    """A requested live detection, checked by `make_detect_request`.

    Attributes:
        plan, trial: the motion that is made; None where the rig is only listened to.
        seconds: how long to listen; None until somebody ends it.
    """

    rig: RigFile
    model: Path
    model_sha256: str
    fitted: Fitted
    detection: Detection
    plan: Plan | None = None
    trial: Trial | None = None
    reflex: Reflex | None = None
    seconds: float | None = None
    stride_ms: float | None = None
    poll_s: float = POLL_S

    @property
    def simulated(self) -> str:
        """``simulated `` before a number of a simulated rig."""
        return "simulated " if self.rig.simulated else ""


def make_detect_request(
    rig: Path,
    model: Path,
    *,
    protocol: Path | None = None,
    trial: str | None = None,
    enable: tuple[str, ...] = (),
    reflex: str | None = None,
    hold_s: float = 1.0,
    seconds: float | None = None,
    stride_ms: float | None = None,
    margin: float | None = None,
    smoothing: int | None = None,
    poll_s: float = POLL_S,
) -> DetectRequest:
    """Read and check everything that can be known before anything moves.

    Raises:
        InputError: rig, model, protocol, trial or reflex; the message says what would be right.
    """
    file, _ = load_rig_file(rig)
    fitted = load_model(model)
    change = {"margin": margin, "smoothing": smoothing}
    change = {name: value for name, value in change.items() if value is not None}
    if stride_ms is not None and not 0 < stride_ms <= fitted.windows.length_ms:
        right = f"must be over 0 and at most the window's {fitted.windows.length_ms} ms"
        raise InputError("--stride", "", f"{stride_ms:g} ms", right)
    common: dict[str, Any] = {
        "model": model, "model_sha256": sha256(model), "fitted": fitted,
        "stride_ms": stride_ms, "poll_s": poll_s,
    }  # fmt: skip
    if protocol is None:
        for name, given in (("--trial", trial), ("--reflex", reflex)):
            if given is not None:
                right = "needs --protocol: without one the arm is not moved, only listened to"
                raise InputError(name, "", given, right)
        if seconds is None and file.in_virtual_time:
            right = f"is needed on {file.name}: its time is virtual and would never end"
            raise InputError("--seconds", "", None, right)
        return DetectRequest(
            file,
            detection=_detection(AnalysisSettings(network=fitted.network), fitted, change),
            seconds=seconds,
            **common,
        )
    if seconds is not None:
        right = "belongs to listening; a trial lasts as long as its motion"
        raise InputError("--seconds", "", seconds, right)
    plan = load_plan(protocol, enable)
    check_plan(file, plan, str(rig))
    if plan.protocol.collection.plate is not None and not file.has_plate:
        raise InputError(rig, "devices.plate", None, f"is needed: {protocol} moves a sliding plate")
    chosen = choose_trial(plan, trial)
    return DetectRequest(
        with_level(file, plan) if file.simulated else file,
        detection=_detection(plan.protocol.analysis, fitted, change),
        plan=plan,
        trial=chosen,
        reflex=None if reflex is None else make_reflex(reflex, file, plan, chosen, hold_s),
        **common,
    )


def load_model(path: Path) -> Fitted:
    """Load a model file. Raises InputError if it is none."""
    try:
        return model_file.load(path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        text = str(error).removeprefix(f"{path}: ")
        raise InputError(path, "", None, text) from None


def choose_trial(plan: Plan, condition: str | None) -> Trial:
    """Find the first trial of a condition, which may omit the repetition and single levels.

    Args:
        condition: as in a trial's id: ``depth=2.4mm,direction=0deg``, in any order.

    Raises:
        InputError: no trial has it, or trials of several conditions do.
    """
    parts = {part.strip() for part in (condition or "").split(",") if part.strip()}
    measured = [trial for trial in plan if trial.role == "measured"]
    found = [trial for trial in measured if parts <= set(trial.id.split(","))]
    conditions = list(dict.fromkeys(trial.condition for trial in found))
    if len(conditions) == 1:
        return found[0]
    firsts = {trial.condition: trial.id.rpartition(",r=")[0] for trial in found or measured}
    names = [*firsts.values()][:SHOWN]
    more = f" and {len(firsts) - SHOWN} more" if len(firsts) > SHOWN else ""
    what = "fits several conditions" if found else "fits no trial"
    if condition is None:
        what = "is needed: which of the protocol's conditions"
    raise InputError("--trial", "", condition, f"{what}: {'; '.join(names)}{more}")


def make_reflex(text: str, file: RigFile, plan: Plan, trial: Trial, hold_s: float) -> Reflex:
    """Parse ``stop`` or ``press:MM``, and check it against the limits of protocol and rig.

    Raises:
        InputError: another word, no motion that it could cut short, or a depth over a limit.
    """
    program = plan.program(trial)
    if not any(isinstance(step, Move) and step.phase in ACTING for step in program.steps):
        raise InputError("--reflex", "", text, "the trial has no slide or retraction to cut short")
    limits = plan.protocol.collection.limits
    deepest = min(float(limits.depth), float(file.limits.depth))
    kind, _, value = text.partition(":")
    if text == "stop":
        return Reflex("stop", deepest, hold_s=hold_s)
    try:
        press_mm = float(value.removesuffix("mm")) if kind == "press" else float("nan")
    except ValueError:
        press_mm = float("nan")
    if not 0 < press_mm < float("inf"):
        raise InputError("--reflex", "", text, "must be 'stop' or 'press:MM', such as press:0.4")
    # a retraction gets shallower all the way, and what presses on is cut off at the limit
    depth = _shallowest_mm(program)
    if depth + press_mm > deepest + 1e-9:
        origin = "the protocol's" if deepest == float(limits.depth) else f"the rig {file.name}'s"
        raise InputError(
            "--reflex",
            "",
            text,
            f"would reach {depth + press_mm:g} mm; {origin} limits.depth is {deepest:g} mm, and "
            f"the trial's motion ends at {depth:g} mm: at most press:{deepest - depth:g}",
        )
    speeds = [s.speed_mm_s for s in program.steps if isinstance(s, Move) and s.phase == "press"]
    return Reflex("press", deepest, press_mm, speeds[0], hold_s)


def _shallowest_mm(program: Program) -> float:
    """Return the least depth at which a reflex may have to press on."""
    moves = (step for step in program.steps if isinstance(step, Move) and step.phase in ACTING)
    return min(step.to.depth_mm for step in moves)


def _detection(said: AnalysisSettings, fitted: Fitted, change: dict[str, Any]) -> Detection:
    network = fitted.network
    rule = said.rule_for(network.outputs_per_class, network.margin)
    return Detection.model_validate({**rule.model_dump(), **change})


RATE_HZ = 100
FOREVER_S = 1e9


def detect(
    request: DetectRequest,
    out: Path | None = None,
    *,
    counting: Counting | None = None,
    build: Callable[[RigFile], Rig] = build_rig,
) -> dict[str, Any]:
    """Run a detection to its end; return a summary, with ``interrupted`` if somebody ended it.

    Args:
        out: a file of JSON lines, one a decision, that is written while it runs.
        counting: the network, instead of the model's by the event-driven kernels in one thread.
        build: makes the rig.

    Raises:
        InputError: there is no folder for `out`.
        RigError: a device failed; the arm is stopped.
        StopRequested, KeyboardInterrupt: somebody stopped a motion.
    """
    training.limit_threads(1)
    counting = counting or counting_of(request.fitted)
    with ExitStack() as done:
        write = done.enter_context(_lines(out))
        done.enter_context(held(request.rig))
        done.enter_context(stopping.signals())
        rig = build(request.rig)
        done.callback(rig.close)
        rig.should_stop = stopping.requested
        rig.poll_s = min(rig.poll_s, request.poll_s)
        detector = _detector(request, rig, counting)
        fitted = request.fitted
        most = fitted.windows.steps * fitted.network.outputs_per_class
        view = done.enter_context(DetectView(_title(request), most))

        def on_decision(timed: TimedDecision) -> None:
            write(timed)
            view.on_decision(timed)

        sink = DetectSink(detector, rig.clock, on_decision, view.poll)
        rig.connect()
        reaction, interrupted = None, False
        try:
            if request.trial is None:
                interrupted = _listen(request, rig, sink)
            else:
                reaction = _move(request, rig, sink)
        except ClockFellBack as error:
            raise RigError("event camera", str(error)) from None
    return _summary(request, sink, reaction, interrupted)


def _detector(request: DetectRequest, rig: Rig, counting: Counting) -> LiveDetector:
    windows = request.fitted.windows
    detector = LiveDetector(
        counting,
        windows,
        request.detection,
        width=rig.events.width,
        height=rig.events.height,
        centre_px=request.rig.calibration.centre_px,
        stride_us=None if request.stride_ms is None else round(request.stride_ms * 1000),
    )
    detector.warm_up()
    return detector


def _listen(request: DetectRequest, rig: Rig, sink: DetectSink) -> bool:
    """Listen without moving; return True if somebody ended it."""
    try:
        rig.listen(FOREVER_S if request.seconds is None else request.seconds, sink, RATE_HZ)
    except (StopRequested, KeyboardInterrupt):
        return True
    return False


def _move(request: DetectRequest, rig: Rig, sink: DetectSink) -> Reaction | None:
    """Make one trial's motion, after what the protocol asks for before its first trial."""
    plan, trial = request.plan, request.trial
    assert plan is not None
    assert trial is not None
    for task in plan.changeovers(None, trial):
        mass = plan.mass_kg(trial)
        mounted = mass is None or rig.plate is None or abs(rig.plate.mass_kg() - mass) < 1e-3
        if task.mounts_plate and mounted:
            continue
        if not rig.operator.ask(task.request, task.prompt, task.expected):
            raise RigError("operator", f"'{task.prompt}' was not confirmed")
    collection = plan.protocol.collection
    rezero = collection.maintenance.rezero
    if rezero is not None:
        slot = plan.rezero_task(trial).slot
        seed = hash_integer(collection.seed, "rezero", slot)
        rig.touch_off(float(rezero.speed), float(rezero.search), seed)
    return run_watched(
        rig,
        plan.program(trial),
        sink,
        hash_integer(trial.seed, 0),  # a simulated trial is the one that `collect` takes first
        collection.recording.sync_rate,
        request.reflex,
    )


@contextmanager
def _lines(out: Path | None) -> Iterator[Callable[[TimedDecision], None]]:
    """Yield a function that writes a decision as one line, and flushes it."""
    if out is None:
        yield lambda timed: None
        return
    if not out.parent.is_dir():
        raise InputError("--out", "", out, "must be a file in a folder that is there")
    with translated_disk_errors(out.parent, RigError), out.open("w", encoding="utf-8") as file:

        def write(timed: TimedDecision) -> None:
            file.write(json.dumps(timed.as_json(), allow_nan=False) + "\n")
            file.flush()

        yield write


def _title(request: DetectRequest) -> str:
    what = "listening" if request.trial is None else f"trial {request.trial.id}"
    reflex = f", reflex {request.reflex.kind}" if request.reflex else ""
    mode = f"{request.simulated}{what}{reflex}"
    return f"detect on {request.rig.name} ({mode}), model {request.model.name}"


def _summary(
    request: DetectRequest, sink: DetectSink, reaction: Reaction | None, interrupted: bool
) -> dict[str, Any]:
    reflex = None
    if request.reflex is not None:
        reflex = {"kind": request.reflex.kind, "done": reaction is not None}
        if reaction is not None:
            reflex |= asdict(reaction)
    return {
        "simulated": request.rig.simulated,
        "rig": request.rig.name,
        "model": {"file": str(request.model), "sha256": request.model_sha256},
        "trial": None if request.trial is None else request.trial.id,
        "protocol": None if request.plan is None else request.plan.protocol.name,
        "virtual_time": request.rig.in_virtual_time,
        **sink.summary(),
        "reflex": reflex,
        "interrupted": interrupted,
    }


PATIENCE_US = 200_000
"""A window without an event after it is judged so long after its end, by the camera's clock as it
is known here: what was sent before must have arrived by then."""
KEPT = 100_000
"""Latencies that are kept for the summary: the last 55 minutes of 30 ms windows."""


class DetectSink(NullSink):
    """A `rigs.core.reacting.Watcher` that feeds a detector.

    Args:
        clock: the rig's, by which arrivals are dated.
        on_decision: called with each decision as soon as it is made.
        every_poll: called each time that the streams were read.
    """

    def __init__(
        self,
        detector: LiveDetector,
        clock: Clock,
        on_decision: Callable[[TimedDecision], None],
        every_poll: Callable[[], None] = lambda: None,
    ) -> None:
        self.detector, self.armed, self.phase = detector, False, ""
        self._clock, self._on_decision, self._every_poll = clock, on_decision, every_poll
        self._camera = FreshestArrival()
        self._latency: deque[float] = deque(maxlen=KEPT)
        self._compute: deque[float] = deque(maxlen=KEPT)
        self._states: Counter[str] = Counter()
        self.events = self.quiet = 0
        self.onsets: dict[str, dict[str, Any]] = {}

    def step(self, phase: str, acting: bool) -> None:
        """Note that a step of the motion begins."""
        self.phase = phase

    def add_events(self, chunk: EventChunk) -> None:
        """Feed events to the detector.

        Raises:
            SlipDetected: incipient slip was detected while `armed`; the whole read is reported.
            ClockFellBack: the camera's clock is another one.
        """
        here_ns, began_ns = self._clock.now_ns(), time.monotonic_ns()
        if len(chunk):
            self.events += len(chunk)
            self._camera.observe(int(chunk.t_us.max()), here_ns)
        self._report(self.detector.push(chunk), here_ns, began_ns)

    def add_event_pulses(self, chunk: PulseChunk) -> None:
        """Advance the detector to the camera's time, which pulses show without events.

        Raises:
            SlipDetected: as `add_events`.
        """
        here_ns, began_ns = self._clock.now_ns(), time.monotonic_ns()
        if len(chunk):
            self._camera.observe(int(chunk.t_ns.max()) // 1000, here_ns)
        now_us = self._camera.camera_us(here_ns)
        if now_us is not None:
            # the first time that is known begins the windows; from then on events may be late
            late_us = 0 if self.detector.now_us is None else PATIENCE_US
            self._report(self.detector.advance(now_us - late_us), here_ns, began_ns)
        self._every_poll()

    def _report(self, made: list[Decision], here_ns: int, began_ns: int) -> None:
        slip = False
        for decision in made:
            compute_ms = (decision.decided_ns - began_ns) / 1e6
            latency_ms = None
            if decision.last_event_us is not None:
                sent_ns = self._camera.host_ns(decision.last_event_us)
                assert sent_ns is not None
                latency_ms = (here_ns - sent_ns) / 1e6 + compute_ms
                self._latency.append(latency_ms)
            self.quiet += decision.events == 0
            self._compute.append(compute_ms)
            origin_us = self.detector.origin_us
            assert origin_us is not None
            timed = TimedDecision(
                decision, (decision.end_us - origin_us) / 1e6, self.phase, latency_ms, compute_ms
            )
            self._states[timed.state] += 1
            if decision.onset is not None:
                self.onsets[decision.onset] = timed.as_json()
            slip |= decision.valid_class == INCIPIENT
            self._on_decision(timed)
        if slip and self.armed:
            self.armed = False
            raise SlipDetected

    def summary(self) -> dict[str, Any]:
        """Return the numbers of events, windows, states and latencies, and the onsets."""
        return {
            "events": self.events,
            "windows": sum(self._states.values()),
            "quiet_windows": self.quiet,
            "states": {name: self._states[name] for name in (*CLASSES, UNDECIDED)},
            "onsets": {name: self.onsets.get(name) for name in CLASSES[1:]},
            "latency_ms": _spread(self._latency),
            "compute_ms": _spread(self._compute),
            "losses": vars(self.detector.losses),
        }


def _spread(values: deque[float]) -> dict[str, float | int | None]:
    """Return median, 95 %, 99 % and maximum of measured times, ms."""
    names = ("median", "p95", "p99", "max")
    if not values:
        return {**dict.fromkeys(names), "n": 0}
    found = np.percentile(np.array(values), [50, 95, 99, 100]).tolist()
    return {**dict(zip(names, found, strict=True)), "n": len(values)}
