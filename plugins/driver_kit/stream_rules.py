"""Rules of devices that stream, of any kind; then those of single kinds."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Any

import numpy as np

from sliplab.plugins.driver_kit.bench import QUIET_S, check_close, check_methods
from sliplab.plugins.driver_kit.camera_benches import PX_PER_MM, SIZE, EventBench, FrameBench
from sliplab.plugins.driver_kit.rule import NotTried, Rules, RuleViolation
from sliplab.plugins.driver_kit.sensor_benches import LOAD, ArmForceBench, ForceBench
from sliplab.plugins.driver_kit.stream_bench import StreamBench
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.streams import EVENTS, FRAMES, PULSES, WRENCH

RULES = Rules[StreamBench]()
"""Rules of every kind of stream."""
CLOCK_RULES = Rules[StreamBench]()
"""Rules of those whose clock the bench can set."""
HOST_RULES = Rules[StreamBench]()
"""Rules of those whose chunks have the host's time of reception."""
EVENT_RULES = Rules[EventBench]()
FRAME_RULES = Rules[FrameBench]()
FORCE_RULES = Rules[ForceBench | ArmForceBench]()
OTHER_SIZE = 40, 56
"""Another region, higher than wide."""
AT_ONCE_S = 0.25
"""Longest duration of a read, s: it does not wait for data."""
READS = 5
LOST_FRAMES = 3, 200, 30_000, 30_000, 30_000
"""Gaps in the numbers of frames, which pass the wraps of counters of 8 and 16 bits."""
WRAP_S = 0.015
"""Time before a wrap at which batches of 10 ms begin, s."""
HOST_WAIT_S, HOST_LATE_S = 0.3, 0.2
"""Time from data to their read, and longest time to their reception, s."""
COLUMNS: dict[str, tuple[str, int]] = {
    **{
        column.field: (column.dtype, 1 + len(column.shape))
        for kind in (EVENTS, FRAMES, PULSES, WRENCH)
        for column in kind.columns.values()
    },
    "images": ("uint8", 3),
    "markers_px": ("float32", 3),
    "plate_px": ("float32", 2),
}
"""Type and number of axes of the arrays of a chunk, as `storage.streams` documents them."""


@RULES.add("declaration", "the device has every method of its capability, and ping finds the fake")
def _declaration(bench: StreamBench) -> None:
    bench.connect()
    check_methods(bench.device, bench.capability)
    if isinstance(bench, FrameBench):
        return  # a fake that the driver opens has no address
    problem = bench.call("ping", lambda: bench.driver.ping(bench.settings), bench.bounds.connect_s)
    if problem is not None:
        raise RuleViolation(f"ping of a fake that answers returned '{problem}'")


