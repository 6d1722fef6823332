"""The benchmarks run and say what they should, on sizes too small to mean anything."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as command
from benchmarks import exchange, kept, measure
from benchmarks.trials import open_session

TINY: dict[str, dict[str, Any]] = {
    "storage": {"events": 30_000, "frames": 3, "size": 96, "runs": 1},
    "scene": {"length_mm": 1.0, "runs": 1, "trials": 0, "grid": 8},
    "clocks": {"trains": 3},
    "clock_kinds": {"trains": 2},
    "align": {"trials": 2},
    "labels": {"frames": 5, "runs": 1},
    "orchestration": {"trials": 30, "runs": 1, "records": 50, "starts": 0, "long": 40},
    "acquisition": {"seconds": 0.5, "events_per_s": 100_000, "size": 96, "pictures": 4}
    | {"saturating": 20},
    "exchange_memory": {"events": 20_000, "forms": ("dsec",)},
    "page": {"runs": 1, "seconds": 3.0},
    "fewer": {"worlds": 1, "adaptive": 1, "cores": 1},
    "statements": {"campaigns": 1, "cores": 1},
}
FILES = ("write_m_events_per_s", "read_m_events_per_s", "window_30ms_ms", "bytes_per_event")
PROMISED = {
    "orchestration": {"loop_ms", "batched_ms", "per_trial_ms", "bluesky_ms", "bluesky_plan_ms"}
    | {"catalogue_build_s", "catalogue_100k_s", "memory_growth_mb", "server_growth_mb"},
    "storage": {f"{kind}{name}" for kind in ("", "pickle_", "aedat4_") for name in FILES}
    | {"frames_per_s_800", "aedat4_own_read_m_events_per_s", "aedat4_own_read_ratio"},
    "scene": {"contact_8_s", "ns_per_event", "ns_per_event_busy", "x_circuit"}
    | {"x_circuit_low_pass", "event_time_p95_us", "readout_p95_us"},
    "clocks": {"worst_error_us", "accepted_share", "wrong_accepted", "fit_ms", "coverage_95"}
    | {f"{rival}_worst_error_us" for rival in ("index", "nearest", "pyxdf")},
    "clock_kinds": {"good_wrong", "good_refused_share", "good_coverage_95", "other_trial_wrong"}
    | {"jump_1ms_at_end_wrong", "lost_30_on_both_refused_share", "kink_0.2ppm_coverage_95"},
    "align": {f"{kind}_{name}" for kind in ("harp", "random", "code") for name in ("coverage",)}
    | {"harp_wrong", "random_refused", "code_pyxdf_error_us"},
    "acquisition": {"frames_lost", "events_lost", "pulses_lost", "memory_growth_mb"}
    | {"saturation_x_realtime", "encode_s_per_trial", "frames_per_s"}
    | {"dropped_on_purpose", "dropped_noticed"},
    "labels": {"x_blob_detector", "x_best_opencv", "centroid_diff_px", "decode_track_x_realtime"}
    | {"aruco_x_realtime"},
    "exchange_memory": {"dsec_import_peak_mb", "dsec_export_peak_mb"},
    "page": {"page_core_percent", "page_memory_mb", "watched_over_alone", "pictures_per_s"}
    | {"feed_core_percent"},
    "fewer": {f"{way}_worst_claim_wrong_percent" for way in ("shuffled", "adaptive")}
    | {f"{way}_true_trials_percent" for way in ("shuffled", "adaptive")}
    | {"adaptive_over_shuffled"},
    "statements": {
        "median of a time, blocks differ by 50 %: wrong_percent",
        "mean of a share, AR(1) of 0.9: held_percent",
        "median of a time, drift of 100 %; adaptive: wrong_percent",
        "16 clusters, 50% of the variance between worlds: held_percent",
    },
}
MARKS = dict.fromkeys(("scene", "fewer", "statements", "orchestration", "page"), pytest.mark.long)
MARKS["acquisition"] = pytest.mark.realtime
"""The scene's takes longest to compile, and is all of it elsewhere in the tests; `fewer` has whole
campaigns, and `orchestration` servers."""


@pytest.mark.quick(2)
@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in TINY])
def test_a_benchmark_gives_what_is_promised(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole: Callable[..., command.Result] = command.result
    monkeypatch.setattr(command, "result", lambda wanted: whole(wanted, **TINY[wanted]))
    monkeypatch.setattr("sys.argv", ["benchmarks", name, "--json"])
    assert command.main() == 0
    (line,) = capsys.readouterr().out.splitlines()
    found = json.loads(line)
    assert set(found) == {"name", "figures", "versions", "machine", "seed", "day"}
    assert found["name"] == name
    assert found["figures"].keys() >= PROMISED[name]
    for figure, value in found["figures"].items():
        assert isinstance(value, float), figure
        assert math.isfinite(value), figure
        assert value >= 0 or figure.endswith("growth_mb"), figure
        low, high = (found["figures"].get(f"{figure}_{end}", value) for end in ("min", "max"))
        assert low <= value <= high
    assert set(found["machine"]) == {"cpu", "cores", "memory_gb", "os"}
    assert found["versions"].keys() >= {"python", "sliplab", "numpy"}
    if name == "acquisition":
        lost = [found["figures"][f"{what}_lost"] for what in ("frames", "events", "pulses")]
        assert lost == [0, 0, 0]
        dropped = [found["figures"][f"dropped_{what}"] for what in ("on_purpose", "noticed")]
        assert dropped == [25, 25]
    if name == "clocks":
        assert (found["figures"]["accepted_share"], found["figures"]["wrong_accepted"]) == (1, 0)


def test_rivals_take_turns() -> None:
    order: list[str] = []
    taken = measure.alternate(2, a=lambda: order.append("a"), b=lambda: order.append("b"))
    assert "".join(order) == "ababab"  # the first round does not count
    assert {name: len(times) for name, times in taken.items()} == {"a": 2, "b": 2}


def test_ratios_are_of_pairs() -> None:
    found = measure.ratio("x", [4.0, 9.0, 2.0], [2.0, 3.0, 2.0])
    assert found == {"x": 2.0, "x_min": 1.0, "x_max": 3.0}


def a_result(name: str, day: str, **figures: float | None) -> dict[str, Any]:
    machine = {"cpu": "some", "cores": 2, "memory_gb": 8.0, "os": "an OS"}
    known = {"versions": {"python": "3"}, "machine": machine, "seed": 1}
    return {"name": name, "figures": figures, "day": day, **known}


def test_the_page_has_every_figure_once(tmp_path: Path) -> None:
    names = ("storage", "scene", "clocks")
    folder, page = tmp_path / "results", tmp_path / "RESULTS.md"
    figures = {"a_ms": 1.25, "a_ms_min": 1.0, "a_ms_max": 2.0, "b_mb": 1234.5, "c_ms": None}
    first = a_result("scene", "2026-01-01", **figures)
    kept.keep(first, names, folder, page)
    kept.keep(a_result("storage", "2026-01-02", d=1.0), names, folder, page)
    kept.keep(a_result("clocks", "2026-01-01", e=5.0), names, folder, page)
    text = page.read_text()
    for row in ("| a_ms | 1.25 (1 to 2) |", "| b_mb | 1,234 |", "| c_ms | - |"):
        assert row in text
    titles = [line for line in text.splitlines() if line.startswith("## ")]
    assert titles == [f"## {name}" for name in names]
    assert "**Run 1**: 2026-01-02, some, 2 cores" in text
    assert "**Run 2**: 2026-01-01, some, 2 cores" in text
    assert text.index("As run 2.") > text.index("## clocks")
    kept.keep(a_result("scene", "2026-01-03", a_ms=1.0), names, folder, page)
    assert "| a_ms | 1 |" in page.read_text()
    assert "b_mb" not in page.read_text()


def test_figures_of_kinds_form_a_matrix(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(kept.COLUMNS, "clocks", ("wrong", "late"))
    folder, page = tmp_path / "results", tmp_path / "RESULTS.md"
    result = a_result("clocks", "2026-01-01", trains=9.0, late_kink=0.5, kink_wrong=0.0, late_x=1.0)
    kept.keep(result, ("clocks",), folder, page)
    assert page.read_text().splitlines()[-5:] == [
        "| figure | value | wrong | late |",
        "| --- | ---: | ---: | ---: |",
        "| trains | 9 |  |  |",
        "| kink |  | 0 | 0.5 |",
        "| x |  |  | 1 |",
    ]


def test_studies_between_comments_are_preserved(tmp_path: Path) -> None:
    folder, page = tmp_path / "results", tmp_path / "RESULTS.md"
    studies = f"{kept.BEGIN}\n\n## Studies\n\n{kept.END}\n"
    page.write_text(f"# Old\n\n{studies}")
    for day in ("2026-01-01", "2026-01-02"):
        kept.keep(a_result("clocks", day, e=5.0), ("clocks",), folder, page)
    text = page.read_text()
    assert text.endswith(f"| e | 5 |\n\n{studies}")
    assert text.count(kept.BEGIN) == 1
    assert "# Old" not in text
    page.write_text(f"{kept.BEGIN}\nno end\n")
    kept.keep(a_result("clocks", "2026-01-03", e=5.0), ("clocks",), folder, page)
    assert page.read_text().endswith(f"{kept.BEGIN}\nno end\n{kept.END}\n")


def test_an_unknown_name_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["benchmarks", "everything"])
    with pytest.raises(SystemExit) as refused:
        command.main()
    assert refused.value.code == 2
    assert "storage" in capsys.readouterr().err


def test_a_stretch_takes_whole_trials_and_knows_how_long_they_are() -> None:
    with open_session("rehearsal", 2, "pilot") as work:
        trial = work.trials[0]
        assert work.take(1) == work.collector.plan.seconds(trial)
        assert work.collector.taken == 1
        assert [left.id for left in work.trials] != [trial.id]
        assert work.collector.campaign.committed() == {trial.id}


def test_files_of_other_programs_are_read_and_compared() -> None:
    """What is read is what was written, or the benchmark itself fails."""
    figures = exchange.measure("aedat4", events=20_000, runs=1)
    assert {"aedat4_read_faery_ratio", "aedat4_write_faery_ratio"} <= figures.keys()
    assert all(value > 0 for value in figures.values())
