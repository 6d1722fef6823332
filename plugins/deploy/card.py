"""The model card: a model, its training data and its accuracy on one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import CLASSES, score
from sliplab.analysis.networks.training import Fitted
from sliplab.plugins.deploy.document import (
    CardData,
    CardModel,
    ModelCard,
    ModelFile,
    SplitFigures,
    WindowCost,
)
from sliplab.protocols.shown import plural
from sliplab.storage.schema.evaluation import Latencies, WindowWork

FORMAT = "sliplab-model-card-1"
FEW_TRIALS = 10
"""Fewest test trials for a meaningful figure."""


@dataclass(frozen=True)
class SplitResult:
    """The network's spike counts, int64 (n, 3), and the labels (n,), of one split's samples."""

    counts: npt.NDArray[np.int64]
    labels: npt.NDArray[np.int64]
    trials: int


def model_card(
    fitted: Fitted,
    file: ModelFile,
    data: CardData,
    splits: Mapping[str, SplitResult],
    work: WindowWork,
    detection: Latencies,
    versions: Mapping[str, str],
    margin: float,
) -> ModelCard:
    """Return the card.

    Args:
        data: where the samples are from.
        splits: results by split.
        work: over the windows of the test split.
        detection: over whole test trials.
        margin: of the margin accuracy, mean spikes.
    """
    figures = {
        name: SplitFigures(
            trials=part.trials,
            samples=len(part.labels),
            **dict(score(part.counts, part.labels, margin)),
        )
        for name, part in splits.items()
    }
    return ModelCard(
        format=FORMAT,
        simulated=data.simulated,
        model=CardModel(
            **dict(file),
            seed=fitted.seed,
            parameters=int(sum(w.numel() for w in fitted.state_dict.values())),
            network=fitted.network,
            windows=fitted.windows,
            training=fitted.training,
            epochs=len(fitted.history),
            chosen_epoch=fitted.chosen_epoch,
            rates_in_training=dict(fitted.chosen.rates),
        ),
        data=data,
        figures=figures,
        margin=margin,
        activity=WindowCost(
            windows=work.n,
            events_a_window=work.events,
            rates=work.rates,
            synaptic_operations=work.synaptic_operations,
            dense_multiply_adds={k: int(v) for k, v in work.dense_multiply_adds.items()},
            share_of_dense=work.share,
            footprint_bytes=work.footprint_bytes,
            connection_sparsity=work.connection_sparsity,
            activation_sparsity=work.activation_sparsity,
        ),
        detection=detection,
        versions=dict(versions),
        warnings=_warnings(fitted, data, splits),
    )


def _warnings(fitted: Fitted, data: CardData, splits: Mapping[str, SplitResult]) -> tuple[str, ...]:
    found = list(fitted.warnings)
    if data.simulated:
        found.append("the data are simulated: the figures say nothing about a real sensor")
    if not data.made_from_these_data:
        found.append(
            "the store's data and settings are not those that the model was trained on: "
            "its figures for 'train' and 'validation' may be those of unseen data, and its figures "
            "for 'test' those of data it was trained on"
        )
    test = splits.get("test")
    if test is None or test.trials < FEW_TRIALS:
        trials = 0 if test is None else test.trials
        found.append(f"only {plural(trials, 'test trial')} of the training campaigns")
    return tuple(found)


def card_markdown(card: ModelCard) -> str:
    """Return the card as Markdown."""
    model, data = card.model, card.data
    stated = " (simulated)" if card.simulated else ""
    text = [f"# {model.file}{stated}", ""]
    text.append(
        f"Spiking network, {model.parameters:,} weights, seed {model.seed}, epoch "
        f"{model.chosen_epoch} of {model.epochs}. SHA-256 `{model.sha256}`."
    )
    if card.warnings:
        text += ["", "## Warnings", "", *(f"- {warning}" for warning in card.warnings)]
    text += ["", f"## Data{stated}", ""]
    text += table(
        ["campaign", "experiment", "collection", "analysis", "rig", "train", "validation", "test"],
        [
            [
                item.name,
                item.experiment,
                f"`{item.collection_hash[:12]}`",
                f"`{item.analysis_hash[:12]}`",
                item.rig,
                *(item.trials.get(split, 0) for split in ("train", "validation", "test")),
            ]
            for item in data.campaigns
        ],
    )
    text += ["", f"## Accuracy over windows{stated}", ""]
    names = [name.replace("_", " ") for name in CLASSES]
    text += table(
        ["split", "trials", "windows", "strict", f"margin {card.margin:g}", "argmax"]
        + [f"recall {name}" for name in names],
        [
            [
                split,
                part.trials,
                part.samples,
                percent(part.accuracy.strict),
                percent(part.accuracy.margin),
                percent(part.accuracy.argmax),
                *(percent(part.recall[name]) for name in CLASSES),
            ]
            for split, part in card.figures.items()
        ],
    )
    text += ["", "Strict: only a unique winner counts. Argmax shares ties."]
    text += ["", f"## Detection over whole test trials{stated}", ""]
    text += latency_table(card.detection)
    spikes = card.activity
    text += ["", f"## Spikes and operations a window{stated}", ""]
    text += table(
        ["layer", "spikes per neuron and step", "synaptic operations", "multiply-adds if dense"],
        [
            [f"{weighted} + {spiking}", f"{rate:.4f}", f"{operations:,.0f}", f"{dense:,}"]
            for (spiking, rate), (weighted, operations), dense in zip(
                spikes.rates.items(),
                list(spikes.synaptic_operations.items())[:-1],
                list(spikes.dense_multiply_adds.values())[:-1],
                strict=True,
            )
        ],
    )
    text += [
        "",
        f"All: {spikes.synaptic_operations['all']:,.0f} synaptic operations, "
        f"{percent(spikes.share_of_dense)} of the dense ones; "
        f"{spikes.events_a_window:.0f} events a window.",
    ]
    if spikes.footprint_bytes is not None:
        text += [
            "",
            f"As NeuroBench counts: footprint {spikes.footprint_bytes:,} bytes, "
            f"connection sparsity {percent(spikes.connection_sparsity)}, "
            f"activation sparsity {percent(spikes.activation_sparsity)}.",
        ]
    text += ["", "## Versions", "", ", ".join(f"{k} {v}" for k, v in card.versions.items())]
    return "\n".join(text) + "\n"


def latency_table(detection: Latencies) -> list[str]:
    """Latency by experiment and onset."""
    rows: list[list[object]] = []
    for experiment, found in detection.items():
        both = found.latency_ms
        for onset, values in (("incipient", both.incipient), ("gross", both.gross)):
            times = (ms(values.mean), ms(values.median), ms(values.max))
            lost = (values.missed, values.late, values.false_early)
            rows.append([experiment, onset, found.trials, *times, *lost])
    columns = ["experiment", "onset", "trials", "mean ms", "median ms", "most ms"]
    return table([*columns, "missed", "late", "false early"], rows)


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Lines of a Markdown table."""
    lines = ["| " + " | ".join(columns) + " |", "| " + " | ".join("---" for _ in columns) + " |"]
    return lines + ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]


def percent(share: float | None) -> str:
    """``94.3 %``; a dash if there is none."""
    return "-" if share is None else f"{100 * share:.1f} %"


def ms(value: float | None) -> str:
    """Milliseconds; a dash if there are none."""
    return "-" if value is None else f"{value:.0f}"
