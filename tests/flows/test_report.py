"""The report of a small study: whole, self-contained, every trial in one place."""

from __future__ import annotations

import copy
import csv
import json
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sliplab
from sliplab.analysis.campaigns import collected
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.report import campaign, outcomes
from sliplab.analysis.report.against import Change, compare
from sliplab.analysis.report.outcomes import MOST_FAILURES, account, failure_section, trial_outcome
from sliplab.analysis.report.page import render_section, write_figures
from sliplab.analysis.report.paper import paper_section
from sliplab.flows.collect import collect
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.report import read_summary, report
from sliplab.plugins.studies.generalise.section import RESULT as GENERALISATION
from sliplab.plugins.studies.generalise.section import skin_section
from sliplab.plugins.studies.section import RESULT as DETECTOR
from sliplab.plugins.studies.section import tradeoff_section
from sliplab.storage.files import json_text, read_json, write_json
from sliplab.storage.schema.evaluation import Seeds, SeedScores, SeedTimes, TrialScore
from sliplab.storage.schema.summary import ReferenceTrial, Summary
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.analysis.report.test_plugin_sections import install
from tests.command_line import here
from tests.flows.collecting.test_session import short
from tests.flows.conftest import write
from tests.protocols.test_plugin import installed

__all__ = ["installed"]  # a fixture
Json = dict[str, Any]
ONSETS = ("incipient", "gross")
UNITLESS = re.compile(
    "trial|name|row|class|detector|stride|true class|tightest gate|windows|failed attempts|side|"
    "place in the plan|epoch|simulated|family|variant|on the front|precision|width"
)
"""Headings of columns without a unit."""


@pytest.fixture(scope="module")
def store(own_study: TrialStore) -> TrialStore:
    """A copy of the small study, with its report."""
    report(own_study, collected(own_study))
    return own_study


@pytest.fixture
def copied(store: TrialStore, tmp_path: Path) -> TrialStore:
    """A copy of it, to be changed at will."""
    return TrialStore.open(shutil.copytree(store.folder, tmp_path / "store"))


def changed(of: Any, **values: Any) -> Any:
    """The same with other values."""
    return of.model_copy(update=values)


def page(store: TrialStore) -> str:
    return (store.folder / "report" / "index.html").read_text()


def test_every_trial_is_counted_once(store: TrialStore) -> None:
    summary = read_summary(store)
    for experiment, planned in (("kinematic", 2), ("gravity", 2), ("disturbance", 0)):
        found = getattr(summary, experiment)
        accounts, lead = found.accounted, found.lead_ms
        assert accounts.planned == planned
        assert sum(accounts.of(name) for name in outcomes.OUTCOMES) == planned
        for name in ("detected_first", "missed", "false_early", "late"):
            assert accounts.of(name) == getattr(lead, name)
    assert [row.campaign for row in summary.trials].count("tiny") == 2
    known = [row.lead_ms for row in summary.trials if row.experiment == "gravity"]
    least = min((value for value in known if value is not None), default=None)
    assert least == summary.gravity.lead_ms.min


def test_a_summary_is_read_and_written_to_the_byte(store: TrialStore) -> None:
    path = store.folder / "report" / "summary.json"
    assert json_text(Summary.load(path).to_json()) == path.read_text()
    known = Summary.load(path).model_fields_set
    assert known == set(Summary.model_fields)


def test_trials_that_were_not_judged_are_told_apart(store: TrialStore) -> None:
    campaigns = collected(store)
    rows = evaluation_of(store).trials
    others = [trial_outcome(row) for row in rows if row.campaign != "tiny"]
    later = account(campaigns, others, "kinematic")
    assert (later.planned, later.not_evaluated) == (2, 2)
    lost = copy.copy(campaigns[0])
    lost.__dict__["trials"] = lost.trials[:0]
    missing = account([lost], [], "kinematic")
    assert (missing.planned, missing.not_taken) == (2, 2)


