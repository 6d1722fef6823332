"""`sliplab.align` on events that two clocks saw, and pyxdf's clock-offset fit beside it.

Simulated. Sources: Harp words (`harp`), pulses at random intervals as Open Ephys recommends
(`random`), and the sync box's pseudo-random code (`code`). Clocks differ by up to 100 ppm and, in
half of the trials, jump once or twice by 50 us to 5 s; stamps jitter by 2 to 50 us; on either side
up to 15 % of the events are missing and 5 % spurious; the recordings begin and end apart.

`coverage`: share of trials in which the interval at a random instant contains the truth.
`wrong`: trials accepted with an error above three times the stated half-width anywhere at 200
instants that events confirm, and all accepted of what must be refused: another session's events,
and regular pulses. `refused`: share of the trials that can be aligned. Errors at the random
instant. pyxdf pairs nothing itself: it is given the true pairs of one trial in ten, and
finds the jumps itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from pyxdf.pyxdf import _clock_sync

from benchmarks.measure import SEED, Figures
from sliplab.plugins.align.align import Alignment, AlignmentRefused, align
from sliplab.plugins.align.events import HARP_BAUD
from sliplab.rigs.core.pulse_code import SEEDS, code_bits
from sliplab.storage.streams import F64, I64

KINDS = ("harp", "random", "code")
FAR = 3.0
"""A map is wrong that is off by so many half-widths."""
INSTANTS = 200
RIVAL = 10
"""One in so many trials is given to pyxdf, which takes longer than all the rest."""


@dataclass(frozen=True)
class Trial:
    """Two lists, as `align` takes them, and the truth.

    Attributes:
        a, b: the lists.
        true_a, true_b: (k,) all true event times on both clocks, ns.
        pair_a, pair_b: stamps of the events that both saw, ns.
        clock: A's time at true times of B, and where A jumped.
    """

    a: Any
    b: Any
    pair_a: I64
    pair_b: I64
    clock: Clock


@dataclass(frozen=True)
class Clock:
    """A's clock, as a function of B's."""

    offset: int
    drift: float
    jumps: tuple[tuple[float, float], ...]

    def at(self, b: F64) -> I64:
        """A's times, ns, at times of B since 0."""
        gained = self.drift * b
        for when, size in self.jumps:
            gained = gained + np.where(b > when, size, 0.0)
        result: I64 = np.rint(b + gained).astype(np.int64) + self.offset
        return result


def measure(trials: int = 1000) -> Figures:
    """Coverage, refusals, wrong maps and errors of each kind."""
    figures: Figures = {"trials": float(trials)}
    for number, kind in enumerate(KINDS):
        figures |= tally(kind, trials, np.random.default_rng([SEED, number]))
    return figures


def tally(kind: str, trials: int, rng: np.random.Generator) -> Figures:
    """Figures of one kind."""
    held, wrong, errors, rival = [], 0, [], []
    for number in range(trials):
        trial = make_trial(kind, rng)
        for a, b in hopeless(kind, trial, rng):
            wrong += _accepted(a, b) is not None
        found = _aligned(kind, trial)
        if found is None:
            continue
        instants = np.sort(rng.uniform(trial.pair_b[0], trial.pair_b[-1], INSTANTS))
        true = np.rint(instants).astype(np.int64)
        mapped = found.map(trial.clock.at(instants))
        error = np.abs(mapped.ns - true).astype(np.float64)
        half = (mapped.high_ns - mapped.low_ns) / 2
        seen = np.flatnonzero(mapped.within)
        if not seen.size:
            continue
        wrong += bool((error[seen] > FAR * half[seen]).any())
        one = int(rng.choice(seen))
        held.append(mapped.low_ns[one] <= true[one] <= mapped.high_ns[one])
        errors.append(error[one] / 1e3)
        if number % RIVAL:
            continue
        rival.append(abs(_by_pyxdf(trial, int(trial.clock.at(instants)[one])) - true[one]) / 1e3)
    return {
        f"{kind}_coverage": float(np.mean(held)),
        f"{kind}_wrong": float(wrong),
        f"{kind}_refused": 1 - len(held) / trials,
        f"{kind}_error_us": float(np.median(errors)),
        f"{kind}_error_p95_us": float(np.quantile(errors, 0.95)),
        f"{kind}_pyxdf_error_us": float(np.median(rival)),
        f"{kind}_pyxdf_error_p95_us": float(np.quantile(rival, 0.95)),
    }


