"""Clock fits by kind of fault: what is accepted wrongly, what is refused for nothing, and coverage.

`python -m benchmarks.clock_kinds [TRAINS] [KIND ...] [--seed N]` prints the table of
docs/clocks.md; `python -m benchmarks clock_kinds` gives the same numbers as figures. The constants
of a fit were chosen on trains of seed 1; the table is of seed 5.

Trains are those of `benchmarks.clocks`, with one more fault each. Of a fit that is accepted the
error is the largest that its map makes at any pulse that was sent between the first and the last
pulse for which the fit vouches. `wrong` counts fits whose error is above three times the stated
uncertainty, and all that were accepted of a train that is another trial's or jumps by whole ticks;
`wrong_anywhere` the same with the pulses sent outside of what is vouched for; `refused` is the
share refused, which is right for jumps and for other trials' trains; `coverage` the share of the
accepted ones whose error is within the stated uncertainty, with its exact interval of 95 % (Clopper
and Pearson 1934); `fit_ms` the median time of a fit.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from statistics import median

import numpy as np
from scipy import special

from benchmarks.clocks import DRIFT_PPM, StampTrain, make_train
from benchmarks.measure import SEED, Figures
from sliplab.analysis.clocks.clocks import ClockRefused, fit_clock
from sliplab.rigs.core.pulse_code import U8, code_bits
from sliplab.storage.streams import F64

FAR = 3.0
"""A fit is wrong whose error is so many times the stated uncertainty."""
KINDS = (
    "good",
    "jump_1ms_at_end",
    "jump_1ms",
    "jump_20us_in_middle",
    "jump_20us",
    "jump_20us_at_end",
    "jump_of_ticks",
    "kink_0.2ppm",
    "kink_1ppm",
    "kink_5ppm",
    "warming",
    "other_trial",
    "other_trial_16_bits",
    "lost_30_on_both",
    "lost_30_and_jump_of_ticks",
)
HOPELESS = (
    "jump_of_ticks",
    "other_trial",
    "other_trial_16_bits",
    "lost_30_and_jump_of_ticks",
)
"""Kinds of which any fit that is accepted is wrong."""
END = 0.005
"""The share of a train that is its end."""


@dataclass(frozen=True)
class Tally:
    """Results of the trains of one kind.

    Attributes:
        errors, stated: of every accepted fit, ns.
        errors_anywhere: the same error with the pulses before and after what is vouched for.
        fit_ms: of every train.
    """

    kind: str
    errors: F64
    stated: F64
    errors_anywhere: F64
    fit_ms: F64

    @property
    def refused(self) -> float:
        """Share of the trains."""
        return 1 - self.errors.size / self.fit_ms.size

    @property
    def wrong(self) -> int:
        """Fits accepted that are wrong by far, where they vouch for themselves."""
        return self._wrong(self.errors)

    @property
    def wrong_anywhere(self) -> int:
        """Fits accepted that are wrong by far at any pulse that was sent."""
        return self._wrong(self.errors_anywhere)

    def _wrong(self, errors: F64) -> int:
        if self.kind in HOPELESS:
            return int(errors.size)
        return int((errors > FAR * self.stated).sum())

    @property
    def coverage(self) -> tuple[float, float, float]:
        """Share within the stated uncertainty, and the interval of 95 %."""
        held, count = int((self.errors <= self.stated).sum()), self.errors.size
        low = float(special.betaincinv(held, count - held + 1, 0.025)) if held else 0.0
        high = float(special.betaincinv(held + 1, count - held, 0.975)) if held < count else 1.0
        return (held / count if count else float("nan")), low, high

    @property
    def row(self) -> str:
        """One line of the table."""
        share, low, high = self.coverage
        given = (
            ""
            if self.kind in HOPELESS or not self.errors.size
            else (
                f"{100 * share:.1f} ({100 * low:.1f} to {100 * high:.1f}) | "
                f"{np.median(self.stated) / 1e3:.2f}"
            )
        )
        return (
            f"| {self.kind.replace('_', ' ')} | {self.fit_ms.size:,} | {self.wrong} | "
            f"{self.wrong_anywhere} | {100 * self.refused:.2f} | {given or ' | '} | "
            f"{median(self.fit_ms.tolist()):.2f} |"
        )


def measure(trains: int = 200) -> Figures:
    """All kinds as figures."""
    figures: Figures = {"trains": float(trains)}
    for kind in KINDS:
        found = tally(kind, trains)
        figures[f"{kind}_wrong"] = float(found.wrong)
        figures[f"{kind}_refused_share"] = found.refused
        if kind not in HOPELESS and found.errors.size:
            figures[f"{kind}_coverage_95"] = found.coverage[0]
        figures[f"{kind}_fit_ms"] = median(found.fit_ms.tolist())
    return figures


def tally(kind: str, trains: int, seed: int = SEED) -> Tally:
    """Fit so many trains of a kind."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    fits = []
    fit_ms = np.empty(trains)
    for number in range(trains):
        made = faulty_train(rng, kind)
        started = time.perf_counter()
        try:
            fit = fit_clock(made.device, made.reference, max_drift_ppm=DRIFT_PPM)
        except ClockRefused:
            continue
        finally:
            fit_ms[number] = (time.perf_counter() - started) * 1e3
        error = np.abs(fit.map.to_reference(made.true) - made.sent).astype(np.float64)
        vouched = (made.true >= fit.first_ns) & (made.true <= fit.last_ns)
        fits.append((error[vouched].max(initial=0.0), fit.uncertainty_ns, error.max()))
    errors, stated, anywhere = np.array(fits).reshape(-1, 3).T
    return Tally(kind, errors, stated, anywhere, fit_ms)


