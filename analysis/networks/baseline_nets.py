"""Baselines: small conventional networks on the same windows, without spikes.

Each has a few ten thousand weights like the spiking network: convolutions on the summed frame
(where), convolutions on the volume of steps (where and when), a gated recurrent unit over the steps
(when), and of taxels, which have no frame, convolutions over the steps. They see log(1 + counts).
Their learning rate falls as the spiking network's does, and the best epoch by validation accuracy
is selected; everything random comes from one seed, so that it repeats on the same number of
threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sparse import SparseWindows

EPOCHS = 10
BATCH = 128
LEARNING_RATE = 2e-3

_CHUNK = 512
"""Samples that are made dense at a time."""

Shape = tuple[int, int, int, int]
Votes = npt.NDArray[np.float32]


class _Frame(nn.Module):
    """Two convolutions on the events of each cell over the whole window."""

    def __init__(self, shape: Shape, classes: int) -> None:
        super().__init__()
        _, channels, rows, columns = shape
        self.layers = nn.Sequential(
            nn.Conv2d(channels, 8, 5, padding=2),
            nn.ReLU(),
            nn.Conv2d(8, 16, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(16 * math.ceil(rows / 2) * math.ceil(columns / 2), 32),
            nn.ReLU(),
            nn.Linear(32, classes),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n, steps, channels, rows, columns) to (n, classes)."""
        return self.layers(torch.log1p(x.sum(dim=1)))


