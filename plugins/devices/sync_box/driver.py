"""Driver of the sync box: a board with firmware/sync_box.c on a serial port.

Reports are checked against the requested train, and missing ones are counted. Nothing is repaired
silently while a train runs: if the box restarts, falls silent or is disconnected, the next call
raises a `SyncBoxFault`, and the next `start` reconnects.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sliplab.plugins.devices.sync_box.line import LEAST_HZ, MOST_HZ, NAME, whole
from sliplab.plugins.devices.sync_box.port import DEVICE, SyncBoxFault, SyncPort, restarted
from sliplab.plugins.devices.sync_box.settings import SyncBoxSettings
from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import DeviceHealth, RigError
from sliplab.rigs.core.pulse_code import LONGEST_GAP_TICKS, SEEDS, CodeBits
from sliplab.storage.streams import ClockReads, PulseChunk

_FARTHEST_TICKS = 1 << 24
"""Largest tick number of a trial: 4 hours at 1,000 Hz."""
_MOST_MISSED = 10_000
"""Largest plausible gap in exposure numbers; a larger one is a garbled line."""


@dataclass
class BoxLosses:
    """Data lost between box and host since the last start; all 0 in a good trial."""

    pulses: int = 0
    """Pulses without a report, from gaps in their numbers."""
    exposures: int = 0
    """Exposures without a report, from gaps in their numbers."""
    reported_by_box: int = 0
    """Reports that the box dropped by its own count, its buffer being full; included above."""
    lines: int = 0
    """Garbled lines of any kind."""
    unread: int = 0
    """Reports dropped by the host because they were not read; see `MOST_WAITING`."""

    def __bool__(self) -> bool:
        return any((self.pulses, self.exposures, self.reported_by_box, self.lines, self.unread))


class ReportTrain:
    """Checks reports, and counts missing ones.

    Args:
        millihertz: rate of the ticks, thousandths of a hertz.
        seed: seed of the code, see `rigs.core.pulse_code`.
        code: name of the code.
    """

    def __init__(self, millihertz: int, seed: int, code: Code) -> None:
        self._millihertz, self._bits = millihertz, CodeBits(seed, code)
        self._next_tick = self._next_exposure = 0
        self._last_exposure_us = 0
        self.first_us: int | None = None
        """Time of tick 0 on the box's clock, as the box reports it; None before that."""
        self.losses = BoxLosses()

    @property
    def longest_gap_s(self) -> float:
        """Longest time between two pulses, s."""
        return LONGEST_GAP_TICKS * 1000 / self._millihertz

    def tick(self, number: int, bit: int, us: int, latest_us: float = math.inf) -> int | None:
        """Check a tick's report; return its time since tick 0, us, if it has a pulse, else None.

        Args:
            latest_us: latest plausible time since tick 0.

        Raises:
            ValueError: it is not a tick of this train.
        """
        if self.first_us is None or not self._next_tick <= number < _FARTHEST_TICKS:
            raise ValueError(f"tick {number} after {self._next_tick - 1}")
        since_us = us - self.first_us
        due_us = number * 1_000_000_000 // self._millihertz
        if since_us > latest_us:  # otherwise every later one would seem too early
            raise ValueError(f"tick {number} at {us} us lies in the future")
        if since_us != due_us or bit != self._bits.upto(number + 1)[number]:
            raise ValueError(f"tick {number}: bit {bit}, {since_us} us")
        self._miss_to(number)
        self._next_tick = number + 1
        return since_us if bit else None

    def exposure(self, number: int, us: int, latest_us: int) -> int:
        """Check an exposure's report; return its time since tick 0, us, below 0 if it is earlier.

        Args:
            latest_us: latest plausible time since tick 0.

        Raises:
            ValueError: it cannot be the next exposure, or one soon after.
        """
        missed = number - self._next_exposure
        if self.first_us is None or not 0 <= missed <= _MOST_MISSED or us < self._last_exposure_us:
            raise ValueError(f"exposure {number} after {self._next_exposure - 1}")
        if us - self.first_us > latest_us:  # otherwise every later one would seem too early
            raise ValueError(f"exposure {number} at {us} us lies in the future")
        self.losses.exposures += missed
        self._next_exposure, self._last_exposure_us = number + 1, us
        return us - self.first_us

    def end(self, ticks: int) -> None:
        """Record that the box stopped after `ticks` ticks; those not reported are missing."""
        if self._next_tick < ticks < _FARTHEST_TICKS:
            self._miss_to(ticks)
            self._next_tick = ticks

    def _miss_to(self, number: int) -> None:
        if number > self._next_tick:
            self.losses.pulses += int(self._bits.upto(number)[self._next_tick : number].sum())


