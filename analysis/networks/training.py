"""Fitting the spiking network to windows, choosing an epoch, and saving the result.

Surrogate gradients through the event-driven network of `networks.spiking`, cross-entropy on
output spike counts, Adam. Spikes are those of weights on the grid
(`networks.network.on_grid`), and their gradients move the fine weights behind it: the network
that is trained, validated, saved and run is one, to the last spike. Two pitfalls of spiking
networks are handled here: a dead layer looks like a network that predicts "no slip" (it is named in
the warnings), and results that cannot be repeated (everything random comes from one seed; the same
call gives the same bits on any number of threads, and after a stop at any epoch).
"""

from __future__ import annotations

import io
import math
import pickle
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import log_softmax
from threadpoolctl import threadpool_limits
from torch import nn

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import regression_start
from sliplab.analysis.networks.gradients import work_on
from sliplab.analysis.networks.network import (
    SPIKING,
    build,
    classes_of,
    matrices,
    on_grid,
    parameters,
    set_matrices,
    set_weights,
    weights,
)
from sliplab.analysis.networks.spiking import Samples, SpikeEngine
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.errors import InputError
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows


def learning_rate(training: Training, done: int, step: int = 0, steps: int = 1) -> float:
    """Return the learning rate of a step in the epoch after `done` epochs.

    Constant, or falling from the full rate to nothing along half a cosine over all steps of all
    epochs (Loshchilov and Hutter, 2017, without restarts); and at the very beginning rising in a
    line. The last steps are nearly none: weights come to rest instead of being caught in a jump.

    Args:
        step, steps: done in this epoch, and all of an epoch.
    """
    rising = training.warm_up * training.epochs * steps
    rate = training.learning_rate * min(1.0, (done * steps + step + 1) / max(rising, 1.0))
    if training.schedule == "constant":
        return rate
    return rate * 0.5 * (1.0 + math.cos(math.pi * (done + step / steps) / training.epochs))


SILENT_RATE = 1e-5
"""Spikes per neuron and step at or below which a layer counts as silent."""

SATURATED_RATE = 0.9
"""Spikes per neuron and step at or above which a layer counts as saturated (1 is the most)."""