FOUND = (
    {"latency_incipient_ms": 90.0, "latency_gross_ms": 40.0, "lead_ms": 900.0}
    | dict.fromkeys(("late_incipient_ms", "late_gross_ms"))
    | dict.fromkeys((f"{x}_{y}" for x in ("missed", "false_early") for y in ONSETS), False)
)


def judged(**changed: Any) -> TrialScore:
    """An evaluated trial."""
    row = (
        {"campaign": "g", "experiment": "gravity", "trial": "t", "condition": {}}
        | {"incipient_ns": 10**9, "gross_ns": 2 * 10**9, "end_ns": 3 * 10**9}
        | {"detected_incipient_ns": 1, "detected_gross_ns": 2, "latency": {**FOUND, **changed}}
    )
    return TrialScore.model_validate(row)


def test_what_became_of_a_trial() -> None:
    assert trial_outcome(judged()).duration_ms == 1000.0
    for values, outcome, gross in (
        ({}, "detected_first", "detected"),
        ({"late_incipient_ms": 20.0, "lead_ms": None}, "late", "detected"),
        ({"late_gross_ms": 299.0, "latency_gross_ms": None}, "detected_first", "late"),
        ({"missed_incipient": True}, "missed", "detected"),
        ({"false_early_incipient": True}, "false_early", "detected"),
        ({"false_early_gross": True}, "detected_first", "false_early"),
        ({"missed_gross": True}, "detected_first", "missed"),
    ):
        found = trial_outcome(judged(**values))
        assert (found.outcome, found.gross) == (outcome, gross), values
        assert found.late_gross_ms == values.get("late_gross_ms")
    none = trial_outcome(changed(judged(), latency=None, gross_ns=None))
    assert (none.outcome, none.gross, none.lead_ms) == ("without_onsets", "without_onsets", None)
    found = outcomes.trial_intervals(
        [trial_outcome(judged()), trial_outcome(judged(lead_ms=1000.0)), none]
    )
    assert found.lead_ms.n == 2
    half = 12.7062047 * 50  # Student's t of two trials
    assert found.lead_ms.mean == pytest.approx([950 - half, 950 + half])


def test_trials_stand_under_their_conditions(store: TrialStore) -> None:
    campaigns = collected(store)
    rows = evaluation_of(store).trials
    found = outcomes.Conditions(campaigns, rows, "gravity")
    cells = found.cells(list(found.factors))
    assert sum(map(len, cells.values())) == 2
    for name, trials in cells.items():
        levels = dict(zip(found.factors, name.split(", "), strict=True))
        assert trials == found.at(**levels)
    both = outcomes.Conditions(campaigns, rows, "kinematic")
    assert both.varied() == ["direction"]
    assert both.breaks(["direction"]) == []
    assert len(both.at(direction="240 deg")) == 1
    both.factors = {"a": ["1", "2"], "b": ["x", "y", "z"]}
    assert list(both.cells(["a", "b"])) == ["1, x", "1, y", "1, z", "2, x", "2, y", "2, z"]
    assert both.breaks(["a", "b"]) == [3]


DRAWN = (
    *("trial", "confusion", "outputs", "latency-kinematic", "gravity-incipient", "gravity-gross"),
    *("answer", "labels", "clocks", "quality-tiny"),
)


def test_figures_stand_beside_the_page_with_their_data(store: TrialStore) -> None:
    folder = store.folder / "report"
    text = page(store)
    names = re.findall(r'<figure id="([^"]+)">', text)
    assert len(names) == text.count("<figure") == len(set(names))
    assert sorted(path.stem for path in (folder / "figures").iterdir()) == sorted(names)
    assert sorted(path.stem for path in (folder / "data").iterdir()) == sorted(names)
    assert set(DRAWN) <= set(names)
    for name in names:
        svg = (folder / "figures" / f"{name}.svg").read_text()
        assert svg in text
        with (folder / "data" / f"{name}.csv").open(newline="") as file:
            head, *rows = list(csv.reader(file))
        assert rows
        assert all(row[-1] == "yes" for row in rows)
        for heading in head:
            assert UNITLESS.fullmatch(heading) or re.search(r"\(.+\)$", heading), (name, heading)
    lines = (folder / "data" / "gravity-incipient.csv").read_text().splitlines()
    known = {row.trial: row for row in read_summary(store).trials}
    for line in csv.DictReader(lines):
        late = known[line["trial"]].latency_incipient_ms
        assert line["incipient latency (ms)"] == ("" if late is None else str(late))


