"""`sliplab detect`: a detector on a rig's running event stream.

Without a protocol the arm does not move. With one, a trial's motion is executed (nothing is
stored), and a reflex may interrupt it. However it ends, the arm is stopped first.

`flows.detecting` has the request and the sink that feeds the detector.
"""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NotRequired, TypeAlias, TypedDict

from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.detector import StreamDetector
from sliplab.analysis.detectors.live import LiveDetector, TimedDecision
from sliplab.analysis.detectors.promise_watch import PromiseWatch
from sliplab.analysis.networks import training
from sliplab.flows.collecting.preparation import change_over, find_zero
from sliplab.flows.detecting.request import DetectRequest
from sliplab.flows.detecting.sink import FAILURES, DetectNumbers, DetectSink, failed_device
from sliplab.flows.detecting.sources import NamedSource, NetworkSource
from sliplab.flows.running import console, stopping
from sliplab.flows.ui.detect_view import DetectView
from sliplab.protocols import InputError
from sliplab.protocols.hashing import hash_integer
from sliplab.rigs.build import ShouldStop, build_rig
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.reacting import DetectionTimes, Reaction, run_watched
from sliplab.rigs.core.real_time import real_time
from sliplab.rigs.core.rig import Rig, StopRequested
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.rig_lock import held
from sliplab.storage.errors import translated_disk_errors
from sliplab.storage.trials.catalogue import refuse_store_file

BuildRig: TypeAlias = Callable[[RigFile, ShouldStop], Rig]
RATE_HZ = 100
LINES = ".jsonl"
"""Suffix of the files of decisions; any other existing file may be a model or a protocol."""
FOREVER_S = 1e9
TURN_S = 0.0005
"""Longest turn of a thread while another one waits, s."""


class ReactionMs(TypedDict):
    """Parts of the time from slip to the end of the reflex, ms, and their sum.

    Attributes:
        window: span of the events that the decision rests on; slip may begin anywhere in it.
        sensor: from its end until the events were read.
        network: from there to the decision, in real time.
        command: until the drivers of arm and gripper had the command.
        actuator: until arm and fingers were at rest, with the drivers' way to them.
    """

    window: float
    sensor: float
    network: float
    command: float
    actuator: float
    total: float


class ReflexJson(TypedDict):
    """A reflex in a detection's summary, with the fields of `Reaction` where it was done.

    Attributes:
        trial_s: end of the window that triggered it, since the stream began.
    """

    kind: str
    done: bool
    phase: NotRequired[str]
    trial_s: NotRequired[float]
    stop_ms: NotRequired[float]
    stopped_mm: NotRequired[tuple[float, float, float]]
    depth_mm: NotRequired[float]
    closed_mm: NotRequired[float]
    stalled: NotRequired[bool]
    reaction_ms: NotRequired[ReactionMs]


class ModelPath(TypedDict):
    """Path and SHA-256 of a model file."""

    file: str
    sha256: str


class DetectSummary(DetectNumbers):
    """Summary of a detection.

    Attributes:
        model: the network; None where another detector ran.
        detector: the other detector's name.
        trial, protocol: of the motion; None where the arm did not move.
        virtual_time: the rig's clock is not the real one.
        interrupted: the user ended it.
    """

    simulated: bool
    rig: str
    model: ModelPath | None
    detector: str | None
    trial: str | None
    protocol: str | None
    virtual_time: bool
    reflex: ReflexJson | None
    interrupted: bool


def detect(
    request: DetectRequest,
    out: Path | None = None,
    *,
    detector: StreamDetector | None = None,
    build: BuildRig = build_rig,
    on_step: Callable[[Rig, str], None] = lambda rig, phase: None,
    show: bool = True,
) -> DetectSummary:
    """Run a detection to its end; return a summary, with ``interrupted`` if the user ended it.

    Args:
        out: a file of JSON lines, one a decision, that is written while it runs.
        detector: that runs, in this process; by default the request's, in a separate process where
            the request has a safe state.
        build: makes the rig.
        on_step: called with the phase when a step of the trial begins.
        show: show decisions on the terminal.

    Raises:
        InputError: there is no folder for `out`, or it is a file of a store or of another kind.
            Or a calibration is of another event camera.
        RigError: a device failed; the arm is stopped.
        SafeState: slip could no longer be detected; the arm stays in contact.
        StopRequested, KeyboardInterrupt: the user stopped a motion.
    """
    training.limit_threads(1)
    with ExitStack() as done:
        done.enter_context(_failures())
        done.enter_context(_short_turns())
        if detector is None:
            centre_px = request.rig.calibration.centre_px
            detector = done.enter_context(request.source.running(request.own_process, centre_px))
        write = done.enter_context(_lines(out))
        done.enter_context(held(request.rig))
        done.enter_context(stopping.signals())
        rig = build(request.rig, stopping.requested)
        done.callback(rig.close)
        size = rig.events.width, rig.events.height
        detector.warm_up(*size)
        live = LiveDetector(detector, width=size[0], height=size[1])
        view = DetectView(_title(request), request.source.most) if show else None
        if view is not None:
            done.enter_context(view)

        def on_decision(timed: TimedDecision) -> None:
            write(timed)
            if view is not None:
                view.on_decision(timed)

        poll = (lambda: None) if view is None else view.poll
        watch = None
        if request.promise is not None:
            watch = PromiseWatch(request.promise, detector.level)
        say = functools.partial(_warn, view)
        own = detector.set_by if isinstance(detector, AtLevel) else None
        level = request.set_by if own is None else own
        if level is not None and not level.promised:
            say(level.words)
        stepped = functools.partial(on_step, rig)
        sink = DetectSink(live, rig.clock, on_decision, poll, request.timeouts, watch, say, stepped)
        rig.connect()
        if isinstance(request.source, NamedSource):
            request.source.check_rig(request.rig, rig.event_serial)
            for doubt in request.source.doubts(request.rig):
                say(doubt)
        if request.real_time and (refused := done.enter_context(real_time())):
            say(f"the system does not allow {refused}: other programs may delay the reflex")
        reaction, interrupted = None, False
        if request.trial is None:
            interrupted = _listen(request, rig, sink)
        else:
            reaction = _move(request, rig, sink)
    return _summary(request, sink, reaction, interrupted)


