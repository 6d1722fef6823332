"""The state of a training between two epochs, and how one epoch changes it."""

from __future__ import annotations

import io
import math
import pickle
from concurrent.futures import Executor
from dataclasses import asdict, dataclass

import numpy as np
import torch

from analysis.nets import metrics
from analysis.nets.epoch_record import EpochRecord
from analysis.nets.learning_rate import learning_rate
from analysis.nets.network import (
    SPIKING,
    build,
    by_parameter,
    matrices,
    on_grid,
    parameters,
    set_weights,
    weights,
)
from analysis.nets.sparse import SparseWindows
from analysis.nets.spiking import Job, Trainer, WindowLoss
from protocols.settings import Network, Training, Windows

MICRO_BATCH = 4
"""Samples whose gradients are computed at once; they are summed up to ``training.batch``. Small
enough for the processor's cache, and to give every thread something to do."""


@dataclass(frozen=True)
class _Part:
    """What a few samples contribute to a step."""

    loss: float
    counts: metrics.IntArray
    rates: dict[str, float]
    gradients: tuple[torch.Tensor, ...]


class Run:
    """A training between two epochs."""

    def __init__(self, network: Network, windows: Windows, training: Training, seed: int) -> None:
        self.training = training
        self.fine = build(network, windows, seed)
        self.trained = build(network, windows, seed)
        """Has the fine weights at their points of the grid, between epochs."""
        self.parameters = parameters(self.fine)
        self.optimizer = torch.optim.Adam(
            self.parameters.values(), training.learning_rate, fused=True
        )
        self.trainer = Trainer(self.trained, windows.cells)
        self.history: list[EpochRecord] = []
        self.seconds: list[float] = []
        self.best = 0
        self.to_grid()
        self.settle()
        self.kept = weights(self.trained)

    def to_grid(self) -> None:
        """Let the spikes be those of the fine weights as they are now."""
        self.trainer.take(on_grid(matrices(self.fine)))

    def settle(self) -> None:
        """Let `trained` have the weights that the spikes are of."""
        set_weights(self.trained, by_parameter(on_grid(matrices(self.fine))))

    @property
    def ended(self) -> bool:
        """Whether all epochs were run, or none of late was better."""
        done = len(self.history)
        return done >= self.training.epochs or (
            self.best > 0 and done - self.best >= self.training.patience
        )

    def one_epoch(
        self, x: SparseWindows, y: metrics.IntArray, order: metrics.IntArray, pool: Executor
    ) -> tuple[float, metrics.IntArray, dict[str, float]]:
        """Mean loss, output spikes (n, 3) in the order of `x`, and the layers' mean rates.

        Parts of a batch are computed in any order and added up in theirs: the sum has the same
        bits on any number of threads.
        """
        batch = self.training.batch
        steps = math.ceil(len(x) / batch)

        def compute(rows: metrics.IntArray) -> _Part:
            job = Job(self.trainer, x, rows, y[rows], self.training.gain)
            loss = WindowLoss.apply(job, *self.trainer.leaves)  # type: ignore[no-untyped-call]
            grads = torch.autograd.grad(loss, self.trainer.leaves)
            return _Part(loss.item(), job.counts, job.rates(), grads)

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
            sums = [
                torch.stack(each).sum(dim=0).numpy()
                for each in zip(*(part.gradients for part in parts), strict=True)
            ]
            total = self.trainer.layout.unpack(sums)
            for name, gradient in by_parameter(total).items():
                self.parameters[name].grad = gradient / len(chosen)
            for group in self.optimizer.param_groups:
                group["lr"] = learning_rate(self.training, len(self.history), start // batch, steps)
            self.optimizer.step()
            self.to_grid()
        self.settle()
        return loss / len(x), counts, {name: total / len(x) for name, total in fired.items()}

    def keep(self, record: EpochRecord) -> None:
        """An epoch is over; its weights are kept if it is the best yet."""
        self.history.append(record)
        if self.best == 0 or record.merit > self.history[self.best - 1].merit:
            self.best, self.kept = record.epoch, weights(self.trained)

    def state(self) -> bytes:
        """Everything that the epochs to come depend on."""
        buffer = io.BytesIO()
        content = {
            "fine": weights(self.fine),
            "optimizer": self.optimizer.state_dict(),
            "kept": self.kept,
            "best": self.best,
            "history": [asdict(record) for record in self.history],
            "seconds": self.seconds,
        }
        torch.save(content, buffer)
        return buffer.getvalue()

    def go_on(self, state: bytes) -> None:
        """Take up what `state` gave.

        Raises:
            ValueError: it is damaged, or of another network.
        """
        try:
            content = torch.load(io.BytesIO(state), map_location="cpu", weights_only=True)
            set_weights(self.fine, content["fine"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.kept, self.best = content["kept"], content["best"]
            self.history = [EpochRecord(**record) for record in content["history"]]
            self.seconds = content["seconds"]
        except (KeyError, TypeError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
            raise ValueError(f"not a state of this training: {error}") from error
        self.to_grid()
        self.settle()