@dataclass(frozen=True)
class EpochRecord:
    """Results of one pass over the training samples.

    Attributes:
        epoch: 1 for the first.
        loss: mean cross-entropy of the training samples, each before the step it was used in.
        train_argmax: their accuracy, likewise, ties shared (`metrics.classification.Accuracy`).
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
        """Key by which epochs are compared, larger is better; see `fit`."""
        return (self.val_strict, self.val_argmax, -self.val_loss)


def epoch_record(
    epoch: int,
    loss: float,
    train_counts: metrics.IntArray,
    train_y: metrics.IntArray,
    val_counts: metrics.IntArray,
    val_y: metrics.IntArray,
    rates: dict[str, float],
    gain: float,
    margin: float,
) -> EpochRecord:
    """The record of an epoch from the output spikes (n, classes) and classes of both parts."""
    val = metrics.accuracy(val_counts, val_y, margin)
    train = metrics.accuracy(train_counts, train_y)
    log_p = log_softmax(gain * val_counts, axis=1)
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


def layer_warnings(record: EpochRecord) -> tuple[str, ...]:
    """Layers that are silent or saturated, by name."""
    found = []
    for name, rate in record.rates.items():
        if rate <= SILENT_RATE:
            found.append(f"layer {name} is silent: {rate:.2g} spikes per neuron and step")
        elif rate >= SATURATED_RATE:
            found.append(f"layer {name} is saturated: {rate:.2g} spikes per neuron and step")
    return tuple(found)


class TrainingRun:
    """A training between two epochs."""

    def __init__(
        self,
        network: NetworkSettings,
        windows: Windows,
        training: Training,
        seed: int,
        classes: int,
    ) -> None:
        self.training = training
        self.classes = classes
        self.fine = build(network, windows, seed, classes)
        self.trained = build(network, windows, seed, classes)
        """Network with the fine weights rounded to the grid, between epochs."""
        self.parameters = parameters(self.fine)
        self.optimizer = torch.optim.Adam(
            self.parameters.values(), training.learning_rate, fused=True
        )
        self.work = work_on(training.device, self.trained, windows.cells, training.gain)
        self.history: list[EpochRecord] = []
        self.seconds: list[float] = []
        self.best = 0
        self.to_grid()
        self.settle()
        self.retained = weights(self.trained)

    def to_grid(self) -> None:
        """Round the fine weights to the grid, and use them for spikes."""
        self.work.take(on_grid(matrices(self.fine)))

    def settle(self) -> None:
        """Copy the rounded weights to `trained`."""
        set_matrices(self.trained, on_grid(matrices(self.fine)))

    @property
    def ended(self) -> bool:
        """True once all epochs were run, or none of the last `patience` was better."""
        done = len(self.history)
        return done >= self.training.epochs or (
            self.best > 0 and done - self.best >= self.training.patience
        )

    def one_epoch(
        self, x: SparseWindows, y: metrics.IntArray, order: metrics.IntArray, pool: Executor
    ) -> tuple[float, metrics.IntArray, dict[str, float]]:
        """Mean loss, output spikes (n, classes) in the order of `x`, and the layers' mean rates."""
        batch = self.training.batch
        steps = math.ceil(len(x) / batch)
        loss = 0.0
        counts = np.zeros((len(x), self.classes), np.int64)
        fired = dict.fromkeys(SPIKING, 0.0)
        for start in range(0, len(x), batch):
            chosen = order[start : start + batch]
            found = self.work.batch(x, y, chosen, pool)
            loss += found.loss
            counts[chosen] = found.counts
            for name, rate in found.fired.items():
                fired[name] += rate
            for name, parameter in self.parameters.items():
                parameter.grad = found.gradients[name] / len(chosen)
            for group in self.optimizer.param_groups:
                group["lr"] = learning_rate(self.training, len(self.history), start // batch, steps)
            self.optimizer.step()
            self.to_grid()
        self.settle()
        return loss / len(x), counts, {name: total / len(x) for name, total in fired.items()}

    def keep(self, record: EpochRecord) -> None:
        """Record an epoch; keep its weights if it is the best so far."""
        self.history.append(record)
        if self.best == 0 or record.merit > self.history[self.best - 1].merit:
            self.best, self.retained = record.epoch, weights(self.trained)

    def state(self) -> bytes:
        """State on which the following epochs depend."""
        buffer = io.BytesIO()
        content = {
            "fine": weights(self.fine),
            "optimizer": self.optimizer.state_dict(),
            "kept": self.retained,
            "best": self.best,
            "history": [asdict(record) for record in self.history],
            "seconds": self.seconds,
        }
        torch.save(content, buffer)
        return buffer.getvalue()

    def go_on(self, state: bytes) -> None:
        """Resume from a checkpoint that `state` returned.

        Raises:
            ValueError: it is damaged, or of another network.
        """
        try:
            content = torch.load(io.BytesIO(state), map_location="cpu", weights_only=True)
            set_weights(self.fine, content["fine"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.retained, self.best = content["kept"], content["best"]
            self.history = [EpochRecord(**record) for record in content["history"]]
            self.seconds = content["seconds"]
        except (KeyError, TypeError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
            raise ValueError(f"not a state of this training: {error}") from error
        self.to_grid()
        self.settle()


VERSION = 8
"""Version; incremented when the same samples, settings and seed give other weights."""


@dataclass(frozen=True)
class Fitted:
    """A trained network and how it came about.

    Attributes:
        state_dict: weights of the chosen epoch, by name; no neuron states.
        network, windows, training, seed: what was requested.
        history: one record an epoch.
        chosen_epoch: the epoch the weights are from.
        warnings: as text, what is wrong with the chosen network; empty when nothing is.
        epoch_seconds: wall time of each epoch. Separate from the records and not saved, so that the
            same training gives the same file.
        classes: names of the classes, in the order of the outputs.
    """

    state_dict: dict[str, torch.Tensor]
    network: NetworkSettings
    windows: Windows
    training: Training
    seed: int
    history: tuple[EpochRecord, ...]
    chosen_epoch: int
    warnings: tuple[str, ...]
    epoch_seconds: tuple[float, ...] = field(default=(), compare=False)
    classes: tuple[str, ...] = metrics.CLASSES

    @property
    def chosen(self) -> EpochRecord:
        """The record of the chosen epoch."""
        return self.history[self.chosen_epoch - 1]

    @cached_property
    def engine(self) -> SpikeEngine:
        """The event-driven engine of the network; it may count in several threads at a time."""
        return SpikeEngine(restore(self), self.windows.cells)

    def check_slip(self, model: Path | str, purpose: str) -> None:
        """Check that the classes are those of slip, for what is made for these alone.

        Args:
            model: its file, for the message.
            purpose: what needs them, such as ``detection``.

        Raises:
            InputError: they are not.
        """
        if self.classes != metrics.CLASSES:
            some = ", ".join(self.classes[:4]) + (" ..." if len(self.classes) > 4 else "")
            raise InputError(
                model,
                "",
                None,
                f"the network tells {len(self.classes)} classes apart ({some}); {purpose} needs "
                f"one of the classes {', '.join(metrics.CLASSES)}",
            )


def fit(
    train_x: Samples,
    train_y: metrics.Labels,
    val_x: Samples,
    val_y: metrics.Labels,
    network: NetworkSettings,
    windows: Windows,
    training: Training,
    seed: int,
    on_epoch: Callable[[EpochRecord], None] | None = None,
    on_state: Callable[[bytes], None] | None = None,
    state: bytes | None = None,
    classes: Sequence[str] = metrics.CLASSES,
) -> Fitted:
    """Train one network and keep its best epoch.

    The best epoch has the highest STRICT validation accuracy on raw spike counts: a unique winner
    that is right. Argmax would give a silent network something for its ties, and a detection
    needs a winner. Equal epochs are ranked by argmax accuracy (ties shared), then by the lower
    validation loss; the earlier one stays. Training ends after ``training.epochs`` or when
    ``training.patience`` epochs in a row were no better. It uses as many threads as torch may.

    A window without any event gets what the biases alone give; where that is not a spike, or a tie,
    it is wrong by strict accuracy.

    Args:
        train_x, val_x: event counts uint8 (n, steps, channels, cells, cells), or sparse.
        train_y, val_y: classes, integer (n,), from 0.
        network, windows, training: the settings; ``training.seeds`` is the caller's to loop over.
        seed: decides the first weights and the order of the samples.
        on_epoch: called with each record as soon as it is there, in the calling thread.
        on_state: called after each epoch with all that is needed to resume there.
        state: last state passed to `on_state` by a call with the same arguments: training resumes
            there and ends with the same bits. Records of earlier epochs are reported again.
        classes: names of the classes, at least 2.

    Raises:
        ValueError: no samples, shapes that do not fit, a label that is not a class, fewer than 2
            classes or two of one name, a state of another training.
    """
    classes = check_classes(classes)
    by_data = network.start == "regression"
    network = regression_start.sized(network, windows, len(classes))
    run = TrainingRun(network, windows, training, seed, len(classes))
    train, train_y = _check(run.trained, windows, train_x, train_y, "training")
    val, val_y = _check(run.trained, windows, val_x, val_y, "validation")
    if by_data:
        regression_start.begin(run.fine, train, train_y)
        run.to_grid()
        run.settle()
    if state is not None:
        run.go_on(state)
        if on_epoch is not None:
            for record in run.history:
                on_epoch(record)
    # the library's own threads would wait for each other busily inside those of the pool
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(torch.get_num_threads()) as pool:
        while not run.ended:
            started = time.perf_counter()
            epoch = len(run.history) + 1
            rng = np.random.default_rng([seed, epoch])
            order = rng.permutation(len(train))
            seen = train
            if training.mirror:
                seen = train.mirrored(rng.integers(0, 4, len(train), np.uint8))
            loss, counts, rates = run.one_epoch(seen, train_y, order, pool)
            val_counts = SpikeEngine(run.trained, windows.cells).counts(val)
            record = epoch_record(
                epoch,
                loss,
                counts,
                train_y,
                val_counts,
                val_y,
                rates,
                training.gain,
                network.margin,
            )
            run.keep(record)
            run.seconds.append(time.perf_counter() - started)
            if on_epoch is not None:
                on_epoch(record)
            if on_state is not None:
                on_state(run.state())
    return Fitted(
        state_dict=run.retained,
        network=network,
        windows=windows,
        training=training,
        seed=seed,
        history=tuple(run.history),
        chosen_epoch=run.best,
        warnings=layer_warnings(run.history[run.best - 1]),
        epoch_seconds=tuple(run.seconds),
        classes=classes,
    )


def check_classes(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of classes; a ValueError unless there are two or more, all distinct."""
    found = tuple(names)
    if len(found) < 2 or len(set(found)) < len(found):
        raise ValueError(f"classes are {', '.join(found) or 'none'}; expected 2 or more, distinct")
    return found


def restore(fitted: Fitted) -> nn.Sequential:
    """The trained network as Sinabs modules."""
    net = build(fitted.network, fitted.windows, fitted.seed, len(fitted.classes))
    set_weights(net, fitted.state_dict)
    return net


def predict_counts(fitted: Fitted, x: Samples) -> npt.NDArray[np.int64]:
    """Output spikes int64 (n, classes) of samples (n, steps, channels, cells, cells).

    Raises:
        ValueError: samples of another shape.
    """
    return fitted.engine.counts(x)


def limit_threads(count: int) -> None:
    """Compute in `count` threads of this process from now on; results do not depend on it."""
    torch.set_num_threads(count)


def _check(
    net: nn.Sequential, windows: Windows, x: Samples, y: metrics.Labels, what: str
) -> tuple[SparseWindows, metrics.IntArray]:
    y = metrics.check_labels(y, classes_of(net))
    if not len(y) or len(x) != len(y):
        raise ValueError(f"{len(x)} {what} samples and {len(y)} labels; expected as many, not none")
    try:
        return SpikeEngine(net, windows.cells).sparse(x), y
    except ValueError as error:
        raise ValueError(f"{what} {error}") from error
