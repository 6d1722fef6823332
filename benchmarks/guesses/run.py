"""Sensitivity of a study's figures to assumed parameters of the scene.

Some of a study's test trials are repeated on the same simulated rig with one parameter 20 %
lower, then 20 % higher. They are relabelled and evaluated by the study's own network and detection
settings. Each setting is a small store, deleted once its figures are stored; so the sweep may be
stopped anywhere, and resumes.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from benchmarks.guesses.document import SettingScores
from benchmarks.guesses.results import Figures, StudySensitivity, figures
from benchmarks.scene_parameters import NAMES, ParameterSetting, in_all, lower_and_higher
from sliplab.analysis.campaigns import Collected
from sliplab.analysis.sweeps.runner import Sweep, SweepTask, task_sweep
from sliplab.flows.other_rig import other_request, retake
from sliplab.flows.running import console
from sliplab.plugins.simulation.settings import MockSettings, scene_of
from sliplab.protocols.errors import InputError
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials.store import TrialStore

TRIALS = 20


@dataclass(frozen=True)
class SettingsMeasured:
    """The settings that were requested, by name.

    Attributes:
        trials: their number, by campaign.
        measured: how many settings were measured now.
        file: that keeps them.
    """

    trials: dict[str, int]
    measured: int
    settings: dict[str, Figures]
    file: str


def measure_guesses(
    store: TrialStore, campaigns: list[Collected], guesses: Sequence[str], trials: int
) -> SettingsMeasured:
    """Measure what is missing; return the figures of all settings that were requested.

    Args:
        guesses: dotted names of assumed parameters.
        trials: of each campaign, test trials spread over its conditions.

    Raises:
        StoreError: not simulated, or not evaluated yet.
        InputError: there is no such parameter, or it is switched off.
    """
    work = StudySensitivity(store, campaigns, trials)
    sweep = guess_sweep(work, guesses)
    measured = sweep.run(
        begin=lambda number, count, task: console.say(f"[{number}/{count}] {task.name} (simulated)")
    )
    saved = work.results.load().settings
    return SettingsMeasured(
        {name: len(ids) for name, ids in work.trials.items()},
        measured,
        {task.name: figures(saved[task.name]) for task in sweep.points},
        str(work.results.path),
    )


def guess_sweep(work: StudySensitivity, guesses: Sequence[str]) -> Sweep[SweepTask]:
    """Return the sweep of the scene as it is, and of each parameter lower and higher.

    Raises:
        InputError: there is no such parameter, or it is switched off.
    """
    rigs = ((item, item.campaign.folder / "rig.yaml") for item in work.campaigns)
    scenes = {item.name: scene_of(load_rig_file(path, stored=True)[0]) for item, path in rigs}
    there = in_all(guesses, list(scenes.values()))
    for name in guesses:
        if name not in there:
            known = ", ".join(NAMES)
            raise InputError(
                "--guess",
                "",
                name,
                f"must be a non-zero parameter of the scene, such as {known}",
            )
    settings = (ParameterSetting(), *lower_and_higher(guesses))
    tasks = [
        SweepTask(setting.name, work.key(setting), partial(measure_setting, work, setting, scenes))
        for setting in settings
    ]
    return task_sweep(tasks, work.results)


def measure_setting(
    work: StudySensitivity, setting: ParameterSetting, scenes: Mapping[str, MockSettings]
) -> SettingScores:
    """Take, label and score the trials at one setting, and delete them.

    Args:
        scenes: settings of the simulated rig of each campaign.
    """
    folder = work.folder / work.key(setting)[:12]
    run_requests = []
    for item in work.campaigns:
        change = setting.change(scenes[item.name])
        run_request = other_request(item, {"mock": change} if change else {}, folder)
        run_requests.append(replace(run_request, only=frozenset(work.trials[item.name])))
    value = setting.value(scenes[work.campaigns[0].name])
    scores = work.score(setting, value, *retake(run_requests))
    shutil.rmtree(folder)
    return scores
