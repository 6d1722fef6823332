"""Recordings that show one of several classes: train, evaluate and report, and what they refuse."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from jsonschema import Draft7Validator

from sliplab.analysis import problem
from sliplab.analysis.campaigns import class_names, collected
from sliplab.analysis.evaluation import baselines
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.baseline_nets import TAXEL_KINDS
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.evaluate import evaluate
from sliplab.flows.label import label
from sliplab.flows.planning.json_schemas import file_schema
from sliplab.flows.report import report
from sliplab.flows.train import train
from sliplab.flows.window_checks import window_baselines
from sliplab.plugins.classes import baselines as class_baselines
from sliplab.plugins.classes.document import ClassSummary
from sliplab.plugins.classes.evaluation import class_evaluation_of, whole_recordings
from sliplab.protocols.errors import InputError
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.command_line import answer, here
from tests.docs.nonsense import check_refusals
from tests.flows import class_store as made
from tests.flows.class_store import CLASSES, LENGTH_MS, adapter, begin_campaign, class_store
from tests.patching import loose

TRIALS = {"train": 10, "validation": 3, "test": 4}


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    """A store from labels to its page."""
    folder = tmp_path_factory.mktemp("classes")
    store = class_store(folder / "store", trials=TRIALS, head=adapter(epochs=12))
    campaigns = collected(store)
    for step in (label, train, evaluate, report):
        assert loose(step)(store, campaigns)["done"]
    return store


@pytest.fixture
def copied(judged: TrialStore, tmp_path: Path) -> TrialStore:
    """A copy of it, to be changed at will."""
    return TrialStore.open(shutil.copytree(judged.folder, tmp_path / "store"))


def samples(store: TrialStore, split: str) -> SampleSet:
    """The samples of a part of the split."""
    campaigns = collected(store)
    return load_samples(StoreLabels(store), campaigns, split, classes=class_names(campaigns))


def test_figures_are_those_of_the_chosen_network_on_the_test_recordings(judged: TrialStore) -> None:
    found = class_evaluation_of(judged)
    scores = found.scores
    assert scores.classes == CLASSES  # box 2 before box 10
    infos = [
        read_json(path) for path in sorted((judged.folder / "models").glob("classes-seed*.json"))
    ]
    best = max(infos, key=lambda info: info["validation"]["strict"])
    assert [info["seed"] for info in infos] == [0, 1]
    assert found.seed == best["seed"]

    fitted = model_file.load(judged.folder / "models" / f"classes-seed{found.seed}.pt")
    assert fitted.classes == CLASSES
    test = samples(judged, "test")
    counts = training.predict_counts(fitted, test.windows)
    assert counts.shape == (len(CLASSES) * TRIALS["test"], len(CLASSES))
    matrix = [[0] * (len(CLASSES) + 1) for _ in CLASSES]
    credit = []
    for row, true in zip(counts.tolist(), test.y.tolist(), strict=True):
        top = [k for k, value in enumerate(row) if value == max(row)]
        credit.append(1 / len(top) if true in top else 0.0)
        matrix[true][top[0] if len(top) == 1 else -1] += 1
    assert [list(row) for row in scores.confusion] == matrix
    right = sum(matrix[k][k] for k in range(len(CLASSES)))
    assert scores.accuracy.argmax == pytest.approx(np.mean(credit))
    assert scores.accuracy.strict == right / len(test)
    # one window each: recordings are windows
    assert scores.trials.argmax.share == pytest.approx(np.mean(credit))
    assert len(scores.wrong) == len(test) - right
    assert scores.accuracy.argmax > 0.6  # against 0.2 by chance: taxels tell classes apart
    for k, row in enumerate(scores.by_class):
        assert row.recall.share == matrix[k][k] / TRIALS["test"]
        said = sum(matrix[j][k] for j in range(len(CLASSES)))
        assert row.precision == (matrix[k][k] / said if said else None)
        assert row.windows.to_json() == TRIALS
    assert scores.windows.to_json() == {name: 5 * n for name, n in TRIALS.items()}
    assert sum(row.n for row in scores.by_factor["force"].values()) == len(test)


def test_accuracy_by_length_is_that_of_spikes_so_far(judged: TrialStore) -> None:
    found = class_evaluation_of(judged)
    fitted = model_file.load(judged.folder / "models" / f"classes-seed{found.seed}.pt")
    test = samples(judged, "test")
    spikes = []
    for window in test.x:
        stream = fitted.engine.stream()
        spikes.append([stream.push(plane) for plane in window])
    so_far = np.cumsum(np.array(spikes, np.int64), axis=1)  # window, step, class
    step_ms = fitted.windows.step_ms
    rows = found.scores.by_length
    assert (rows[0].ms, rows[-1].ms) == (step_ms, LENGTH_MS)
    for row in rows:
        counts = so_far[:, row.ms // step_ms - 1]
        top = counts == counts.max(axis=1, keepdims=True)
        credit = top[np.arange(len(test)), test.y] / top.sum(axis=1)
        assert row.share == pytest.approx(credit.mean())
    assert rows[-1].share == pytest.approx(found.scores.accuracy.argmax)


def test_counts_of_a_recordings_windows_are_added_up() -> None:
    counts = np.array([[3, 1, 0], [0, 4, 0], [2, 0, 0], [5, 5, 1], [0, 0, 9]])
    sums, true, trial = whole_recordings(
        counts, np.array([0, 0, 0, 1, 2]), np.array([0, 0, 1, 1, 1])
    )
    assert sums.tolist() == [[3, 5, 0], [2, 0, 0], [5, 5, 1], [0, 0, 9]]
    assert (true.tolist(), trial.tolist()) == ([0, 0, 1, 2], [0, 1, 1, 1])


def test_the_page_says_what_the_data_are_and_how_to_repeat_it(judged: TrialStore) -> None:
    folder = judged.folder / "report"
    page = (folder / "index.html").read_text()
    about = ("Classification report", "Objects touched by a skin of six taxels", "CC0", "clocks")
    said = ("How early a class is known", "logistic regression on each", "Guessing gives 20.0 %")
    for text in (*about, *said, f"sliplab train {judged.folder}"):
        assert text in page, text
    assert "simulated" not in page.split("</style>")[1].lower()
    written = read_json(folder / "summary.json")
    Draft7Validator(file_schema("classes-summary")).validate(written)
    summary = ClassSummary.load(folder / "summary.json")
    assert summary.data["objects"].unknown == {"clocks": 5 * sum(TRIALS.values())}
    assert summary.to_json() == written
    rows = list(csv.DictReader((folder / "data" / "confusion.csv").read_text().splitlines()))
    assert [row["true class"] for row in rows] == list(CLASSES)
    drawn = [int(row["called pen (windows)"]) for row in rows]
    assert drawn == [row[-2] for row in summary.classes.confusion]
    kept = judged.folder / "derived" / "evaluation" / "classes.json"
    Draft7Validator(file_schema("classes")).validate(read_json(kept))
    assert check_refusals("classes", kept) > 12
    assert check_refusals("classes-summary", folder / "summary.json") > 12


@pytest.mark.long
def test_nothing_is_made_twice_and_other_methods_join(
    copied: TrialStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(class_baselines, "TAXEL_KINDS", {"gru": TAXEL_KINDS["gru"]})
    monkeypatch.setattr(class_baselines, "CLASS_EPOCHS", 2)

    def boosted(*_: object, classes: int) -> None:
        raise ValueError(f"gradient boosting needs more than {classes} classes")

    monkeypatch.setattr(baselines, "boosted", boosted)
    campaigns = collected(copied)
    for name in ("label", "train", "evaluate"):
        found = answer(name, copied.folder)
        assert list(found) == ["step", "done", "fresh"]
        assert (found["step"], found["done"]) == (name, 0)
    done = window_baselines(copied, campaigns)
    assert done["argmax"].keys() == {"gru"}
    assert (done["done"], done["fresh"]) == (1, 0)
    said = " ".join(capsys.readouterr().err.split())
    assert "warning: boosting is left out: gradient boosting needs more than 5 classes" in said
    assert report(copied, campaigns)["done"] == 1
    summary = ClassSummary.load(copied.folder / "report" / "summary.json")
    assert summary.classes.trained_baselines.keys() == {"gru"}
    assert "gated recurrent unit" in (copied.folder / "report" / "index.html").read_text()
    assert window_baselines(copied, campaigns)["done"] == 0
    assert answer("report", copied.folder) == {"step": "report", "done": 0, "fresh": 1}


@pytest.mark.long
def test_parts_of_one_recording_may_show_several_classes(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "store")
    campaign = begin_campaign(store, adapter(), simulated=True)
    rng = np.random.default_rng(2)
    for part, count in TRIALS.items():
        for k in range(count):
            parts = [made.events(rng, n, 2, begin_ms=2 * n * LENGTH_MS) for n in (0, 1)]
            parts.insert(1, made.events(rng, 0, 2, begin_ms=LENGTH_MS))
            spans = [(0, 2 * LENGTH_MS, "still"), (2 * LENGTH_MS, 3 * LENGTH_MS, "stroke")]
            chunk = type(parts[0]).joined(parts)
            made.add_trial(
                campaign, f"{part}_{k}", chunk, spans, fields={"part": part}, simulated=True
            )
    campaigns = collected(store)
    assert class_names(campaigns) == ("still", "stroke")
    for step in (label, train, evaluate, report):
        loose(step)(store, campaigns)
    scores = class_evaluation_of(store).scores
    each = scores.trials.argmax
    assert (scores.accuracy.n, each.n, each.trials) == tuple(k * TRIALS["test"] for k in (3, 2, 1))
    page = (store.folder / "report" / "index.html").read_text()
    assert "Every number and figure in this report is simulated." in page
    assert "one or several of them" in page
    assert "mock rig" not in page.replace("\n", " ")


@pytest.mark.long
def test_a_class_without_training_recordings_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = class_store(tmp_path / "store", trials={"train": 3, "validation": 1, "test": 1})
    for path in (store.folder / "campaigns" / "objects" / "trials").glob("train_cup_*"):
        shutil.rmtree(path)
    campaigns = collected(store)
    label(store, campaigns)
    train(store, campaigns)
    said = " ".join(capsys.readouterr().err.split())
    assert "warning: no training samples of cup: the network cannot learn it" in said
    evaluate(store, campaigns)
    report(store, campaigns)
    page = (store.folder / "report" / "index.html").read_text()
    assert "no training windows of cup" in page


def test_without_settings_a_network_of_taxels_begins_by_the_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    head = adapter()
    windows = {**head["analysis"]["windows"], "parts": 2}
    store = class_store(tmp_path / "store", head={**head, "analysis": {"windows": windows}})
    campaigns = collected(store)
    label(store, campaigns)
    with monkeypatch.context() as less:
        less.setattr(problem, "MOST_CHANNELS", 8)
        with pytest.raises(InputError, match=r"outputs_per_class = 4: gives \d+ outputs"):
            train(store, campaigns)
    train(store, campaigns)
    fitted = model_file.load(store.folder / "models" / "classes-seed0.pt")
    channels = 2 * 2 * made.TAXELS
    assert (fitted.network.conv1_channels, fitted.windows.channels) == (channels, channels)
    evaluate(store, campaigns)
    found = class_evaluation_of(store)
    assert found.scores.accuracy.argmax == 1.0  # each object has its taxel


@pytest.mark.parametrize(
    ("trials", "classes", "text"),
    [
        ({"validation": 2, "test": 1}, CLASSES, "there are no training samples"),
        ({"train": 2, "validation": 1}, ("cup",), "1 class in the recordings; at least two"),
    ],
)
def test_what_cannot_be_trained_is_said(
    tmp_path: Path, trials: dict[str, int], classes: tuple[str, ...], text: str
) -> None:
    store = class_store(tmp_path / "store", classes, trials)
    campaigns = collected(store)
    label(store, campaigns)
    with pytest.raises(StoreError, match=text):
        train(store, campaigns)
    assert not list((store.folder / "models").glob("*"))


@pytest.mark.long
def test_without_test_recordings_there_are_no_figures(tmp_path: Path) -> None:
    store = class_store(tmp_path / "store", trials={"train": 2, "validation": 1})
    campaigns = collected(store)
    for name, made_of in (("label", 15), ("train", 2)):
        assert answer(name, store.folder) == {"step": name, "done": made_of, "fresh": 0}
    with pytest.raises(StoreError, match="there are no test samples"):
        evaluate(store, campaigns)
    with pytest.raises(StoreError, match="nothing evaluated yet; run `sliplab evaluate`"):
        report(store, campaigns)


def test_a_damaged_or_missing_model_is_asked_for(copied: TrialStore) -> None:
    (copied.folder / "models" / "classes-seed1.pt").unlink()
    with pytest.raises(StoreError, match=r"classes-seed1\.pt: is missing or stale"):
        evaluate(copied, collected(copied))


ABOUT_SLIP = "'objects': its recordings show classes, and this is about slip"
REFUSED = {
    "evaluate STORE --margin 3": (2, "--margin = 3.0: sets how slip is detected"),
    "evaluate STORE --smoothing 3": (2, "--smoothing = 3: sets how slip is detected"),
    "evaluate STORE --checks": (1, ABOUT_SLIP),
    "evaluate STORE --model STORE/models/classes-seed0.pt": (1, ABOUT_SLIP),
    "generalise STORE": (1, ABOUT_SLIP),
    "holdout STORE": (1, ABOUT_SLIP),
    "tradeoff STORE": (1, ABOUT_SLIP),
    "review STORE": (1, ABOUT_SLIP),
    "sync STORE": (1, "there are no clocks to fit"),
}


@pytest.mark.parametrize("command", REFUSED)
def test_what_belongs_to_slip_says_so_in_one_line(judged: TrialStore, command: str) -> None:
    code, text = REFUSED[command]
    done = here(*command.replace("STORE", str(judged.folder)).split())
    assert done.returncode == code, done.stderr
    assert len([line for line in done.stderr.splitlines() if line.startswith("error: ")]) == 1
    assert text in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr


def test_two_reports_on_classes_are_compared(judged: TrialStore) -> None:
    found = here("report", judged.folder, "--against", judged.folder, "--json")
    figures = {row["name"]: row for row in json.loads(found.stdout)["against"]["figures"]}
    assert {
        "accuracy, strict, mean of seeds",
        "accuracy on recordings, argmax, the chosen network",
    } <= figures.keys()
    assert not any(row["difference"] for row in figures.values())


def test_classes_and_slip_are_analysed_apart(copied: TrialStore) -> None:
    slides = adapter(name="slides", experiment="kinematic", split={})
    del slides["labels"]
    begin_campaign(copied, slides)
    with pytest.raises(InputError, match="'objects' is of classes and 'slides' of slip"):
        train(copied, collected(copied))
    assert train(copied, collected(copied, ["objects"]))["done"] == 0


def test_more_classes_than_a_byte_counts_are_told_apart_in_the_matrix() -> None:
    from sliplab.plugins.classes.plot import NAMED, confusion_map

    many = 130
    matrix = np.eye(many, many + 1, dtype=np.int64)
    names = [f"object {k}" for k in range(many)]
    svg = confusion_map(matrix, names, simulated=True)
    assert ">object 0<" in svg
    assert ">undecided<" in svg
    assert sum(svg.count(f">{name}<") for name in names) <= 2 * NAMED
    assert "simulated" in svg
