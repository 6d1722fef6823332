"""A requested live detection: rig, model, motion and reflex, checked before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sliplab.analysis.detectors.alarms import Level
from sliplab.analysis.detectors.detectors import Tuned
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.training import Fitted
from sliplab.flows.detecting.detector_process import PATIENT_S, OwnProcess
from sliplab.flows.detecting.sink import Timeouts
from sliplab.flows.detecting.sources import NamedSource, NetworkSource, Source
from sliplab.protocols import InputError, Plan, PlannedTrial, load_plan
from sliplab.protocols.detection import Detection
from sliplab.protocols.program import ACTING, Move, Program
from sliplab.protocols.settings import AnalysisSettings
from sliplab.rigs.core.reacting import Reflex
from sliplab.rigs.physics_levels import with_level
from sliplab.rigs.rig_file import ReflexSettings, RigFile, check_plan, load_rig_file
from sliplab.storage.files import sha256

UNSAFE_NS = 500_000_000
"""Shortest silence of the stream that ends a trial with a reflex and without a safe state, ns."""
POLL_S = 0.005
"""Period of reading the streams, s."""
SHOWN = 6
"""Conditions that a message names."""


@dataclass(frozen=True)
class DetectRequest:
    """A requested live detection, checked by `make_detect_request`.

    Attributes:
        source: what detects.
        rig: that reads its streams as often as requested.
        safe: reaction when slip can no longer be detected, where a reflex is requested.
        plan, trial: the motion that is made; None where the rig is only listened to.
        seconds: how long to listen; None until the user ends it.
        promise: false alarms an hour, at most, that are watched; None without a promise.
        set_by: the promise of a level, and what was measured for it.
    """

    rig: RigFile
    source: Source
    plan: Plan | None = None
    trial: PlannedTrial | None = None
    reflex: Reflex | None = None
    safe: Reflex | None = None
    seconds: float | None = None
    promise: float | None = None
    set_by: Level | None = None

    @property
    def own_process(self) -> OwnProcess | None:
        """The detector's own process; None: it runs in this one."""
        limit_ns = None if self.timeouts is None else self.timeouts.decision_ns
        if limit_ns is None:
            return None
        answer_s = PATIENT_S if self.rig.in_virtual_time else limit_ns / 1e9
        return OwnProcess(answer_s, self.real_time)

    @property
    def real_time(self) -> bool:
        """Whether a real reflex waits for what is computed."""
        return self.reflex is not None and not self.rig.in_virtual_time

    @property
    def timeouts(self) -> Timeouts | None:
        """Timeouts after which slip counts as undetectable; None without a reflex that needs them.

        Without a safe state decisions may be late, as they may be computed in this process.
        """
        if self.reflex is None:
            return None
        settings = self.rig.reflex or ReflexSettings()
        stream_ns = round(settings.stream_timeout * 10**9)
        if self.safe is None:
            return Timeouts(max(stream_ns, UNSAFE_NS), None)
        return Timeouts(stream_ns, round(settings.decision_timeout * 10**9))

    @property
    def simulated(self) -> str:
        """``simulated `` before a number of a simulated rig."""
        return "simulated " if self.rig.simulated else ""


def make_detect_request(
    rig: Path,
    model: Path | None,
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
    detector: Tuned | NamedSource | None = None,
    promise: float | None = None,
    set_by: Level | None = None,
) -> DetectRequest:
    """Read and check everything that can be known before anything moves.

    Args:
        model: a network; None where `detector` is another one.
        detector: instead of the network with the protocol's rule, or instead of the rule.
        promise, set_by: as `DetectRequest`. By default a calibrated detector's own promise, on its
            own rig.

    Raises:
        InputError: rig, model, protocol, trial or reflex; the message says what would be right.
    """
    file, _ = load_rig_file(rig)
    given = (("margin", margin), ("smoothing", smoothing))
    change = {name: value for name, value in given if value is not None}
    source: Callable[[AnalysisSettings | None], Source]
    if isinstance(detector, NamedSource):
        detector.check_rig(file)
        source = partial(_named, detector)
        set_by = detector.promised_on(file, promise) or set_by
        promise = promise if set_by is None else set_by.asked
    else:
        assert model is not None
        source = _network(model, stride_ms, detector, change)
    if protocol is None:
        for name, text in (("--trial", trial), ("--reflex", reflex)):
            if text is not None:
                right = "needs --protocol: without it the arm does not move"
                raise InputError(name, "", text, right)
        if seconds is None and file.in_virtual_time:
            right = f"is needed on {file.name}: its time is virtual and has no end"
            raise InputError("--seconds", "", None, right)
        return DetectRequest(
            rig=file.read_at_least(poll_s),
            source=source(None),
            seconds=seconds,
            promise=promise,
            set_by=set_by,
        )
    if seconds is not None:
        right = "applies only without --protocol; a trial lasts as long as its motion"
        raise InputError("--seconds", "", seconds, right)
    plan = load_plan(protocol, enable)
    check_plan(file, plan, str(rig))
    if plan.protocol.collection.plate is not None and not file.has_plate:
        raise InputError(rig, "devices.plate", None, f"is needed: {protocol} moves a sliding plate")
    chosen = choose_trial(plan, trial)
    return DetectRequest(
        rig=with_level(file, plan).read_at_least(poll_s),
        source=source(plan.protocol.analysis),
        plan=plan,
        trial=chosen,
        reflex=None if reflex is None else make_reflex(reflex, file, plan, chosen, hold_s),
        safe=None if reflex is None else make_safe_state(file, plan),
        promise=promise,
        set_by=set_by,
    )