def _warn(view: DetectView | None, text: str) -> None:
    """Show a warning, if anything is shown."""
    if view is not None:
        console.say(f"warning: {text}")


def _listen(request: DetectRequest, rig: Rig, sink: DetectSink) -> bool:
    """Listen without moving; return True if the user ended it."""
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
    change_over(rig, plan, None, trial)
    find_zero(rig, plan, trial)
    return run_watched(
        rig,
        plan.program(trial),
        sink,
        hash_integer(trial.seed, 0),  # a simulated trial is the one that `collect` takes first
        plan.protocol.collection.recording.sync_rate,
        request.reflex,
        request.safe,
    )


@contextmanager
def _short_turns() -> Iterator[None]:
    """Let threads take short turns: those of drivers would hold a decision up for 5 ms."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(TURN_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def _failures() -> Iterator[None]:
    """Raise RigError where the detector fails."""
    try:
        yield
    except tuple(FAILURES) as error:
        raise RigError(failed_device(error), str(error)) from None


@contextmanager
def _lines(out: Path | None) -> Iterator[Callable[[TimedDecision], None]]:
    """Yield a function that writes a decision as one line, and flushes it."""
    if out is None:
        yield lambda timed: None
        return
    if not out.parent.is_dir():
        raise InputError("--out", "", out, "must be a file in an existing folder")
    refuse_store_file(out, "--out")
    if out.is_file() and out.suffix.lower() != LINES:
        raise InputError("--out", "", out, f"exists, and only a {LINES} file is replaced")
    with translated_disk_errors(out.parent, RigError), out.open("w", encoding="utf-8") as file:

        def write(timed: TimedDecision) -> None:
            file.write(json.dumps(timed.as_json(), allow_nan=False) + "\n")
            file.flush()

        yield write


def _title(request: DetectRequest) -> str:
    what = "listening" if request.trial is None else f"trial {request.trial.id}"
    reflex = f", reflex {request.reflex.kind}" if request.reflex else ""
    mode = f"{request.simulated}{what}{reflex}"
    return f"detect on {request.rig.name} ({mode}), {request.source.title}"


def _reaction_ms(reaction: Reaction, seen: DetectionTimes) -> ReactionMs:
    command, actuator = reaction.command_ms, reaction.actuator_ms
    return {
        "window": seen.window_ms,
        "sensor": seen.sensor_ms,
        "network": seen.network_ms,
        "command": command,
        "actuator": actuator,
        "total": seen.window_ms + seen.sensor_ms + seen.network_ms + command + actuator,
    }


def _summary(
    request: DetectRequest, sink: DetectSink, reaction: Reaction | None, interrupted: bool
) -> DetectSummary:
    reflex: ReflexJson | None = None
    if request.reflex is not None:
        reflex = {"kind": request.reflex.kind, "done": reaction is not None}
        if reaction is not None:
            seen = reaction.evidence
            assert seen is not None  # a `DetectSink` triggered it
            reflex = {
                **reflex,
                "phase": reaction.phase,
                "trial_s": seen.trial_s,
                "stop_ms": reaction.stop_ms,
                "stopped_mm": reaction.stopped_mm,
                "depth_mm": reaction.depth_mm,
                "closed_mm": reaction.closed_mm,
                "stalled": reaction.stalled,
                "reaction_ms": _reaction_ms(reaction, seen),
            }
    source, model = request.source, None
    if isinstance(source, NetworkSource):
        model = ModelPath(file=str(source.model), sha256=source.sha256)
    return {
        "simulated": request.rig.simulated,
        "rig": request.rig.name,
        "model": model,
        "detector": None if isinstance(source, NetworkSource) else source.name,
        "trial": None if request.trial is None else request.trial.id,
        "protocol": None if request.plan is None else request.plan.protocol.name,
        "virtual_time": request.rig.in_virtual_time,
        **sink.summary(),
        "reflex": reflex,
        "interrupted": interrupted,
    }
