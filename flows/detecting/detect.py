"""`sliplab detect`: a trained network on a rig's running event stream.

Without a protocol the arm stands and is only listened to. With one, a trial's motion is made (and
nothing of it is kept), and a reflex may cut it short. Whatever ends it, the arm is stopped first.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sliplab.analysis.detectors.live import ClockFellBack, Counting, LiveDetector, counting_of
from sliplab.analysis.networks import training
from sliplab.flows.detecting.detect_order import DetectOrder
from sliplab.flows.detecting.detect_sink import DetectSink, Timed
from sliplab.flows.detecting.detect_view import DetectView
from sliplab.flows.running import stopping
from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_integer
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.reacting import Reaction, run_watched
from sliplab.rigs.core.rig import Rig, StopRequested
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.rig_lock import held
from sliplab.storage.errors import translated_disk_errors

RATE_HZ = 100
FOREVER_S = 1e9


def detect(
    order: DetectOrder,
    out: Path | None = None,
    *,
    counting: Counting | None = None,
    build: Callable[[RigFile], Rig] = build_rig,
) -> dict[str, Any]:
    """Run it to its end; returns what was seen, with ``interrupted`` where somebody ended it.

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
    counting = counting or counting_of(order.fitted)
    with ExitStack() as done:
        write = done.enter_context(_lines(out))
        done.enter_context(held(order.rig))
        done.enter_context(stopping.signals())
        rig = build(order.rig)
        done.callback(rig.close)
        rig.should_stop = stopping.requested
        rig.poll_s = min(rig.poll_s, order.poll_s)
        detector = _detector(order, rig, counting)
        fitted = order.fitted
        most = fitted.windows.steps * fitted.network.outputs_per_class
        view = done.enter_context(DetectView(_title(order), most))

        def on_decision(timed: Timed) -> None:
            write(timed)
            view.on_decision(timed)

        sink = DetectSink(detector, rig.clock, on_decision, view.poll)
        rig.connect()
        reaction, interrupted = None, False
        try:
            if order.trial is None:
                interrupted = _listen(order, rig, sink)
            else:
                reaction = _move(order, rig, sink)
        except ClockFellBack as error:
            raise RigError("event camera", str(error)) from None
    return _summary(order, sink, reaction, interrupted)


def _detector(order: DetectOrder, rig: Rig, counting: Counting) -> LiveDetector:
    windows = order.fitted.windows
    detector = LiveDetector(
        counting,
        windows,
        order.detection,
        width=rig.events.width,
        height=rig.events.height,
        centre_px=order.rig.calibration.centre_px,
        stride_us=None if order.stride_ms is None else round(order.stride_ms * 1000),
    )
    detector.warm_up()
    return detector


def _listen(order: DetectOrder, rig: Rig, sink: DetectSink) -> bool:
    """Listen without moving; whether somebody ended it."""
    try:
        rig.listen(FOREVER_S if order.seconds is None else order.seconds, sink, RATE_HZ)
    except (StopRequested, KeyboardInterrupt):
        return True
    return False


def _move(order: DetectOrder, rig: Rig, sink: DetectSink) -> Reaction | None:
    """One trial's motion, with what the protocol wants before its first trial."""
    plan, trial = order.plan, order.trial
    assert plan is not None
    assert trial is not None
    for task in plan.changeovers(None, trial):
        mass = plan.mass_kg(trial)
        mounted = mass is None or rig.plate is None or abs(rig.plate.mass_kg() - mass) < 1e-3
        if not mounted and not rig.operator.ask(task.kind, task.prompt, task.expected):
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
        order.reflex,
    )


@contextmanager
def _lines(out: Path | None) -> Iterator[Callable[[Timed], None]]:
    """Writes decisions as they come; each line is handed to the system at once."""
    if out is None:
        yield lambda timed: None
        return
    if not out.parent.is_dir():
        raise InputError("--out", "", out, "must be a file in a folder that is there")
    with translated_disk_errors(out.parent, RigError), out.open("w", encoding="utf-8") as file:

        def write(timed: Timed) -> None:
            file.write(json.dumps(timed.as_json(), allow_nan=False) + "\n")
            file.flush()

        yield write


def _title(order: DetectOrder) -> str:
    what = "listening" if order.trial is None else f"trial {order.trial.id}"
    reflex = f", reflex {order.reflex.kind}" if order.reflex else ""
    return f"detect on {order.rig.name} ({order.simulated}{what}{reflex}), model {order.model.name}"


def _summary(
    order: DetectOrder, sink: DetectSink, reaction: Reaction | None, interrupted: bool
) -> dict[str, Any]:
    reflex = None
    if order.reflex is not None:
        reflex = {"kind": order.reflex.kind, "done": reaction is not None}
        if reaction is not None:
            reflex |= asdict(reaction)
    return {
        "simulated": order.rig.simulated,
        "rig": order.rig.name,
        "model": {"file": str(order.model), "sha256": order.model_sha256},
        "trial": None if order.trial is None else order.trial.id,
        "protocol": None if order.plan is None else order.plan.protocol.name,
        "virtual_time": order.rig.in_virtual_time,
        **sink.summary(),
        "reflex": reflex,
        "interrupted": interrupted,
    }