@pytest.mark.long
def test_sections_of_other_packages_stand_in_the_report(
    installed: Any, copied: TrialStore, tmp_path: Path
) -> None:
    install(installed, tmp_path, "lab_rubs")
    install(installed, tmp_path, "lab_bad", ('"rubs"', '"bad"'), ("return Rubs()", "return 1 / 0"))
    assert report(copied, collected(copied))["done"] == 1
    assert report(copied, collected(copied))["done"] == 0
    text = page(copied)
    titles = re.findall(r'<li><a href="#s\d+">([^<]+)</a>', text)
    place = titles.index("Quality and retakes over the campaigns, and wear")
    assert titles[place - 2 : place] == ["Rubs", "Sections that could not be made"]
    assert "<p>7 rubs, simulated</p>" in text
    assert "<p>bad: ZeroDivisionError: division by zero</p>" in text
    data = copied.folder / "report" / "data" / "rubs-force.csv"
    assert data.read_text().splitlines() == ["force (N),simulated", "1,yes", "2,yes"]


def test_every_address_in_the_page_is_beside_it(store: TrialStore) -> None:
    folder = store.folder / "report"
    text = page(store)
    assert not re.search(r"<(script|img|iframe|link rel=.stylesheet)", text)
    for address in re.findall(r'<a href="([^"]+)"', text):
        if address.startswith("#"):
            assert f'id="{address[1:]}"' in text
        else:
            assert (folder / address).is_file()
    for said in (
        *("88 ms after onset", "measured by its authors on their own robot", "here (simulated)"),
        *(f"sliplab {command} {store.folder.resolve()}" for command in ("review", "generalise")),
        "No campaign has reference trials",
    ):
        assert said in text


def test_only_the_papers_preset_brings_the_papers_figures(store: TrialStore) -> None:
    summary = read_summary(store)
    known = paper_section(summary)
    assert known is not None
    assert known.rows.columns[:2] == ["figure", "paper"]
    others = {"lab": changed(summary.networks["preset-paper"], preset=None, title="lab.pt")}
    among = paper_section(changed(summary, networks=others))
    assert among is not None
    assert among.rows.columns == ["figure", "here (simulated)", "lab.pt (simulated)"]
    made = render_section(among, simulated=True)
    assert made.title == "Comparison of networks"
    assert "88 ms" not in made.html
    assert paper_section(changed(summary, networks={})) is None


def test_failures_have_a_command_that_shows_them(store: TrialStore) -> None:
    first = read_summary(store).trials[0]
    row = changed(first, trial="a=1,r=1", outcome="late", gross="missed")
    early = changed(row, outcome="detected_first", gross="false_early", campaign="b")
    fine = changed(row, trial="fine", outcome="detected_first", gross="detected")
    found = failure_section(store.folder, [early, fine, row])
    assert [line[1].split(":")[0] for line in found.table.rows] == [row.campaign, "b"]
    assert "incipient detected late" in found.table.rows[0][1]
    assert "gross missed" in found.table.rows[0][1]
    command = f"sliplab view {store.folder.resolve()} a=1,r=1 --campaign {row.campaign}"
    assert found.table.rows[0][0] == command  # two campaigns have this trial
    assert "2 of 3 evaluated trials failed" in render_section(found, simulated=True).html
    many = failure_section(store.folder, [row] * (MOST_FAILURES + 1))
    assert len(many.table.rows) == MOST_FAILURES
    assert "summary.json" in render_section(many, simulated=True).html
    late = [
        changed(row, outcome="detected_first", gross="late", late_gross_ms=late_ms)
        for late_ms in (359.0, 579.4)
    ]
    grouped = failure_section(store.folder, late)  # one cause, each by how much in its own row
    assert grouped.causes == [("gross late", 2)]
    said = [line[1].split(", ")[1] for line in grouped.table.rows]
    assert said == [f"{late_ms} ms after it ended" for late_ms in (359, 579)]
    none = render_section(failure_section(store.folder, [fine]), simulated=True).html
    assert "0 of 1 evaluated trials failed in some way." in none
    assert "<table" not in none


