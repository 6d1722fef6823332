"""Latencies of every trained network on the same trials."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sliplab.analysis.campaigns import collected
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.trials import judge, summaries
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import wanted_models
from sliplab.flows.evaluate import evaluate
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.report import read_summary
from sliplab.flows.study import study
from sliplab.storage.trials.store import TrialStore
from tests.flows.conftest import Ran, summary_json, tiny, tiny_gravity, write


@pytest.fixture(scope="module")
def two_seeds(ran: Ran, tmp_path_factory: pytest.TempPathFactory, rig_path: Path) -> TrialStore:
    """Slides by consecutive windows and falling plates by overlapping ones; two networks.

    The trials and their labels are those of the small study.
    """
    folder = tmp_path_factory.mktemp("seeds")
    shutil.copytree(ran[0][0].store, folder / "store")
    slides, plates = tiny(), tiny_gravity()
    slides["analysis"]["training"] = {"epochs": 2, "seeds": [3, 4]}
    plates["analysis"]["detection"] = {"stride_ms": 10}
    files = [write(folder / f"{data['name']}.yaml", data) for data in (slides, plates)]
    study([make_request(file, rig_path, folder / "store") for file in files])
    return TrialStore.open(folder / "store")


@pytest.mark.long
def test_each_network_is_judged_by_the_chosen_one_s_rule(two_seeds: TrialStore) -> None:
    campaigns = collected(two_seeds)
    found = evaluation_of(two_seeds)
    for model in wanted_models(two_seeds, campaigns):
        fitted = model_file.load(model.path)
        alone = summaries(judge(fitted, found.detection, two_seeds, campaigns).rows)
        for name, scores in found.experiments.items():
            (ours,) = (it for it in scores.by_seed if it.seed == model.seed)
            assert ours.chosen == (model.seed == found.seed)
            assert ours.latency_ms == alone[name].latency_ms
            assert ours.lead_ms == alone[name].lead_ms
            if ours.chosen:
                assert (ours.latency_ms, ours.lead_ms) == (scores.latency_ms, scores.lead_ms)
    slides = found.experiments["kinematic"].by_seed
    assert [it.seed for it in slides] == [3, 4]
    assert slides[0].latency_ms != slides[1].latency_ms


@pytest.mark.long
def test_spikes_of_every_network_are_kept(two_seeds: TrialStore) -> None:
    campaigns = collected(two_seeds)
    assert evaluate(two_seeds, campaigns)["done"] == 0
    kept = evaluation_of(two_seeds)

    def counted() -> dict[Path, int]:
        files = (two_seeds.folder / "derived").glob("counts*/**/*.npz")
        return {path: path.stat().st_mtime_ns for path in files}

    before = counted()
    assert any("counts_seed" in str(path) for path in before)
    assert evaluate(two_seeds, campaigns, margin=0.0)["done"] == 1
    other = evaluation_of(two_seeds)
    assert all(len(scores.by_seed) == 2 for scores in other.experiments.values())
    assert evaluate(two_seeds, campaigns)["done"] == 1
    assert evaluation_of(two_seeds) == kept
    assert counted() == before


@pytest.mark.long
def test_the_report_shows_every_network(two_seeds: TrialStore) -> None:
    found = evaluation_of(two_seeds)
    summary = read_summary(two_seeds)
    assert summary.gravity.by_seed == found.experiments["gravity"].by_seed
    page = (two_seeds.folder / "report/index.html").read_text()
    assert f"{found.seed}, shown above" in page
    assert "The same trials by every trained network" in page
    assert len(summary_json(two_seeds)["kinematic"]["by_seed"]) == 2


def test_one_network_is_not_shown_twice(ran: Ran) -> None:
    (run_request, *_), _ = ran
    store = TrialStore.open(run_request.store)
    assert "by_seed" not in summary_json(store)["kinematic"]
    page = (store.folder / "report/index.html").read_text()
    assert "every trained network" not in page