MOST_WAITING = 100_000
"""Buffered pulses or exposures: 17 minutes at 100 Hz. Further ones are counted and dropped."""
AHEAD_US = 1_000_000
"""Largest lead of an exposure over the host's clock, besides 2 %; a larger one is garbled."""
TICK_AHEAD_US = 5_000_000
"""The same of a tick, which was checked against the train; a scene may jump ahead."""
MOST_EARLY = 1000
"""Buffered reports before the answer to `GO`, in case the request must be repeated."""


class SerialSyncBox:
    """A sync box on a serial port; see `rigs.core.capabilities.SyncBox`.

    The port is opened by `connect`, or by the first call that needs it.

    Args:
        settings: port and timeouts.
        now_ns: the host's monotonic clock.
    """

    def __init__(
        self, settings: SyncBoxSettings, now_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._settings, self._now_ns = settings, now_ns
        self._port: SyncPort | None = None
        self._running = False
        self._train: ReportTrain | None = None
        self._early: list[str] = []
        self._pulses: list[int] = []
        self._exposures: list[int] = []
        self._asked_ns = self._heard_ns = self._clock_us = 0

    def connect(self) -> None:
        """Open the port and check that a sync box answers; reconnects after a fault.

        Raises:
            SyncBoxFault: no such port, or no sync box with this protocol on it.
        """
        if self._port is None or self._port.fault is not None:
            self._disconnect()
            self._port = SyncPort(self._settings, self._now_ns, self._take)

    def close(self) -> None:
        """Stop the ticks if the box answers, and close the port; safe to call more than once."""
        try:
            self.stop()
        except SyncBoxFault:
            pass  # a disconnected box cannot be stopped; close the port all the same
        finally:
            self._disconnect()

    def _disconnect(self) -> None:
        if self._port is not None:
            self._port.close()
        self._port, self._train, self._running, self._clock_us = None, None, False, 0

    def health(self) -> DeviceHealth:
        """Return the box's health report.

        Raises:
            SyncBoxFault: no answer.
        """
        clock = self.read_clock()
        took_us = (int(clock.after_ns[0]) - int(clock.before_ns[0])) / 1000
        return DeviceHealth(
            device=DEVICE,
            model="sync box",
            serial=self._settings.port,
            firmware=NAME,
            temperature_c=None,
            clock="its own, 1 us",
            notes=(f"answers in {took_us:.0f} us",),
        )

    def start(self, rate_hz: float, seed: int, code: Code = "lfsr") -> None:
        """Start ticks and code; a running train is ended, and its reports are discarded.

        Args:
            rate_hz: 1 to 1,000, in steps of a thousandth.
            seed: 1 to 4,294,967,294.
            code: see `rigs.core.pulse_code`.

        Raises:
            RigError: the box cannot send such a train.
            SyncBoxFault: the box does not answer.
        """
        millihertz = round(rate_hz * 1000)
        if not LEAST_HZ <= rate_hz <= MOST_HZ or abs(millihertz - rate_hz * 1000) > 1e-6:
            raise RigError(
                DEVICE, f"rate {rate_hz} Hz: must be {LEAST_HZ:g} to {MOST_HZ:g}, in steps of 0.001"
            )
        if not 1 <= seed <= SEEDS:
            raise RigError(DEVICE, f"seed {seed}: must lie between 1 and {SEEDS}")
        self.connect()
        self.stop()
        port = self._open()
        port.ask(f"ARM {millihertz / 1000:.3f} {seed} 0 {code}", "OK ARM")
        with port.news:
            # no report of an older train follows the answer to ARM
            self._train = ReportTrain(millihertz, seed, code)
            self._pulses, self._exposures, self._early = [], [], []
            port.lines.wrong = 0
            self._asked_ns = self._now_ns()
        port.ask("GO", "OK GO ")
        with port.news:
            self._heard_ns, self._running = self._now_ns(), True

    def read_pulses(self) -> PulseChunk:
        """Return pulses since the last call, box clock, integer microseconds; tick 0 is at 0.

        Raises:
            SyncBoxFault: the box restarted, was disconnected, or has stopped sending pulses.
        """
        if self._port is not None:
            with self._port.news:
                self._check(self._port)
                pulses, self._pulses = self._pulses, []
        else:
            pulses = []
        return PulseChunk(np.array(pulses, np.int64) * 1000)

    def read_exposures(self) -> PulseChunk:
        """Return starts of exposures since the last call, box clock, integer microseconds.

        Raises:
            SyncBoxFault: as `read_pulses`.
        """
        if self._port is not None:
            with self._port.news:
                self._check(self._port)
                exposures, self._exposures = self._exposures, []
        else:
            exposures = []
        return PulseChunk(np.array(exposures, np.int64) * 1000)

    def read_clock(self) -> ClockReads:
        """Read the box's clock, integer microseconds: one row.

        The clock is 0 at tick 0 of the last train; before the first train, at power-on.

        Raises:
            SyncBoxFault: no answer, or the clock jumped back.
        """
        port = self._open()
        with port.news:
            self._check(port)
        found, before_ns, after_ns = port.ask("T?", "T", numbered=True)
        us = int(found)
        with port.news:
            fell_us, self._clock_us = self._clock_us - us, us
            if fell_us > 0:
                port.fail(restarted(f"its clock jumped back by {fell_us / 1e6:.3f} s"))
                port.check()
            first_us = self._train.first_us if self._train is not None else None
        row = ((us - (first_us or 0)) * 1000, before_ns, after_ns)
        return ClockReads(*(np.array([value], np.int64) for value in row))

    def stop(self) -> None:
        """Stop the ticks after the current pulse; the clock keeps running.

        All pulses can be read afterwards, because the box answers after its last report.

        Raises:
            SyncBoxFault: no answer.
        """
        port = self._port
        if port is None or not self._running:
            return
        with port.news:
            self._running = False
            if port.fault is not None:
                return  # the next read raises it; there is nothing left to stop
        port.ask("STOP", "OK STOP")

    @property
    def losses(self) -> BoxLosses:
        """Losses of the last train."""
        if self._port is None or self._train is None:
            return BoxLosses()
        with self._port.news:
            return replace(self._train.losses, lines=self._port.lines.wrong)

    def _open(self) -> SyncPort:
        if self._port is None:
            self.connect()
        assert self._port is not None
        return self._port

    def _check(self, port: SyncPort) -> None:
        """Raise a fault if there is one; call with `port.news` held."""
        if self._running and self._train is not None:
            quiet_s = (port.read_to_ns - self._heard_ns) / 1e9
            if quiet_s > self._train.longest_gap_s + self._settings.silence_s:
                port.fail(
                    SyncBoxFault(
                        f"no pulse reported for {quiet_s:.1f} s: it was reset or unplugged, or its "
                        f"firmware hangs. Check its cable and supply, then start the trial again"
                    )
                )
        port.check()

    # -- in the reading thread, with the port's `news` held ----------------------------------

    def _take(self, body: str) -> bool:
        kind, _, rest = body.partition(" ")
        train = self._train
        if kind not in {"P", "X", "D"}:
            if kind == "T":
                whole(rest.rpartition(" ")[2])  # raises if the line is garbled
            elif train is not None:
                self._begin_or_end(train, body)
            return False
        if train is None:
            return True
        numbers = [whole(word) for word in rest.split(" ")]
        if kind == "D":
            (train.losses.reported_by_box,) = numbers
            return True
        if train.first_us is None:
            if len(self._early) < MOST_EARLY:
                self._early.append(body)
            return True
        passed_us = (self._now_ns() - self._asked_ns) // 1000
        # by the host's clock, or by the last report of the box's own clock
        latest_us = max(passed_us + passed_us // 50, self._clock_us - train.first_us)
        if kind == "P":
            number, bit, us = numbers
            since_us = train.tick(number, bit, us, latest_us + TICK_AHEAD_US)
            self._heard_ns = self._now_ns()
            if since_us is not None:
                self._keep(self._pulses, since_us, train)
        else:
            number, us = numbers
            since_us = train.exposure(number, us, latest_us + AHEAD_US)
            if since_us >= 0:
                self._keep(self._exposures, since_us, train)
        return True

    def _begin_or_end(self, train: ReportTrain, body: str) -> None:
        if body.startswith("OK GO ") and train.first_us is None:
            train.first_us = whole(body.removeprefix("OK GO "))
            early, self._early = self._early, []
            for report in early:
                self._take(report)
        elif body.startswith("OK STOP "):
            train.end(whole(body.removeprefix("OK STOP ")))

    @staticmethod
    def _keep(waiting: list[int], us: int, train: ReportTrain) -> None:
        if len(waiting) < MOST_WAITING:
            waiting.append(us)
        else:
            train.losses.unread += 1