def detector() -> Json:
    """Numbers of the shape that the report's section on trade-offs reads."""
    work = {"us_per_s": [9e3, 1e4], "synaptic_operations_per_s": [1e7, 1e7]}
    test = {"strict": [0.9, 0.92], "p95_ms": [200.0, 210.0], "lost_either": [0.0, 0.0]}
    test["false_early_either"] = [0.0, 0.01]
    rows = [
        {"length_ms": 30, "step_ms": 1, "pool_px": 20, "width": 1.0, "stride_ms": 30}
        | {"precision": "as trained", "smoothing": 4, "margin": 2.0, "front": paper}
        | {"paper": paper, "test": {**test, "mean_ms": [90.0, late]}, "work": work}
        for paper, late in ((True, 100.0), (False, None))
    ]
    return {"simulated": True, "rows": rows}


@pytest.mark.long
def test_results_of_other_programs_are_taken_up(copied: TrialStore) -> None:
    other = copied
    skin = {"share": 0.8, "low": 0.7, "high": 0.9, "n": 100, "trials": 4, "argmax": 0.81}
    skin["recall"] = {"no_slip": 0.8, "incipient": 0.8, "gross": None}
    results = {
        "skin 101": skin,
        "depth 2.4 mm": {**skin, "seen": 0.9},
        "speed 1 mm/s": {"left out": "no train trials"},
    }
    found = {
        "generalisation": {"simulated": True, "results": results},
        "detector": detector(),
    }
    files = {"generalisation": GENERALISATION, "detector": DETECTOR}
    for name, data in found.items():
        path = other.folder / files[name].file
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, data)
    assert report(other, collected(other))["done"] == 1
    assert report(other, collected(other))["done"] == 0
    text = page(other)
    for word in ("skin 101", "no train trials", "without a depth"):
        assert word in text
    assert "not done here" not in text
    data = other.folder / "report" / "data"
    assert (data / "skins.csv").read_text().splitlines()[2] == "skin 101,0.8,0.7,0.9,yes"
    lines = list(csv.DictReader((data / "tradeoff-detector.csv").read_text().splitlines()))
    assert [line["mean latency (ms)"] for line in lines] == ["95.0", ""]
    assert [line["strict accuracy (%)"] for line in lines] == ["91.0", "91.0"]

    path = other.folder / DETECTOR.file
    path.write_text("{")
    assert report(other, collected(other))["done"] == 1
    assert re.search(r"tradeoff: .*delete .*detector_tradeoff\.json", page(other))
    with pytest.raises(StoreError, match=r"report/detector_tradeoff\.json: is not of the shape"):
        tradeoff_section(other, {"rows": [{}]})
    path.unlink()
    with pytest.raises(StoreError, match=r"results\.json: is not of the shape"):
        skin_section({}, "sliplab generalise", 0.9, simulated=True)
    assert report(other, collected(other))["done"] == 1
    absent = tradeoff_section(other, None)
    assert absent.command.startswith("sliplab tradeoff ")
    write_figures(other.folder / "report", list(absent.all_figures()), simulated=True)
    assert list(data.iterdir()) == []  # an older report's figures go


def test_an_evaluation_of_another_version_is_refused_by_name(copied: TrialStore) -> None:
    path = copied.folder / "derived" / "evaluation" / "evaluation.json"
    write_json(path, {**read_json(path), "format": [1, 1]})
    with pytest.raises(StoreError, match=r"another version.*sliplab evaluate"):
        report(copied, collected(copied))