def faulty_train(rng: np.random.Generator, kind: str) -> StampTrain:
    """A train of `benchmarks.clocks` with one more fault."""
    if kind.startswith("other_trial"):
        return _other_trial(rng, code_bits if kind == "other_trial" else _old_code)
    missing = 0.3 if kind.startswith("lost_30") else None
    made = make_train(rng, missing=missing, clock=lambda sent, tick: _clock(rng, kind, sent, tick))
    if missing is None:
        return made
    there = rng.random(made.reference.size) >= missing
    return StampTrain(made.device, made.reference[there], made.true, made.sent, made.tick_ns)


def _clock(rng: np.random.Generator, kind: str, sent: F64, tick: int) -> F64:
    """Lead of the device's clock at times since the train began, ns."""
    span = float(sent[-1])
    sign = float(rng.choice([-1, 1]))
    away = sign * rng.uniform(0.1, 0.9)
    anywhere = span * abs(away)
    if kind.startswith("kink"):
        ppm = float(kind.removeprefix("kink_").removesuffix("ppm"))
        shift = sign * ppm * 1e-6 * np.maximum(sent - anywhere, 0.0)
    elif kind == "warming":
        # the drift changes all the time, by 3 ppm in all
        shift = sign * 1.5e-6 * sent**2 / span
    elif "jump" in kind:
        at = span * (1 - END) if "end" in kind else span / 2 if "middle" in kind else anywhere
        size = 1e6 if "1ms" in kind else 2e4
        if "ticks" in kind:
            at, size = span / 2, float(rng.integers(1, 20)) * tick
        shift = np.where(sent > at, sign * size, 0.0)
    else:
        shift = np.zeros(sent.size)
    return shift


def _other_trial(rng: np.random.Generator, code: Callable[[int, int], U8]) -> StampTrain:
    """Pulses that the device saw in one trial, with those that the box sent in another as long."""
    seconds, tick = float(rng.uniform(20, 60)), int(rng.choice([10, 20, 50])) * 1_000_000
    one, other = (make_train(rng, seconds=seconds, tick=tick, code=code) for _ in range(2))
    return StampTrain(one.device, other.reference, one.true, one.sent, tick)


def _old_code(seed: int, n: int) -> U8:
    """The code of recordings made before it had 32 bits: stretches of one that has 65,535."""
    begin = seed % 65_535
    return np.resize(np.roll(_old_period(), -begin), n)


@cache
def _old_period() -> U8:
    bits = [1] * 16
    for _ in range(65_535 - 16):
        bits.append(bits[-16] ^ bits[-14] ^ bits[-13] ^ bits[-11])
    return np.array(bits, np.uint8)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.clock_kinds")
    parser.add_argument("trains", nargs="?", type=int, default=10_000)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    print(f"seed {asked.seed}, simulated; trains as in benchmarks/clocks.py, with one more fault\n")
    print(
        "| kind | trains | wrong | wrong anywhere | refused (%) | coverage (%, 95 %) | "
        "stated (us, median) | fit (ms) |"
    )
    print("| --- | --: | --: | --: | --: | --: | --: | --: |")
    for kind in asked.kinds or KINDS:
        print(tally(kind, asked.trains, asked.seed).row, flush=True)


if __name__ == "__main__":
    main()
