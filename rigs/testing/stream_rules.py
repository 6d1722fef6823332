"""Rules of devices that stream, of any kind; then those of single kinds."""

from __future__ import annotations

import itertools

import numpy as np

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.testing.bench import QUIET_S, check_close, check_methods
from sliplab.rigs.testing.camera_benches import SIZE, FrameBench
from sliplab.rigs.testing.rule import Rules, Seen
from sliplab.rigs.testing.sensor_benches import ArmForceBench, ForceBench, SyncBench
from sliplab.rigs.testing.stream_bench import StreamBench

RULES = Rules[StreamBench]()
"""Rules of every kind of stream."""
FRAME_RULES = Rules[FrameBench]()
FORCE_RULES = Rules[ForceBench | ArmForceBench]()
SYNC_RULES = Rules[SyncBench]()


@RULES.add("declaration", "the device has every method of its capability, and ping finds the fake")
def _declaration(bench: StreamBench) -> None:
    bench.connect()
    check_methods(bench.device, bench.capability)
    if isinstance(bench, FrameBench):
        return  # a fake that the driver opens has no address of its own
    problem = bench.call("ping", lambda: bench.driver.ping(bench.settings), bench.bounds.connect_s)
    if problem is not None:
        raise Seen(f"ping of a fake that answers returned '{problem}'")


@RULES.add("data", "everything that the device sends is read once, unchanged, in order of time")
def _data(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    _check_order(bench.gather())
    bench.check_content()


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
        raise Seen(f"read did not report it within {bench.bounds.news_s:g} s")


@RULES.add("fresh start", "start drops what came before it: a run never begins with older data")
def _fresh(bench: StreamBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.feed()
    bench.wait(QUIET_S)
    mark = bench.mark()
    bench.stop()
    bench.came.clear()
    bench.start()
    for time in bench.gather():
        if mark is not None and time < mark:
            raise Seen("the second run began with data of the first one")


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
        raise Seen(f"{len(late)} came after stop")
    bench.start()
    _check_order(bench.gather())


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
        raise Seen("it started again while it was unplugged")
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
            raise Seen(f"frames of {first.images.shape[1:]} px instead of {SIZE[::-1]}")
        if first.number[0] != 0:
            raise Seen(f"the first frame after start had number {first.number[0]}")


# -- force sensors ----------------------------------------------------------------------------


@FORCE_RULES.add("zero", "after zero the present load is read as zero")
def _zero(bench: ForceBench | ArmForceBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.call("zero", bench.device.zero)

    def zeroed() -> bool:
        bench.feed()
        bench.came.clear()
        bench.read()
        return bool(bench.came) and float(np.abs(bench.came[-1].force_n[-1]).max()) < 1e-3

    if not bench.until(zeroed, bench.bounds.news_s):
        raise Seen(f"{bench.bounds.news_s:g} s later the load was not zero")


@FORCE_RULES.add("overload", "a load out of range is a RigError in the next read, not a number")
def _overload(bench: ForceBench | ArmForceBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.overload()
    _check_noticed(bench)


# -- sync boxes -------------------------------------------------------------------------------


@SYNC_RULES.add("refused trains", "start raises a RigError for a rate or a seed that is none")
def _refused(bench: SyncBench) -> None:
    bench.connect()
    for rate_hz, seed in ((0.0, 1), (1e6, 1), (100.0, 0)):
        error = bench.refusal(
            "start",
            lambda r=rate_hz, s=seed: bench.device.start(r, s, bench.CODE),  # type: ignore[misc]
        )
        if error is None:
            raise Seen(f"start took {rate_hz:g} Hz with seed {seed}")


@SYNC_RULES.add("clock", "read_clock lies between the host's times, and never falls back")
def _clock(bench: SyncBench) -> None:
    bench.connect()
    bench.start()
    _check_clock(bench)


@SYNC_RULES.add(
    "late answer", "an answer that comes too late is dropped: the clock that is read is never old"
)
def _late(bench: SyncBench) -> None:
    bench.connect()
    bench.start()
    bench.fake.answer_late()
    _check_clock(bench)


# ---------------------------------------------------------------------------------------------


def _check_order(times: list[int]) -> None:
    for before, after in itertools.pairwise(times):
        if after < before:
            raise Seen(f"time {after} came after {before}")


def _check_noticed(bench: StreamBench) -> None:
    if not bench.until(bench.fault, bench.bounds.news_s):
        raise Seen(f"read did not report it within {bench.bounds.news_s:g} s")


def _check_clock(bench: SyncBench) -> None:
    """Raise Seen unless two of three reads of the clock agree with the host's times."""
    rows: list[tuple[int, int, int]] = []
    for _ in range(4):
        try:
            reads = bench.call("read_clock", bench.device.read_clock)
        except RigError:
            bench.refusal("close", bench.close_device)
            bench.connect()
            bench.start()
            rows.clear()
            continue
        rows.append((int(reads.device_ns[0]), int(reads.before_ns[0]), int(reads.after_ns[0])))
        bench.wait(QUIET_S)
    if len(rows) < 2:
        raise Seen("read_clock failed again and again")
    for (d1, b1, a1), (d2, b2, a2) in itertools.pairwise(rows):
        if not b2 - a1 - 2_000 <= d2 - d1 <= a2 - b1 + 2_000:
            raise Seen(
                f"between two reads the clock went on by {(d2 - d1) / 1e9:.3f} s, the host's by "
                f"{(b2 - a1) / 1e9:.3f} to {(a2 - b1) / 1e9:.3f} s"
            )
