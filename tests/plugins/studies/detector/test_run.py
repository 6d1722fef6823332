"""The search over the detector's settings: what it tries, keeps, goes on with and tells."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sliplab.analysis.campaigns import Collected, collected
from sliplab.analysis.detectors.latency import score_trial, summarise_latency, true_slip
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.analysis.labels.reviewed import label_key
from sliplab.analysis.networks import training
from sliplab.analysis.study import Finding
from sliplab.analysis.windows import dataset
from sliplab.flows.running import console, stopping
from sliplab.plugins.studies.detector.document import DetectorRow, DetectorTradeoff, mean
from sliplab.plugins.studies.detector.grid import (
    PAPER,
    Axes,
    NetworkSetting,
    strides,
)
from sliplab.plugins.studies.detector.rows import OBJECTIVES, RULES
from sliplab.plugins.studies.detector.run import detector_search, tradeoff_detector
from sliplab.plugins.studies.detector.search import PRECISIONS, SearchSize, trial_counts
from sliplab.plugins.studies.detector.study import STUDY
from sliplab.protocols.detection import Detection
from sliplab.storage.errors import StoreError
from sliplab.storage.schema.label import LABELS as STEP
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from tests.analysis.labels.reviewable import Reviewable, label
from tests.command_line import here
from tests.conftest import ROOT

SIZE = SearchSize(samples=40, epochs=2, trials=2, seeds=2, stride_ms=15)
AXES = Axes(length_ms=(15, 30), step_ms=(1,), pool_px=(20,), width=(0.5, 1.0))
TRIALS = 20


def made(folder: Path) -> TrialStore:
    """A kinematic campaign, and a gravity trial with the same events."""
    kinematic = Reviewable(folder, TRIALS)
    campaign = kinematic.store.campaign("gravity")
    protocol = (ROOT / "protocols" / "pilot_gravity.yaml").read_text()
    campaign.update({"name": "gravity", "simulated": True}, protocol, "rig: 1\n")
    item = Collected(campaign)
    trial = next(trial for trial in item.plan if trial.split == "test")
    (campaign.folder / "trials").mkdir(exist_ok=True)
    kinematic._link(campaign, trial.id, item.plan.describe(trial))
    recording = campaign.recording(trial.id)
    key = label_key(recording, item.settings.labelling)
    Derived.of(kinematic.store, STEP, "gravity").write(trial.id, key, label())
    return kinematic.store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    return made(tmp_path_factory.mktemp("tradeoff") / "store")


@pytest.fixture(scope="module")
def result(
    store: TrialStore, tmp_path_factory: pytest.TempPathFactory
) -> tuple[DetectorTradeoff, Path]:
    folder = tmp_path_factory.mktemp("out") / "new"
    found = tradeoff_detector(store, collected(store), folder, SIZE, AXES)
    assert found.named == {"made": 6}
    assert STUDY.write(found) == folder / "detector_tradeoff.html"
    return found.result, folder


def test_rows_are_of_every_setting_precision_stride_and_rule(
    result: tuple[DetectorTradeoff, Path],
) -> None:
    assert result[0].simulated
    assert (result[0].runs, result[0].kept, result[0].pending) == (6, 6, 0)
    found = result[0].to_json()
    keys = ("length_ms", "step_ms", "pool_px", "width", "precision", "stride_ms", "rule")
    rows = {tuple(row[key] for key in keys) for row in found["rows"]}
    expected = set()
    for setting in found["settings"]:
        for stride in strides(setting["length_ms"], 15):
            for precision in PRECISIONS:
                for rule in RULES:
                    expected.add((*setting.values(), precision, stride, rule))
    assert rows == expected
    assert len(found["rows"]) == len(rows)
    assert [row["seeds"] for row in found["rows"]] == [[0, 1]] * len(rows)
    (paper,) = [row for row in found["rows"] if row["paper"]]
    assert [paper[key] for key in keys] == [30, 1, 20, 1.0, "trained", 30, "paper's"]
    assert (paper["smoothing"], paper["margin"]) == (4, 8.0)
    assert found["trials"]["falling"] == 1
    # true gross onset of the plate is 0.5 s; the first window of it ends at 35 ms
    leads = [v for row in found["rows"] for v in row["falling"]["lead_min_ms"] if v is not None]
    assert all(lead <= 500 for lead in leads)


def test_the_papers_row_is_what_its_rule_gives_on_every_window(
    store: TrialStore, result: tuple[DetectorTradeoff, Path]
) -> None:
    (paper,) = [row for row in result[0].rows if row.paper]
    search = detector_search(store, collected(store), SIZE, AXES)
    run = next(run for run in search.runs if run.setting == PAPER and run.seed == 1)
    fitted = search.fitted(run, lambda share, note: None)
    scored, hits = [], []
    for used in search.trials.test:
        x, ends = dataset.trial_windows(used.recording, run.windows)
        counts = training.predict_counts(fitted, x)
        said = detect(counts, ends, Detection())
        slip = true_slip(used.label)
        assert slip is not None
        scored.append(score_trial(said, slip, 30_000_000))
        kept = trial_counts(search.read(run)[1], "trained", 15)
        place = search.trials.judged.index(used)
        assert np.array_equal(kept[place][0][::2], counts)
        assert np.array_equal(kept[place][1][::2], ends)
        hits.append(len(counts))
    assert min(hits) > 5
    summary = summarise_latency(scored).incipient
    assert paper.test["mean_ms"][1] == summary.mean
    assert paper.test["missed"][1] == summary.missed / len(scored)
    assert paper.test["false_early"][1] == summary.false_early / len(scored)


def test_the_front_is_the_definitions(result: tuple[DetectorTradeoff, Path]) -> None:
    rows = result[0].rows

    def costs(row: DetectorRow) -> list[float]:
        values = [(row.objective(name), sign) for name, sign in OBJECTIVES.items()]
        return [float("inf") if value is None else sign * value for value, sign in values]

    for row in rows:
        mine = costs(row)
        beaten = any(
            all(a <= b for a, b in zip(other, mine, strict=True)) and other != mine
            for other in map(costs, rows)
        )
        assert row.front == (not beaten)
    assert 0 < sum(row.front for row in rows) < len(rows)


def test_page_numbers_and_table_say_the_same(result: tuple[DetectorTradeoff, Path]) -> None:
    found, folder = result
    names = [f"detector_tradeoff.{kind}" for kind in ("csv", "html", "json")]
    assert sorted(item.name for item in folder.iterdir()) == [*names, "tables"]
    assert STUDY.read(folder / names[2]) == found
    every = pd.read_parquet(folder / "tables" / "detector_tradeoff.rows.parquet")
    assert list(every["precision"]) == [row.precision for row in found.rows]
    assert every["simulated"].all()
    page = (folder / names[1]).read_text()
    assert page.count("<svg") == 2
    assert page.count("<h2>") == page.count("<small>simulated</small></h2>") == 7
    assert "★" in page
    table = list(csv.DictReader(io.StringIO((folder / names[0]).read_text())))
    assert len(table) == len(found.rows)
    for line, row in zip(table, found.rows, strict=True):
        assert line["simulated"] == "True"
        assert line["stride_ms"] == str(row.stride_ms)
        assert float(line["test_strict_share"]) == mean(row.test["strict"])
        assert float(line["us_single_per_window"]) > 0
        assert line["front"] == str(row.front)
    factors = {item.factor for item in found.comparisons}
    assert factors == {
        "length_ms",
        "step_ms",
        "pool_px",
        "width",
        "stride_ms",
        "precision",
        "rule",
    }
    for item in found.comparisons:
        if item.paper:
            assert item.difference is not None
            assert item.difference["strict"].mean == 0
    assert sum(item.paper for item in found.comparisons) == len(factors)


def test_a_kept_search_is_not_made_again_and_grows(
    store: TrialStore, result: tuple[DetectorTradeoff, Path], tmp_path: Path
) -> None:
    out = tmp_path / "o"

    def tried(size: SearchSize, **how: Any) -> Finding[DetectorTradeoff]:
        return tradeoff_detector(store, collected(store), out, size, AXES, **how)

    plan = tried(SIZE, dry_run=True)
    assert plan.dry
    assert (plan.result.pending, plan.result.estimated_s) == (0, 0)
    more = SearchSize(samples=40, epochs=2, trials=2, seeds=3, stride_ms=15)
    grown = tried(more, dry_run=True).result
    assert (grown.kept, grown.pending) == (6, 3)
    assert grown.estimated_s is not None
    assert grown.estimated_s > 0
    assert not out.exists()
    # other samples are another search beside it
    other = SearchSize(samples=41, epochs=2, trials=2, seeds=1, stride_ms=15)
    found = tried(other, minutes=0)
    assert (found.result.kept, found.result.rows) == (0, ())
    assert STUDY.write(found).exists()


@pytest.mark.long
def test_it_goes_on_in_the_middle_of_a_training(tmp_path: Path) -> None:
    axes = Axes(length_ms=(30,), step_ms=(5,), pool_px=(40,), width=(0.5,))
    ask = SearchSize(samples=30, epochs=3, trials=1, seeds=1, stride_ms=30)
    stores = [made(tmp_path / name) for name in ("whole", "stopped")]
    models = []
    for store in stores:
        search = detector_search(store, collected(store), ask, axes)
        run = search.runs[0]
        if store is stores[1]:
            epochs: list[float] = []

            def stop(part: str, share: float, note: str, epochs: list[float] = epochs) -> None:
                epochs.append(share)
                if len(epochs) == 2:
                    raise KeyboardInterrupt

            with pytest.raises(KeyboardInterrupt):
                search.measure(run, stop)
            assert len(list(search.derived.folder.glob("*.state"))) == 1
            assert not search.sweep.done(run)
        reported: list[tuple[str, float]] = []
        search.measure(run, lambda part, share, note, done=reported: done.append((part, share)))
        assert sum(share for part, share in reported if part == "train") == pytest.approx(1)
        assert sum(share for part, share in reported if part == "count") == pytest.approx(1)
        assert not list(search.derived.folder.glob("*.state"))
        models.append(search.model_path(run).read_bytes())
    assert models[0] == models[1]


def test_windows_of_each_length_lie_in_the_same_stretches(store: TrialStore) -> None:
    trials = detector_search(store, collected(store), SIZE, AXES).trials
    for setting in (PAPER, NetworkSetting(length_ms=15)):
        found = trials.samples(setting, trials.train, 10_000)
        whole = trials.samples(setting, trials.train, 25)
        assert len(whole) == 25
        assert set(np.unique(found.trial)) == set(range(len(trials.train)))
        known = trials.train[0].label
        ours = (found.trial == 0) & (found.y == 0)
        ends = found.start_ns[ours] + setting.length_ms * 1_000_000
        assert ends.max() == known.incipient_ns
        assert found.start_ns[(found.trial == 0) & (found.y == 2)].min() == known.gross_ns


def test_a_stop_and_a_lack_of_labels_are_said(store: TrialStore, monkeypatch: Any) -> None:
    campaigns = [item for item in collected(store) if item.name == "gravity"]
    with pytest.raises(StoreError, match="no kinematic campaign"):
        detector_search(store, campaigns, SIZE, AXES)

    def check() -> None:
        raise KeyboardInterrupt

    more = SearchSize(samples=40, epochs=2, trials=2, seeds=3, stride_ms=15)
    search = detector_search(store, collected(store), more, AXES)
    monkeypatch.setattr(stopping, "check", check)
    with pytest.raises(KeyboardInterrupt), console.bar("", 1) as bar:
        search.sweep.run(bar.advance)


def test_the_command_names_what_is_wrong_and_knows_its_old_form(
    store: TrialStore, tmp_path: Path
) -> None:
    for words, message in (
        ((), "STORE: is needed"),
        (("--scene", "p.yaml"), "has moved: python -m benchmarks.scene_tradeoff p.yaml"),
        ((store.folder, "--pool", 30), "--pool = 30: must divide"),
        (("--detector", store.folder, "--pool", 30), f"write: sliplab tradeoff {store.folder}"),
    ):
        done = here("tradeoff", *words)
        assert done.returncode == 2, done.stderr
        assert message in done.stderr.replace("\n", " ")
    size = ("--samples", 40, "--epochs", 2, "--trials", 2, "--seeds", 1, "--stride", 15)
    axes = ("--length", 15, "--length", 30, "--step", 1, "--pool", 20, "--width", 0.5)
    asked = ("tradeoff", store.folder, "--dry-run", *size, *axes, "--width", 1)
    done = here(*asked, "--json")
    assert done.returncode == 0, done.stderr
    reported = json.loads(done.stdout)
    assert (reported["runs"], reported["simulated"]) == (3, True)
    assert not {"page", "rows"} & set(reported)
    done = here(*asked)
    assert "tradeoff (simulated)" in done.stdout
    assert "page" not in done.stderr
