"""Memory layout of weights and neurons for the event-driven kernels, and back to torch's shapes.

The kernels are not specific to convolutions: a layer is a table of what each source reaches
(`analysis.networks.spiking_kernels`). This file makes the four tables of the network and packs its
weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.networks.lanes import BLOCK, LANES

F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]
U32 = npt.NDArray[np.uint32]
U64 = npt.NDArray[np.uint64]


def whole(count: int, of: int) -> int:
    """The least multiple of `of` that is not below `count`."""
    return -(-count // of) * of


@dataclass(frozen=True)
class LayerPlane:
    """Neurons of a layer: a square of channels-last pixels in a border, or a row of neurons.

    Attributes:
        side: pixels a side without the border.
        channels: neurons a pixel.
        pad: pixels of border before the first, along both axes.
        full: pixels a side with the border.
    """

    side: int
    channels: int
    pad: int
    full: int

    @property
    def depth(self) -> int:
        """Places of a pixel: its neurons, filled up to whole vectors."""
        return whole(self.channels, LANES)

    @property
    def places(self) -> int:
        """Places of all pixels, with the border."""
        return self.full * self.full * self.depth

    @property
    def size(self) -> int:
        """The same up to a multiple of `BLOCK`, because so many neurons take a step at once."""
        return whole(self.places, BLOCK)

    def index(self) -> I64:
        """Places of the neurons proper, int64 (side, side, channels)."""
        line = np.arange(self.pad, self.pad + self.side)
        pixel = line[:, None] * self.full + line
        return pixel[:, :, None] * self.depth + np.arange(self.channels)

    def spans(self, of: int) -> U64:
        """Uint64 (n, 2): runs of neurons that hold all proper ones, bounds multiples of `of`."""
        index = self.index().reshape(self.side, -1)
        found: list[list[int]] = []
        for first, last in zip(index[:, 0].tolist(), index[:, -1].tolist(), strict=True):
            begin, end = first // of * of, whole(last + 1, of)
            if found and begin <= found[-1][1]:
                found[-1][1] = end
            else:
                found.append([begin, end])
        return np.array(found, np.uint64)

    def rest(self) -> F32:
        """Potentials before a window: zero, and minus infinity in the border."""
        values = np.full(self.size, -np.inf, np.float32)
        values[self.index().ravel()] = 0.0
        return values


@dataclass(frozen=True)
class ConnectionTable:
    """Connections of a layer: what each source reaches, and where its weights are packed.

    Attributes:
        reach: uint32 (sources, 2), see `analysis.networks.spiking_kernels`.
        stride_w, stride: from a run to the next among weights and among currents.
        runs, length: how many runs a source has, and weights of one.
        order: int64, for each packed weight its place in the layer's flattened matrix
            (`analysis.networks.network.matrices`); -1 for none.
        bias: where the biases begin among the packed weights, one for each neuron of the
            target; -1 for none.
        target: the neurons.
    """

    reach: U32
    stride_w: int
    stride: int
    runs: int
    length: int
    order: I64
    target: LayerPlane
    bias: int = -1

    @property
    def shape(self) -> tuple[np.uint64, ...]:
        """The layer's shape as `networks.spiking_kernels` takes it."""
        return tuple(map(np.uint64, (self.stride_w, self.stride, self.runs, self.length)))

    def pack(self, weight: F32) -> F32:
        """A layer's matrix, packed."""
        flat = np.append(weight.ravel(), np.float32(0.0))
        return np.ascontiguousarray(flat[self.order])

    def unpack(self, packed: F32, shape: tuple[int, ...]) -> F32:
        """Return sums by packed weight in the matrix's shape."""
        return packed[self.back].reshape(shape)

    @cached_property
    def back(self) -> I64:
        """For each weight of the matrix its place among the packed."""
        there = np.flatnonzero(self.order >= 0)
        places = np.empty(there.size, np.int64)
        places[self.order[there]] = there
        return places


