"""The map between two clocks by events that both saw."""

from __future__ import annotations

import csv
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import sliplab
from benchmarks.align import KINDS, make_trial
from sliplab import AlignmentRefused, InputError
from sliplab.plugins.align.align import UNKNOWN
from sliplab.plugins.align.clock_state import ClockState
from sliplab.plugins.align.events import events_from
from sliplab.rigs.core.pulse_code import code_bits
from sliplab.storage.streams import F64
from tests.command_line import answer, here

RNG = 4


def _random_events(n: int = 200, seed: int = RNG) -> F64:
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.2, 1.8, n))


def _regular() -> tuple[F64, F64]:
    rng = np.random.default_rng(RNG)
    b = np.arange(100.0)
    a = b * (1 + 60e-6) - 1000.0
    return a[5:] + rng.normal(0, 20e-6, 95), b[:90]


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", KINDS)
def test_intervals_hold_and_jumps_are_placed(kind: str) -> None:
    rng = np.random.default_rng(RNG)
    held, far = [], 0
    for _ in range(12):
        trial = make_trial(kind, rng, jumps=1)
        found = sliplab.align(trial.a, trial.b, harp=kind == "harp")
        instants = np.linspace(trial.pair_b[0], trial.pair_b[-1], 50)
        true = np.rint(instants).astype(np.int64)
        mapped = found.map(trial.clock.at(instants))
        at = mapped.within
        half = (mapped.high_ns - mapped.low_ns) / 2
        far += int((np.abs(mapped.ns - true) > 3 * half)[at].sum())
        held.append(((mapped.low_ns <= true) & (true <= mapped.high_ns))[at].mean())
        for jump in found.jumps:
            when, size = trial.clock.jumps[0]
            assert jump.size_ns == pytest.approx(-size, abs=1e5)
            low, high = sorted((jump.after_ns, jump.before_ns))
            there = trial.clock.at(np.array([when, when + 1.0]))
            assert low <= there.max()
            assert there.min() <= high
    assert far == 0
    assert np.mean(held) > 0.85


def test_events_of_another_session_are_refused() -> None:
    with pytest.raises(AlignmentRefused) as refused:
        sliplab.align(_random_events(seed=1), _random_events(seed=2))
    assert refused.value.reason in {"ambiguous", "no_match"}


def test_regular_pulses_are_ambiguous_without_an_offset() -> None:
    a, b = _regular()
    with pytest.raises(AlignmentRefused, match="or give an approximate offset"):
        sliplab.align(a, b)
    with pytest.raises(AlignmentRefused, match=r"events of B come 1 s apart.*0\.6"):
        sliplab.align(a, b, offset_s=1000.0, within_s=0.6)
    found = sliplab.align(a, b, offset_s=1000.1, within_s=0.3)
    assert found.by == "offset"
    assert found.stretches[0].rate_ppm == pytest.approx(-60, abs=1)
    mapped = found.map(np.array([-950.0]))
    assert mapped.ns[0] == pytest.approx(50e9 * (1 - 60e-6), abs=3e4)
    assert mapped.low_ns[0] < mapped.ns[0] < mapped.high_ns[0]


def test_few_taps_align_by_an_offset() -> None:
    taps = np.array([1.0, 2.3, 4.1, 7.7, 9.2, 12.0])
    noise = np.random.default_rng(RNG).normal(0, 1e-3, 6)
    found = sliplab.align(taps + 50.0, np.append(taps + noise, 14.0), offset_s=-50.0, within_s=0.2)
    assert found.stretches[0].events == 6
    mapped = found.map(np.array([56.0]))
    assert mapped.low_ns[0] < 6e9 < mapped.high_ns[0]


def test_ids_pair_events_and_bad_ones_are_left_out() -> None:
    times = np.arange(60) * 30.0
    ids = np.arange(60) + 7
    other = ids.copy()
    other[10] = 50
    b = times * (1 - 40e-6) + np.random.default_rng(RNG).normal(0, 1e-5, 60)
    found = sliplab.align((times + 5.0, ids), (b, other))
    assert found.by == "ids"
    assert found.stretches[0].rate_ppm == pytest.approx(-40, abs=0.2)


