"""Rules of sync boxes alone."""

from __future__ import annotations

from typing import get_args

import numpy as np

from sliplab.plugins.driver_kit.bench import COMMON_WRAPS_S, QUIET_S
from sliplab.plugins.driver_kit.rule import NotTried, Rules, RuleViolation
from sliplab.plugins.driver_kit.sensor_benches import US_NS, SyncBench
from sliplab.plugins.driver_kit.stream_rules import check_clock_reads, clock_row
from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.pulse_code import SEEDS, CodeBits

RULES = Rules[SyncBench]()
LATE_S = 0.25
"""Longest time from a call to the box's reaction, s."""
SLOW_HZ = 1.0
TICKS = 8
"""Ticks after a jump of which one at least is a pulse."""
"""Rate of a train during whose jump of time few pulses are due."""


@RULES.add("refused trains", "start raises a RigError for a rate or a seed that is none")
def _refused(bench: SyncBench) -> None:
    bench.connect()
    for rate_hz, seed in ((0.0, 1), (1e6, 1), (100.0, 0)):
        error = bench.refusal(
            "start",
            lambda r=rate_hz, s=seed: bench.device.start(r, s, bench.CODE),  # type: ignore[misc]
        )
        if error is None:
            raise RuleViolation(f"start took {rate_hz:g} Hz with seed {seed}")


@RULES.add("clock", "read_clock lies between the host's times, and never falls back")
def _clock(bench: SyncBench) -> None:
    bench.connect()
    bench.start()
    _check_clock(bench)


@RULES.add(
    "late answer", "an answer that comes too late is dropped: the clock that is read is never old"
)
def _late(bench: SyncBench) -> None:
    bench.connect()
    bench.start()
    bench.fake.answer_late()
    _check_clock(bench)


@RULES.add(
    "trains", "the box sends the train of every code that was requested: its rate, seed and bits"
)
def _trains(bench: SyncBench) -> None:
    bench.connect()
    for code, seed in zip(get_args(Code), (SEEDS - 9, 77, 123_456), strict=False):
        bench.CODE, bench.seed = code, seed
        if code == bench.USUAL:
            bench.start()
        elif bench.refusal("start", bench.begin) is not None:
            continue  # a box need not have every code
        train = bench.trains[-1] if bench.trains else None
        if train is None:
            raise RuleViolation("start returned, and no train had begun")
        asked = bench.RATE_HZ, bench.seed, bench.CODE
        if (train.rate_hz, train.seed, train.code) != asked:
            raise RuleViolation(
                f"requested {asked[0]:g} Hz, seed {asked[1]} and code {asked[2]}, the box sent "
                f"{train.rate_hz:g} Hz, seed {train.seed} and code {train.code}"
            )
        bench.gather()
        bench.check_content()


@RULES.add("ticks stop", "stop ends the train on the box, not only in the driver")
def _ticks_stop(bench: SyncBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    bench.stop()
    if not bench.until(lambda: bench.trains[-1] is None, LATE_S):
        raise RuleViolation(f"{LATE_S:g} s after stop the box still ticked")


@RULES.add("clock at start", "tick 0 is at 0 of the clock that read_clock reads, in ns")
def _clock_at_start(bench: SyncBench) -> None:
    bench.connect()
    begun_ns = bench.host_ns()
    bench.start()
    started_ns = bench.host_ns()
    bench.wait(QUIET_S)
    device_ns, before_ns, after_ns = clock_row(bench, bench.device.read_clock)
    least_s, most_s = (before_ns - started_ns) / 1e9, (after_ns - begun_ns) / 1e9
    if not least_s - LATE_S <= device_ns / 1e9 <= most_s + LATE_S:
        raise RuleViolation(
            f"{least_s:.3f} to {most_s:.3f} s after start its clock was {device_ns / 1e9:.3f} s"
        )


@RULES.add(
    "counter wraps",
    "clock and pulses go on where a counter of the box wraps, as one of 32 bits does",
)
def _wraps(bench: SyncBench) -> None:
    bench.RATE_HZ = SLOW_HZ
    wrap_s = COMMON_WRAPS_S[-1] / 1000.0  # of an unsigned counter of us
    bench.connect()
    error = bench.refusal("start", bench.begin)
    if error is not None:
        raise NotTried(f"it sends no train of {SLOW_HZ:g} Hz: {error}")
    reads = [clock_row(bench, bench.device.read_clock)]
    for jump_s in (wrap_s - 2.5, 6.0):
        bench.pass_time(jump_s)
        bench.wait(QUIET_S)
        device_ns, before_ns, after_ns = clock_row(bench, bench.device.read_clock)
        ahead_ns = round(1e9 * jump_s)
        check_clock_reads([reads[-1], (device_ns - ahead_ns, before_ns, after_ns)])
        reads.append((device_ns, before_ns, after_ns))
    came: list[int] = []

    def past_wrap() -> bool:
        came.extend(bench.read())
        return any(t_ns > wrap_s * 1e9 for t_ns in came)

    # a driver may reject what lies ahead of the clock that it has read, so the next ticks count
    bench.until(past_wrap, TICKS / SLOW_HZ)
    pulses = np.array(came, np.int64)
    bits = CodeBits(bench.seed, bench.CODE).upto(round(wrap_s) + 3 * TICKS)
    due = np.flatnonzero(bits) * round(1e9 / SLOW_HZ)
    late = pulses[pulses > wrap_s * 1e9]
    if not len(late):
        raise RuleViolation(f"no pulse had a time after {wrap_s:.3f} s")
    off = np.abs(late[:, None] - due[None]).min(axis=1)
    if (off > US_NS).any():
        raise RuleViolation(f"pulses came at {late.tolist()} ns, which are none of the code")


@RULES.add(
    "exposures", "an exposure of the camera is read once, at its time on the box's clock, in ns"
)
def _exposures(bench: SyncBench) -> None:
    bench.connect()
    bench.start()
    bench.gather()
    if len(bench.call("read_exposures", bench.device.read_exposures)):
        raise RuleViolation("an exposure came, though the camera had made none")
    expose = getattr(bench.fake, "expose", None)
    if expose is None:
        raise NotTried("the fake has no `expose`: it cannot simulate the camera's output")
    clock = [clock_row(bench, bench.device.read_clock)[0]]
    expose()
    clock.append(clock_row(bench, bench.device.read_clock)[0])
    found: list[int] = []

    def came() -> bool:
        found.extend(bench.call("read_exposures", bench.device.read_exposures).t_ns.tolist())
        bench.read()
        return bool(found)

    if not bench.until(came, bench.bounds.news_s):
        raise RuleViolation(f"no exposure came within {bench.bounds.news_s:g} s")
    bench.wait(QUIET_S)
    came()
    if len(found) != 1 or not clock[0] - US_NS <= found[0] <= clock[1] + US_NS:
        raise RuleViolation(f"an exposure between {clock[0]} and {clock[1]} ns came as {found} ns")


# ---------------------------------------------------------------------------------------------


def _check_clock(bench: SyncBench) -> None:
    """Raise Seen unless two of three reads of the clock agree with the host's times."""
    rows: list[tuple[int, int, int]] = []
    for _ in range(4):
        try:
            rows.append(clock_row(bench, bench.device.read_clock))
        except RigError:
            bench.refusal("close", bench.close_device)
            bench.connect()
            bench.start()
            rows.clear()
            continue
        bench.wait(QUIET_S)
    if len(rows) < 2:
        raise RuleViolation("read_clock failed again and again")
    check_clock_reads(rows)