def _named(source: NamedSource, stated: AnalysisSettings | None) -> Source:
    """Return a detector by its name; a protocol's settings do not change it."""
    return source


def _network(
    model: Path, stride_ms: float | None, tuned: Tuned | None, change: Mapping[str, float]
) -> Callable[[AnalysisSettings | None], Source]:
    """Return a function of a protocol's settings, if any, that makes the source of a network.

    Raises:
        InputError: the model or the stride.
    """
    fitted = load_model(model)
    fitted.check_slip(model, "detection")
    if stride_ms is not None and not 0 < stride_ms <= fitted.windows.length_ms:
        right = f"must be over 0 and at most the window's {fitted.windows.length_ms} ms"
        raise InputError("--stride", "", f"{stride_ms:g} ms", right)
    network = partial(NetworkSource, model, sha256(model), fitted, stride_ms=stride_ms)
    own = AnalysisSettings(network=fitted.network)
    return lambda stated: network(detection=tuned or _detection(stated or own, fitted, change))


def load_model(path: Path) -> Fitted:
    """Load a model file. Raises InputError if it is not one."""
    try:
        return model_file.load(path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        text = str(error).removeprefix(f"{path}: ")
        raise InputError(path, "", None, text) from None


def choose_trial(plan: Plan, condition: str | None) -> PlannedTrial:
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
        what = "is required: choose one of the protocol's conditions"
    raise InputError("--trial", "", condition, f"{what}: {'; '.join(names)}{more}")


def make_reflex(text: str, file: RigFile, plan: Plan, trial: PlannedTrial, hold_s: float) -> Reflex:
    """Parse ``stop``, ``press:MM`` or ``grip:MM``, and check it against protocol and rig.

    Raises:
        InputError: another word, no motion that it could cut short, no gripper, or a depth over a
            limit.
    """
    program = plan.program(trial)
    if not any(isinstance(step, Move) and step.phase in ACTING for step in program.steps):
        raise InputError("--reflex", "", text, "the trial has no motion in contact to cut short")
    deepest = deepest_mm(file, plan)
    kind, _, value = text.partition(":")
    if text == "stop":
        return Reflex("stop", deepest, hold_s=hold_s)
    try:
        deeper_mm = float(value.removesuffix("mm")) if kind in ("press", "grip") else float("nan")
    except ValueError:
        deeper_mm = float("nan")
    if not 0 < deeper_mm < float("inf"):
        right = "must be 'stop', 'press:MM' or 'grip:MM', such as press:0.4"
        raise InputError("--reflex", "", text, right)
    # a retraction gets shallower throughout, and motion beyond the limit is cut off
    depth = _shallowest_mm(program)
    if depth + deeper_mm > deepest + 1e-9:
        limits = plan.protocol.collection.limits
        origin = "the protocol's" if deepest == float(limits.depth) else f"the rig {file.name}'s"
        raise InputError(
            "--reflex",
            "",
            text,
            f"would reach {depth + deeper_mm:g} mm; {origin} limits.depth is {deepest:g} mm, and "
            f"the trial's motion ends at {depth:g} mm: at most {kind}:{deepest - depth:g}",
        )
    if kind == "grip":
        return _grip(text, file, deeper_mm, deepest, hold_s)
    speeds = [s.speed_mm_s for s in program.steps if isinstance(s, Move) and s.phase == "press"]
    return Reflex("press", deepest, deeper_mm, speeds[0], hold_s=hold_s)


def make_safe_state(file: RigFile, plan: Plan) -> Reflex | None:
    """Return the reaction when slip can no longer be detected, if the rig file names one."""
    wanted = file.reflex
    if wanted is None:
        return None
    deepest = deepest_mm(file, plan)
    if wanted.safe_state == "stop":
        return Reflex("stop", deepest)
    assert wanted.grip is not None  # the rig file was checked
    return _grip("", file, float(wanted.grip), deepest, 0.0)


def deepest_mm(file: RigFile, plan: Plan) -> float:
    """Return the largest depth that protocol and rig allow."""
    return min(float(plan.protocol.collection.limits.depth), float(file.limits.depth))


def _grip(text: str, file: RigFile, deeper_mm: float, deepest: float, hold_s: float) -> Reflex:
    """Return a tightening of the gripper at its largest speed.

    Raises:
        InputError: there is no gripper, or it cannot move by so little.
    """
    allowed = file.gripper_range
    if allowed is None:
        right = f"needs a gripper, and the rig {file.name} has none: use stop or press:MM"
        raise InputError("--reflex", "", text, right)
    if deeper_mm < allowed.step_mm:
        right = f"is less than the gripper's step: at least grip:{allowed.step_mm:.2g}"
        raise InputError("--reflex", "", text, right)
    stated = None if file.reflex is None else file.reflex.force
    force_n = allowed.force_n[0] if stated is None else float(stated)
    most = file.limits.force
    if most is not None and force_n > most:
        right = (
            f"closes with {force_n:g} N, and the rig {file.name}'s limits.force is {most:g} N: set "
            "reflex.force to less, or use stop or press:MM"
        )
        raise InputError("--reflex", "", text, right)
    return Reflex("grip", deepest, deeper_mm, allowed.speed_mm_s[1], force_n, hold_s)


def _shallowest_mm(program: Program) -> float:
    """Return the least depth at which a reflex may have to press on."""
    moves = (step for step in program.steps if isinstance(step, Move) and step.phase in ACTING)
    return min(step.to.depth_mm for step in moves)


def _detection(stated: AnalysisSettings, fitted: Fitted, change: Mapping[str, float]) -> Detection:
    network = fitted.network
    rule = stated.rule_for(network.outputs_per_class, network.margin)
    return Detection.model_validate({**rule.model_dump(), **change})
