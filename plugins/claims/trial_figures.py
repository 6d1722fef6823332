"""Figures of one recorded trial that claims are about: its label's, and a network's on it."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sliplab.analysis.labels.labelling import label_results
from sliplab.analysis.trial_work import TrialWork
from sliplab.plugins.claims.document import TrialFigures
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.network_settings import MARGIN
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.recording import Recording

if TYPE_CHECKING:
    from sliplab.analysis.networks.training import Fitted

STEP = "claims"
VERSION = 1


@dataclass(frozen=True)
class Judge:
    """Settings and network that a trial's figures are computed with.

    Attributes:
        settings: of the protocol. model: the network's file; None: only the label's figures.
    """

    settings: AnalysisSettings
    model: Path | None

    @cached_property
    def model_hash(self) -> str | None:
        """Hash of the network's file; None without one."""
        return None if self.model is None else hashlib.sha256(self.model.read_bytes()).hexdigest()

    def work(self, recording: Recording, campaign: str) -> TrialWork:
        """Return a trial's figures as work, with the key that they are stored under."""
        settings = self.settings.model_dump(mode="json")
        key = make_key(STEP, VERSION, [recording.checksum, self.model_hash], settings)
        return TrialWork(recording, campaign, key, self)


def kept_figures(recording: Recording, judge: Judge) -> tuple[TrialFigures, None]:
    """Return the figures of a trial as a result to keep."""
    return trial_figures(recording, judge), None


def trial_figures(recording: Recording, judge: Judge) -> TrialFigures:
    """Label a trial, let the network detect in it, and return its figures.

    A detection that is missed, late or false has an infinite latency, and a lead of minus infinity:
    it is as bad as can be, and percentiles count it.
    """
    label, _ = label_results(recording, judge.settings.labelling)
    found: dict[str, float | None] = {"slip_duration": None, "first_slip": None}
    start_ns, _ = recording.motion_ns
    if label.incipient_ns is not None:
        found["first_slip"] = (label.incipient_ns - start_ns) / 1e6
        if label.gross_ns is not None:
            found["slip_duration"] = (label.gross_ns - label.incipient_ns) / 1e6
    if judge.model is not None:
        found |= _of_network(recording, label, judge.settings, _loaded(judge.model))
    finite = {name: value for name, value in found.items() if value is None or math.isfinite(value)}
    return TrialFigures(values=finite, undetected=tuple(sorted(found.keys() - finite.keys())))


@cache
def _loaded(model: Path) -> Fitted:
    from sliplab.analysis.networks import model_file

    return model_file.load(model)


def _of_network(
    recording: Recording, label: TrialLabel, settings: AnalysisSettings, fitted: Fitted
) -> dict[str, float | None]:
    from sliplab.analysis.detectors.latency import score_trial, true_slip
    from sliplab.analysis.detectors.predictions import window_counts
    from sliplab.analysis.detectors.smoothing_rule import detect
    from sliplab.analysis.metrics import window_groups
    from sliplab.analysis.networks import training
    from sliplab.analysis.windows import dataset

    slip = true_slip(label)
    if slip is None:
        return dict.fromkeys(("latency_incipient", "latency_gross", "lead", "accuracy"))
    outputs = fitted.network.outputs_per_class
    rule = settings.rule_for(outputs, MARGIN * outputs)
    counts, end_ns = window_counts(recording, fitted, rule.stride_ms)
    scored = score_trial(detect(counts, end_ns, rule), slip, round(rule.false_early_ms * 1e6))
    name = dataset.TrialId("", recording.folder.name)
    seed = hash_integer("samples", recording.folder.name)
    samples = dataset.trial_samples(recording, label, name, fitted.windows, settings.samples, seed)
    hits = window_groups.strict_hits(training.predict_counts(fitted, samples.windows), samples.y)

    def or_never(value: float | None, never: float) -> float:
        return never if value is None else value

    return {
        "latency_incipient": or_never(scored.latency_incipient_ms, math.inf),
        "latency_gross": or_never(scored.latency_gross_ms, math.inf),
        "lead": or_never(scored.lead_ms, -math.inf),
        "accuracy": 100.0 * float(np.mean(hits)) if len(hits) else None,
    }
