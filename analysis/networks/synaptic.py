"""Exact synaptic operations of a window, compared with dense multiply-adds.

A spike costs one addition at each neuron it reaches, and nothing is done where nothing happens;
that is what spiking buys. How many neurons it reaches depends on where it fired: near the border a
kernel is cut off, and a stride leaves out taps. So places are counted, not layers' spikes times a
mean. An ordinary network does the same sums for every place and step; both are counted by the same
synapses, none of them in the padding.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.networks.network import SPIKING, WEIGHTED, parameters
from sliplab.analysis.networks.spiking import Trainer, side_by_side
from sliplab.analysis.networks.spiking_gradients import forward_kept
from sliplab.analysis.networks.training import Fitted, restore
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.storage.schema.evaluation import WindowWork

I64 = npt.NDArray[np.int64]

CHUNK = 64
"""Windows that a thread counts at a time."""


def reached(side: int, kernel: int, stride: int) -> I64:
    """Outputs that each of `side` places in a row reaches, of a convolution padded by half.

    Output o takes in the places o * stride - kernel // 2 + d for each tap d.
    """
    outputs = np.arange(math.ceil(side / stride))
    first = outputs * stride - kernel // 2
    place = np.arange(side)[:, None]
    return ((place >= first) & (place < first + kernel)).sum(axis=1).astype(np.int64)


def fan_out(trainer: Trainer, cells: int) -> list[I64]:
    """Synapses of each place that can fire, for each weighted layer, as the kernels number places.

    For the first layer places are input cells (channel, row, column), for the others neurons of
    the layer below in its plane; zero if there is no neuron.
    """
    (c1, channels, k1, _), (c2, _, k2, _), (hidden, _), (outputs, _) = trainer.layout.shapes
    near, far = reached(cells, k1, 1), reached(cells, k2, 2)
    tables = trainer.layout.tables
    result = [np.tile((np.outer(near, near) * c1).ravel(), channels)]
    strided = (np.outer(far, far) * c2)[:, :, None]
    each: I64
    for table, each in zip(tables[:3], (strided, np.array(hidden), np.array(outputs)), strict=True):
        plane = np.zeros(table.target.size, np.int64)
        plane[table.target.index()] = each
        result.append(plane)
    return result


def count_work(fitted: Fitted, x: SparseWindows) -> WindowWork | None:
    """Count a trained network's operations for each window, from rest; None without windows."""
    return count_net_work(restore(fitted), fitted.windows.cells, x)


def count_net_work(net: nn.Sequential, cells: int, x: SparseWindows) -> WindowWork | None:
    """The same of any network that the kernels compute, with so many cells along a side."""
    if not len(x):
        return None
    trainer = Trainer(net, cells)
    synapses = fan_out(trainer, cells)
    layers = len(WEIGHTED)
    chunks = range(0, len(x), CHUNK)
    done = np.zeros((len(chunks), layers), np.int64)
    fired = np.zeros((len(chunks), layers), np.int64)

    def some(begin: int) -> None:
        state, scratch, (potentials, lists, ends), *_ = memory = trainer.borrow()
        out = np.zeros(trainer.classes, np.int64)
        row = begin // CHUNK
        for i in range(begin, min(begin + CHUNK, len(x))):
            forward_kept(
                x.cell,
                x.count,
                x.offsets,
                i,
                trainer.steps,
                trainer.layers,
                trainer.layout.spans,
                trainer.constants[0],
                trainer.layout.rest,
                state,
                scratch,
                potentials,
                lists,
                ends,
                out,
            )
            for k in range(layers):
                spikes = lists[k][: int(ends[k][-1])]
                fired[row, k] += len(spikes)
                if k + 1 < layers:
                    done[row, k + 1] += synapses[k + 1][spikes].sum()
        trainer.give_back(memory)

    side_by_side(some, chunks)
    operations = done.sum(axis=0)
    operations[0] = int((synapses[0][x.cell] * x.count).sum())
    spikes, n = fired.sum(axis=0), len(x)
    always = {
        name: 0 if getattr(net, name).bias is None else count * trainer.steps
        for name, count in zip(WEIGHTED, trainer.layout.neurons, strict=True)
    }
    synaptic = {name: int(operations[k]) / n + always[name] for k, name in enumerate(WEIGHTED)}
    dense = {
        name: int(synapses[k].sum()) * trainer.steps + always[name]
        for k, name in enumerate(WEIGHTED)
    }
    total, all_dense = sum(synaptic.values()), sum(dense.values())
    neurons, weights = sum(trainer.layout.neurons), parameters(net)
    size = sum(values.numel() for values in weights.values()) + neurons
    synapse_weights = torch.cat([weights[f"{name}.weight"].detach().flatten() for name in WEIGHTED])
    return WindowWork(
        synaptic_operations={**synaptic, "all": total},
        dense_multiply_adds={**dense, "all": all_dense},
        share=total / all_dense,
        spikes={name: int(spikes[k]) / n for k, name in enumerate(SPIKING)},
        rates={
            name: int(spikes[k]) / (n * trainer.steps * trainer.layout.neurons[k])
            for k, name in enumerate(SPIKING)
        },
        events=float(x.totals.mean()),
        n=n,
        footprint_bytes=size * np.dtype(np.float32).itemsize,
        connection_sparsity=float((synapse_weights == 0).double().mean()),
        activation_sparsity=1 - int(spikes.sum()) / (n * trainer.steps * neurons),
    )