def first_convolution(channels: int, cells: int, kernel: int, plane: LayerPlane) -> ConnectionTable:
    """Connect the input's cells (channel, y, x); torch's weight is (c1, channels, kernel, kernel).

    A unit at (y, x) reaches outputs y + kernel // 2 - d by tap d, for each d: in the order of
    outputs the taps are reversed.
    """
    p = kernel // 2
    taps = np.arange(kernel)[::-1]
    o = np.arange(plane.depth)[None, None, None, :]
    i = np.arange(channels)[:, None, None, None]
    order = ((o * channels + i) * kernel + taps[None, :, None, None]) * kernel
    order = np.where(o < plane.channels, order + taps[None, None, :, None], -1)
    reach = np.zeros((channels, cells, cells, 2), np.uint32)
    line = np.arange(cells) + plane.pad - p
    length = kernel * plane.depth
    reach[..., 0] = (line[:, None] * plane.full + line) * plane.depth
    reach[..., 1] = i[:, :, :, 0] * kernel * length
    stride = plane.full * plane.depth
    return ConnectionTable(
        reach.reshape(-1, 2), length, stride, kernel, length, order.ravel(), plane
    )


def strided_taps(kernel: int) -> tuple[list[list[int]], list[int]]:
    """For even and odd positions: the taps that a stride of 2 leaves, and the first output.

    Output o is reached from position y by tap d = y + kernel // 2 - 2 o. Taps are in the order of
    outputs; the first output is counted from y // 2.
    """
    p = kernel // 2
    taps = [[d for d in reversed(range(kernel)) if (parity + p - d) % 2 == 0] for parity in (0, 1)]
    return taps, [(parity + p - of[0]) // 2 if of else 0 for parity, of in enumerate(taps)]


def strided_plane(cells: int, c2: int, kernel: int) -> LayerPlane:
    """The neurons of the second convolution, with room for every tap."""
    taps, first = strided_taps(kernel)
    side = (cells + 1) // 2
    pad = max(0, *(-at for at in first))
    most = max(map(len, taps))  # those that there are not are filled up with zeros
    ends = [y // 2 + first[y % 2] + most for y in range(cells)]
    return LayerPlane(side, c2, pad, pad + max(side, *ends))


def second_convolution(below: LayerPlane, kernel: int, plane: LayerPlane) -> ConnectionTable:
    """Connect layer 1, stride 2; torch's weight is (c2, c1, kernel, kernel)."""
    taps, first = strided_taps(kernel)
    c1, c2 = below.channels, plane.channels
    most = max(map(len, taps))
    order = np.full((c1, 2, 2, most, most, plane.depth), -1, np.int64)
    i, o = np.arange(c1)[:, None], np.arange(c2)[None, :]
    for py in (0, 1):
        for px in (0, 1):
            for a, dy in enumerate(taps[py]):
                for b, dx in enumerate(taps[px]):
                    order[:, py, px, a, b, :c2] = ((o * c1 + i) * kernel + dy) * kernel + dx
    reach = np.zeros((below.size, 2), np.uint32)
    line = np.arange(below.side)
    parity = line % 2
    at = line // 2 + np.array(first)[parity] + plane.pad
    index = below.index()
    reach[index, 0] = ((at[:, None] * plane.full + at) * plane.depth)[:, :, None]
    length = most * plane.depth
    block = most * length
    reach[index, 1] = ((np.arange(c1) * 2 + parity[:, None, None]) * 2 + parity[:, None]) * block
    return ConnectionTable(
        reach, length, plane.full * plane.depth, most, length, order.ravel(), plane
    )


def full_layer(below: LayerPlane, n: int) -> ConnectionTable:
    """Connect a whole layer; the matrix is (n, channels * side * side + 1), channels first."""
    plane = LayerPlane(1, n, 0, 1)
    index = below.index()
    sources = index.transpose(2, 0, 1).ravel()  # in the order in which torch flattens
    order = np.full((below.size + 1, plane.depth), -1, np.int64)
    row = np.arange(n) * (sources.size + 1)
    order[sources, :n] = row + np.arange(sources.size)[:, None]
    order[-1, :n] = row + sources.size
    reach = np.zeros((below.size, 2), np.uint32)
    reach[:, 1] = np.arange(below.size) * plane.depth
    bias = below.size * plane.depth
    return ConnectionTable(
        reach, plane.depth, plane.depth, 1, plane.depth, order.ravel(), plane, bias
    )


def strided_back(below: LayerPlane, kernel: int, plane: LayerPlane) -> U32:
    """Return the table of the backward pass through the second convolution, uint32 (pixels, 2).

    Its columns are a pixel's place in its plane, and that of tap (0, 0) in the plane below.
    """
    line = np.arange(plane.side)
    here = (line[:, None] + plane.pad) * plane.full + line + plane.pad
    there = 2 * line + below.pad - kernel // 2
    under = there[:, None] * below.full + there
    pixels = np.stack([here, under * below.depth], axis=-1)
    return pixels.reshape(-1, 2).astype(np.uint32)


def _filled(values: F32, *shape: int) -> F32:
    """The same with zeros behind along each axis, for neurons that fill up the lanes."""
    filled = np.zeros(shape, np.float32)
    filled[tuple(map(slice, values.shape))] = values
    return filled


class NetworkLayout:
    """Tables of a network, by the shapes of its matrices and the cells along a sample's side."""

    def __init__(self, shapes: tuple[tuple[int, ...], ...], cells: int) -> None:
        (c1, channels, k1, _), (c2, _, k2, _), (hidden, _), (out, _) = shapes
        self.shapes = shapes
        pad = max(k1 // 2, k2 // 2)
        one = LayerPlane(cells, c1, pad, cells + 2 * pad + 1)
        two = strided_plane(cells, c2, k2)
        three = full_layer(two, hidden)
        self.tables = (
            first_convolution(channels, cells, k1, one),
            second_convolution(one, k2, two),
            three,
            full_layer(three.target, out),
        )
        planes = [table.target for table in self.tables]
        self.rest = tuple(plane.rest() for plane in planes)
        self.spans = tuple(plane.spans(BLOCK) for plane in planes)
        self.neurons = tuple(plane.side * plane.side * plane.channels for plane in planes)

    def layers(self, weights: list[F32]) -> tuple[Any, ...]:
        """Pack a network's matrices for the kernels."""
        return (
            tuple(table.reach for table in self.tables),
            tuple(table.pack(w) for table, w in zip(self.tables, weights, strict=True)),
            tuple(table.shape for table in self.tables),
            tuple(table.bias for table in self.tables),
        )

    def back(self, weights: list[F32]) -> tuple[Any, ...]:
        """Return the arguments of `networks.spiking_gradients.backward`."""
        kernel = self.shapes[1][2]
        one, two, three, four = (table.target for table in self.tables)
        of2 = weights[1].transpose(0, 2, 3, 1)
        of3 = self.tables[2].pack(weights[2]).reshape(two.size + 1, -1)
        of4 = self.tables[3].pack(weights[3]).reshape(three.size + 1, -1)
        return (
            one.spans(LANES),
            strided_back(one, kernel, two),
            _filled(of2, two.depth, kernel, kernel, one.depth).reshape(two.depth, -1),
            kernel,
            _filled(of3.T[:, : two.places], three.places, two.places),
            _filled(of4.T[:, : three.places], four.places, three.places),
        )

    def unpack(self, grads: Sequence[F32]) -> list[F32]:
        """Gradients by packed weights, in the matrices' shapes."""
        return [
            table.unpack(grad, shape)
            for table, grad, shape in zip(self.tables, grads, self.shapes, strict=True)
        ]

    def state(self) -> tuple[F32, ...]:
        """Potentials of each layer at rest."""
        return tuple(rest.copy() for rest in self.rest)

    def scratch(self) -> tuple[Any, ...]:
        """Memory for one thread; see `analysis.networks.spiking_kernels.step`."""
        sizes = [len(rest) for rest in self.rest]
        rows = self.tables[0].target.full
        return (
            tuple(np.zeros(size, np.float32) for size in sizes),
            tuple(np.zeros(size, np.uint64) for size in sizes),
            np.zeros(rows, np.uint64),
            np.zeros(rows, np.uint64),
        )