@RULES.add("data", "everything that the device sends is read once, unchanged, in order of time")
def _data(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    _check_order(bench.gather())
    bench.check_content()


@RULES.add("arrays", "each array of a chunk has its documented type, and one row a sample")
def _arrays(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    for chunk in bench.came:
        stored = chunk.KIND.columns.values()
        known = COLUMNS | {each.field: (each.dtype, 1 + len(each.shape)) for each in stored}
        for name, values in chunk._arrays().items():
            kind, axes = known[name]
            if (str(values.dtype), values.ndim) != (kind, axes) or len(values) != len(chunk):
                raise RuleViolation(
                    f"{name} was an array of {values.dtype} of shape {values.shape} for "
                    f"{len(chunk)} samples; it is one of {kind} with {axes} axes"
                )


@RULES.add("read at once", "read returns at once, with data and without: it waits for none")
def _at_once(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    took: list[float] = []
    with suppress(RigError):  # it has fallen silent meanwhile
        for _ in range(READS):
            began = monotonic()
            bench.read()
            took.append(monotonic() - began)
    if not took or min(took) > AT_ONCE_S:
        raise RuleViolation(
            f"read took {min(took, default=9):.2f} s or more where nothing had come"
        )


@RULES.add(
    "start while it streams",
    "a second start is refused with a RigError and changes nothing, or begins a new run; all data "
    "after it are read once",
)
def _start_twice(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.came.clear()
    if bench.refusal("a second start", bench.begin) is not None:
        bench.quiet()
        bench.came.clear()
    _check_order(bench.gather())
    bench.check_content()


@RULES.add("before start", "nothing is read before start: no data of the time before it")
def _before_start(bench: StreamBench) -> None:
    bench.connect()
    bench.feed()
    bench.wait(QUIET_S)
    try:
        early = bench.quiet()
    except RigError:
        early = []  # a device that is not streaming may say so
    if early:
        raise RuleViolation(f"{len(early)} were read before start")


@RULES.add(
    "times fall back",
    "a device whose clock falls back is reported as a fault, and no earlier time is returned",
)
def _times_fall_back(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    times = bench.gather()
    bench.turn_back()

    def noticed() -> bool:
        bench.feed()
        try:
            times.extend(bench.read())
        except RigError:
            return True
        _check_order(times)
        return False

    if not bench.until(noticed, bench.bounds.news_s):
        raise RuleViolation(f"read did not report it within {bench.bounds.news_s:g} s")


@RULES.add("fresh start", "start drops what came before it: a run never begins with older data")
def _fresh(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.feed()
    bench.wait(QUIET_S)
    mark = bench.mark()
    bench.stop()
    bench.forget()
    bench.start()
    for time in bench.gather():
        if mark is not None and time < mark:
            raise RuleViolation("the second run began with data of the first one")
    if mark is not None:
        bench.check_fresh(mark)


@RULES.add(
    "stop",
    "stop returns from any state, nothing comes after it, and the stream can start again",
)
def _stop(bench: StreamBench) -> None:
    bench.connect()
    bench.call("stop before start", bench.device.stop)
    bench.start()
    bench.gather()
    for _ in range(2):
        bench.stop()
    bench.quiet()
    bench.feed()
    late = bench.quiet()
    if late:
        raise RuleViolation(f"{len(late)} came after stop")
    bench.start()
    _check_order(bench.gather())


@RULES.add("read after stop", "what came before stop can still be read after it")
def _read_after_stop(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    last = bench.gather()[-1]
    bench.came.clear()
    bench.feed()
    bench.wait(QUIET_S)
    bench.stop()
    late = bench.quiet()
    if not late or late[-1] <= last:
        raise RuleViolation("what came before stop could not be read after it")


@RULES.add("silent", "a device that falls silent is reported in time; stop and close return")
def _silent(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.silence()
    _check_noticed(bench)
    bench.refusal("stop", bench.device.stop)
    bench.refusal("close", bench.close_device)


@RULES.add(
    "silent from the beginning",
    "every call of a device that never answers returns in time, or raises a RigError in time",
)
def _silent_start(bench: StreamBench) -> None:
    bench.silence()
    if bench.refusal("connect", bench.open, bench.bounds.connect_s) is None:
        bench.refusal("start", bench.begin)
        bench.refusal("read", bench.take)
        bench.refusal("stop", bench.device.stop)
    bench.refusal("close", bench.close_device)


@RULES.add("unplugged", "a device that is gone is reported in time; stop and close return")
def _unplugged(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.unplug()
    _check_noticed(bench)
    bench.refusal("stop", bench.device.stop)
    if bench.refusal("start", bench.begin) is None and not bench.until(
        bench.fault, bench.bounds.news_s
    ):
        raise RuleViolation("it started again while it was unplugged")
    bench.call("close", bench.close_device)


@RULES.add(
    "close",
    "close gives back every thread, process, file and socket, also while it streams, and works "
    "twice",
    warm=True,
)
def _close(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.call("close while it streams", bench.close_device)
    check_close(bench)


@CLOCK_RULES.add(
    "counter wraps", "times go on where a counter of the device wraps, as one of 32 bits does"
)
def _wraps(bench: StreamBench) -> None:
    for wrap_s in sorted(bench.wraps_s):
        bench.seek(round((wrap_s - 0.4) * 1e9))
        bench.connect()
        bench.start()
        _check_order(bench.flow(round((wrap_s - WRAP_S) * 1e9)))
        bench.check_steps()
        bench.call("close", bench.close_device)


@HOST_RULES.add(
    "host times",
    "host_ns is the host's monotonic clock when a sample was received, in ns; not when it was read",
)
def _host_times(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.read()
    soonest_s: list[float] = []
    last_ns = 0
    for _ in range(3):
        bench.came.clear()
        sent_ns = bench.host_ns()
        bench.feed()
        bench.wait(HOST_WAIT_S + getattr(bench.fake, "behind_s", 0.0))
        bench.read()
        now_ns = bench.host_ns()
        for host_ns in (host_ns for chunk in bench.came for host_ns in chunk.host_ns.tolist()):
            if not max(sent_ns - round(HOST_LATE_S * 1e9), last_ns) <= host_ns <= now_ns:
                raise RuleViolation(
                    f"host_ns was {host_ns} of a sample sent at {sent_ns} and read by {now_ns} ns "
                    "of the host's monotonic clock"
                )
            last_ns = host_ns
        if bench.came:
            soonest_s.append((int(bench.came[0].host_ns[0]) - sent_ns) / 1e9)
    if not soonest_s:
        raise RuleViolation("no sample came")
    if min(soonest_s) > HOST_LATE_S:
        raise RuleViolation(f"host_ns was {min(soonest_s):.2f} s or more after a sample was sent")


# -- event cameras ----------------------------------------------------------------------------


@EVENT_RULES.add("sensor size", "width is the number of columns, height the number of rows")
def _sensor_size(bench: EventBench) -> None:
    bench.connect()
    if (bench.device.width, bench.device.height) != SIZE:
        raise RuleViolation(
            f"width and height were {bench.device.width} x {bench.device.height}, the sensor has "
            f"{SIZE[0]} columns and {SIZE[1]} rows"
        )


# -- frame cameras ----------------------------------------------------------------------------


@FRAME_RULES.add(
    "region", "frames have the size of the region, and their numbers begin at 0 with each start"
)
def _region(bench: FrameBench) -> None:
    bench.connect()
    for _ in range(2):
        bench.came.clear()
        bench.start()
        bench.gather()
        bench.stop()
        first = bench.came[0]
        if first.images.shape[1:] != SIZE[::-1]:
            raise RuleViolation(f"frames of {first.images.shape[1:]} px instead of {SIZE[::-1]}")
        if first.number[0] != 0:
            raise RuleViolation(f"the first frame after start had number {first.number[0]}")


@FRAME_RULES.add(
    "another region",
    "set_region takes columns and rows in this order, and holds from the next start on",
)
def _another_region(bench: FrameBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.stop()
    error = bench.refusal("set_region", lambda: bench.device.set_region(*OTHER_SIZE))
    if error is not None:
        raise NotTried(f"its sensor has no region of {OTHER_SIZE[0]} x {OTHER_SIZE[1]} px: {error}")
    bench.came.clear()
    bench.start()
    bench.gather()
    if bench.came[-1].images.shape[1:] != OTHER_SIZE[::-1]:
        raise RuleViolation(
            f"frames of {bench.came[-1].images.shape[1:]} px instead of {OTHER_SIZE[::-1]}"
        )
    bench.check_content()


@FRAME_RULES.add(
    "lost frames",
    "a frame that is lost leaves a gap in the numbers, which go on where a counter of 8 or 16 bits "
    "wraps",
)
def _lost(bench: FrameBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    for count in LOST_FRAMES:
        bench.lose(count)
        bench.came.clear()
        bench.gather()
        bench.check_content()


@FRAME_RULES.add(
    "scale and exposure",
    "px_per_mm is the scale that the driver was given, mid_exposure_ns half the exposure in ns",
)
def _scale(bench: FrameBench) -> None:
    bench.connect()
    if not abs(bench.device.px_per_mm - PX_PER_MM) < 1e-6:
        raise RuleViolation(f"px_per_mm was {bench.device.px_per_mm}, not {PX_PER_MM}")
    if not abs(bench.device.mid_exposure_ns - bench.mid_exposure_ns) <= 1000:
        raise RuleViolation(
            f"mid_exposure_ns was {bench.device.mid_exposure_ns} for an exposure of "
            f"{bench.settings.exposure_us:g} us"
        )


@FRAME_RULES.add(
    "level of the sync line", "sync is the level of the sync line in the exposure of its frame"
)
def _sync_level(bench: FrameBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.check_sync()


@FRAME_RULES.add(
    "clock of a camera",
    "read_clock raises a RigError, or returns a clock in ns that runs as the host's does, read "
    "between the host's times before and after",
)
def _camera_clock(bench: FrameBench) -> None:
    bench.connect()
    if bench.refusal("read_clock", bench.device.read_clock) is not None:
        return  # one without such a clock says so
    check_clock_reads([clock_row(bench, bench.device.read_clock) for _ in range(3)])


# -- force sensors ----------------------------------------------------------------------------


@FORCE_RULES.add(
    "zero",
    "after zero the present load is read as zero, and a change of it in full, in N and N m; each "
    "time",
)
def _zero(bench: ForceBench | ArmForceBench) -> None:
    bench.steady = True
    bench.connect()
    bench.start()
    bench.gather()
    for load, zero, what in (
        (LOAD, LOAD, "the load was not zero"),
        (2.0 * LOAD, LOAD, "its change was not read"),
        (2.0 * LOAD, 2.0 * LOAD, "the load was not zero after a second zero"),
    ):
        bench.load = load
        if (load == zero).all():
            bench.call("zero", bench.device.zero)
        last: list[float] = []

        def read(due: Any = load - zero, last: list[float] = last) -> bool:
            bench.feed()
            bench.came.clear()
            bench.read()
            if bench.came:
                chunk = bench.came[-1]
                last[:] = [*chunk.force_n[-1].tolist(), *chunk.torque_nm[-1].tolist()]
            return bool(last) and bool((np.abs(np.array(last) - due) < 1e-3).all())

        if not bench.until(read, bench.bounds.news_s):
            raise RuleViolation(
                f"{bench.bounds.news_s:g} s later {what}: {np.round(last, 4).tolist()}"
            )


@FORCE_RULES.add("overload", "a load out of range is a RigError in the next read, not a number")
def _overload(bench: ForceBench | ArmForceBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.overload()
    _check_noticed(bench)


# ---------------------------------------------------------------------------------------------


def _check_order(times: list[int]) -> None:
    for before, after in itertools.pairwise(times):
        if after < before:
            raise RuleViolation(f"time {after} came after {before}")


def _check_noticed(bench: StreamBench) -> None:
    if not bench.until(bench.fault, bench.bounds.news_s):
        raise RuleViolation(f"read did not report it within {bench.bounds.news_s:g} s")


def check_clock_reads(rows: list[tuple[int, int, int]]) -> None:
    """Raise Seen unless a clock's reads, with host's times before and after, agree with each other.

    Args:
        rows: clock, and host's time before and after, ns.
    """
    for (d1, b1, a1), (d2, b2, a2) in itertools.pairwise(rows):
        if not b2 - a1 - 2_000 <= d2 - d1 <= a2 - b1 + 2_000:
            raise RuleViolation(
                f"between two reads the clock went on by {(d2 - d1) / 1e9:.3f} s, the host's by "
                f"{(b2 - a1) / 1e9:.3f} to {(a2 - b1) / 1e9:.3f} s"
            )


def clock_row(bench: StreamBench, read_clock: Callable[[], Any]) -> tuple[int, int, int]:
    """Return one read of a device's clock, with the host's times before and after, ns.

    Raises:
        Seen: these are not times of the host's monotonic clock during the call.
        RigError: raised by the driver.
    """
    begun_ns = bench.host_ns()
    reads = bench.call("read_clock", read_clock)
    ended_ns = bench.host_ns()
    device_ns, before_ns, after_ns = (
        int(column[0]) for column in (reads.device_ns, reads.before_ns, reads.after_ns)
    )
    if not begun_ns <= before_ns <= after_ns <= ended_ns:
        raise RuleViolation(
            f"read_clock returned {before_ns} and {after_ns} ns as the host's times before and "
            f"after; it was called at {begun_ns} and returned at {ended_ns} ns"
        )
    return device_ns, before_ns, after_ns
