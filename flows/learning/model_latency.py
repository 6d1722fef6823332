"""How late a network sees slip over whole test trials: as trained, and in a chip's arithmetic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.detection import detect
from sliplab.analysis.detectors.latency import score_trial, summarise_latency, true_slip
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.networks import training
from sliplab.analysis.networks.quantised import Quantised, chip_run, quantised_net
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows import dataset
from sliplab.flows.learning.train import rules_of

Latency = dict[str, Any]
"""By experiment: ``trials`` with both onsets, and ``latency_ms`` as `summarise_latency` has it."""


def latencies(
    campaigns: list[Collected],
    labels: Labels,
    fitted: Fitted,
    whole: Quantised,
    on_trial: Callable[[], None] = lambda: None,
) -> tuple[Latency, Latency]:
    """Latency over the test trials of `campaigns`, as trained and with the whole numbers.

    Args:
        on_trial: called before each of them; some thousand windows take a second.
    """
    rules = rules_of(campaigns, fitted.network.outputs_per_class)
    fast, chip = training.engine(fitted), quantised_net(fitted, whole)
    found: tuple[dict[str, list[Any]], ...] = ({}, {})
    for item in campaigns:
        rule = rules[item.name]
        for _, recording in item.of_split("test"):
            on_trial()
            slip = true_slip(labels.read(item, recording))
            if slip is None:
                continue
            x, end_ns = dataset.trial_windows(recording, fitted.windows)
            both = fast.counts(x), chip_run(chip, x.dense()).counts
            for rows, counts in zip(found, both, strict=True):
                said = detect(counts, end_ns, rule)
                scored = score_trial(said, slip, round(rule.false_early_ms * 1e6))
                rows.setdefault(item.experiment, []).append(scored)
    real, chips = map(_summary, found)
    return real, chips


def _summary(rows: dict[str, list[Any]]) -> Latency:
    return {
        experiment: {"trials": len(each), "latency_ms": summarise_latency(each).to_json()}
        for experiment, each in rows.items()
    }
