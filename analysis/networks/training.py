"""Fitting the spiking network to windows, choosing an epoch, and keeping the result.

Surrogate gradients through the event-driven network of `networks.spiking`, cross-entropy on
output spike counts, Adam. Spikes are those of weights on the grid
(`networks.network.on_grid`), and their gradients move the fine weights behind it: the network
that is trained, validated, saved and run is one, to the last spike. Two traps of spiking networks
are dealt with here: a layer that never fires passes for a network that says "no slip" (it is named
in the warnings), and a result that cannot be repeated (everything random comes from one seed; the
same call gives the same bits on any number of threads, and after a stop at any epoch).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks.epoch_record import EpochRecord, epoch_record, layer_warnings
from sliplab.analysis.networks.network import build, set_weights
from sliplab.analysis.networks.spiking import Engine, Samples
from sliplab.analysis.networks.training_run import Run
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.settings import Network, Training, Windows

VERSION = 8
"""Raised when the same samples, settings and seed give other weights."""


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
    train_x: Samples,
    train_y: metrics.Labels,
    val_x: Samples,
    val_y: metrics.Labels,
    network: Network,
    windows: Windows,
    training: Training,
    seed: int,
    on_epoch: Callable[[EpochRecord], None] | None = None,
    on_state: Callable[[bytes], None] | None = None,
    state: bytes | None = None,
) -> Fitted:
    """Train one network and keep its best epoch.

    The best epoch has the highest STRICT validation accuracy on raw spike counts: a unique winner
    that is right. Argmax would give a silent network something for its ties, and a detection
    needs a winner. Equal epochs are told apart by argmax accuracy (ties shared), then by the lower
    validation loss; the earlier one stays. Training ends after ``training.epochs`` or when
    ``training.patience`` epochs in a row were no better. It uses as many threads as torch may.

    A window without any event gets what the biases alone give; where that is no spike, or a tie,
    it is wrong by strict accuracy.

    Args:
        train_x, val_x: event counts uint8 (n, steps, channels, cells, cells), or sparse.
        train_y, val_y: classes, integer (n,), 0..2.
        network, windows, training: the settings; ``training.seeds`` is the caller's to loop over.
        seed: decides the first weights and the order of the samples.
        on_epoch: called with each record as soon as it is there, in the calling thread.
        on_state: called after each epoch with all that is needed to go on from there.
        state: what `on_state` was given last, by a call with the same arguments: training goes on
            there and ends with the same bits. Records of the epochs before are told again.

    Raises:
        ValueError: no samples, shapes that do not fit, a label that is no class, a state of
            another training.
    """
    run = Run(network, windows, training, seed)
    train, train_y = _check(run.trained, windows, train_x, train_y, "training")
    val, val_y = _check(run.trained, windows, val_x, val_y, "validation")
    if state is not None:
        run.go_on(state)
        if on_epoch is not None:
            for record in run.history:
                on_epoch(record)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        while not run.ended:
            started = time.perf_counter()
            epoch = len(run.history) + 1
            rng = np.random.default_rng([seed, epoch])
            order = rng.permutation(len(train))
            seen = train
            if training.mirror:
                seen = train.mirrored(rng.integers(0, 4, len(train), np.uint8))
            loss, counts, rates = run.one_epoch(seen, train_y, order, pool)
            val_counts = Engine(run.trained, windows.cells).counts(val)
            record = epoch_record(
                epoch, loss, counts, train_y, val_counts, val_y, rates, training.gain,
                network.margin,
            )  # fmt: skip
            run.keep(record)
            run.seconds.append(time.perf_counter() - started)
            if on_epoch is not None:
                on_epoch(record)
            if on_state is not None:
                on_state(run.state())
    return Fitted(
        state_dict=run.kept,
        network=network,
        windows=windows,
        training=training,
        seed=seed,
        history=tuple(run.history),
        chosen_epoch=run.best,
        warnings=layer_warnings(run.history[run.best - 1]),
        epoch_seconds=tuple(run.seconds),
    )


def restore(fitted: Fitted) -> nn.Sequential:
    """The trained network as Sinabs modules."""
    net = build(fitted.network, fitted.windows, fitted.seed)
    set_weights(net, fitted.state_dict)
    return net


def engine(fitted: Fitted) -> Engine:
    """What counts spikes of the trained network fast."""
    return Engine(restore(fitted), fitted.windows.cells)


def predict_counts(fitted: Fitted, x: Samples) -> npt.NDArray[np.int64]:
    """Output spikes int64 (n, 3) of samples (n, steps, channels, cells, cells).

    Raises:
        ValueError: samples of another shape.
    """
    return engine(fitted).counts(x)


def limit_threads(count: int) -> None:
    """Compute in `count` threads of this process from now on; results do not depend on it."""
    torch.set_num_threads(count)


def _check(
    net: nn.Sequential, windows: Windows, x: Samples, y: metrics.Labels, what: str
) -> tuple[SparseWindows, metrics.IntArray]:
    y = metrics.check_labels(y)
    if not len(y) or len(x) != len(y):
        raise ValueError(f"{len(x)} {what} samples and {len(y)} labels; expected as many, not none")
    try:
        return Engine(net, windows.cells).sparse(x), y
    except ValueError as error:
        raise ValueError(f"{what} {error}") from error
