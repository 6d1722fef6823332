"""`sliplab evaluate --checks`: tries to show that figures cannot be trusted; fails if so."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.window_checks import (
    CheckFailed,
    check_chance,
    check_permutations,
    permuted,
    shuffled_chance,
)
from sliplab.flows.learning.evaluate import choose_model
from sliplab.flows.learning.samples import load_samples
from sliplab.flows.learning.train import training_settings, wanted_models
from sliplab.flows.running import console
from sliplab.storage.trials.store import Store, StoreError

EPOCHS = 3
"""Of each training on shuffled labels: as many as true labels need to be well above chance."""

MOST = 2000
"""Test windows that are looked at, evenly spread over all."""


def window_checks(
    store: Store, campaigns: list[Collected], reviewed: bool = False
) -> dict[str, Any]:
    """Permuted classes, shuffled labels, and no trial in two parts of the split.

    Raises:
        StoreError: a check failed; the message says which figure cannot be trusted.
    """
    settings = training_settings(campaigns)
    labels = Labels(store, reviewed)
    train, validation, test = (
        load_samples(labels, campaigns, split) for split in ("train", "validation", "test")
    )
    if not len(test):
        raise StoreError("there are no test samples to check; collect more trials")
    model = choose_model(wanted_models(store, campaigns, reviewed))
    rows = np.unique(np.linspace(0, len(test) - 1, min(MOST, len(test))).astype(np.int64))
    few = test.windows.take(rows)
    how = settings.training.model_copy(update={"epochs": EPOCHS, "patience": EPOCHS})
    try:
        console.say("permuted classes")
        orders = check_permutations(
            permuted(model_file.load(model.path), few), test.y[rows], metrics.score
        )
        console.say("shuffled labels (nine short trainings)")
        chance = shuffled_chance(
            (train.windows, train.y), (validation.windows, validation.y), (few, test.y[rows]),
            settings.network, settings.windows, how,
        )  # fmt: skip
        check_chance(chance)
    except (CheckFailed, ValueError) as error:
        raise StoreError(f"{store.folder}: {error}") from None
    return {"step": "checks", "done": 2, "fresh": 0, "orders": orders, "shuffled": asdict(chance)}
