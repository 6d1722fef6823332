"""Fast event-driven inference of the network, with spike counts equal to Sinabs' own.

`networks.network` defines the network; here its weights are packed for the event-driven kernels.
The counts are exactly equal: trained weights lie on a grid (`networks.network.on_grid`), so every
current is exact in float32 in whatever order it is summed, and a neuron's potential is summed in
the one order that there is, that of time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from sinabs.activation import MembraneReset, SingleExponential, SingleSpike
from torch import nn

from sliplab.analysis.networks import spiking_gradients, spiking_kernels
from sliplab.analysis.networks.network import SPIKING, classes_of, matrices
from sliplab.analysis.networks.spiking_layout import NetworkLayout
from sliplab.analysis.windows.sparse import SparseWindows

F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]
Samples = SparseWindows | npt.NDArray[np.uint8]

CHUNK = 64
"""Windows that a thread counts at a time."""


class SpikeEngine:
    """Spike counts of one network, with the weights that it has now.

    Args:
        net: from `analysis.networks.network.build`; neither used nor changed afterwards.
        cells: along a sample's side.

    Raises:
        TypeError: it holds a neuron that the kernels do not compute.
    """

    def __init__(self, net: nn.Sequential, cells: int) -> None:
        self.steps = int(_layer(net, SPIKING[0]).num_timesteps)
        self.threshold, _, _ = neuron(net)
        self.classes = classes_of(net)
        weights = matrices(net)
        self._layout = NetworkLayout(tuple(w.shape for w in weights), cells)
        self._layers = self._layout.layers(weights)
        self.shape = (self.steps, weights[0].shape[1], cells, cells)
        self._idle: list[tuple[Any, Any]] = []

    def counts(self, x: Samples, threads: int | None = None) -> I64:
        """Output spikes int64 (n, classes) of samples, each from rest; see `spikes`."""
        return self.spikes(x, threads)[0]

    def spikes(self, x: Samples, threads: int | None = None) -> tuple[I64, I64]:
        """Output spikes of samples, each from rest, and how often each layer fired.

        Args:
            x: (n, steps, channels, cells, cells), dense uint8 or sparse.
            threads: those of torch by default; the result does not depend on it.

        Returns:
            int64 (n, classes), and int64 (n, 4).

        Raises:
            ValueError: samples of another shape, or not uint8.
        """
        x = self.sparse(x)
        out = np.zeros((len(x), self.classes), np.int64)
        fired = np.zeros((len(x), len(SPIKING)), np.int64)

        def some(begin: int) -> None:
            state, scratch = self._borrow()
            spiking_kernels.windows(
                x.cell,
                x.count,
                x.offsets,
                begin,
                min(begin + CHUNK, len(x)),
                self.steps,
                self._layers,
                self.threshold,
                self._layout.rest,
                state,
                scratch,
                out,
                fired,
            )
            self._idle.append((state, scratch))

        side_by_side(some, range(0, len(x), CHUNK), threads)
        return out, fired

    def stream(self) -> StatefulNetwork:
        """Return the network as a stepper that starts at rest."""
        return StatefulNetwork(self)

    def sparse(self, x: Samples) -> SparseWindows:
        """The samples as the kernels read them.

        Raises:
            ValueError: another shape, or not uint8.
        """
        if not isinstance(x, SparseWindows):
            if x.shape[1:] != self.shape:
                expected = ", ".join(map(str, self.shape))
                raise ValueError(f"samples have the shape {x.shape}; expected (n, {expected})")
            x = SparseWindows.of(x)
        if x.shape != self.shape:
            raise ValueError(f"samples have the shape {x.shape}; expected {self.shape}")
        return x

    def _borrow(self) -> tuple[Any, Any]:
        """Borrow memory for one thread; return it to `_idle`."""
        try:
            return self._idle.pop()
        except IndexError:
            return self._layout.state(), self._layout.scratch()


class StatefulNetwork:
    """A network that is given one step after the other, and keeps its potentials."""

    def __init__(self, engine: SpikeEngine) -> None:
        self._engine = engine
        self._state = engine._layout.state()
        self._scratch = engine._layout.scratch()
        self._fired = np.zeros(len(SPIKING), np.int64)

    def push(self, plane: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """The next step's counts (channels, cells, cells): output spikes by class, uint8 (K,).

        Raises:
            ValueError: another shape, or not uint8.
        """
        engine = self._engine
        if plane.shape != engine.shape[1:] or plane.dtype != np.uint8:
            raise ValueError(f"a step is {plane.dtype} {plane.shape}; uint8 {engine.shape[1:]}")
        cell = np.flatnonzero(plane).astype(np.uint32)
        n = spiking_kernels.step(
            cell,
            plane.ravel()[cell],
            0,
            len(cell),
            engine._layers,
            engine.threshold,
            self._state,
            self._scratch,
            self._fired,
        )
        classes = self._scratch[1][-1][:n] % np.uint64(engine.classes)
        return np.bincount(classes.astype(np.int64), minlength=engine.classes).astype(np.uint8)


@dataclass(frozen=True)
class WindowGradients:
    """A few windows through a network and back.

    Attributes:
        loss: the sum of the cross-entropies of their output spike counts times the gain.
        counts: output spikes int64 (n, classes).
        rates: mean spikes per neuron and step of each spiking layer, by name.
        grads: float32, gradients of the loss by the packed weights of each layer.
    """

    loss: float
    counts: I64
    rates: dict[str, float]
    grads: tuple[F32, ...]


class Trainer:
    """A network's packed weights and memory, for gradients in several threads."""

    def __init__(self, net: nn.Sequential, cells: int) -> None:
        self.steps = int(_layer(net, SPIKING[0]).num_timesteps)
        self.constants = neuron(net)
        self.classes = classes_of(net)
        self.layout = NetworkLayout(tuple(w.shape for w in matrices(net)), cells)
        self._idle: list[Any] = []
        self.take(matrices(net))

    def take(self, weights: list[F32]) -> None:
        """Use these weights from now on."""
        self.layers = self.layout.layers(weights)
        self.back = self.layout.back(weights)

    def gradients(
        self, x: SparseWindows, rows: I64, labels: I64, gain: float = 1.0
    ) -> WindowGradients:
        """Run some windows forward and back.

        Args:
            rows: int64 (n,), which windows.
            labels: classes int64 (n,) of these.
            gain: what a spike counts in the cross-entropy.
        """
        fired = np.zeros(len(SPIKING), np.int64)
        counts = np.zeros((len(rows), self.classes), np.int64)
        grads = tuple(np.zeros_like(w) for w in self.layers[1])
        memory = self.borrow()
        loss = spiking_gradients.windows_loss(
            x.cell,
            x.count,
            x.offsets,
            rows,
            labels,
            gain,
            self.steps,
            self.layers,
            self.layout.spans,
            self.back,
            self.constants,
            self.layout.rest,
            memory[:4],
            self.layout.neurons[-1],
            memory[4],
            counts,
            fired,
            grads,
        )
        self.give_back(memory)
        steps = self.steps * len(rows)
        rates = {
            name: int(fired[k]) / (steps * self.layout.neurons[k]) for k, name in enumerate(SPIKING)
        }
        return WindowGradients(float(loss), counts, rates, grads)

    def borrow(self) -> tuple[Any, Any, Any, Any, F32]:
        """Return the state, scratch, record, planes and a padded row for one thread.

        The record has, for each layer and one window: potentials float32 (steps, neurons), spikes
        uint64 and where each step's end, uint64 (steps + 1,).
        """
        try:
            return self._idle.pop()
        except IndexError:
            layout = self.layout
            sizes = [len(rest) for rest in layout.rest]
            one, two = (table.target for table in layout.tables[:2])
            above = [table.target.places for table in layout.tables[1:]]
            kernel = layout.shapes[1][2]
            retained = (
                tuple(np.empty((self.steps, size), np.float32) for size in sizes),
                tuple(np.empty(self.steps * size, np.uint64) for size in sizes),
                tuple(np.empty(self.steps + 1, np.uint64) for size in sizes),
            )
            planes = (
                tuple(np.zeros((self.steps, places), np.float32) for places in above),
                np.zeros(max(sizes), np.float32),
                np.zeros(sizes[0], np.float32),
                np.zeros((two.full**2, one.depth * kernel * kernel), np.float32),
            )
            row = np.zeros(above[-1], np.float32)
            return layout.state(), layout.scratch(), retained, planes, row

    def give_back(self, memory: tuple[Any, Any, Any, Any, F32]) -> None:
        """Return borrowed memory."""
        self._idle.append(memory)


def side_by_side(
    work: Callable[[int], None], items: Iterable[int], threads: int | None = None
) -> None:
    """Do all of the work, in as many threads as given or as torch may use."""
    items = list(items)
    count = min(threads or torch.get_num_threads(), len(items))
    if count <= 1:
        for item in items:
            work(item)
        return
    with ThreadPoolExecutor(count) as pool:
        for _ in pool.map(work, items):
            pass


def neuron(net: nn.Sequential) -> tuple[np.float32, np.float32, np.float32]:
    """Threshold, width and scale of a network's neurons.

    Raises:
        TypeError: they are not the paper's, or not all the same.
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