@pytest.mark.long
def test_an_evaluation_without_figures_by_each_onset_is_shown(copied: TrialStore) -> None:
    older = copied
    path = older.folder / "derived" / "evaluation" / "evaluation.json"
    kept = read_json(path)
    for entry in (kept["detectors"] or {"detectors": []})["detectors"]:
        for rate in entry["rates"]:
            del rate["by_reference"]
    write_json(path, kept)
    report(older, collected(older))
    summary = read_summary(older)
    for entry in summary.detectors.detectors if summary.detectors else ():
        assert all(rate.by_reference == {} for rate in entry.rates)
    # decisions of the network's rule stand in every evaluation
    own = summary.kinematic.by_reference
    assert list(own) == ["change_point", "paper", "true"]
    assert all(each.trials + each.lacking == 2 for each in own.values())
    assert own["paper"].latency_ms == summary.kinematic.latency_ms
    assert "The same decisions by each onset" in page(older)


@pytest.mark.long
def test_wear_is_the_slope_of_reference_trials(tmp_path: Path, rig_path: Path) -> None:
    times = [None if k else 900.0 for k in range(8)]
    rows = [
        ReferenceTrial(
            trial=f"{k}", place=1 + 10 * k, hold_events_per_s=1e3 + 2 * k, first_slip_ms=time
        )
        for k, time in enumerate(times)
    ]
    found = campaign.wear(rows)
    slope = found["hold_events_per_s"].percent_per_100_trials
    assert slope == pytest.approx(100 * 20.0 / 1007.0)
    assert found["hold_events_per_s"].low == pytest.approx(slope)
    no_trend = dict.fromkeys(("percent_per_100_trials", "low", "high"))
    assert found["first_slip_ms"].to_json() == {"n": 1, **no_trend}
    data = short()
    data["collection"]["factors"]["direction"]["values"] = [0, 120]
    condition = {"depth": 2.4, "speed": 1.6, "direction": 0}
    data["collection"]["references"] = {"every": 1, "condition": condition}
    data["collection"]["maintenance"]["rezero"]["touches"] = 3
    run_request = make_request(write(tmp_path / "p.yaml", data), rig_path, tmp_path / "store")
    collect(run_request)
    store = TrialStore.open(run_request.store)
    (item,) = collected(store)
    before = campaign.reference_trials(store, item)
    assert [row.first_slip_ms for row in before] == [None, None]
    label(store, [item])
    after = campaign.reference_trials(store, item)
    assert [row.hold_events_per_s for row in after] == [row.hold_events_per_s for row in before]
    slips = [row.first_slip_ms for row in after if row.first_slip_ms is not None]
    assert len(slips) == len(after)
    assert min(slips) > 0
    assert max(slips) - min(slips) < 40.0  # the same condition: within some frames
    known = campaign.references_of(store, [item])
    section = campaign.quality_section([item], known, simulated=True)
    names = [figure.name for figure in section.all_figures()]
    assert names == ["quality-tiny", "references-tiny"]
    records = [recording.record for _, recording in item.trials]
    zeros = [record.depth_zero_mm or 0.0 for record in records]
    sds = list(dict.fromkeys(record.depth_zero_sd_mm or 0.0 for record in records))
    sd = (sum(sd**2 for sd in sds) / len(sds)) ** 0.5
    shown = [f"{x:+.3f}" for x in (zeros[0], zeros[-1], min(zeros), max(zeros))]
    row = ["tiny", str(len(sds)), "3", *shown, f"{sd:.3f}", f"{sd / 3**0.5:.3f}"]
    assert section.tables[0].rows == [row]
    assert 0.0 < sd < 0.05
    words = "Campaign tiny: event rate in the hold: 2 reference trials, too few for a trend."
    assert words in render_section(section, simulated=True).html
    steep = {"tiny": changed(known["tiny"], wear=found)}
    worn = campaign.quality_section([item], steep, simulated=True)
    said = render_section(worn, simulated=True).html
    trend = f"changes by {slope:+.2f} % in 100 trials"
    assert trend in " ".join(said.split())
    assert "more than chance." in said


