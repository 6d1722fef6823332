"""Fitting the spiking network to windows, choosing an epoch, and keeping the result.

Surrogate gradients through the fused neurons of `analysis.iaf`, cross-entropy on output spike
counts, Adam. Two traps of spiking networks are dealt with here: a layer that never fires passes
for a network that says "no slip" (it is named in the warnings), and a result that cannot be
repeated (everything random comes from one seed, and the same call gives the same bits on any
number of threads).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import log_softmax
from torch import nn

from analysis import metrics
from analysis.iaf import fused_counts, fused_layers, lone_workers
from analysis.network import SPIKING, build, check_samples, set_weights, weights
from protocols.settings import Network, Training, Windows

Array = npt.NDArray[Any]

MICRO_BATCH = 8
"""Samples whose gradients are computed at once; they are summed up to ``training.batch``. Small
enough for the processor's cache, and to give every thread something to do."""

SILENT_RATE = 1e-5
"""Spikes per neuron and step at or below which a layer counts as silent."""

SATURATED_RATE = 0.9
"""Spikes per neuron and step at or above which a layer counts as saturated (1 is the most)."""


@dataclass(frozen=True)
class EpochRecord:
    """What one pass over the training samples gave.

    Attributes:
        epoch: 1 for the first.
        loss: mean cross-entropy of the training samples, each before the step it was used in.
        train_argmax: their accuracy, likewise, ties shared (`analysis.metrics.Accuracy`).
        val_loss: mean cross-entropy of the validation samples after the epoch.
        val_argmax, val_strict, val_margin: their accuracies.
        rates: mean spikes per neuron and step of each spiking layer over the epoch, by name.
    """

    epoch: int
    loss: float
    train_argmax: float
    val_loss: float
    val_argmax: float
    val_strict: float
    val_margin: float
    rates: dict[str, float]

    @property
    def merit(self) -> tuple[float, float, float]:
        """What epochs are compared by, the larger the better: see `fit`."""
        return (self.val_strict, self.val_argmax, -self.val_loss)


@dataclass(frozen=True)
class Fitted:
    """A trained network and how it came about.

    Attributes:
        state_dict: weights of the chosen epoch, by name; no neuron states.
        network, windows, training, seed: what was asked for.
        history: one record an epoch.
        chosen_epoch: the epoch the weights are from.
        warnings: in words, what is wrong with the chosen network; empty when nothing is.
        epoch_seconds: wall time of each epoch. Kept apart from the records and not saved, so
            that the same training gives the same file.
    """

    state_dict: dict[str, torch.Tensor]
    network: Network
    windows: Windows
    training: Training
    seed: int
    history: tuple[EpochRecord, ...]
    chosen_epoch: int
    warnings: tuple[str, ...]
    epoch_seconds: tuple[float, ...] = field(default=(), compare=False)

    @property
    def chosen(self) -> EpochRecord:
        """The record of the chosen epoch."""
        return self.history[self.chosen_epoch - 1]


def fit(
    train_x: Array,
    train_y: metrics.Labels,
    val_x: Array,
    val_y: metrics.Labels,
    network: Network,
    windows: Windows,
    training: Training,
    seed: int,
    on_epoch: Callable[[EpochRecord], None] | None = None,
) -> Fitted:
    """Train one network and keep its best epoch.

    The best epoch has the highest STRICT validation accuracy on raw spike counts: a unique winner
    that is right. Argmax would give a silent network something for its ties, and a detection
    needs a winner. Equal epochs are told apart by argmax accuracy (ties shared), then by the lower
    validation loss; the earlier one stays. Training ends after ``training.epochs`` or when
    ``training.patience`` epochs in a row were no better. It uses as many threads as torch may.

    There are no biases, so a window without any event gives no spike whatever is learned: it is a
    tie, and wrong by strict accuracy.

    Args:
        train_x, val_x: event counts uint8 (n, steps, channels, cells, cells); they stay uint8
            until a batch is made.
        train_y, val_y: classes, integer (n,), 0..2.
        network, windows, training: the settings; ``training.seeds`` is the caller's to loop over.
        seed: decides the first weights and the order of the samples.
        on_epoch: called with each record as soon as it is there, in the calling thread.

    Raises:
        ValueError: no samples, shapes that do not fit, a label that is no class.
    """
    net = build(network, windows, seed)
    train_y = _check(net, train_x, train_y, "training")
    val_y = _check(net, val_x, val_y, "validation")
    optimizer = torch.optim.Adam(
        [p for p in net.parameters() if p.requires_grad], lr=training.learning_rate
    )
    rng = np.random.default_rng([seed, 1])
    history: list[EpochRecord] = []
    seconds: list[float] = []
    best, kept = 0, weights(net)
    with lone_workers() as pool:
        for epoch in range(1, training.epochs + 1):
            started = time.perf_counter()
            order = rng.permutation(len(train_x))
            loss, counts, rates = _one_epoch(
                net, optimizer, train_x, train_y, order, training.batch, pool
            )
            val_counts = fused_counts(net, val_x, pool=pool)
            record = _record(epoch, loss, counts, train_y, val_counts, val_y, rates)
            history.append(record)
            seconds.append(time.perf_counter() - started)
            if on_epoch is not None:
                on_epoch(record)
            if best == 0 or record.merit > history[best - 1].merit:
                best, kept = epoch, weights(net)
            elif epoch - best >= training.patience:
                break
    return Fitted(
        state_dict=kept,
        network=network,
        windows=windows,
        training=training,
        seed=seed,
        history=tuple(history),
        chosen_epoch=best,
        warnings=_warnings(history[best - 1]),
        epoch_seconds=tuple(seconds),
    )