class _Volume(nn.Module):
    """Two convolutions over steps, rows and columns at once, both of stride 2."""

    def __init__(self, shape: Shape, classes: int) -> None:
        super().__init__()
        steps, channels, rows, columns = shape
        left = [math.ceil(math.ceil(side / 2) / 2) for side in (steps, rows, columns)]
        self.layers = nn.Sequential(
            nn.Conv3d(channels, 8, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv3d(8, 16, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(16 * math.prod(left), 32),
            nn.ReLU(),
            nn.Linear(32, classes),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n, steps, channels, rows, columns) to (n, classes)."""
        return self.layers(torch.log1p(x).transpose(1, 2))


class _Recurrent(nn.Module):
    """A gated recurrent unit that is given one step's cells after the other."""

    def __init__(self, shape: Shape, classes: int) -> None:
        super().__init__()
        self.unit = nn.GRU(math.prod(shape[1:]), 48, batch_first=True)
        self.last = nn.Linear(48, classes)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n, steps, channels, rows, columns) to (n, classes)."""
        states, _ = self.unit(torch.log1p(x).flatten(2))
        return self.last(states[:, -1])


class _StepConvolutions(nn.Module):
    """Three convolutions over the steps, each of stride 2, that mix all cells of a step."""

    def __init__(self, shape: Shape, classes: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv1d(math.prod(shape[1:]), 32, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv1d(32, 32, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv1d(32, 48, 5, stride=2, padding=2),
            nn.ReLU(),
        )
        self.last = nn.Linear(2 * 48, classes)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n, steps, channels, rows, columns) to (n, classes)."""
        found = self.layers(torch.log1p(x).flatten(2).transpose(1, 2))
        return self.last(torch.cat([found.mean(dim=2), found.amax(dim=2)], dim=1))


KINDS: dict[str, Callable[[Shape, int], nn.Module]] = {
    "cnn_frame": _Frame,
    "cnn_volume": _Volume,
    "gru": _Recurrent,
}
"""Name to network, of windows with rows and columns of cells."""

TAXEL_KINDS: dict[str, Callable[[Shape, int], nn.Module]] = {
    "cnn_steps": _StepConvolutions,
    "gru": _Recurrent,
}
"""Name to network, of windows with a single cell."""


@dataclass(frozen=True)
class _BestEpoch:
    strict: float
    loss: float
    epoch: int
    state: dict[str, torch.Tensor]


def fitted_net(
    kind: str,
    train: SampleSet,
    validation: SampleSet,
    epochs: int = EPOCHS,
    seed: int = 0,
    on_epoch: Callable[[int, float], None] | None = None,
    classes: int = len(CLASSES),
    batch: int = BATCH,
) -> tuple[nn.Module, dict[str, Any]]:
    """Train one of `KINDS` or `TAXEL_KINDS`, and keep its best epoch.

    The best epoch is that of the best validation accuracy.

    Args:
        epochs: over which the rate falls to nothing along half a cosine.
        seed: of the first weights, the order and the mirrors.
        on_epoch: called with each epoch and its validation accuracy.
        classes: that there are.
        batch: windows a step of the optimiser; fewer for few windows.

    Returns:
        the network, and what it was: epochs, weights, multiply-adds a window.

    Raises:
        KeyError: no such kind.
        ValueError: no training or no validation samples, no epoch.
    """
    if epochs < 1:
        raise ValueError(f"{kind}: {epochs} epochs; must be at least one")
    if not len(train) or not len(validation):
        raise ValueError(f"{kind}: {len(train)} training and {len(validation)} validation samples")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = (KINDS | TAXEL_KINDS)[kind](train.windows.shape, classes)
    optimizer = torch.optim.Adam(net.parameters(), lr=LEARNING_RATE)
    best: _BestEpoch | None = None
    steps = epochs * math.ceil(len(train) / batch)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for done in range(1, epochs + 1):
        rng = np.random.default_rng([seed, done])
        _one_epoch(net, optimizer, falling, train, rng, batch)
        votes = net_votes(net, validation.windows, classes)
        strict = metrics.accuracy(votes, validation.y).strict or 0.0
        loss = float(
            nn.functional.cross_entropy(torch.from_numpy(votes), torch.from_numpy(validation.y))
        )
        if best is None or (strict, -loss) > (best.strict, -best.loss):
            state = {name: value.clone() for name, value in net.state_dict().items()}
            best = _BestEpoch(strict, loss, done, state)
        if on_epoch is not None:
            on_epoch(done, strict)
    assert best is not None
    net.load_state_dict(best.state)
    stated = {
        "epochs": epochs,
        "chosen_epoch": best.epoch,
        "validation_strict": best.strict,
        "weights": sum(p.numel() for p in net.parameters()),
        "multiply_adds": multiply_adds(net, train.windows.shape),
    }
    return net, stated


def _one_epoch(
    net: nn.Module,
    optimizer: torch.optim.Optimizer,
    falling: torch.optim.lr_scheduler.LRScheduler,
    train: SampleSet,
    rng: np.random.Generator,
    batch: int,
) -> None:
    net.train()
    order = rng.permutation(len(train))
    # at random, as the spiking network's are
    windows = train.windows.mirrored(rng.integers(0, 4, len(train), np.uint8))
    for start in range(0, len(order), batch):
        rows = order[start : start + batch]
        loss = nn.functional.cross_entropy(
            net(_dense(windows.take(rows))), torch.from_numpy(train.y[rows])
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        falling.step()


def net_votes(net: nn.Module, x: SparseWindows, classes: int = len(CLASSES)) -> Votes:
    """Return logits of samples, float32 (n, classes)."""
    net.eval()
    out = np.empty((len(x), classes), np.float32)
    with torch.no_grad():
        for start in range(0, len(x), _CHUNK):
            rows = np.arange(start, min(start + _CHUNK, len(x)))
            out[rows] = net(_dense(x.take(rows))).numpy()
    return out


def _dense(x: SparseWindows) -> torch.Tensor:
    return torch.from_numpy(x.dense().astype(np.float32))


def multiply_adds(net: nn.Module, shape: Shape) -> int:
    """Multiply-adds of one window, padding included, counted layer by layer on an empty one."""
    total = 0

    def convolution(layer: Any, _: Any, out: torch.Tensor) -> None:
        nonlocal total
        total += out[0].numel() * layer.weight[0].numel()

    def linear(layer: nn.Linear, _: Any, out: torch.Tensor) -> None:
        nonlocal total
        total += out[0].numel() * layer.in_features

    def recurrent(layer: nn.GRU, given: tuple[torch.Tensor, ...], _: Any) -> None:
        nonlocal total
        gates = 3 * layer.hidden_size
        total += given[0].shape[1] * gates * (layer.input_size + layer.hidden_size)

    hooks: dict[type[nn.Module], Callable[..., None]] = {
        nn.Conv1d: convolution,
        nn.Conv2d: convolution,
        nn.Conv3d: convolution,
        nn.Linear: linear,
        nn.GRU: recurrent,
    }
    handles = [
        module.register_forward_hook(hooks[type(module)])
        for module in net.modules()
        if type(module) in hooks
    ]
    try:
        with torch.no_grad():
            net(torch.zeros((1, *shape)))
    finally:
        for handle in handles:
            handle.remove()
    return total