def test_scores_have_every_trial_with_its_condition(store: TrialStore) -> None:
    opened = sliplab.open_store(store.folder)
    scores = opened.scores()
    outcomes = scores[scores.figure == "outcome.detected_first"]
    assert outcomes.trial.tolist() == [row.trial for row in read_summary(store).trials]
    assert (outcomes.condition != "").all()

    keys = ["figure", "campaign", "experiment", "split", "condition", "trial", "detector"]
    shutil.move(store.folder / "report" / "scores.parquet", store.folder / "kept")
    early = opened.scores()  # of the evaluation
    shutil.move(store.folder / "kept", store.folder / "report" / "scores.parquet")
    assert 200 < len(early) < len(scores)
    assert set(early.trial) == set(scores.trial)
    both = early.merge(scores, how="left", on=keys, suffixes=("", "_reported"))
    pd.testing.assert_series_equal(both.value, both.value_reported, check_names=False)


def test_a_report_against_itself_differs_in_nothing(store: TrialStore) -> None:
    summary = read_summary(store)
    found = compare(summary, copy.deepcopy(summary))
    assert found.settings == []
    assert len(found.figures) > 10
    for row in found.figures:
        assert row.difference == 0
        assert row.beyond in {False, None}


def several_seeds(summary: Summary, *shares: tuple[float, float]) -> Summary:
    """The same with trained seeds of these accuracies, and margins."""
    each = tuple(
        SeedScores(
            seed=k, chosen=not k, validation_strict=None, strict=share, argmax=share, margin=margin
        )
        for k, (share, margin) in enumerate(shares)
    )
    return changed(summary, kinematic=changed(summary.kinematic, seeds=Seeds(each=each, spread={})))


def gravity_trials(summary: Summary, values: Iterable[Json]) -> Summary:
    """The same with these gravity trials, 40 of them."""
    first = next(row for row in summary.trials if row.experiment == "gravity")
    rows = (changed(first, trial=str(k), **value) for k, value in enumerate(values))
    return changed(summary, trials=tuple(rows))


def test_a_difference_is_more_than_noise_where_its_interval_says_so(store: TrialStore) -> None:
    summary = read_summary(store)
    rng = np.random.default_rng(1)
    ours, theirs = (
        gravity_trials(
            summary,
            (
                {"outcome": "detected_first", "gross": "detected", "latency_incipient_ms": late + x}
                | {"latency_gross_ms": 50.0 + 400 * x, "lead_ms": None if k == 3 else 900.0 - x}
                for k, x in enumerate(rng.normal(0, 10, 40))
            ),
        )
        for late in (120.0, 80.0)
    )
    ours = several_seeds(ours, (0.9, 0.8))
    theirs = several_seeds(theirs, *((share, share) for share in (0.88, 0.90, 0.91)))
    theirs = changed(theirs, versions={**theirs.versions, "numpy": "0"})
    found = {row.name: row for row in compare(ours, theirs).figures}
    mean = "gravity: incipient latency, mean"
    late = found[mean]
    assert (late.basis, late.beyond) == ("same trials", True)
    assert late.high is not None
    assert late.low < late.difference < late.high
    assert late.difference == pytest.approx(40.0, abs=6)
    assert found["gravity: gross latency, mean"].beyond is False
    strict = found["accuracy, strict, mean of seeds"]
    assert (strict.basis, strict.beyond) == ("seeds", False)
    assert found["accuracy, margin, mean of seeds"].beyond is True
    assert compare(ours, theirs).to_json()["settings"] == [
        {"what": "versions.numpy", "here": ours.versions["numpy"], "there": "0"}
    ]
    # trials of another protocol only have the same names, and vary as well
    hashes = {name: changed(of, collection="another") for name, of in theirs.protocols.items()}
    found = {row.name: row for row in compare(ours, changed(theirs, protocols=hashes)).figures}
    assert found[mean].basis == "trials"
    both = found["accuracy, strict, mean of seeds"]
    assert (both.basis, both.beyond) == ("seeds and trials", False)
    assert both.low < strict.low < strict.high < both.high
    assert found["accuracy, margin, mean of seeds"].beyond is None, "without an interval over them"