def test_seconds_of_a_harp_clock_are_its_times() -> None:
    trial = make_trial("harp", np.random.default_rng(RNG), jumps=0)
    words = events_from(trial.a, "a", harp=True)
    found = sliplab.align(trial.a, "harp", harp=True)
    mapped = found.map(words.ns)
    assert np.abs(mapped.ns - words.ids * 10**9).max() < 300_000


def test_clock_that_falls_back_maps_to_an_interval_that_contains_both_times() -> None:
    b = _random_events(400)
    a = b.copy()
    a[200:] -= 5.0
    found = sliplab.align(a, b)
    assert len(found.jumps) == 1
    mapped = found.map(a[[50, 198, 201, 350]])
    for true, low, high in zip(
        b[[50, 198, 201, 350]], mapped.low_ns / 1e9, mapped.high_ns / 1e9, strict=True
    ):
        assert low - 1e-5 <= true <= high + 1e-5
    assert mapped.high_ns[1] - mapped.low_ns[1] > 4.9e9
    assert mapped.high_ns[0] - mapped.low_ns[0] < 1e6


def test_a_stretch_that_fits_nowhere_is_unknown() -> None:
    b = _random_events(400)
    a = b.copy()
    a[250:] += 3.0
    a[150:250] = np.sort(np.random.default_rng(9).uniform(a[150], a[249], 100))
    found = sliplab.align(a, b)
    mapped = found.map(a[[60, 200, 340]])
    assert mapped.known.tolist() == [True, False, True]
    assert mapped.ns[1] == UNKNOWN


def test_intervals_widen_beyond_the_events() -> None:
    b = _random_events()
    a = b + np.random.default_rng(RNG).normal(0, 1e-5, b.size)
    mapped = sliplab.align(a, b).map(np.array([a[0] - 60, a[100], a[-1] + 60]))
    assert mapped.within.tolist() == [False, True, False]
    half = (mapped.high_ns - mapped.low_ns) / 2
    assert half[[0, 2]].min() > 20 * half[1]


