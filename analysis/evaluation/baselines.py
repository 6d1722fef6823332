"""Other methods on the same windows, each trained and kept: `sliplab evaluate --baselines`.

They take minutes and do not depend on the spiking network, so each is kept on its own as soon as
it is there, and is made again only when a sample changed. Networks are trained with several seeds
and chosen among by validation windows, as the spiking network is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy.typing as npt

from sliplab.analysis.evaluation import windows as window_scores
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks.baseline_nets import EPOCHS, KINDS, trained_net
from sliplab.analysis.networks.baselines import RIDGE, ROUNDS, boosted, logistic_cells
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import STEP as SAMPLES
from sliplab.storage.schema.evaluation import BaselineResult, TrainedBaseline
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import Store

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
"""Each baseline, and what else it depends on."""


def baseline_key(store: Store, name: str) -> str:
    """Return the key of results on the samples in the store."""
    kept = Derived.of(store, SAMPLES)
    samples = [kept.key(split) for split in ("train", "validation", "test")]
    return make_key(STEP, VERSION, samples, [name, NAMES[name]])


def fresh_keys(store: Store) -> list[str]:
    """Keys of the baselines that are there and belong to today's samples."""
    kept = Derived.of(store, STEP)
    return [key for name in NAMES if kept.fresh(name, key := baseline_key(store, name))]


def baselines(store: Store) -> dict[str, TrainedBaseline]:
    """Compare each baseline in the store with the network, by name; see `window_scores.compared`.

    A network's figures of other windows than the baseline's are not compared.
    """
    kept = Derived.of(store, STEP)
    network = window_scores.kept_counts(store, Derived.of(store, EVALUATION).key(EVALUATION))
    found: dict[str, TrainedBaseline] = {}
    if network is None:
        return found
    for name in NAMES:
        if not kept.fresh(name, baseline_key(store, name)):
            continue
        votes = kept.arrays(name)["votes"]
        if len(votes) != len(network["y"]):
            continue
        row = window_scores.compared(votes, network["counts"], network["y"], network["trial"])
        found[name] = TrainedBaseline(**dict(row), made=kept.load(name, BaselineResult).made)
    return found


def train_baseline(
    name: str,
    train: SampleSet,
    validation: SampleSet,
    test: SampleSet,
    say: Callable[[str], None],
) -> tuple[npt.NDArray[Any], dict[str, Any]]:
    """Return votes on the test windows, and what was fitted; `say` hears of each epoch."""
    if name == "logistic_cells":
        return logistic_cells(train.windows, train.y, test.windows)
    if name == "boosting":
        return boosted(train, validation, test.windows)
    runs = []
    for seed in SEEDS:

        def on_epoch(epoch: int, strict: float, seed: int = seed) -> None:
            validated = f"validation {100 * strict:.1f} %"
            say(f"{name}: seed {seed}, epoch {epoch} of {EPOCHS}, {validated}")

        runs.append(
            trained_net(name, train, validation, test.windows, seed=seed, on_epoch=on_epoch)
        )
    shares = [metrics.accuracy(votes, test.y).argmax for votes, _ in runs]
    each = [
        {"seed": seed, "validation_strict": said["validation_strict"], "argmax": share}
        for seed, (_, said), share in zip(SEEDS, runs, shares, strict=True)
    ]
    votes, said = max(runs, key=lambda run: float(run[1]["validation_strict"]))
    return votes, {**said, "seeds": each}
