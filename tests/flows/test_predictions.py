"""Predictions of any model: judged as our networks are, and refused where they do not fit."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import sliplab
from sliplab.analysis import problem
from sliplab.analysis.campaigns import collected
from sliplab.analysis.evaluation.networks import STEP, retained
from sliplab.flows.window_checks import window_checks
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.flows.older import older_store

SPIKES = ["no_slip_spikes", "incipient_spikes", "gross_spikes"]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> sliplab.Store:
    """Four labelled slides and a network."""
    store = sliplab.open_store(older_store(tmp_path_factory.mktemp("predictions") / "store"))
    store.label()
    return store


@pytest.fixture(scope="module")
def own(store: sliplab.Store) -> pd.DataFrame:
    """Output spikes of the store's network in its test windows."""
    return sliplab.load_model(store.models()[0]).predict(store)


def stored(store: sliplab.Store, name: str) -> dict[str, object]:
    found = Derived.of(TrialStore.open(store.folder), STEP).read(name)
    return {key: found[key] for key in ("windows", "trials", "experiments", "detection")}


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_own_predictions_give_the_figures_of_the_network(
    store: sliplab.Store, own: pd.DataFrame, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"ours{suffix}"
    shuffled = own.sample(frac=1, random_state=1)
    _ = shuffled.to_csv(path, index=False) if suffix == ".csv" else shuffled.to_parquet(path)
    expected = store.evaluate(model=store.models()[0])
    done = here("evaluate", store.folder, "--predictions", path, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    for key in ("accuracy", "interval", "latency_ms", "lead_ms", "margin", "false_alarms"):
        assert expected[key] == found[key], key
    assert found["accuracy"]["n"] == store.windows("test")["label"].notna().sum()
    assert stored(store, "predictions-ours") == stored(store, f"model-{store.models()[0].stem}")
    # again there is nothing to do
    assert store.evaluate(predictions=path)["done"] == 0


def test_windows_name_every_window_of_training_and_judging(
    store: sliplab.Store, own: pd.DataFrame
) -> None:
    windows = store.windows()
    assert set(windows["split"]) == {"train", "validation", "test"}
    assert not windows.duplicated(["campaign", "trial", "start_ns"]).any()
    assert (windows["end_ns"] - windows["start_ns"]).unique().tolist() == [30_000_000]
    assert (windows["run"] | windows["label"].notna()).all()
    assert set(windows["label"].dropna()) == {"no_slip", "incipient", "gross"}
    test = store.windows("test")
    assert (test[["trial", "start_ns"]] == own[["trial", "start_ns"]]).all().all()
    with pytest.raises(sliplab.InputError, match="split = tests: must be one of"):
        store.windows("tests")


def test_probabilities_and_classes_are_judged_by_any_lead(
    store: sliplab.Store, own: pd.DataFrame
) -> None:
    counts = own[SPIKES].to_numpy(np.float64) + 1e-3
    shares = counts / counts.sum(axis=1, keepdims=True)
    names = ["no_slip", "incipient", "gross"]
    columns = {name: shares[:, k] for k, name in enumerate(names)}
    by_probability = store.evaluate(predictions=own[["trial", "start_ns"]].assign(**columns))
    strict = store.evaluate(predictions=own, margin=0)["accuracy"]["strict"]
    assert set(by_probability["margin"].values()) == {0.0}
    assert by_probability["accuracy"]["strict"] == by_probability["accuracy"]["margin"] == strict
    truth = store.windows("test")["label"]
    perfect = own[["trial", "start_ns"]].assign(**{"class": truth.fillna("no_slip")})
    found = store.evaluate(predictions=perfect)
    assert found["accuracy"]["strict"] == found["accuracy"]["argmax"] == 1
    with pytest.raises(sliplab.InputError, match="--margin = 2: must be a fraction from 0 to 1"):
        store.evaluate(predictions=perfect, margin=2)


def test_margin_counts_by_the_outputs_of_the_model(
    store: sliplab.Store, own: pd.DataFrame, tmp_path: Path
) -> None:
    outputs = own.attrs["outputs_per_class"]
    (usual,) = store.evaluate(predictions=own)["margin"].values()
    twice = own.copy()
    twice.attrs["outputs_per_class"] = 2 * outputs
    twice.to_parquet(tmp_path / "twice.parquet")
    for given, margin in {"table": twice, "file": tmp_path / "twice.parquet"}.items():
        (found,) = store.evaluate(predictions=margin)["margin"].values()
        assert found == 2 * usual, given
    twice.attrs["outputs_per_class"] = "many"
    assert store.evaluate(predictions=twice)["margin"] == {"small": usual}


def test_another_problem_is_refused_by_its_name(
    store: sliplab.Store, own: pd.DataFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    force = SimpleNamespace(name="force", of_slip=False)
    monkeypatch.setattr(problem, "problem_of", lambda *_: force)
    for call in (
        store.windows,
        store.torch_dataset,
        store.tonic_dataset,
        lambda: store.evaluate(predictions=own),
        lambda: store.evaluate(model=store.models()[0]),
        lambda: window_checks(TrialStore.open(store.folder), collected(store._store)),
    ):
        with pytest.raises(sliplab.StoreError, match="show force, and this is about slip"):
            call()


FAULTS: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame], str]] = {
    "missing": (lambda t: t.iloc[2:], "missing: 2 windows: "),
    "double": (lambda t: pd.concat([t, t.iloc[:1]]), "more than once: 1 window: "),
    "strange": (
        lambda t: pd.concat([t, t.iloc[:1].assign(start_ns=7)]),
        "unknown, `Store.windows` lists the right ones: 1 window: 7 of ",
    ),
    "trial": (
        lambda t: pd.concat([t, t.iloc[:1].assign(trial="nobody")]),
        "nobody: no labelled test trial of the store",
    ),
    "nan": (
        lambda t: t.assign(gross_spikes=t["gross_spikes"].where(t.index != 3)),
        "must be whole numbers from 0 to 1,000,000; not so in 1 row: 3",
    ),
    "half": (lambda t: t.assign(gross_spikes=0.5), "must be whole numbers from 0"),
    "too many": (lambda t: t.assign(gross_spikes=1e19), "from 0 to 1,000,000"),
    "time": (lambda t: t.assign(start_ns=None), "start_ns: must be whole nanoseconds"),
    "column": (lambda t: t.drop(columns=["trial"]), "trial: is missing"),
    "outputs": (lambda t: t.drop(columns=SPIKES), "must have the columns class or no_slip,"),
    "kinds": (lambda t: t.assign(**{"class": "gross"}), "there are several of these"),
    "class": (
        lambda t: t.drop(columns=SPIKES).assign(**{"class": "slip"}),
        "class: must be one of no_slip, incipient, gross",
    ),
    "share": (
        lambda t: t.drop(columns=SPIKES).assign(no_slip=2.0, incipient=0.0, gross=0.0),
        "must be from 0 to 1",
    ),
    "sum": (
        lambda t: t.drop(columns=SPIKES).assign(no_slip=0.8, incipient=0.5, gross=0.3),
        "must be from 0 to 1, and add up to 1; not so in ",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_does_not_fit_is_named(store: sliplab.Store, own: pd.DataFrame, fault: str) -> None:
    change, words = FAULTS[fault]
    with pytest.raises(sliplab.InputError) as caught:
        store.evaluate(predictions=change(own))
    assert words in str(caught.value)


def test_all_faults_are_named_at_once_with_exit_code_2(
    store: sliplab.Store, own: pd.DataFrame, tmp_path: Path
) -> None:
    table = pd.concat([own.iloc[1:], own.iloc[5:6], own.iloc[:1].assign(trial="nobody")])
    table["gross_spikes"] = table["gross_spikes"].where(table.index != 3, -1)
    path = tmp_path / "wrong.CSV"
    table.to_csv(path, index=False)
    done = here("evaluate", store.folder, "--predictions", path)
    assert done.returncode == 2
    said = " ".join(done.stderr.split())
    faults = ("nobody: no labelled", "missing: 1 window", "more than once", "must be whole numbers")
    for words in faults:
        assert words in said
    for words, options in {
        "cannot be read": ("--predictions", tmp_path / "none.csv"),
        ".csv or .parquet": ("--predictions", tmp_path / "a.txt"),
        "cannot be given with --model": ("--predictions", path, "--model", path),
        "applies only to the store's own": ("--predictions", path, "--baselines"),
    }.items():
        done = here("evaluate", store.folder, *options)
        assert done.returncode == 2
        assert words in done.stderr


def test_predictions_stand_beside_the_networks_of_the_report(
    store: sliplab.Store, own: pd.DataFrame
) -> None:
    store.evaluate(predictions=own)
    opened = TrialStore.open(store.folder)
    found = retained(opened, collected(opened))["predictions"]
    assert (found.engine, found.title) == ("predictions", "predictions")
