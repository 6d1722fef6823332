"""The same network, many times faster than step by step: spike counts equal to Sinabs' own.

`analysis.network` says what the network is; here its weights are packed for the event-driven
kernels. Equality is not luck: trained weights lie on a grid (`analysis.network.on_grid`), so every
current is exact in float32 in whatever order it is summed, and a neuron's potential is summed in
the one order that there is, that of time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from sinabs.activation import MembraneReset, SingleExponential, SingleSpike
from torch import nn

from analysis import spiking_gradients, spiking_kernels
from analysis.metrics import CLASSES
from analysis.network import SPIKING, WEIGHTED, check_samples
from analysis.sparse import SparseWindows
from analysis.spiking_layout import Layout

F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]
Samples = SparseWindows | npt.NDArray[np.uint8]

CHUNK = 64
"""Windows that a thread counts at a time."""


class Engine:
    """Spike counts of one network, with the weights that it has now.

    Args:
        net: from `analysis.network.build`; neither used nor changed afterwards.
        cells: along a sample's side.

    Raises:
        TypeError: it holds a neuron that the kernels do not compute.
    """

    def __init__(self, net: nn.Sequential, cells: int) -> None:
        self._net = net
        self.steps = int(_layer(net, SPIKING[0]).num_timesteps)
        self.threshold, _, _ = neuron(net)
        weights = torch_weights(net)
        self._layout = Layout(tuple(w.shape for w in weights), cells)
        self._layers = self._layout.layers(weights)
        self.shape = (self.steps, weights[0].shape[1], cells, cells)
        self._idle: list[tuple[Any, Any]] = []

    def counts(self, x: Samples, threads: int | None = None) -> I64:
        """Output spikes int64 (n, 3) of samples, each from rest; see `spikes`."""
        return self.spikes(x, threads)[0]

    def spikes(self, x: Samples, threads: int | None = None) -> tuple[I64, I64]:
        """Output spikes of samples, each from rest, and how often each layer fired.

        Args:
            x: (n, steps, channels, cells, cells), dense uint8 or sparse.
            threads: those of torch by default; the result does not depend on it.

        Returns:
            int64 (n, 3) in the order of `analysis.metrics.CLASSES`, and int64 (n, 4).

        Raises:
            ValueError: samples of another shape, or not uint8.
        """
        x = self.sparse(x)
        out = np.zeros((len(x), len(CLASSES)), np.int64)
        fired = np.zeros((len(x), len(SPIKING)), np.int64)

        def some(begin: int) -> None:
            state, scratch = self._borrow()
            spiking_kernels.windows(
                x.cell, x.count, x.offsets, begin, min(begin + CHUNK, len(x)), self.steps,
                self._layers, self.threshold, self._layout.rest, state, scratch, out, fired,
            )  # fmt: skip
            self._idle.append((state, scratch))

        side_by_side(some, range(0, len(x), CHUNK), threads)
        return out, fired

    def stream(self) -> Stream:
        """The network step by step, from rest."""
        return Stream(self)

    def sparse(self, x: Samples) -> SparseWindows:
        """The samples as the kernels read them.

        Raises:
            ValueError: another shape, or not uint8.
        """
        if not isinstance(x, SparseWindows):
            check_samples(self._net, x.shape)
            if x.shape[1:] != self.shape:
                raise ValueError(f"samples have the shape {x.shape}; expected (n, *{self.shape})")
            x = SparseWindows.of(x)
        if x.shape != self.shape:
            raise ValueError(f"samples have the shape {x.shape}; expected {self.shape}")
        return x

    def _borrow(self) -> tuple[Any, Any]:
        """Memory for one thread, to be put back into `_idle`."""
        try:
            return self._idle.pop()
        except IndexError:
            return self._layout.state(), self._layout.scratch()


class Stream:
    """A network that is given one step after the other, and keeps its potentials."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._state = engine._layout.state()
        self._scratch = engine._layout.scratch()
        self._fired = np.zeros(len(SPIKING), np.int64)

    def push(self, plane: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """The next step's counts (channels, cells, cells): which output neurons fire, (3,).

        Raises:
            ValueError: another shape, or not uint8.
        """
        engine = self._engine
        if plane.shape != engine.shape[1:] or plane.dtype != np.uint8:
            raise ValueError(f"a step is {plane.dtype} {plane.shape}; uint8 {engine.shape[1:]}")
        cell = np.flatnonzero(plane).astype(np.uint32)
        n = spiking_kernels.step(
            cell, plane.ravel()[cell], 0, len(cell), engine._layers, engine.threshold,
            self._state, self._scratch, self._fired,
        )  # fmt: skip
        fires = np.zeros(len(CLASSES), np.bool_)
        fires[self._scratch[3][-1][:n]] = True
        return fires

    def reset(self) -> None:
        """Back to rest."""
        for state, rest in zip(self._state, self._engine._layout.rest, strict=True):
            state[:] = rest


class WindowCounts(torch.autograd.Function):
    """Output spikes of windows as a function of the weights, for training with torch."""

    @staticmethod
    def forward(ctx: Any, job: Job, *weights: torch.Tensor) -> torch.Tensor:
        """Float32 (n, 3) for the job's windows; `weights` are the trainer's `leaves`."""
        ctx.job = job
        return torch.from_numpy(job.forward())

    @staticmethod
    def backward(ctx: Any, by_count: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Surrogate gradients by the weights."""
        return None, *map(torch.from_numpy, ctx.job.backward(by_count.numpy()))


class Job:
    """A few windows through a network and back, with the memory for it.

    Args:
        trainer: the network.
        windows: samples; `rows` of them are meant.
        rows: integer (n,).
    """

    def __init__(self, trainer: Trainer, windows: SparseWindows, rows: I64) -> None:
        self._trainer, self._windows, self._rows = trainer, windows, rows
        self._kept: list[tuple[Any, Any, Any]] = []

    def forward(self) -> F32:
        """Output spikes float32 (n, 3)."""
        trainer, x = self._trainer, self._windows
        state, scratch, *_ = memory = trainer.borrow()
        out = np.zeros((len(self._rows), len(CLASSES)), np.int64)
        for i, row in enumerate(self._rows.tolist()):
            kept = trainer.kept()
            spiking_gradients.forward_kept(
                x.cell, x.count, x.offsets, row, trainer.steps, trainer.layers,
                trainer.constants[0], trainer.layout.rest, state, scratch, *kept, out[i],
            )  # fmt: skip
            self._kept.append(kept)
        trainer.give_back(memory)
        return out.astype(np.float32)

    def backward(self, by_count: F32) -> tuple[F32, ...]:
        """Gradients by the packed weights; may be called once."""
        trainer, x = self._trainer, self._windows
        _, _, planes, padded = memory = trainer.borrow()
        grads = tuple(np.zeros_like(w) for w in trainer.layers[1])
        for i, row in enumerate(self._rows.tolist()):
            padded[: len(CLASSES)] = by_count[i]
            spiking_gradients.backward(
                x.cell, x.count, x.offsets, row, trainer.steps, trainer.layers, trainer.back,
                trainer.constants, *self._kept[i], padded, planes, grads,
            )  # fmt: skip
            trainer.keep(self._kept[i])
        self._kept = []
        trainer.give_back(memory)
        return grads

    def rates(self) -> dict[str, float]:
        """Mean spikes per neuron and step of each spiking layer, by name; before `backward`."""
        steps = self._trainer.steps * len(self._rows)
        return {
            name: sum(int(kept[2][k][-1]) for kept in self._kept)
            / (steps * self._trainer.layout.neurons[k])
            for k, name in enumerate(SPIKING)
        }


class Trainer:
    """A network's packed weights and memory, for `Job`s in several threads."""

    def __init__(self, net: nn.Sequential, cells: int) -> None:
        self.steps = int(_layer(net, SPIKING[0]).num_timesteps)
        self.constants = neuron(net)
        self.layout = Layout(tuple(w.shape for w in torch_weights(net)), cells)
        self._idle: list[Any] = []
        self._spare: list[Any] = []
        self.take(torch_weights(net))

    def take(self, weights: list[F32]) -> None:
        """Use these weights from now on."""
        self.layers = self.layout.layers(weights)
        self.back = self.layout.back(weights)
        self.leaves = tuple(torch.from_numpy(w).requires_grad_() for w in self.layers[1])
        """The packed weights, by which `WindowCounts` is differentiated."""

    def borrow(self) -> tuple[Any, Any, Any, F32]:
        """State, scratch, planes and a padded row for one thread."""
        try:
            return self._idle.pop()
        except IndexError:
            layout = self.layout
            taps = np.zeros(layout.shapes[1][1] * layout.shapes[1][2] ** 2, np.float32)
            planes = (layout.state(), layout.state()[:-1], taps)
            row = np.zeros(len(layout.rest[-1]), np.float32)
            return layout.state(), layout.scratch(), planes, row

    def give_back(self, memory: tuple[Any, Any, Any, F32]) -> None:
        """For the next to borrow."""
        self._idle.append(memory)

    def kept(self) -> tuple[Any, Any, Any]:
        """Potentials, lists of spikes and their ends for one window."""
        try:
            return self._spare.pop()
        except IndexError:
            sizes = [len(rest) for rest in self.layout.rest]
            return (
                tuple(np.empty((self.steps, size), np.float32) for size in sizes),
                tuple(np.empty(self.steps * size, np.uint64) for size in sizes),
                tuple(np.empty(self.steps + 1, np.uint64) for size in sizes),
            )

    def keep(self, kept: tuple[Any, Any, Any]) -> None:
        """For the next window."""
        self._spare.append(kept)


def side_by_side(
    work: Callable[[int], None], items: Iterable[int], threads: int | None = None
) -> None:
    """Do all of the work, in as many threads as torch may use or as are given."""
    items = list(items)
    count = min(threads or torch.get_num_threads(), len(items))
    if count <= 1:
        for item in items:
            work(item)
        return
    with ThreadPoolExecutor(count) as pool:
        for _ in pool.map(work, items):
            pass


def torch_weights(net: nn.Sequential) -> list[F32]:
    """Copies of a network's weights, in order."""
    return [np.array(_layer(net, n).weight.detach().numpy(), np.float32) for n in WEIGHTED]


def neuron(net: nn.Sequential) -> tuple[np.float32, np.float32, np.float32]:
    """Threshold, width and scale of a network's neurons.

    Raises:
        TypeError: they are not the paper's, or not all alike.
    """
    found = {_constants(name, _layer(net, name)) for name in SPIKING}
    if len(found) > 1:
        raise TypeError(f"neurons differ: (threshold, width, scale) are {sorted(found)}")
    threshold, width, scale = found.pop()
    return np.float32(threshold), np.float32(width), np.float32(scale)


def _layer(net: nn.Sequential, name: str) -> Any:
    return getattr(net, name)


def _constants(name: str, layer: Any) -> tuple[float, float, float]:
    surrogate = layer.surrogate_grad_fn
    if not (
        layer.spike_fn is SingleSpike
        and layer.reset_fn == MembraneReset(0.0)
        and type(surrogate) is SingleExponential
        and layer.min_v_mem is None
        and layer.tau_syn is None
    ):
        raise TypeError(f"{name}: the kernels compute only single spikes with reset to zero")
    threshold = float(layer.spike_threshold.detach())
    if not threshold > 0:
        raise TypeError(f"{name}: threshold {threshold}; the kernels need a positive one")
    return threshold, threshold * surrogate.grad_width, surrogate.grad_scale
