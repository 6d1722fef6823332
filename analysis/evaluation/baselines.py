"""Baselines on the same windows, each trained and stored: `sliplab evaluate --baselines`.

They take minutes and do not depend on the spiking network, so each is stored separately as soon as
it is complete, and is trained again only when a sample changed. Networks are trained with several
seeds and chosen among by validation windows, as the spiking network is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from sliplab.analysis.evaluation import windows as window_scores
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks.baseline_nets import (
    BATCH,
    EPOCHS,
    KINDS,
    fitted_net,
    net_votes,
)
from sliplab.analysis.networks.baselines import RIDGE, ROUNDS, boosted, logistic_cells
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import STEP as SAMPLES
from sliplab.storage.schema.evaluation import BaselineResult, TrainedBaseline
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import TrialStore

STEP = "baselines"
EVALUATION = "evaluation"
"""Step and name of what it is compared with."""
VERSION = 3
SEEDS = (0, 1, 2)
"""Seed of every ordinary network; other methods have nothing random."""
NAMES: dict[str, Any] = {
    "logistic_cells": RIDGE,
    "boosting": ROUNDS,
    **{kind: [EPOCHS, *SEEDS] for kind in KINDS},
}
"""Each baseline on windows of slip, and what else it depends on."""


@dataclass(frozen=True)
class Methods:
    """The methods that a network is compared with.

    Attributes:
        names: each method, and what else it depends on.
        classes: that there are.
        prefix: begins the names of samples and results.
        evaluation: name of the evaluation of the network.
        epochs, batch: of ordinary networks.
    """

    names: Mapping[str, Any]
    classes: int = len(metrics.CLASSES)
    prefix: str = ""
    evaluation: str = EVALUATION
    epochs: int = EPOCHS
    batch: int = BATCH

    def key(self, store: TrialStore, name: str) -> str:
        """Return the key of results on the samples in the store."""
        saved = Derived.of(store, SAMPLES)
        parts = [saved.key(f"{self.prefix}{split}") for split in ("train", "validation", "test")]
        return make_key(STEP, VERSION, parts, [name, self.names[name]])

    def fresh_keys(self, store: TrialStore) -> list[str]:
        """Keys of the baselines that are there and belong to today's samples."""
        saved = Derived.of(store, STEP)
        keys = {name: self.key(store, name) for name in self.names}
        return [key for name, key in keys.items() if saved.fresh(f"{self.prefix}{name}", key)]

    def results(self, store: TrialStore) -> dict[str, TrainedBaseline]:
        """Compare each baseline in the store with the network, by name; see `compared`.

        A network's figures of other windows than the baseline's are not compared.
        """
        saved = Derived.of(store, STEP)
        evaluated = Derived.of(store, EVALUATION).key(self.evaluation)
        network = window_scores.kept_counts(store, evaluated, self.prefix)
        found: dict[str, TrainedBaseline] = {}
        if network is None:
            return found
        for name in self.names:
            stored = f"{self.prefix}{name}"
            if not saved.fresh(stored, self.key(store, name)):
                continue
            votes = saved.arrays(stored)["votes"]
            if len(votes) != len(network["y"]):
                continue
            row = window_scores.compared(votes, network["counts"], network["y"], network["trial"])
            found[name] = TrainedBaseline(**dict(row), made=saved.load(stored, BaselineResult).made)
        return found


def slip_methods() -> Methods:
    """Return the methods on windows of slip."""
    return Methods(NAMES)


def train_baseline(
    name: str,
    train: SampleSet,
    validation: SampleSet,
    test: SampleSet,
    say: Callable[[str], None],
    methods: Methods,
) -> tuple[npt.NDArray[Any], dict[str, Any]]:
    """Return votes on the test windows, and what was fitted; `say` hears of each epoch.

    Raises:
        ValueError: there are too few samples for this method.
    """
    classes = methods.classes
    if name == "logistic_cells":
        return logistic_cells(train.windows, train.y, test.windows, classes)
    if name == "boosting":
        return boosted(train, validation, test.windows, classes=classes)
    runs = []
    for seed in SEEDS:

        def on_epoch(epoch: int, strict: float, seed: int = seed) -> None:
            validated = f"validation {100 * strict:.1f} %"
            say(f"{name}: seed {seed}, epoch {epoch} of {methods.epochs}, {validated}")

        net, stated = fitted_net(
            name,
            train,
            validation,
            methods.epochs,
            seed,
            on_epoch,
            classes=classes,
            batch=methods.batch,
        )
        runs.append((net_votes(net, test.windows, classes), stated))
    shares = [metrics.accuracy(votes, test.y).argmax for votes, _ in runs]
    each = [
        {"seed": seed, "validation_strict": stated["validation_strict"], "argmax": share}
        for seed, (_, stated), share in zip(SEEDS, runs, shares, strict=True)
    ]
    votes, stated = max(runs, key=lambda run: float(run[1]["validation_strict"]))
    return votes, {**stated, "seeds": each}
