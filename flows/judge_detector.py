"""A calibrated detector on a store's test trials."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.alarms import SceneEvidence, false_alarm_rate, outcome
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.latency import median_with_lost
from sliplab.analysis.detectors.skin import calibrated, load_calibration
from sliplab.analysis.detectors.stored_scenes import each_scene, judged_scene
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.problem import need_slip
from sliplab.flows.label import report_states
from sliplab.flows.running import console
from sliplab.flows.steps import StepResult
from sliplab.protocols.errors import InputError
from sliplab.storage.schema.evaluation import AlarmRate
from sliplab.storage.trials.store import StoreError, TrialStore

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


class JudgedDetector(StepResult):
    """Figures of a calibrated detector on test trials.

    Attributes:
        promised: false alarms an hour of holding, at most, as its calibration says.
        trials: with both onsets. missed: without an alarm between them.
        early: a false alarm lasted until the onset.
        false_alarms: as long as surely nothing slipped, see `still_until_ns`.
        median_ms: from the label's incipient onset to the alarm, below 0 where a tip slid before a
            marker had moved by 2 pixels; a missed one infinite; None if so.
    """

    detector: str
    simulated: bool
    level: float
    promised: float | None
    trials: int
    missed: int
    early: int
    false_alarms: AlarmRate
    median_ms: float | None


def judge_detector(
    store: TrialStore,
    campaigns: list[Collected],
    model: Path,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> JudgedDetector:
    """Judge a detector that `sliplab calibrate detector` set up.

    Args:
        cluster: not used; a trial takes less than a second.
        reviewed: people's decisions are applied to the labels.

    Raises:
        InputError: the calibration, or a trial of a sensor of another size.
        StoreError: no test trial has both onsets, or one has no label yet.
    """
    labels = StoreLabels(store, reviewed)
    need_slip(labels, campaigns)
    skin = load_calibration(model)
    detector = calibrated(skin)
    used = training_campaigns(campaigns)
    found: list[SceneEvidence] = []
    with console.bar("trials", 0) as bar:
        for scene in each_scene(labels, used, "test"):
            try:
                evidence = feed(detector, scene)
            except ValueError as error:  # of another size
                raise InputError(model, "", None, f"{scene.name}: {error}") from None
            found.append(judged_scene(scene, evidence))
            bar.advance(1, scene.name)
    if not found:
        raise StoreError(f"{store.folder}: no test trial has both onsets")
    outcomes = [outcome(one, skin.level) for one in found]
    late_ms = [
        (one.detected_us - one.slip.paper_us) / 1000
        for one in outcomes
        if one.detected_us is not None
    ]
    missed = len(outcomes) - len(late_ms)
    return {
        "step": "evaluate",
        "done": len(found),
        "fresh": 0,
        "detector": str(model),
        "simulated": store.simulated,
        "level": float(skin.level),
        "promised": None if skin.hold.high is None else float(skin.hold.high),
        "trials": len(found),
        "missed": missed,
        "early": sum(one.early for one in outcomes),
        "false_alarms": false_alarm_rate(found, skin.level),
        "median_ms": median_with_lost(late_ms, missed, np.inf),
        **report_states(labels, campaigns),
    }
