"""Sensitivity of a study's figures to assumed parameters of its simulated scene.

Test trials of the study are repeated with one parameter lower, then higher, and evaluated by the
study's own network and detection settings (`benchmarks.guesses`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from benchmarks.guesses.document import SensitivityResults, SettingScores, TrialAtSetting
from benchmarks.scene_parameters import CHANGE, ParameterSetting
from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.trials import judge, summaries
from sliplab.analysis.labels import labelling
from sliplab.analysis.metrics.intervals import difference, share_difference
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import choose_model, wanted_models
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.sweeps.runner import ResultFile, sample_trials
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.sample_sets import several
from sliplab.storage.schema.evaluation import TrialLatency
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import StoreError, TrialStore

STEP, FILE, VERSION = "guesses", "results.json", 1
FIGURES = {
    "strict": "windows right",
    "incipient_ms": "incipient latency",
    "gross_ms": "gross latency",
    "gravity_lead_ms": "gravity lead",
    "disturbance_lead_ms": "disturbance lead",
    "depth_zero_mm": "depth zero",
}
"""Compared figures of a study, and their titles. Depth zero is what the rig found by touching the
plate: it detects contact by events, so a number of the camera moves it, and with it every depth."""
UNITS = {name: "%" if name == "strict" else name.rsplit("_", 1)[1] for name in FIGURES}
_MEDIANS = ("incipient_ms", "gross_ms")

Figures = dict[str, float | None]
"""By the names of `FIGURES`; None where no trial has one."""


class StudySensitivity:
    """The test trials of a study that are repeated at each setting, and their stored results.

    Args:
        trials: of each campaign, test trials spread over its conditions.

    Raises:
        StoreError: not simulated, or not evaluated yet.
    """

    def __init__(self, store: TrialStore, campaigns: list[Collected], trials: int) -> None:
        self.campaigns = campaigns
        self.folder = store.folder / "derived" / STEP
        if not all(item.info.get("simulated") for item in campaigns):
            raise StoreError(
                f"{store.folder}: contains real trials; only simulated ones have assumed parameters"
            )
        self.detection = evaluation_of(store).detection
        self.model = choose_model(wanted_models(store, campaigns))
        self.trials = {item.name: _chosen(item, trials) for item in campaigns}
        head = {"simulated": True, "change": CHANGE}
        self.results = ResultFile(self.folder / FILE, SensitivityResults, "settings", head)

    @cached_property
    def fitted(self) -> Fitted:
        """The study's network."""
        return model_file.load(self.model.path)

    def key(self, setting: ParameterSetting) -> str:
        """Return the key of a setting's results."""
        made_of = [
            [item.name, item.plan.collection_hash, item.info["rig_hash"], self.trials[item.name]]
            for item in self.campaigns
        ]
        detection = {name: found.model_dump(mode="json") for name, found in self.detection.items()}
        inputs = [self.model.key, made_of, detection, labelling.VERSION, dataset.VERSION]
        inputs += several(self.campaigns)
        return make_key(STEP, VERSION, inputs, [setting.parameter, setting.factor])

    def score(
        self,
        setting: ParameterSetting,
        value: float | None,
        store: TrialStore,
        campaigns: list[Collected],
    ) -> SettingScores:
        """Score the trials that were repeated at a setting.

        Args:
            value: of the changed parameter.
            store, campaigns: the repeated trials, labelled.
        """
        judged = judge(self.fitted, self.detection, store, campaigns)
        return SettingScores(
            parameter=setting.parameter,
            factor=setting.factor,
            value=value,
            windows=judged.hits_by_trial(with_campaign=bool(several(campaigns))),
            trials=tuple(
                TrialAtSetting(**dict(row), depth_zero_mm=recording.record.depth_zero_mm)
                for row, recording in judged.trials
            ),
            experiments=summaries(judged.rows),
        )


def _chosen(item: Collected, trials: int) -> list[str]:
    """Return the ids of a campaign's test trials that are repeated."""
    test = tuple(trial for trial, _ in item.of_split("test"))
    return sorted(t.id for t in sample_trials(replace(item.plan, trials=test), trials))


def figures(setting: SettingScores) -> Figures:
    """Return the compared figures of one setting of a study."""
    right, count = (sum(found[k] for found in setting.windows.values()) for k in (0, 1))
    summary: Figures = {"strict": right / count if count else None}
    for name, found in _values(setting).items():
        there = [value for value in found.values() if value is not None]
        middle = np.median if name in _MEDIANS else np.mean
        value = float(middle(there)) if there else np.inf
        summary[name] = value if np.isfinite(value) else None
    return summary


def figure_cells(found: Figures) -> list[str]:
    """Return figures as cells of a table, in the units of `UNITS`."""
    return [_cell(name, value) for name, value in found.items()]


def _cell(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    if name == "strict":
        return f"{100 * value:.1f}"
    return f"{value:.3f}" if UNITS[name] == "mm" else f"{value:.0f}"


def changes(base: SettingScores, other: SettingScores) -> dict[str, tuple[float, float] | None]:
    """Return the 95 % interval of each figure's change, over trials that both have."""
    found: dict[str, tuple[float, float] | None] = {}
    first, second = _values(other), _values(base)
    for name in first:
        both = sorted(first[name].keys() & second[name].keys())
        pair = [np.array([of[name][t] for t in both], np.float64) for of in (first, second)]
        statistic = "median" if name in _MEDIANS else "mean"
        found[name] = difference(pair[0], pair[1], statistic, paired=True)
    trials = sorted(other.windows.keys() & base.windows.keys())
    hits = [np.array([of.windows[t] for t in trials]).reshape(-1, 2).T for of in (other, base)]
    found["strict"] = share_difference((hits[0][0], hits[0][1]), (hits[1][0], hits[1][1]))
    return found


def _values(setting: SettingScores) -> dict[str, Figures]:
    """Return latencies and leads by trial; None where a trial has none.

    A latency of which medians are taken is infinite where the detection was missed or late.
    """
    found: dict[str, Figures] = {name: {} for name in FIGURES if name != "strict"}
    for row in setting.trials:
        trial = f"{row.campaign}/{row.trial}"
        found["depth_zero_mm"][trial] = row.depth_zero_mm
        for name, key in _keys(row.experiment):
            found[name][trial] = _time(row.latency, name, key)
    return found


def _time(latency: TrialLatency | None, name: str, key: str) -> float | None:
    if latency is None:
        return None
    lost = latency.uncounted[3 if key == "latency_gross_ms" else 2]
    return np.inf if name in _MEDIANS and lost else getattr(latency, key)


def _keys(experiment: str) -> Iterator[tuple[str, str]]:
    if experiment == "kinematic":
        yield from (("incipient_ms", "latency_incipient_ms"), ("gross_ms", "latency_gross_ms"))
    else:
        yield f"{experiment}_lead_ms", "lead_ms"
