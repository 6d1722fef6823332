"""Other methods on the same windows, and checks that try to show a figure to be wrong."""

from __future__ import annotations

from functools import partial

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation import baselines
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import (
    choose_model,
    training_settings,
    wanted_models,
)
from sliplab.analysis.networks.window_checks import (
    Chance,
    CheckFailed,
    check_chance,
    check_permutations,
    permuted,
    shuffled_chance,
)
from sliplab.analysis.problem import need_slip, problem_of
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.running import console
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.storage.schema.evaluation import BaselineResult
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import StoreError, TrialStore

SPLITS = ("train", "validation", "test")
CHECKED_EPOCHS = 3
"""Epochs of each training on shuffled labels: enough to beat chance clearly with true labels."""
CHECKED_WINDOWS = 2000
"""Number of test windows that are checked, evenly spread over all."""


class BaselinesDone(StepResult):
    """Numbers of what `window_baselines` did; `argmax` accuracy by method."""

    argmax: dict[str, float | None]


class ChecksDone(StepResult):
    """Numbers of what `window_checks` did.

    Attributes:
        orders: of the classes that were tried; shuffled: accuracies on shuffled labels.
    """

    orders: int
    shuffled: Chance


def window_baselines(
    store: TrialStore, campaigns: list[Collected], reviewed: bool = False
) -> BaselinesDone:
    """Train and keep every baseline that is missing or stale.

    Args:
        reviewed: people's decisions are applied to the labels.
    """
    problem = problem_of(StoreLabels(store, reviewed), campaigns)
    methods = problem.baselines()
    of = methods.prefix
    train, validation, test = map(problem.samples, SPLITS)
    stored = Derived.of(store, baselines.STEP)
    keys = {name: methods.key(store, name) for name in methods.names}
    stale = [name for name, key in keys.items() if not stored.fresh(f"{of}{name}", key)]
    if stale:
        with timed(store, "baselines"):
            for name in stale:
                console.say(f"{name}: {len(train)} training windows")
                try:
                    votes, made = baselines.train_baseline(
                        name, train, validation, test, console.say, methods
                    )
                except ValueError as error:  # too few samples for this one
                    console.say(f"warning: {name} is left out: {error}")
                    continue
                result = BaselineResult(made=made, argmax=metrics.accuracy(votes, test.y).argmax)
                stored.write(f"{of}{name}", keys[name], result, {"votes": votes})
    there = [name for name, key in keys.items() if stored.fresh(f"{of}{name}", key)]
    return {
        "step": "baselines",
        "done": len(set(stale).intersection(there)),
        "fresh": len(keys) - len(stale),
        "argmax": {name: stored.load(f"{of}{name}", BaselineResult).argmax for name in there},
    }


def window_checks(
    store: TrialStore, campaigns: list[Collected], reviewed: bool = False
) -> ChecksDone:
    """Check permuted classes, shuffled labels, and that no trial is in two parts of the split.

    Raises:
        StoreError: a check failed; the message says which figure cannot be trusted.
    """
    labels = StoreLabels(store, reviewed)
    need_slip(labels, campaigns)
    settings = training_settings(campaigns)
    load = partial(load_samples, labels, campaigns)
    train, validation, test = map(load, SPLITS)
    if not len(test):
        raise StoreError("there are no test samples to check; collect more trials")
    model = choose_model(wanted_models(store, campaigns, reviewed))
    rows = np.unique(
        np.linspace(0, len(test) - 1, min(CHECKED_WINDOWS, len(test))).astype(np.int64)
    )
    few = test.windows.take(rows)
    change = {"epochs": CHECKED_EPOCHS, "patience": CHECKED_EPOCHS}
    how = settings.training.model_copy(update=change)
    try:
        console.say("permuted classes")
        orders = check_permutations(
            permuted(model_file.load(model.path), few), test.y[rows], metrics.score
        )
        console.say("shuffled labels (nine short trainings)")
        chance = shuffled_chance(
            (train.windows, train.y),
            (validation.windows, validation.y),
            (few, test.y[rows]),
            settings.network,
            settings.windows,
            how,
        )
        check_chance(chance)
    except (CheckFailed, ValueError) as error:
        raise StoreError(f"{store.folder}: {error}") from None
    return {"step": "checks", "done": 2, "fresh": 0, "orders": orders, "shuffled": chance}
