"""What the figures of a study owe to the guessed numbers of the simulated scene.

Some of a study's test trials are taken again on the same simulated rig with one guessed number 20 %
lower, then 20 % higher. They are labelled anew and judged by the study's own network and detection
settings: what differs is what the guess decides. Each setting is a small store, which goes when its
figures are kept; so it may be stopped anywhere, and goes on.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, collected, training_campaigns
from sliplab.analysis.labels import labelling
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.windows import dataset
from sliplab.flows.collect import collect
from sliplab.flows.labelling.label import label
from sliplab.flows.learning import evaluate
from sliplab.flows.learning.evaluate import choose_model
from sliplab.flows.learning.samples import several
from sliplab.flows.learning.train import wanted_models
from sliplab.flows.learning.trial_scores import summaries
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import console
from sliplab.flows.searching.guess_changes import AS_IT_IS, NAMES, figures
from sliplab.flows.searching.other_rig import judge, other_request
from sliplab.flows.searching.scene_runs import sample_trials
from sliplab.flows.searching.sensitivity import CHANGE, LARGEST_POISSON, nested, value_of
from sliplab.protocols.errors import InputError
from sliplab.protocols.settings import Detection
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import Store, StoreError

STEP, FILE, VERSION = "guesses", "results.json", 1
TRIALS = 20
GUESSES = tuple(NAMES)
"""What is tried unless others are named."""

Json = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """One guess at a factor of its value; the scene as it is has neither."""

    parameter: str | None = None
    factor: float = 1.0

    @property
    def name(self) -> str:
        """What its results stand under."""
        return AS_IT_IS if self.parameter is None else f"{self.parameter} x {self.factor:g}"


class Guesses:
    """The settings of a study's scene, and what is kept of them.

    Args:
        trials: of each campaign, test trials spread over its conditions.

    Raises:
        StoreError: not simulated, or not evaluated yet.
    """

    def __init__(self, store: Store, campaigns: list[Collected], trials: int = TRIALS) -> None:
        self.store, self.campaigns = store, campaigns
        self.folder = store.folder / "derived" / STEP
        if not all(item.info.get("simulated") for item in campaigns):
            raise StoreError(f"{store.folder}: holds real trials; only simulated ones have guesses")
        _, evaluated = evaluate.evaluation_of(store)
        self.detection = {
            name: Detection.model_validate(value) for name, value in evaluated["detection"].items()
        }
        self.model = choose_model(wanted_models(store, campaigns))
        self.trials = {item.name: self._chosen(item, trials) for item in campaigns}

    @staticmethod
    def _chosen(item: Collected, trials: int) -> list[str]:
        test = tuple(trial for trial, _ in item.of_split("test"))
        return sorted(t.id for t in sample_trials(replace(item.plan, trials=test), trials))

    @cached_property
    def fitted(self) -> training.Fitted:
        """The study's network."""
        return model_file.load(self.model.path)

    def results(self) -> dict[str, Json]:
        """What is kept, by the settings' names."""
        try:
            found: dict[str, Json] = read_json(self.folder / FILE)["settings"]
        except FileNotFoundError:
            return {}
        return found

    def settings(self, guesses: Sequence[str]) -> list[Setting]:
        """The scene as it is, and each guess down and up.

        Raises:
            InputError: there is no such number, or it is switched off.
        """
        for name in guesses:
            for item in self.campaigns:
                self._value(item, name)
        factors = (1.0 - CHANGE, 1.0 + CHANGE)
        return [Setting(), *(Setting(name, factor) for name in guesses for factor in factors)]

    def _value(self, item: Collected, name: str) -> float:
        rig, _ = load_rig_file(item.campaign.folder / "rig.yaml", stored=True)
        try:
            value = value_of(rig.scene, name)
        except (AttributeError, TypeError, ValueError):
            value = None
        if not value:
            known = ", ".join(GUESSES)
            raise InputError(
                "GUESS", "", name,
                f"must be a number of the scene that is not zero, such as {known}",
            )  # fmt: skip
        return value

    def missing(self, settings: Sequence[Setting]) -> list[Setting]:
        """Those whose figures are not kept, or were made of something else."""
        kept = self.results()
        return [s for s in settings if kept.get(s.name, {}).get("key") != self._key(s)]

    def measure(self, setting: Setting) -> None:
        """Take, label and judge the trials at one setting; keep the figures."""
        key = self._key(setting)
        folder = self.folder / key[:12]
        store = Store.create(folder / "store")
        run_requests = [self._run_request(item, setting, folder) for item in self.campaigns]
        for run_request in run_requests:
            collect(run_request)
        campaigns = collected(store, [run_request.campaign for run_request in run_requests])
        label(store, campaigns)
        found = self._judge(store, campaigns)
        value = None
        if setting.parameter is not None:
            value = self._value(self.campaigns[0], setting.parameter) * setting.factor
        kept = {
            "key": key, "parameter": setting.parameter, "factor": setting.factor,
            "value": value, **found,
        }  # fmt: skip
        write_json(
            self.folder / FILE,
            {
                "simulated": True,
                "change": CHANGE,
                "settings": {**self.results(), setting.name: kept},
            },
        )
        shutil.rmtree(folder)

    def _key(self, setting: Setting) -> str:
        made_of = [
            [item.name, item.plan.collection_hash, item.info["rig_hash"], self.trials[item.name]]
            for item in self.campaigns
        ]
        detection = {name: found.model_dump(mode="json") for name, found in self.detection.items()}
        inputs = [self.model.key, made_of, detection, labelling.VERSION, dataset.VERSION]
        inputs += several(self.campaigns)
        return make_key(STEP, VERSION, inputs, [setting.parameter, setting.factor])

    def _run_request(self, item: Collected, setting: Setting, folder: Path) -> RunRequest:
        """The chosen trials of a campaign on the changed rig."""
        change: Json = {}
        if setting.parameter is not None:
            new = self._value(item, setting.parameter) * setting.factor
            if setting.parameter.endswith("poisson_ratio"):
                new = min(new, LARGEST_POISSON)
            change = {"mock": nested(setting.parameter, new)}
        run_request = other_request(item, change, folder)
        return replace(run_request, only=frozenset(self.trials[item.name]))

    def _judge(self, store: Store, campaigns: list[Collected]) -> Json:
        """Windows and trials at one setting, by the study's network and settings."""
        judged = judge(self.fitted, self.detection, store, campaigns)
        rows = [
            {**row, "depth_zero_mm": recording.record.depth_zero_mm}
            for row, recording in judged.trials
        ]
        used = training_campaigns(campaigns)
        names = [
            f"{campaign}/{trial}" if several(used) else trial
            for campaign, trial in judged.samples.trials
        ]
        hits = window_groups.strict_hits(judged.counts, judged.samples.y)
        windows = _by_trial(hits, judged.samples.trial, names)
        return {"windows": windows, "trials": rows, "experiments": summaries(rows)}


def _by_trial(
    hits: npt.NDArray[Any], trial: npt.NDArray[np.int64], ids: Sequence[str]
) -> dict[str, list[int]]:
    """By trial its windows that were called rightly, and all of its windows."""
    right = np.bincount(trial, hits, len(ids))
    count = np.bincount(trial, minlength=len(ids))
    return {name: [int(right[k]), int(count[k])] for k, name in enumerate(ids)}


def measure_guesses(
    store: Store, campaigns: list[Collected], guesses: Sequence[str], trials: int
) -> Json:
    """Measure what is missing; what is kept of all settings that were asked for."""
    work = Guesses(store, campaigns, trials)
    settings = work.settings(guesses)
    missing = work.missing(settings)
    for number, setting in enumerate(missing):
        console.say(f"[{number + 1}/{len(missing)}] {setting.name} (simulated)")
        work.measure(setting)
    kept = work.results()
    return {
        "simulated": True,
        "trials": {name: len(ids) for name, ids in work.trials.items()},
        "measured": len(missing),
        "settings": {s.name: figures(kept[s.name]) for s in settings},
        "file": str(work.folder / FILE),
    }
