"""`sliplab generalise`: accuracy on levels left out of training and on other simulated skins.

For a level of a factor a network is trained without its trials and tested on them. For other
skins, which differ by the scatter of their making (`mock.scene.skin.seed`), some of the same trials
are taken on each and the store's own network is tested on them. After a stop a collection resumes
at its last trial.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from functools import partial

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.models import ModelOnDisk, choose_model, wanted_models
from sliplab.analysis.study import Finding
from sliplab.analysis.sweeps.runner import SweepTask, task_sweep
from sliplab.flows.other_rig import other_request, retake
from sliplab.flows.running import console
from sliplab.plugins.studies.generalise.document import GeneralisationResults, UnseenScores
from sliplab.plugins.studies.generalise.results import (
    STEP,
    Generalisation,
    all_samples,
    score_windows,
)
from sliplab.protocols.errors import InputError
from sliplab.storage.trials.store import TrialStore

SKIN_SEEDS = 101
"""Seed of the first other skin."""
SKINS, TRIALS = 5, 36
"""Other skins, and trials on each, unless others are requested."""


def measure_generalisation(
    store: TrialStore,
    campaigns: list[Collected],
    factors: Sequence[str] = (),
    levels: Sequence[str] = (),
    every: bool = False,
    skins: int | None = None,
    trials: int = TRIALS,
    epochs: int | None = None,
) -> Finding[GeneralisationResults]:
    """Measure what is missing of what is requested.

    Args:
        factors: these; all by default.
        levels: these levels of them.
        every: all levels; by default, the lowest of each factor.
        skins: how many others; by default `SKINS` where trials are simulated, else none.
        trials: on each other skin.
        epochs: of each training, instead of the protocol's.

    Returns:
        all stored results. ``named`` has their file, the ``results`` that were requested, and how
        many of these were ``made`` now; `Finding.more` has the requested ones and the file.

    Raises:
        StoreError: a trial has no label yet.
        InputError: no such factor or level, or other skins of a real rig.
    """
    work = Generalisation(store, campaigns, epochs)
    chosen = work.choose(factors, levels, every)
    tasks = [work.without(factor, level, console.say) for factor, level in chosen]
    count = skins if skins is not None else SKINS if store.simulated else 0
    if count:
        if not store.simulated:
            raise InputError("--skins", "", 1, "must be 0: only simulated rigs have other skins")
        model = choose_model(wanted_models(store, work.campaigns))
        tasks += [skin_task(work, model, SKIN_SEEDS + number, trials) for number in range(count)]
    sweep = task_sweep(tasks, work.results)
    made = sweep.run(begin=lambda number, count, task: console.say(f"{task.name} ..."))
    path = work.results.path
    stored = (
        work.results.load()
        if path.exists()
        else GeneralisationResults(simulated=store.simulated, results={})
    )
    requested = {task.name: stored.results[task.name] for task in tasks}
    named = {"step": STEP, "made": made, "results": requested, "file": path}
    return Finding(stored, work.folder, path.stem, more=(requested, path), named=named)


def skin_task(work: Generalisation, model: ModelOnDisk, seed: int, trials: int) -> SweepTask:
    """Return the task that tests the store's network on another skin of the same design."""
    name = f"skin {seed}"
    key = work.key(name, [work.campaigns[0].info["rig_hash"], trials, model.key])
    return SweepTask(name, key, partial(_touch, work, model, seed, trials))


def _touch(work: Generalisation, model: ModelOnDisk, seed: int, trials: int) -> UnseenScores:
    """Take some of the same trials on another skin, score them, and delete them."""
    item, folder = work.campaigns[0], work.folder / f"skin{seed}"
    taken = TrialStore.create(folder / "store").campaign(item.name).committed()
    change = {"mock": {"scene": {"skin": {"seed": seed}}}}
    request = other_request(item, change, folder, most=max(0, trials - len(taken)))
    samples, _ = all_samples(*retake([request]))
    counts = training.predict_counts(model_file.load(model.path), samples.windows)
    shutil.rmtree(folder)
    return score_windows(counts, samples.y, samples.trial)
