"""The state of a training between two epochs, and how one epoch changes it."""

from __future__ import annotations

import io
import math
import pickle
from concurrent.futures import Executor
from dataclasses import asdict

import numpy as np
import torch

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks.epoch_record import EpochRecord
from sliplab.analysis.networks.learning_rate import learning_rate
from sliplab.analysis.networks.network import (
    SPIKING,
    build,
    matrices,
    on_grid,
    parameters,
    set_matrices,
    set_weights,
    weights,
)
from sliplab.analysis.networks.training_work import work_on
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.settings import Network, Training, Windows


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
        self.work = work_on(training.device, self.trained, windows.cells, training.gain)
        self.history: list[EpochRecord] = []
        self.seconds: list[float] = []
        self.best = 0
        self.to_grid()
        self.settle()
        self.kept = weights(self.trained)

    def to_grid(self) -> None:
        """Let the spikes be those of the fine weights as they are now."""
        self.work.take(on_grid(matrices(self.fine)))

    def settle(self) -> None:
        """Let `trained` have the weights that the spikes are of."""
        set_matrices(self.trained, on_grid(matrices(self.fine)))

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
        """Mean loss, output spikes (n, 3) in the order of `x`, and the layers' mean rates."""
        batch = self.training.batch
        steps = math.ceil(len(x) / batch)
        loss = 0.0
        counts = np.zeros((len(x), len(metrics.CLASSES)), np.int64)
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
