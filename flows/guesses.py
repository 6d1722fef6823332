"""`sliplab guesses`: sensitivity of a study's figures to assumed parameters of the scene.

Some of a study's test trials are repeated on the same simulated rig with one parameter 20 %
lower, then 20 % higher. They are labelled anew and judged by the study's own network and detection
settings. Each setting is a small store, deleted once its figures are kept; so the sweep may be
stopped anywhere, and resumes.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.trials import summaries
from sliplab.analysis.labels import labelling
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.models import choose_model, wanted_models
from sliplab.analysis.sweeps.runner import ResultFile, Sweep, Task, sample_trials, task_sweep
from sliplab.analysis.sweeps.sensitivity import (
    CHANGE,
    NAMES,
    Setting,
    figures,
    lower_and_higher,
    value_of,
)
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.sample_sets import several
from sliplab.flows.other_rig import Judged, judge, other_request, retake
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import Store, StoreError

STEP, FILE, VERSION = "guesses", "results.json", 1
TRIALS = 20
GUESSES = tuple(NAMES)
"""Assumed parameters that are varied by default."""

Json = dict[str, Any]


class Guesses:
    """A study whose scene is varied, and what is kept of it.

    Args:
        trials: of each campaign, test trials spread over its conditions.

    Raises:
        StoreError: not simulated, or not evaluated yet.
    """

    def __init__(self, store: Store, campaigns: list[Collected], trials: int = TRIALS) -> None:
        self.campaigns = campaigns
        self.folder = store.folder / "derived" / STEP
        if not all(item.info.get("simulated") for item in campaigns):
            raise StoreError(f"{store.folder}: holds real trials; only simulated ones have guesses")
        self.detection = evaluation_of(store).detection
        self.model = choose_model(wanted_models(store, campaigns))
        self.trials = {item.name: self._chosen(item, trials) for item in campaigns}
        head = {"simulated": True, "change": CHANGE}
        self.results = ResultFile(self.folder / FILE, "settings", head)

    @staticmethod
    def _chosen(item: Collected, trials: int) -> list[str]:
        test = tuple(trial for trial, _ in item.of_split("test"))
        return sorted(t.id for t in sample_trials(replace(item.plan, trials=test), trials))

    @cached_property
    def fitted(self) -> training.Fitted:
        """The study's network."""
        return model_file.load(self.model.path)

    @cached_property
    def simulated(self) -> dict[str, Any]:
        """Settings of the simulated rig of each campaign."""
        rigs = ((item, item.campaign.folder / "rig.yaml") for item in self.campaigns)
        return {item.name: load_rig_file(path, stored=True)[0].scene for item, path in rigs}

    def sweep(self, guesses: Sequence[str]) -> Sweep[Task]:
        """Return the sweep of the scene as it is, and of each number lower and higher.

        Raises:
            InputError: there is no such number, or it is switched off.
        """
        for name in guesses:
            if not all(value_of(simulated, name) for simulated in self.simulated.values()):
                known = ", ".join(GUESSES)
                raise InputError(
                    "GUESS", "", name,
                    f"must be a number of the scene that is not zero, such as {known}",
                )  # fmt: skip
        tasks = []
        for setting in (Setting(), *lower_and_higher(guesses)):
            key = self._key(setting)
            tasks.append(Task(setting.name, key, partial(self.measure, setting, key)))
        return task_sweep(tasks, self.results)

    def measure(self, setting: Setting, key: str) -> Json:
        """Take, label and judge the trials at one setting; return its figures."""
        folder = self.folder / key[:12]
        run_requests = []
        for item in self.campaigns:
            change = setting.change(self.simulated[item.name])
            run_request = other_request(item, {"mock": change} if change else {}, folder)
            only = frozenset(self.trials[item.name])
            run_requests.append(replace(run_request, only=only))
        store, campaigns = retake(run_requests)
        judged = judge(self.fitted, self.detection, store, campaigns)
        rows = [
            {**row.to_json(), "depth_zero_mm": recording.record.depth_zero_mm}
            for row, recording in judged.trials
        ]
        experiments = summaries([row for row, _ in judged.trials])
        shutil.rmtree(folder)
        return {
            "parameter": setting.parameter,
            "factor": setting.factor,
            "value": setting.value(self.simulated[self.campaigns[0].name]),
            "windows": _windows_by_trial(judged, bool(several(training_campaigns(campaigns)))),
            "trials": rows,
            "experiments": {name: scores.to_json() for name, scores in experiments.items()},
        }

    def _key(self, setting: Setting) -> str:
        made_of = [
            [item.name, item.plan.collection_hash, item.info["rig_hash"], self.trials[item.name]]
            for item in self.campaigns
        ]
        detection = {name: found.model_dump(mode="json") for name, found in self.detection.items()}
        inputs = [self.model.key, made_of, detection, labelling.VERSION, dataset.VERSION]
        inputs += several(self.campaigns)
        return make_key(STEP, VERSION, inputs, [setting.parameter, setting.factor])


def _windows_by_trial(judged: Judged, with_campaign: bool) -> dict[str, list[int]]:
    """Return by trial its windows that were classified correctly, and all of its windows."""
    samples = judged.samples
    names = [f"{c}/{trial}" if with_campaign else trial for c, trial in samples.trials]
    hits = window_groups.strict_hits(judged.counts, samples.y)
    right = np.bincount(samples.trial, hits, len(names))
    count = np.bincount(samples.trial, minlength=len(names))
    return {name: [int(right[k]), int(count[k])] for k, name in enumerate(names)}


def measure_guesses(
    store: Store, campaigns: list[Collected], guesses: Sequence[str], trials: int
) -> Json:
    """Measure what is missing; return what is kept of all settings that were asked for."""
    work = Guesses(store, campaigns, trials)
    sweep = work.sweep(guesses)
    measured = sweep.run(
        begin=lambda number, count, task: console.say(f"[{number}/{count}] {task.name} (simulated)")
    )
    kept = work.results.all()
    return {
        "simulated": True,
        "trials": {name: len(ids) for name, ids in work.trials.items()},
        "measured": measured,
        "settings": {task.name: figures(kept[task.name]) for task in sweep.points},
        "file": str(work.folder / FILE),
    }