def test_compared_medians_count_late_detections(store: TrialStore) -> None:
    lost = {"outcome": "late", "gross": "missed"} | dict.fromkeys(
        ("latency_gross_ms", "latency_incipient_ms", "lead_ms")
    )
    kept = {"outcome": "detected_first", "gross": "detected", "latency_gross_ms": 50.0}

    def with_lost(number: int) -> Summary:
        times = ({"latency_incipient_ms": 100.0 + k, "lead_ms": 900.0 - k} for k in range(40))
        values = (lost if k < number else {**kept, **each} for k, each in enumerate(times))
        return gravity_trials(read_summary(store), values)

    found = {row.name: row for row in compare(with_lost(10), with_lost(0)).figures}
    # of 100 to 139 ms the ten quickest came too late
    median = found["gravity: incipient latency, median"]
    assert (median.here, median.there) == pytest.approx((129.5, 119.5))
    assert found["gravity: lead, median"].difference == pytest.approx(-10.0)
    # means are of those that count
    assert found["gravity: incipient latency, mean"].here == pytest.approx(124.5)
    none = {row.name for row in compare(with_lost(21), with_lost(0)).figures}
    assert "gravity: incipient latency, median" not in none
    assert "gravity: incipient latency, mean" in none


def several_times(summary: Summary, *medians_ms: float) -> Summary:
    """The same with trained seeds of these median times of gravity trials."""
    gravity = summary.gravity
    each = []
    for seed, median in enumerate(medians_ms):
        times = changed(gravity.latency_ms.incipient, median=median)
        latency = changed(gravity.latency_ms, incipient=times, gross=times)
        lead = changed(gravity.lead_ms, median=median)
        each.append(SeedTimes(seed=seed, chosen=not seed, latency_ms=latency, lead_ms=lead))
    first, several = each[0], tuple(each) if len(each) > 1 else ()
    own = changed(gravity, latency_ms=first.latency_ms, lead_ms=first.lead_ms, by_seed=several)
    return changed(summary, gravity=own)


def test_median_times_are_compared_by_seeds_where_there_are_several(store: TrialStore) -> None:
    summary = read_summary(store)

    def figures(ours: tuple[float, ...], theirs: tuple[float, ...]) -> dict[str, Change]:
        both = several_times(summary, *ours), several_times(summary, *theirs)
        return {row.name: row for row in compare(*both).figures}

    of_seeds = "gravity: incipient latency, median, mean of seeds"
    far = figures((300.0, 302.0, 301.0), (250.0, 252.0))[of_seeds]
    assert (far.unit, far.basis, far.here, far.there) == ("ms", "seeds", 301.0, 251.0)
    assert far.beyond
    # two networks of one study
    near = figures((494.0, 249.0), (240.0,))
    assert near[of_seeds].difference == pytest.approx(371.5 - 240.0)
    assert near[of_seeds].beyond is False
    assert near["gravity: lead, median, mean of seeds"].beyond is False
    assert not any(name.startswith("kinematic") and "seeds" in name for name in near)
    alone = figures((300.0,), (250.0,))
    assert of_seeds not in alone
    assert len(near) == len(alone) + 3
    for name in (name for name in alone if name.startswith("gravity: ") and "small" not in name):
        assert f"{name}, the chosen network" in near


@pytest.mark.long
def test_against_is_a_page_and_a_command(store: TrialStore, tmp_path: Path) -> None:
    other = tmp_path / "summary.json"
    shutil.copy(store.folder / "report" / "summary.json", other)
    done = here("report", store.folder, "--against", other, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["against"]
    assert found["settings"] == []
    text = (store.folder / "report" / "against.html").read_text()
    assert "Both reports are simulated." in text
    assert "Protocols, settings, seeds and versions are the same." in text
    page = sliplab.open_store(store.folder).report(against=other)
    assert page == store.folder / "report" / "against.html"
    done = here("report", store.folder, "--against", store.folder)
    assert done.returncode == 0
    assert "Two reports (simulated)" in done.stdout
    other.write_text('{"simulated": true}')
    for wrong in (tmp_path / "nowhere", other):
        done = here("report", store.folder, "--against", wrong)
        assert done.returncode == 2
        assert "--against" in done.stderr