def make_trial(kind: str, rng: np.random.Generator, jumps: int | None = None) -> Trial:
    """A trial of a kind, with so many jumps; by default none in half of them, else 1 or 2."""
    true = _events(kind, rng)
    span = float(true[-1])
    if jumps is None:
        jumps = int(rng.choice([0, 0, 1, 2]))
    places = (np.arange(jumps) + rng.uniform(0.3, 0.7, jumps)) / max(jumps, 1)
    sizes = rng.choice([-1, 1], jumps) * 10 ** rng.uniform(np.log10(5e4), np.log10(5e9), jumps)
    clock = Clock(
        int(rng.integers(-(10**15), 10**15)),
        rng.uniform(-100e-6, 100e-6),
        tuple(zip((places * span).tolist(), sizes.tolist(), strict=True)),
    )
    jitter = 10 ** rng.uniform(np.log10(2e3), np.log10(5e4))
    begins, ends = rng.uniform(0, 0.1, 2) * span, (1 - rng.uniform(0, 0.1, 2)) * span
    stamps, there = [], []
    for side, times in enumerate((clock.at(true.astype(np.float64)), true)):
        there.append((true >= begins[side]) & (true <= ends[side]))
        there[-1] &= rng.random(true.size) >= rng.uniform(0, 0.15)
        stamps.append(times + np.rint(rng.normal(0, jitter, true.size)).astype(np.int64))
    both = there[0] & there[1]
    if kind == "harp":
        first = int(rng.integers(10**8, 10**9))
        seconds = first + np.arange(true.size)
        lists = [
            _harp_edges(times[at], seconds[at], rng)
            for times, at in zip(stamps, there, strict=True)
        ]
    else:
        lists = [_with_spurious(times[at], rng) for times, at in zip(stamps, there, strict=True)]
    return Trial(lists[0], lists[1], stamps[0][both], stamps[1][both], clock)


def _events(kind: str, rng: np.random.Generator) -> I64:
    if kind == "harp":
        return np.arange(int(rng.integers(120, 600)), dtype=np.int64) * 10**9
    if kind == "random":
        steps = rng.uniform(0.2e9, 1.8e9, int(rng.integers(150, 900)))
        return np.rint(np.cumsum(steps)).astype(np.int64)
    tick = int(rng.choice([10, 20, 50])) * 1_000_000
    bits = code_bits(int(rng.integers(1, SEEDS)), int(rng.uniform(20, 60) * 1e9 / tick))
    return np.flatnonzero(bits).astype(np.int64) * tick


def _with_spurious(times: I64, rng: np.random.Generator) -> I64:
    """Events in the order of recording, with spurious ones among them."""
    extra = int(rng.uniform(0, 0.05) * times.size)
    where = np.sort(rng.choice(times.size - 1, extra, replace=False))
    step = np.maximum(times[where + 1] - times[where], 0)
    stray = times[where] + np.rint(rng.random(where.size) * step).astype(np.int64)
    return np.insert(times, where + 1, stray)


def _harp_edges(times: I64, seconds: I64, rng: np.random.Generator) -> tuple[I64, I64]:
    """Edges and levels of words, of which some lose an edge or get another one."""
    edges: list[float] = []
    levels: list[int] = []
    bit = 1e9 / HARP_BAUD
    broken = rng.uniform(0, 0.05)
    for begin, second in zip(times.tolist(), seconds.tolist(), strict=True):
        word = [
            level
            for byte in int(second).to_bytes(4, "little")
            for level in (0, *((byte >> k) & 1 for k in range(8)), 1)
        ]
        changes = np.flatnonzero(np.diff([1, *word]))
        if rng.random() < broken:
            changes = np.delete(changes, int(rng.integers(1, changes.size)))
        # what is integer in float64 up to 104 days stays exact
        edges += [begin + round(int(k) * bit) for k in changes]
        levels += [word[k] for k in changes]
    return np.array(edges, np.int64), np.array(levels, np.int64)


def hopeless(kind: str, trial: Trial, rng: np.random.Generator) -> list[tuple[Any, Any]]:
    """Pairs of lists that must be refused."""
    if kind == "harp":
        return []
    other = make_trial(kind, rng, jumps=0)
    regular = np.arange(400, dtype=np.int64) * 500_000_000
    jitter = np.rint(rng.normal(0, 20_000, (2, regular.size))).astype(np.int64)
    return [(trial.a, other.b), (regular[50:] + 7 + jitter[0, 50:], (regular + jitter[1])[:350])]


def _aligned(kind: str, trial: Trial) -> Alignment | None:
    return _accepted(trial.a, trial.b, harp=kind == "harp")


def _accepted(a: Any, b: Any, harp: bool = False) -> Alignment | None:
    try:
        return align(a, b, harp=harp)
    except AlignmentRefused:
        return None


def _by_pyxdf(trial: Trial, a: int) -> float:
    """B's time by pyxdf's regression through the true pairs, with its own search for jumps, ns."""
    origin_a, origin_b = int(trial.pair_a[0]), int(trial.pair_b[0])
    times = (trial.pair_a - origin_a) / 1e9
    stream = SimpleNamespace(
        clock_times=times.tolist(),
        clock_values=((trial.pair_b - origin_b) / 1e9 - times).tolist(),
        time_stamps=np.array([(a - origin_a) / 1e9]),
        clock_segments=[],
    )
    _clock_sync({0: stream})
    return float(stream.time_stamps[0]) * 1e9 + origin_b