@pytest.mark.parametrize(
    ("a", "options", "text"),
    [
        ([1.0, float("nan")], {}, "must be a finite time"),
        ([[1.0]], {}, "must be one row of numbers"),
        ([1.0] * 9, {"unit": "h"}, "must be one of s, ms, us, ns"),
        ([1.0] * 9, {"max_drift_ppm": 0}, r"must be in \(0, 50000\]"),
        ([1.0] * 9, {"within_s": -1.0, "offset_s": 1.0}, "must be positive"),
        ([1e12] * 9, {}, "check their unit"),
        ([10**12] * 9, {"unit": "s"}, "check their unit"),
        (np.full(9, 2**63 + 1, np.uint64), {}, "check their unit"),
    ],
)
def test_wrong_arguments_are_named(a: Any, options: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        sliplab.align(a, _random_events(), **options)


def test_too_few_events_are_refused() -> None:
    with pytest.raises(AlignmentRefused, match="a has 4 events"):
        sliplab.align([1.0, 2.0, 3.0, 4.0], _random_events())


def test_command_writes_mapped_times(tmp_path: Path) -> None:
    b = _random_events()
    a = b * (1 + 5e-6) + 12.5
    _write(tmp_path / "a.csv", "time_ms", a * 1e3)
    _write(tmp_path / "b.csv", "t", b)
    _write(tmp_path / "grasps.csv", "t", [a[40]])
    done = here(
        "align", tmp_path / "a.csv", tmp_path / "b.csv", "--map", tmp_path / "grasps.csv",
        "--out", tmp_path / "out.csv", "--json",
    )  # fmt: skip
    assert json.loads(done.stdout)["times"] == 1
    with (tmp_path / "out.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert int(row["b_low_ns"]) - 1000 <= b[40] * 1e9 <= int(row["b_high_ns"]) + 1000


def test_command_refuses_with_its_reason(tmp_path: Path) -> None:
    _write(tmp_path / "a.csv", "t", np.arange(100.0))
    done = here("align", tmp_path / "a.csv", tmp_path / "a.csv", "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["refused"] == "ambiguous"


A = _random_events() + 12.5
LINES = [f"{t:.9f}" for t in A]
PLAIN = "\n".join(["t", *LINES])
LINE_5 = f"\n{LINES[3]}\n"


def _table(heading: str, row: str, factor: float = 1.0) -> str:
    return "\n".join([heading, *(row.format(factor * t, k=k) for k, t in enumerate(A))])


# what a file holds, and the column that is used or the fault that is named
FILES: dict[str, tuple[str | bytes, str]] = {
    "BOM": ("\ufeff" + PLAIN, "t (s)"),
    "CRLF": (PLAIN.replace("\n", "\r\n"), "t (s)"),
    "UTF-16": (PLAIN.encode("utf-16"), "t (s)"),
    "comment": ("# made by hand\n\n" + PLAIN, "t (s)"),
    "no heading": (PLAIN[2:], "t (s)"),
    "semicolons": (_table("t;x", "{:.9f};1"), "t (s)"),
    "tabs": (_table("\tTime [ms]", "{k}\t{:.6f}", 1e3), "Time [ms] (ms)"),
    "two words": (_table("Time [ms]", "{:.6f}", 1e3), "Time [ms] (ms)"),
    "micro": (_table("time (µs)", '"{:.3f}"', 1e6), "time (µs) (us)"),
    "one with a unit": (_table("frame,seen_ms", "{k},{:.6f}", 1e3), "seen_ms (ms)"),
    "only one": (_table("stamp", "{:.9e}"), "stamp (s)"),
    "empty": (b"", "is empty; its first line names the columns"),
    "only a heading": ("t\n", "is empty below its heading t"),
    "binary": (b"\0" * 99, "byte 0: is no text"),
    "Latin-1": ("Zeit µs\n1".encode("latin-1"), "byte 5: is not UTF-8 text"),
    "gzip": (gzip.compress(PLAIN.encode()), "is a workbook or compressed: save it as CSV"),
    "Excel": (b"PK\3\4", "is a workbook or compressed: save it as CSV"),
    "huge": (b"1\n" * 600, "is larger than 0 MiB: leave out rows"),
    "unknown": (_table("frame,stamp", "{k},{:.9f}"), "heading = frame, stamp: name the column"),
    "long rows": (_table("1", "{k},{:.9f}"), "row 2: has 2 cells below a heading of 1 column"),
    "decimal comma": (PLAIN.replace(".", ","), "1 column; a number has a decimal point"),
    "German": (_table("t;x", "{:.9f};1").replace(".", ","), "a number, with a decimal point"),
    "NaN": (PLAIN.replace(LINE_5, "\nNaN\n"), "row 5, t = NaN: must be a time in s"),
    "word": (PLAIN.replace(LINE_5, "\nlate\n"), "row 5, t = late: must be a time in s"),
    "empty cell": (_table("t,x", "{:.9f},1").replace(LINES[3], ""), "row 5, t: must be a time"),
    "thousands": (_table("t", '"{:,.0f}"', 1e6), "row 2, t = "),
    "ns as s": (_table("t", "{:.0f}", 1e9), "is no time in s: name the unit by --unit"),
    "ids of text": (_table("t,id", "{:.9f},e{k}"), "row 2, id = e0: must be a whole number"),
    "broken ids": (_table("t,id", "{:.9f},{k}.5"), "row 2, id = 0.5: must be a whole number"),
    "levels of text": (_table("t,state", "{:.9f},up"), "row 2, state = up: must be 0 or 1"),
    "no rising edge": (_table("t,state", "{:.9f},0"), "state: is 0 in every row"),
    "all equal": (_table("t", "3"), "row 2 = 3 s: is the time of all 200 events"),
    "reversed": ("\n".join(["t", *LINES[::-1]]), "as 198 others: not in order; sort the events"),
    "row of disorder": ("\n".join(["t", *LINES[::-1]]), f"row 3 = {A[-2]:.9g} s: is earlier"),
}


@pytest.mark.quick(10)
@pytest.mark.parametrize("name", FILES)
def test_files_of_strangers_are_read_or_their_fault_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    data, text = FILES[name]
    if name == "huge":
        monkeypatch.setattr("sliplab.storage.formats.tables.MOST_TABLE", 1000)
    a, b = tmp_path / "a.csv", tmp_path / "b.csv"
    a.write_bytes(data if isinstance(data, bytes) else data.encode())
    _write(b, "t", A - 12.5)
    done = here("align", a, b, "--json")
    if done.returncode == 0:
        assert json.loads(done.stdout)["columns"]["a"] == text
    else:
        assert done.returncode == 2
        assert text in done.stderr
        assert str(a) in done.stderr


# lists that are refused, and the likely cause
PAIRS = {
    "A in ms": (_table("t", "{:.6f}", 1e3), PLAIN, "1e3 times those of B: check the units"),
    "us as s": (
        _table("t", "{:.1f}", 1e6),
        "\n".join(["t", *(f"{5e6 * t:.1f}" for t in _random_events(seed=9))]),
        "s apart: is the unit right?; ",
    ),
    "B in ms": (PLAIN, _table("t", "{:.6f}", 1e3), "1e-3 times those of B: check the units"),
    "two parts": (
        "\n".join(["t", *LINES[100:], *LINES[:100]]),
        _table("t", "{k}"),
        f"row 102 = {A[0]:.9g} s: is earlier",
    ),
    "reversed ids": (
        "\n".join(["t,id", *(f"{t:.9f},{199 - k}" for k, t in enumerate(A))]),
        _table("t,id", "{:.9f},{k}"),
        "as no two clocks do: check that the ids of both mean the same, in the same order",
    ),
    "equal ids": (
        _table("t,id", "{:.9f},7"),
        _table("t,id", "{:.9f},{k}"),
        "0 ids in both lists, once in each; at least 5 are needed",
    ),
    "one event": ("t\n1", PLAIN, "has 1 event; at least 5 are needed"),
}


@pytest.mark.parametrize("name", PAIRS)
def test_refusals_name_the_likely_cause(tmp_path: Path, name: str) -> None:
    first, second, text = PAIRS[name]
    (tmp_path / "a.csv").write_text(first)
    (tmp_path / "b.csv").write_text(second)
    done = here("align", tmp_path / "a.csv", tmp_path / "b.csv")
    assert done.returncode == 1
    assert text in " ".join(done.stderr.split())
    assert "raise it" not in done.stderr


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--map", "b.csv"], "--map = b.csv: needs --out"),
        (["--out", "none/c.csv"], "--out = none/c.csv: its folder does not exist"),
        (["--unit", "h"], "unit = h: must be one of s, ms, us, ns"),
        (["--unit", "kg"], "--unit = kg: must be one of s, ms"),
        (["--unit", "ms"], "heading = t_s: names the unit s, and --unit ms: leave one out"),
        (["--within", "0.2"], "--within = 0.2: needs --offset"),
        (["--taps", "--harp"], "--taps = true: goes without --harp"),
        (["--taps", "--out", "c.csv"], "--out = c.csv: needs --map"),
    ],
)
def test_wrong_options_are_named(tmp_path: Path, options: list[str], text: str) -> None:
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(PLAIN.replace("t\n", "t_s\n", 1))
    done = here("align", tmp_path / "a.csv", tmp_path / "b.csv", *options)
    assert done.returncode == 2
    assert text in done.stderr


def test_taps_of_a_harp_clock_and_times_that_fall_back_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,pull\n1.5,0\n1.25,1\n")
    for b, text in (
        ("harp", "B.csv = harp: must be a file with a signal"),
        (tmp_path / "a.csv", "sample 2 = 1.25 s: falls back behind the one before"),
    ):
        done = here("align", tmp_path / "a.csv", b, "--taps")
        assert done.returncode == 2
        assert text in " ".join(done.stderr.split())


def test_times_beyond_the_events_are_counted_and_an_older_file_is_kept(tmp_path: Path) -> None:
    taps = np.cumsum(np.random.default_rng(RNG).uniform(0.5, 1.5, 40))
    _write(tmp_path / "a.csv", "t", taps)
    _write(tmp_path / "b.csv", "t", taps + 7.0)
    _write(tmp_path / "asked.csv", "t", [taps[3], 1e6])
    files = [tmp_path / name for name in ("a.csv", "b.csv")]
    more = ("--map", tmp_path / "asked.csv", "--out", tmp_path / "out.csv")
    made = answer("align", *files, *more)
    assert (made["times"], made["unknown"], made["beyond_events"]) == (2, 0, 1)
    written = (tmp_path / "out.csv").read_bytes()
    done = here("align", *files, *more)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert (tmp_path / "out.csv").read_bytes() == written


def test_times_too_far_for_any_interval_are_unknown(tmp_path: Path) -> None:
    taps = np.cumsum(np.random.default_rng(RNG).uniform(0.5, 1.5, 40))
    asked = np.array([-4.5e9, -1e9, -1e8, 1e8, 1e9, 4.5e9])
    mapped = sliplab.align(taps, taps + 7.0).map(asked)
    assert mapped.known.tolist() == [False, False, True, True, False, False]
    assert (mapped.far == ~mapped.known).all()
    assert (mapped.ns[mapped.far] == UNKNOWN).all()
    assert (mapped.low_ns < mapped.ns)[mapped.known].all()
    assert (mapped.ns < mapped.high_ns)[mapped.known].all()
    late = sliplab.align(taps + 4.5e9, taps - 4.5e9).map(taps[:3] + 4.5e9)
    np.testing.assert_allclose(late.ns / 1e9, taps[:3] - 4.5e9, rtol=0, atol=1e-5)
    for name, values in (("a", taps), ("b", taps + 7.0), ("asked", asked)):
        _write(tmp_path / f"{name}.csv", "t", values)
    files = [tmp_path / name for name in ("a.csv", "b.csv")]
    done = here("align", *files, "--map", tmp_path / "asked.csv", "--out", tmp_path / "out.csv")
    assert done.returncode == 0
    said = " ".join(done.stderr.split())
    assert "warning: 4 times of 6, such as -4.5e+09 s, so far from the events" in said
    assert "wrong unit or origin?" in said
    assert (tmp_path / "out.csv").read_text().count(",,,,0\n") == 4


def test_taps_in_two_signals_align_their_clocks(tmp_path: Path) -> None:
    rng, taps = np.random.default_rng(RNG), np.array([2.0, 7.5])
    for name, rate, offset in (("a", 400.0, 0.0), ("b", 1000.0, -3.25)):
        t = np.arange(0, 10, 1 / rate)
        since = t[:, None] - taps
        force = 80 * np.where(since >= 0, np.exp(-np.abs(since) / 0.02), 0).sum(axis=1)
        values = force + rng.normal(0, 0.1, t.size)
        rows = (f"{1e3 * (at + offset):.4f},{x:.4f}" for at, x in zip(t, values, strict=True))
        (tmp_path / f"{name}.csv").write_text("\n".join(["time_ms,force_n", *rows]))
    found = answer("align", tmp_path / "a.csv", tmp_path / "b.csv", "--taps")
    assert (found["paired_by"], found["taps"]) == ("taps", 2)
    assert abs(found["offset_ns"] + 3.25e9) <= found["half_ns"] < 6e6
    by_array = sliplab.align_taps((t + 100.0, values), (t - 3.25, values))
    mapped = by_array.map([107.5])
    assert mapped.low_ns[0] <= round((7.5 - 3.25) * 1e9) <= mapped.high_ns[0]
    with pytest.raises(AlignmentRefused, match="no clear tap"):
        sliplab.align_taps((t, rng.normal(size=t.size)), (t, values))
    with pytest.raises(InputError, match="finite"):
        sliplab.align_taps((t, np.where(t > 5, np.nan, values)), (t, values))


def _write(path: Path, name: str, values: Any) -> None:
    path.write_text("\n".join([name, *(f"{value:.9f}" for value in values)]) + "\n")


@pytest.mark.parametrize("n", [5, 8, 30])
def test_a_straight_clock_has_the_interval_of_least_squares(n: int) -> None:
    rng = np.random.default_rng(n)
    x = np.sort(rng.uniform(0, 1e11, n))
    state = ClockState.through(x, x + rng.normal(0, 1e4, n))
    asked = np.linspace(-5e10, 1.5e11, 9)
    gain, half = state.at(asked)
    slope, level = np.polyfit(x, state.gained + state.slope * (x - x[0]) + state.level, 1)
    rest = state.gained + state.slope * (x - x[0]) + state.level - slope * x - level
    variance = (rest**2).sum() / (n - 2)
    spread = variance * (1 / n + (asked - x.mean()) ** 2 / ((x - x.mean()) ** 2).sum())
    # one that wanders unseen widens it
    expected = stats.t.ppf(0.975, n - 2) * np.sqrt(spread)
    assert (half > 0.99 * expected).all()
    assert (half < (1.01 if n < 12 else 2.0) * expected).all()
    if n < 12:
        np.testing.assert_allclose(gain, slope * asked + level, atol=1e-2 * half.min())


def test_times_beside_a_piece_that_could_not_be_aligned_are_unknown() -> None:
    # ten events, too few for a pattern, then A falls back
    b = _random_events(120)
    a = np.where(np.arange(120) < 10, b, b - 3.0)
    found = sliplab.align(a, b)
    (stretch,) = found.stretches
    assert stretch.events >= 100
    begin, end = int(1e9 * a[0]), int(1e9 * a[9])
    ((low, high),) = found.unclear_ns
    # the clock may have fallen back anywhere between two events
    assert low < begin
    assert high > end + int(1e9 * (b[10] - b[9]))
    asked = np.array([begin, end, end + 10_000_000, int(1e9 * a[60])])
    assert found.map(asked).known.tolist() == [False, False, False, True]


@pytest.mark.parametrize("seed", range(8))
def test_a_clock_that_jumps_every_few_events_is_refused_or_right(seed: int) -> None:
    rng = np.random.default_rng(seed)
    b = _random_events(200, seed)
    steps = np.zeros(200)
    places = np.cumsum(rng.integers(3, 40, 30))
    places = places[places < 200]
    steps[places] = rng.choice([-1, 1], places.size) * 10 ** rng.uniform(-4, 0, places.size)
    clock = b + np.cumsum(steps)
    a, ids = clock + rng.normal(0, 1e-5, 200), np.arange(200)
    try:
        found = sliplab.align((a, ids), (b, ids))
    except AlignmentRefused:
        return
    mapped = found.map(clock)
    half = (mapped.high_ns - mapped.low_ns) / 2
    off = np.abs(mapped.ns - np.rint(1e9 * b))
    assert (off <= 3 * half)[mapped.within].all()


@pytest.mark.parametrize("name", ["a.csv", "b.csv"])
def test_a_file_that_is_read_is_not_written_over(tmp_path: Path, name: str) -> None:
    for file in ("a.csv", "b.csv"):
        (tmp_path / file).write_text("t\n" + "\n".join(map(str, _random_events(60))))
    before = (tmp_path / name).read_bytes()
    said = here("align", tmp_path / "a.csv", tmp_path / "b.csv", "--out", tmp_path / name)
    assert said.returncode == 2
    assert "name another file" in said.stderr
    assert (tmp_path / name).read_bytes() == before


@pytest.mark.parametrize("wrong", [None, np.arange(9.0), ([], []), ([0.0, 1.0], ["a", "b"])])
def test_what_is_no_signal_with_taps_is_named(wrong: Any) -> None:
    with pytest.raises(InputError, match=r"a pair of times and values of numbers|has no samples"):
        sliplab.align_taps(wrong, wrong)


@pytest.mark.parametrize("seed", [3, 5, 11])
def test_pairs_by_chance_behind_a_jump_are_no_stretch(seed: int) -> None:
    """A jump by 39 ticks of a code and 30 us, with a jitter of 7 us."""
    rng = np.random.default_rng(seed)
    b = np.flatnonzero(code_bits(seed + 1, 4000)).astype(np.int64) * 10_000_000
    a = b + 390_030_000 * (b > 20_000_000_000)
    jittered = [each + np.rint(rng.normal(0, 7000, b.size)).astype(np.int64) for each in (a, b)]
    found = sliplab.align(*jittered)
    (jump,) = found.jumps
    assert jump.size_ns == pytest.approx(-390_030_000, abs=10_000)
    mapped = found.map(a)
    assert np.abs(mapped.ns - b)[mapped.within].max() < 10_000
    assert mapped.within.mean() > 0.9
