"""Other networks on a store: the preset that `also` names, and models of files."""

from __future__ import annotations

import json
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from sliplab.analysis.campaigns import collected
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.networks import STEP
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.network import spike_counts
from sliplab.analysis.networks.training import restore
from sliplab.analysis.windows.dataset import trial_windows
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.evaluate import evaluate
from sliplab.flows.judge_network import judge_model
from sliplab.flows.report import report
from sliplab.flows.train import train
from sliplab.protocols import InputError
from sliplab.protocols.windows import Windows
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.flows.conftest import summary_json


@pytest.fixture
def store(own_study: TrialStore) -> TrialStore:
    return own_study


LAB = """
import torch
from sinabs.activation import MembraneReset, SingleSpike
from sinabs.layers import IAFSqueeze
from torch import nn


def neurons():
    return IAFSqueeze(num_timesteps=30, spike_fn=SingleSpike, reset_fn=MembraneReset())


torch.manual_seed(0)
net = nn.Sequential(
    nn.Conv2d(1, 4, 5, padding=2, bias=False), neurons(),
    nn.Conv2d(4, 6, 3, stride=2, padding=1, bias=False), neurons(),
    nn.Flatten(), nn.Linear(600, 16), neurons(), nn.Linear(16, 3), neurons(),
)
with torch.no_grad():
    for value in net.parameters():
        if value.ndim:  # a threshold has none
            value.copy_(value * 4)


def network(x):
    for layer in net:
        if isinstance(layer, IAFSqueeze):
            layer.reset_states()
    with torch.no_grad():
        spikes = net(torch.from_numpy(x).float().flatten(0, 1))
    return spikes.unflatten(0, (len(x), -1)).sum(dim=1)
"""


def lab(folder: Path) -> str:
    """A lab's network in plain Sinabs, for windows of the store."""
    (folder / "lab.py").write_text(LAB)
    return f"{folder / 'lab.py'}:network"


def test_the_papers_network_is_judged_by_its_own_rule(store: TrialStore) -> None:
    campaigns = collected(store)
    found = Derived.of(store, STEP).read("preset-paper")
    rules = found["detection"]
    assert {(rule["smoothing"], rule["margin"]) for rule in rules.values()} == {(4, 2.0)}
    assert rules.keys() == {"tiny", "tiny_gravity"}
    fitted = model_file.load(store.folder / "models" / "paper-seed0.pt")
    assert (fitted.network.outputs_per_class, fitted.network.biases) == (1, False)
    test = load_samples(StoreLabels(store), campaigns, "test")
    counts = spike_counts(restore(fitted), test.x)
    expected = metrics.score(counts, test.y, 2.0).to_json()
    assert {name: found["windows"][name] for name in expected} == json.loads(json.dumps(expected))
    assert len(found["trials"]) == 4
    assert (
        summary_json(store)["networks"]["preset-paper"]["kinematic"]["accuracy"]
        == (expected["accuracy"])
    )


@pytest.mark.long
def test_the_preset_by_itself_is_the_network_that_stood_beside(
    store: TrialStore, tmp_path: Path
) -> None:
    comparison = Derived.of(store, STEP).read("preset-paper")
    shutil.copytree(store.folder, tmp_path / "store")
    for item in collected(TrialStore.open(tmp_path / "store")):
        file = item.campaign.protocol_file
        data = yaml.safe_load(file.read_text())
        data["analysis"]["preset"] = "paper"
        file.write_text(yaml.safe_dump(data))
    alone = TrialStore.open(tmp_path / "store")
    campaigns = collected(alone)
    assert train(alone, campaigns)["done"] == 1
    models = alone.folder / "models"
    assert (models / "seed0.pt").read_bytes() == (models / "paper-seed0.pt").read_bytes()
    assert evaluate(alone, campaigns)["done"] == 1
    found = evaluation_of(alone).to_json()
    assert found["windows"]["accuracy"] == comparison["windows"]["accuracy"]
    assert found["trials"] == comparison["trials"]
    report(alone, campaigns)
    said = summary_json(alone)["paper"]
    assert (said["preset"], said["differences"]) == ("paper", [])


@pytest.mark.long
def test_a_labs_network_is_asked_for_its_counts(store: TrialStore, tmp_path: Path) -> None:
    place, campaigns = lab(tmp_path), collected(store)
    done = here("evaluate", store.folder, "--model", place, "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["engine"], said["margin"]["tiny"]) == ("function", 2.0)
    network = runpy.run_path(str(tmp_path / "lab.py"))["network"]
    test = load_samples(StoreLabels(store), campaigns, "test")
    expected = network(test.x).numpy().astype(np.int64)
    assert said["accuracy"] == metrics.accuracy(expected, test.y, 2.0).to_json()
    assert len(np.unique(expected, axis=0)) > 3
    for item in campaigns:
        kept = Derived.of(store, "counts-model-lab-network", item.name)
        for _, recording in item.of_split("test"):
            x, end_ns = trial_windows(recording, Windows())
            arrays = kept.arrays(recording.folder.name)
            np.testing.assert_array_equal(arrays["counts"], network(x.dense()).numpy())
            np.testing.assert_array_equal(arrays["end_ns"], end_ns)
    # again there is nothing to do, and the report has a column more
    assert judge_model(store, campaigns, Path(place))["done"] == 0
    assert report(store, campaigns)["done"] == 1
    page = (store.folder / "report" / "index.html").read_text()
    assert "lab.py:network (simulated)" in page
    assert "88 ms after onset" in page
    assert "measured by its authors on their own robot" in " ".join(page.split())
    assert "paper preset (simulated)" in page
    assert "a function of another program" in page


def test_a_model_of_this_program_is_judged_as_in_its_store(store: TrialStore) -> None:
    own = Derived.of(store, "evaluation").read("evaluation")
    found = judge_model(store, collected(store), store.folder / "models" / "seed0.pt")
    assert found["accuracy"].to_json() == own["windows"]["accuracy"]
    assert found["interval"].to_json() == own["windows"]["interval"]
    assert Derived.of(store, STEP).read("model-seed0")["trials"] == own["trials"]


def test_sinabs_gives_the_counts_of_the_kernels(store: TrialStore) -> None:
    path = store.folder / "models" / "seed0.pt"
    fast, slow = (judge_model(store, collected(store), path, how) for how in ("fast", "sinabs"))
    assert slow["accuracy"] == fast["accuracy"]
    assert slow["latency_ms"] == fast["latency_ms"]


def test_what_cannot_be_judged_is_refused(store: TrialStore, tmp_path: Path) -> None:
    campaigns = collected(store)
    with pytest.raises(InputError, match=r"lab\.pt: cannot be read"):
        judge_model(store, campaigns, tmp_path / "lab.pt")
    torch.save({"weight": torch.ones(3)}, tmp_path / "lab.pt")
    with pytest.raises(InputError, match=r"a network of another program as FILE\.py:FUNCTION"):
        judge_model(store, campaigns, tmp_path / "lab.pt")
    with pytest.raises(InputError, match=r"--engine = fast: is of model files"):
        judge_model(store, campaigns, Path(lab(tmp_path)), "fast")
    done = here("evaluate", store.folder, "--engine", "fast")
    assert done.returncode == 2
    assert "--engine = fast: belongs to --model" in done.stderr
