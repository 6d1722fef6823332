"""`sliplab generalise`: the network on levels that it never saw, and on skins it never touched.

For a level of a factor a network is trained without its trials and tested on them. For other
skins, which differ by the scatter of their making (`mock.scene.skin.seed`), some of the same trials
are taken on each and the store's own network is tested on them. Each result is kept as soon as it
is there; after a stop a training resumes at its last epoch, a collection at its last trial.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from functools import partial
from typing import Any

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.models import Model, choose_model, training_settings, wanted_models
from sliplab.analysis.networks.training import EpochRecord
from sliplab.analysis.sweeps.generalisation import TrialSamples, markdown, scored, train_without
from sliplab.analysis.sweeps.runner import Json, ResultFile, Task, task_sweep
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import (
    TrialRef,
    by_id,
    load_samples,
    several,
    split_trials,
)
from sliplab.flows.other_rig import other_request, retake
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.storage.files import make_folder, write_text
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import Store

STEP, FILE, TABLE, VERSION = "generalisation", "results.json", "results.md", 1
SKIN_SEEDS = 101
"""Seed of the first other skin."""
SKINS, TRIALS = 5, 36
"""Other skins, and trials on each, unless others are asked for."""


class _Results(ResultFile):
    """The results, and a table of all of them."""

    def write(self, name: str, key: str, data: Json, arrays: Json | None = None) -> None:
        super().write(name, key, data, arrays)
        write_text(self.path.with_name(TABLE), markdown(self.all(), self.head["simulated"]))


class Generalisation:
    """A store's samples, and the results that are kept.

    Args:
        store: labelled, with a trained network.
        epochs: of each training, instead of the protocol's.
    """

    def __init__(self, store: Store, campaigns: list[Collected], epochs: int | None = None) -> None:
        self.store, self.folder = store, store.folder / "derived" / STEP
        make_folder(self.folder)
        self.results = _Results(self.folder / FILE, "results", {"simulated": store.simulated})
        self.campaigns = training_campaigns(campaigns)
        self.settings = training_settings(self.campaigns)
        if epochs is not None:
            change = {"epochs": epochs, "patience": epochs}
            how = self.settings.training.model_copy(update=change)
            self.settings = self.settings.model_copy(update={"training": how})
        samples, known = all_samples(store, self.campaigns)
        conditions = [item.plan.describe(trial) for item, trial, _ in known]
        self.trials = TrialSamples(samples, [trial.id for _, trial, _ in known], conditions)
        ids = [[item.name, trial.id, recording.checksum] for item, trial, recording in known]
        settings = self.settings.model_dump(mode="json")
        self._inputs = [VERSION, dataset.VERSION, *several(campaigns), ids, settings]

    def levels(self, factor: str) -> list[str]:
        """Return a factor's levels among the trials, in words, the lowest first.

        Raises:
            InputError: no trial has such a factor.
        """
        found = self.trials.levels(factor)
        if not found:
            known = ", ".join(self.factors())
            raise InputError("--factor", "", factor, f"must be a factor of the slides: {known}")
        return found

    def factors(self) -> list[str]:
        """Return all factors of two levels or more."""
        names = (
            name for item in self.campaigns for name in item.plan.protocol.collection.all_factors
        )
        return [name for name in dict.fromkeys(names) if len(self.levels(name)) > 1]

    def without(self, factor: str, level: str) -> Task:
        """Return the task that trains without a level and tests on it."""
        name = f"{factor} {level}"
        epochs = self.settings.training.epochs
        key = self._key(name, training.VERSION)

        def on_epoch(record: EpochRecord) -> None:
            share = f"validation {100 * record.val_strict:.1f} %"
            console.say(f"without {name}: epoch {record.epoch} of at most {epochs}, {share}")

        state = self.folder / f"{key[:16]}.state"
        work = partial(train_without, self.trials, factor, level, self.settings, state, on_epoch)
        return Task(name, key, work)

    def skin(self, model: Model, seed: int, trials: int) -> Task:
        """Return the task that tests the store's network on another skin of the same design."""
        name = f"skin {seed}"
        key = self._key(name, [self.campaigns[0].info["rig_hash"], trials, model.key])
        return Task(name, key, lambda: self.touch(model, seed, trials))

    def touch(self, model: Model, seed: int, trials: int) -> Json:
        """Take some of the same trials on another skin, judge them, and let them go."""
        item, folder = self.campaigns[0], self.folder / f"skin{seed}"
        taken = Store.create(folder / "store").campaign(item.name).committed()
        change = {"mock": {"scene": {"skin": {"seed": seed}}}}
        request = other_request(item, change, folder, most=max(0, trials - len(taken)))
        samples, _ = all_samples(*retake([request]))
        counts = training.predict_counts(model_file.load(model.path), samples.windows)
        shutil.rmtree(folder)
        return scored(counts, samples.y, samples.trial)

    def _key(self, name: str, inputs: Any) -> str:
        return make_key(STEP, VERSION, self._inputs, [name, inputs])


def all_samples(store: Store, campaigns: list[Collected]) -> tuple[SampleSet, list[TrialRef]]:
    """Return the samples of all parts of the split, and their trials in the samples' order."""
    labels = Labels(store)
    splits = ("train", "validation", "test")
    parts = [load_samples(labels, campaigns, split) for split in splits]
    joined = SampleSet.join(parts, campaigns[0].settings.windows)
    found = by_id([ref for split in splits for ref in split_trials(campaigns, split)])
    return joined, [found[name] for name in joined.trials]


def measure_generalisation(
    store: Store,
    campaigns: list[Collected],
    factors: Sequence[str] = (),
    levels: Sequence[str] = (),
    every: bool = False,
    skins: int | None = None,
    trials: int = TRIALS,
    epochs: int | None = None,
) -> Json:
    """Measure what is missing of what is asked for.

    Args:
        factors: these; all by default.
        levels: these levels of them.
        every: all levels; by default, the lowest of each factor.
        skins: how many others; by default `SKINS` where trials are simulated, else none.
        trials: on each other skin.
        epochs: of each training, instead of the protocol's.

    Raises:
        InputError: no such factor or level, or other skins of a real rig.
    """
    work = Generalisation(store, campaigns, epochs)
    known = {factor: work.levels(factor) for factor in factors or work.factors()}
    unknown = set(levels) - {level for there in known.values() for level in there}
    if unknown:
        there = ", ".join(level for there in known.values() for level in there)
        raise InputError("--level", "", min(unknown), f"must be one of {there}")
    tasks = [
        work.without(factor, level)
        for factor, there in known.items()
        for level in there
        if (level in levels if levels else every or level == there[0])
    ]
    count = skins if skins is not None else SKINS if store.simulated else 0
    if count:
        if not store.simulated:
            raise InputError("--skins", "", 1, "must be 0: only a simulated rig has other skins")
        model = choose_model(wanted_models(store, work.campaigns))
        tasks += [work.skin(model, SKIN_SEEDS + number, trials) for number in range(count)]
    sweep = task_sweep(tasks, work.results)
    made = sweep.run(begin=lambda number, count, task: console.say(f"{task.name} ..."))
    return {
        "step": STEP,
        "simulated": store.simulated,
        "made": made,
        "results": {task.name: work.results.read(task.name) for task in tasks},
        "file": str(work.folder / FILE),
    }
