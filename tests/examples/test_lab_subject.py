"""A package with a command, a study, a section and a detector: all found by its declaration."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sliplab.analysis.campaigns import collected
from sliplab.analysis.detectors.registry import known, make_detector
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks import model_file
from sliplab.analysis.problem import Workers, problem_of
from sliplab.analysis.report.page import Rendered
from sliplab.analysis.report.plugin_sections import ReportData, plugin_sections, sections_key
from sliplab.analysis.trial_work import in_order
from sliplab.flows.cli import app as cli
from sliplab.flows.label import label
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.study import StudyOutcome, searches
from sliplab.plugins.classes.evaluation import class_evaluation_of
from sliplab.protocols.plugin import plugins
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer
from tests.conftest import ROOT
from tests.examples.conftest import install
from tests.flows.class_store import adapter, class_store
from tests.flows.conftest import write
from tests.flows.detect.detecting import short_slide

Ran = tuple[list[RunRequest], StudyOutcome]


@pytest.fixture
def subject(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install the package by what an installer writes, for one test."""
    install("lab-subject", tmp_path / "site", monkeypatch)
    groups, added = list(cli.app.registered_groups), set(cli._added)
    plugins.cache_clear()
    yield
    plugins.cache_clear()
    cli.app.registered_groups[:] = groups  # the command line of this process is as it was
    cli._added.intersection_update(added)


@pytest.mark.long
@pytest.mark.usefixtures("subject")
def test_command_study_and_section(ran: Ran, tmp_path: Path) -> None:
    shutil.copytree(ran[0][0].store, tmp_path / "store")
    store = TrialStore.open(tmp_path / "store")
    campaigns = collected(store)
    assert plugins().faults == ()
    before = sections_key(store, campaigns)
    shown = plugin_sections(ReportData(store, campaigns, True), last=True)
    assert "Event rates" not in [each.title for each in shown if isinstance(each, Rendered)]

    (search,) = [each for each in searches(ran[0]) if each.name == "rates"]
    count = sum(len(item.trials) for item in campaigns)
    assert search.run(store, campaigns) == count > 0
    found = answer("rates", store.folder)
    assert found["simulated"] is True
    assert len(found["rates"]) == count
    assert all(each["motion"] > each["hold"] > 0 for each in found["rates"])
    assert found["rates"][0]["trial"] in Path(found["page"]).read_text()

    assert sections_key(store, campaigns) != before  # the next report is made again
    *_, last = plugin_sections(ReportData(store, campaigns, True), last=True)
    assert isinstance(last, Rendered)
    assert (last.title, "(simulated)" in last.html) == ("Event rates", True)
    assert found["rates"][0]["trial"] in last.html


@pytest.mark.usefixtures("subject")
def test_problem_is_trained_evaluated_and_reported(tmp_path: Path) -> None:
    parts = {"train": 2, "validation": 1, "test": 2}
    store = class_store(tmp_path / "store", trials=parts, head=adapter(name="boxes"))
    campaigns = collected(store)
    label(store, campaigns)
    problem = problem_of(StoreLabels(store), campaigns)
    train, validation = map(problem.samples, ("train", "validation"))
    display = nullcontext(SimpleNamespace(epoch=lambda record: None))
    for model in problem.models():
        problem.train(model, train, validation, lambda model: display)
    job = problem.job(None, None)
    workers = Workers(lambda split: in_order, lambda step, work, make: None, None)
    problem.evaluate(job, problem.prepare(job, workers))
    page = problem.page(lambda item: 0, {})
    scores = class_evaluation_of(store).scores
    assert scores.classes == ("box", "other")
    # two of the five objects are boxes
    assert [sum(row) for row in scores.confusion] == [4, 6]
    assert model_file.load(store.folder / "models" / "classes-seed0.pt").classes == scores.classes
    assert page.numbers["classes"]["classes"] == ["box", "other"]
    assert "other" in page.html


@pytest.mark.usefixtures("subject")
def test_detector_is_the_same_in_any_pieces() -> None:
    assert known()["lab_jump"] == "lab_rates.detector:Jump"
    detector = make_detector("lab_jump")
    rng = np.random.default_rng(1)
    quiet, burst = rng.integers(0, 500_000, 500), rng.integers(500_000, 600_000, 2_000)
    t_us = np.sort(np.concatenate([quiet, burst]))
    zeros = np.zeros(len(t_us), np.uint16)
    events = EventChunk(zeros, zeros, zeros.astype(np.uint8), t_us)
    found = []
    for cuts in ([600_000], [7_000, 10_000, 123_456, 500_001, 600_000]):
        detector.begin(640, 480)
        parts, at = [], 0
        for cut in cuts:
            end = int(np.searchsorted(t_us, cut))
            piece = EventChunk(*(column[at:end] for column in (events.x, events.y, events.p, t_us)))
            parts.append(detector.push(piece, cut))
            at = end
        found.append(np.concatenate([part.value for part in parts]))
    np.testing.assert_array_equal(*found)
    assert len(found[0]) == 60
    assert found[0][50] > 10 > found[0][1:50].max()


@pytest.mark.usefixtures("subject")
def test_detector_runs_live_and_in_a_reflex(tmp_path: Path) -> None:
    rig, named = ROOT / "rigs" / "rehearsal.yaml", ("--detector", "lab_jump", "--level", "0.5")
    found = answer("detect", "--rig", rig, *named, "--seconds", "1", "--out", tmp_path / "d.jsonl")
    assert found["detector"] == "lab_jump"
    assert found["windows"] >= 95
    protocol = write(tmp_path / "p.yaml", short_slide())
    moving = ("--protocol", protocol, "--trial", "", "--reflex", "stop", "--hold", "0.1")
    assert answer("detect", "--rig", rig, *named, *moving)["reflex"]["phase"] == "slide"