def restore(fitted: Fitted) -> nn.Sequential:
    """The trained network as Sinabs modules; for `analysis.iaf.fused_counts` on a live stream."""
    net = build(fitted.network, fitted.windows, fitted.seed)
    set_weights(net, fitted.state_dict)
    return net


def predict_counts(fitted: Fitted, x: Array) -> npt.NDArray[np.int64]:
    """Output spikes int64 (n, 3) of samples (n, steps, channels, cells, cells).

    Raises:
        ValueError: samples of another shape.
    """
    return fused_counts(restore(fitted), x)


def limit_threads(count: int) -> None:
    """Compute in `count` threads of this process from now on; results do not depend on it."""
    torch.set_num_threads(count)


@dataclass(frozen=True)
class _Part:
    """What a few samples contribute to a step."""

    loss: float
    counts: metrics.IntArray
    rates: dict[str, float]
    gradients: tuple[torch.Tensor, ...]


def _one_epoch(
    net: nn.Sequential,
    optimizer: torch.optim.Optimizer,
    x: Array,
    y: metrics.IntArray,
    order: metrics.IntArray,
    batch: int,
    pool: Executor,
) -> tuple[float, metrics.IntArray, dict[str, float]]:
    """Mean loss, output spikes (n, 3) in the order of `x`, and the layers' mean rates.

    Parts of a batch are computed in any order and added up in theirs: the sum has the same bits
    on any number of threads.
    """
    parameters = [p for p in net.parameters() if p.requires_grad]

    def compute(rows: metrics.IntArray) -> _Part:
        layers = fused_layers(net, torch.from_numpy(x[rows].astype(np.float32)))
        out = layers[SPIKING[-1]].sum(dim=1)
        loss = nn.functional.cross_entropy(out, torch.from_numpy(y[rows]), reduction="sum")
        return _Part(
            loss=loss.item(),
            counts=out.detach().numpy().astype(np.int64),
            rates={name: spikes.detach().mean().item() for name, spikes in layers.items()},
            gradients=torch.autograd.grad(loss, parameters),
        )

    loss = 0.0
    counts = np.zeros((len(x), len(metrics.CLASSES)), np.int64)
    fired = dict.fromkeys(SPIKING, 0.0)
    for start in range(0, len(x), batch):
        chosen = order[start : start + batch]
        rows = [chosen[k : k + MICRO_BATCH] for k in range(0, len(chosen), MICRO_BATCH)]
        parts = list(pool.map(compute, rows))
        for row, part in zip(rows, parts, strict=True):
            loss += part.loss
            counts[row] = part.counts
            for name, rate in part.rates.items():
                fired[name] += rate * len(row)
        for parameter, *gradients in zip(parameters, *(p.gradients for p in parts), strict=True):
            parameter.grad = torch.stack(gradients).sum(dim=0) / len(chosen)
        optimizer.step()
    return loss / len(x), counts, {name: total / len(x) for name, total in fired.items()}


def _record(
    epoch: int,
    loss: float,
    train_counts: metrics.IntArray,
    train_y: metrics.IntArray,
    val_counts: metrics.IntArray,
    val_y: metrics.IntArray,
    rates: dict[str, float],
) -> EpochRecord:
    val = metrics.accuracy(val_counts, val_y)
    train = metrics.accuracy(train_counts, train_y)
    log_p = log_softmax(val_counts.astype(np.float64), axis=1)
    return EpochRecord(
        epoch=epoch,
        loss=loss,
        train_argmax=train.argmax or 0.0,
        val_loss=-float(log_p[np.arange(len(val_y)), val_y].mean()),
        val_argmax=val.argmax or 0.0,
        val_strict=val.strict or 0.0,
        val_margin=val.margin or 0.0,
        rates=rates,
    )


def _warnings(record: EpochRecord) -> tuple[str, ...]:
    """Layers that are silent or saturated, by name."""
    found = []
    for name, rate in record.rates.items():
        if rate <= SILENT_RATE:
            found.append(f"layer {name} is silent: {rate:.2g} spikes per neuron and step")
        elif rate >= SATURATED_RATE:
            found.append(f"layer {name} is saturated: {rate:.2g} spikes per neuron and step")
    return tuple(found)


def _check(net: nn.Sequential, x: Array, y: metrics.Labels, what: str) -> metrics.IntArray:
    y = metrics.check_labels(y)
    if not len(y) or len(x) != len(y):
        raise ValueError(f"{len(x)} {what} samples and {len(y)} labels; expected as many, not none")
    check_samples(net, x.shape)
    if x.dtype != np.uint8:
        raise ValueError(f"{what} samples are {x.dtype}; expected uint8 counts")
    return y
