"""Events of markers that move in front of an event camera, without drawing a single frame.

A pixel of such a camera fires when its log intensity has changed by its threshold. For a disc
with a known edge that happens when the disc's rim is at a known distance, so the times are roots
on the disc's path: exact to a microsecond where frames at 1 kHz give half a millisecond (v2e, Hu,
Liu and Delbruck 2021), and more than a hundred times cheaper. Only pixels that may fire are
computed.

Discs must not come so near to each other that their edges overlap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.circuit import (
    OFF,
    ON,
    RATE_DECADES,
    Circuit,
    events_of_circuit,
    memorise_image,
    new_circuit,
    start_cells,
)
from sliplab.plugins.simulation.scene.edges import CUT, dark_pixels, darken, memorise_discs, widen
from sliplab.plugins.simulation.scene.flicker import (
    FlickeringLight,
    flicker_events,
    new_flicker,
    steady,
)
from sliplab.plugins.simulation.scene.marker_path import (
    SEGMENT,
    cut_block,
    excursion,
    farthest,
    fit_blocks,
    inner_weights,
    markers_in_image,
    slope_weights,
    stands_still,
)
from sliplab.plugins.simulation.scene.noise import (
    BIN_NS,
    Candidates,
    NoiseRates,
    candidates,
    hot_places,
    noise_events,
)
from sliplab.plugins.simulation.scene.optics import EventOptics
from sliplab.plugins.simulation.scene.pixels import (
    FIRE_FIELDS,
    PIXEL_FIELDS,
    STEP_FIELDS,
    STRIDE,
    WAIT_FIELDS,
    events_of_pixels,
    pack_steps,
)
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.scene.readout import (
    NEVER_NS,
    ScanTimes,
    larger,
    read_each,
    read_scans,
)
from sliplab.plugins.simulation.scene.rim_pixels import (
    REACH_PX,
    RimLists,
    make_list,
    may_fire,
    near_rim,
    no_lists,
    reaches,
    renew,
)
from sliplab.storage.kernels import njit

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
U16 = npt.NDArray[np.uint16]
U8 = npt.NDArray[np.uint8]
Events = tuple[I64, U16, U16, U8]
"""True time in ns of the event or of its reading, column, row, polarity; (n,) each."""


class CameraKernel(NamedTuple):
    """Settings of the camera that the kernel takes; fields as in `EventOptics`."""

    block_ns: int
    chord: bool
    """Straight lines between rows in place of cubics."""
    contrast: float
    edge: float
    refractory_ns: int
    period_ns: int
    column_ns: float
    lowest: float
    """The lowest threshold of all."""
    leak_below: float
    """Of `noise.NoiseRates`."""


class Pixels(NamedTuple):
    """State of the pixels of an array."""

    threshold: F64
    """(height, width)."""
    state: F64
    """See `scene.edges`, (height, width, 4)."""
    fired: I64
    """Time at which each last fired, true ns, (height, width)."""
    seen: F64
    """Rectangles in which markers have been, see `edges.darken`, (n, 4)."""


class MarkerSensor:
    """The pixels' state, and the markers of n papillae in the image."""

    def __init__(self, optics: EventOptics, layout_mm: F64, seed: int) -> None:
        self.optics = optics
        self._layout_mm = np.ascontiguousarray(layout_mm, np.float64)
        shape = (optics.height, optics.width)
        self.threshold: F64 = _between_pixels(
            seed, "thresholds", shape, optics.threshold, optics.threshold_sigma
        )
        # a reference that leaks makes its positive events itself
        rate_hz, leaks = optics.noise_hz, optics.leak_share
        if optics.leak == "reference":
            rate_hz, leaks = rate_hz * (1.0 - leaks), 0.0
        self._noise = NoiseRates(
            optics.width,
            optics.height,
            rate_hz,
            leaks,
            optics.hot_hz,
            hot_places(optics.width, optics.height, optics.hot_pixels, seed),
        )
        self._circuit = self._new_circuit(seed) if optics.has_circuit else None
        self._light = steady()
        self._started = True
        middle = 0.5 * (optics.width - 1), 0.5 * (optics.height - 1)
        self._projection = (
            float(optics.px_per_mm),
            float(optics.shift_mm_per_n),
            float(optics.growth_mm_per_n),
            float(optics.radius_mm),
            *middle,
        )
        # floats also where a setting was written as whole
        self._camera = CameraKernel(
            optics.block_ns,
            optics.path == "chord",
            float(optics.contrast),
            float(optics.edge_px),
            round(optics.refractory_us * 1e3),
            optics.period_ns,
            optics.column_ns,
            float(self.threshold.min()),
            self._noise.leak_below,
        )
        self._dark: F64 = dark_pixels(self.threshold, optics.contrast, optics.edge_px)
        self._pixels = Pixels(
            self.threshold,
            self._dark.copy(),
            np.empty(shape, np.int64),
            np.tile([np.inf, -np.inf, np.inf, -np.inf], (len(self._layout_mm), 1)),
        )
        self._lists = no_lists(len(self._layout_mm), 0)
        self._pending = np.empty(0, np.int64)
        self._phase_ns = 0
        self._trial = 0
        self._bins: dict[int, Candidates] = {}

    def _new_circuit(self, seed: int) -> Circuit:
        """Pixels with individual OFF thresholds and leak rates."""
        optics, shape, off = self.optics, self.threshold.shape, self.threshold
        mean, sigma = optics.threshold_off, optics.threshold_off_sigma
        if mean is not None or sigma is not None:
            mean = optics.threshold if mean is None else mean
            sigma = optics.threshold_sigma if sigma is None else sigma
            off = _between_pixels(seed, "OFF thresholds", shape, mean, sigma)
        leak_hz = np.zeros(shape)
        if optics.leak == "reference":
            decades = RATE_DECADES * generator(seed, "leak rates").standard_normal(shape)
            leak_hz = optics.noise_hz * optics.leak_share * 10.0**decades
        return new_circuit(self.threshold, off, leak_hz, optics.cutoff_hz)

    @property
    def scans(self) -> ScanTimes:
        """Scan times of the read-out in this trial."""
        optics = self.optics
        return ScanTimes(optics.period_ns, self._phase_ns, optics.column_ns, optics.width)

    def path(self, loads: F64) -> F64:
        """Markers in the image: column, row and radius in px, (n, 3, m).

        Args:
            loads: tangential force on the plate x, y and normal force, N, (m, 3 n).
        """
        result: F64 = markers_in_image(
            np.ascontiguousarray(loads), self._layout_mm, self._projection
        )
        return result

    def reset(self, load: F64, seed: int) -> None:
        """Every pixel takes the image under `load`, (3 n,), as its reference.

        Args:
            seed: the trial's: noise, when the read-out scans, and the phase of the light.
        """
        optics = self.optics
        self._light = steady()
        self._trial, self._bins = seed, {}
        discs = np.ascontiguousarray(self.path(load[None])[:, :, 0])
        darken(self._pixels.seen, self._dark, self._pixels.state)
        memorise_discs(
            discs,
            optics.contrast,
            optics.edge_px,
            self.threshold,
            self._pixels.state,
            self._pixels.seen,
        )
        if self._circuit is not None:
            # a camera that has run for long: each pixel is at a random point between two leaks
            phase = generator(seed, "leak phases").random(self.threshold.shape)
            memorise_image(self._circuit, discs, optics.contrast, optics.edge_px, phase)
            self._started = False
        self._pixels.fired[:] = NEVER_NS
        self._pending = np.empty(0, np.int64)
        if optics.period_ns:
            self._phase_ns = int(generator(seed, "read-out").integers(optics.period_ns))
        # room for rims half as wide again; where that is not enough, trace does without lists
        band = CUT * optics.edge_px + REACH_PX + 1.0
        slots = int(4.0 * np.pi * band * (1.5 * float(discs[:, 2].max()) + band)) // 8 * 8
        if self._lists.place.shape[1] < slots:
            self._lists = no_lists(len(discs), slots)
        self._lists.origin[:] = 0.0

    def sense(
        self, loads: F64, t_ns: I64, flicker: tuple[float, float, int] | None = None
    ) -> Events:
        """Events between the first and the last row of `loads`, in order of time.

        Between rows markers move on smooth curves, block by block of a global grid of true time,
        so that the result does not depend on how a trial is cut into calls. With a read-out that
        scans, times are those at which columns are read; a scan that is not complete comes with
        the next call.

        Args:
            loads: as in `path`; the first row is the last one of the call before.
            t_ns: true time of each row, int64, (m,), strictly rising; every multiple of the
                optics' `block_ns` between the first and the last one is among them.
            flicker: of a light that is not steady (`scene.flicker`): amplitude over mean,
                frequency (Hz), and true time (ns) from which it is so, in all later calls, too.
        """
        if not self._started:
            if self._circuit is not None:
                start_cells(self._circuit, int(t_ns[0]))
            self._started = True
        if flicker is not None and self._light.share == 0.0 and flicker[2] < t_ns[-1]:
            self._light = self._flickering(*flicker[:2], max(flicker[2], int(t_ns[0])))
        when, x, y, p, self._pending = trace(
            np.ascontiguousarray(loads),
            self._layout_mm,
            self._projection,
            t_ns,
            self._camera,
            self._phase_ns,
            self._pixels,
            self._lists,
            self._circuit,
            self._candidates(int(t_ns[0]), int(t_ns[-1])),
            self._light,
            self._pending,
        )
        return when, x, y, p

    def _flickering(self, share: float, hz: float, since_ns: int) -> FlickeringLight:
        """Return a light that flickers from a true time on."""
        on = off = self.threshold
        if self._circuit is not None:
            on, off = self._circuit.cells[..., ON], self._circuit.cells[..., OFF]
        return new_flicker(share, hz, on, off, since_ns, self._trial)

    def _candidates(self, begin_ns: int, end_ns: int) -> Candidates:
        """Possible noise of the whole seconds of the trial that a span of true time touches."""
        first, last = begin_ns // BIN_NS, max((end_ns - 1) // BIN_NS, begin_ns // BIN_NS)
        if first == last and first in self._bins:
            return self._bins[first]
        # bins drawn before are dropped, those needed again are retained
        self._bins = {
            index: self._bins.get(index) or candidates(self._noise, self._trial, index)
            for index in range(first, last + 1)
        }
        if first == last:
            return self._bins[first]
        return Candidates(
            *(np.concatenate(column) for column in zip(*self._bins.values(), strict=True))
        )


def _between_pixels(seed: int, name: str, shape: tuple[int, int], mean: float, sigma: float) -> F64:
    """Thresholds that vary between pixels, cut at three sigma and at a tenth of the mean."""
    spread = np.clip(generator(seed, name).standard_normal(shape), -3.0, 3.0)
    result: F64 = np.maximum(mean + sigma * spread, 0.1 * mean)
    return result


SPAN_NS = 96_000_000
"""Largest time computed together; a packed event has room for 134 ms."""


@njit(cache=True, nogil=True, error_model="numpy")
def find_blocks(row_ns: I64, begin: int, block_ns: int, first: I64) -> int:
    """Blocks of a grid of `block_ns` from row `begin` on, as many as are computed together.

    Args:
        first: first row of each block, counted from `begin`, then the last row of all; written.

    Returns:
        how many blocks there are, at least one; together not above `SPAN_NS` if more than one.
    """
    last, k, blocks = row_ns.shape[0] - 1, begin, 0
    first[0] = 0
    while k < last and (blocks == 0 or (blocks + 1) * block_ns <= SPAN_NS):
        border = (row_ns[k] // block_ns + 1) * block_ns
        k += 1
        while k < last and row_ns[k] < border:
            k += 1
        blocks += 1
        first[blocks] = k - begin
    return blocks


@njit(cache=True, nogil=True, error_model="numpy")
def trace(
    loads: F64,
    layout_mm: F64,
    projection: tuple[float, float, float, float, float, float],
    row_ns: I64,
    camera: CameraKernel,
    phase_ns: int,
    of_pixels: Pixels,
    lists: RimLists,
    circuit: Circuit | None,
    noise: Candidates,
    light: FlickeringLight,
    pending: I64,
) -> tuple[I64, U16, U16, U8, I64]:
    """Return signal and noise events under `loads`, as the camera delivers them.

    In a block each marker's path is fitted and cut into segments, the pixels that may fire are
    picked from its list, and tiles of them go through the segments. Noise is added, and the block
    is read out. Blocks lie on a grid of true time and do not depend on each other.

    Args:
        loads, layout_mm, projection: see `marker_path.markers_in_image`.
        row_ns: true times of the rows, (m,); one lies on each border of a block in between.
        camera: `CameraKernel`; phase_ns: of `readout.ScanTimes`.
        of_pixels, lists: `Pixels` and `RimLists`, written.
        circuit: pixels of `circuit`, which do all signal events where there are any; without them
            their code is not compiled.
        noise: `noise.Candidates`, at least those of this time.
        light: `flicker.FlickeringLight`, written.
        pending: packed events of scans that were not complete, ns after `row_ns[0]`, less a period
            and the time to read all columns.

    Returns:
        time (ns, int64), column, row (uint16), polarity (uint8), each (k,), and what is pending.
    """
    # numba counts references at each access to an array inside a tuple: once, and not in the loops
    threshold, state, fired, seen = of_pixels
    origin, aim, place = lists
    noise_t = noise.t_ns
    chord, contrast, edge = camera.chord, camera.contrast, camera.edge
    period_ns, column_ns = camera.period_ns, camera.column_ns
    path = markers_in_image(loads, layout_mm, projection)
    total, height, width = row_ns.shape[0], threshold.shape[0], threshold.shape[1]
    rows, inverse = np.empty(total), np.empty(total)
    since, until = np.empty(total), np.empty(total)
    curve, weights, spread = np.empty((12, total)), np.empty((4, 2 * total)), np.empty((4, total))
    tree, stack, segments = (
        np.empty((4 * total, 7)),
        np.empty((160, 3)),
        np.empty(total, SEGMENT),
    )
    first, behind = np.empty(total, np.int64), np.empty(total, np.int64)
    inner, steps = np.empty((3, total)), np.empty((total, STEP_FIELDS))
    tile, fire = np.empty(STRIDE * PIXEL_FIELDS), np.empty(STRIDE * FIRE_FIELDS)
    wait = np.empty(STRIDE * WAIT_FIELDS)
    slots, hit = np.empty(place.shape[1], np.int64), np.empty(place.shape[1], np.uint8)
    pixels, gaps = np.empty(place.shape[1], np.int64), np.empty(place.shape[1])
    # of the profile, at the rim: a pixel has no more events than its level goes up and down
    steepest, reach = 0.26 * contrast / edge, CUT * edge
    capacity = (1 << 13) + pending.shape[0] + noise_t.shape[0]
    events, other = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    room = 1 << 13
    t_ns, ps = np.empty(room, np.int64), np.empty(room, np.uint8)
    xs, ys = np.empty(room, np.uint16), np.empty(room, np.uint16)
    waiting = pending.shape[0]
    # with a literal numba would compile what takes them twice
    stored, begin = np.int64(0), np.int64(0)
    lead_ns = period_ns + np.int64(width * column_ns)
    noise_at = np.searchsorted(noise_t, row_ns[0])
    events[:waiting] = pending
    while begin < total - 1:
        blocks = find_blocks(row_ns, begin, camera.block_ns, first)
        last = first[blocks]
        stop = begin + last
        base_ns, end_ns = row_ns[begin] - lead_ns, row_ns[stop]
        for k in range(last + 1):
            rows[k] = row_ns[begin + k] - row_ns[begin]
        n = waiting
        if n + noise_t.shape[0] > capacity:
            capacity = 2 * (n + noise_t.shape[0])
            events, other = larger(events, capacity), np.empty(capacity, np.int64)
        for block in range(blocks):
            noise_at, n = noise_events(
                noise,
                noise_at,
                row_ns[begin + first[block + 1]],
                base_ns,
                camera.leak_below,
                contrast,
                edge,
                path[:, :, begin + first[block]],
                events,
                n,
            )
        if light.share > 0.0:
            for block in range(blocks):
                begin_ns = row_ns[begin + first[block]]
                events, n = flicker_events(
                    light, begin_ns, row_ns[begin + first[block + 1]], base_ns, events, n
                )
            if capacity < events.shape[0]:
                capacity = events.shape[0]
                other = np.empty(capacity, np.int64)
        for block in range(blocks):
            a, b = first[block], first[block + 1]
            slope_weights(rows, a, b, block, inverse, weights)
            for k in range(a, b):
                since[k], until[k] = rows[k] - rows[a], rows[k + 1] - rows[a]
        inner_weights(first, blocks, weights, inner)
        if circuit is not None:
            events, n = events_of_circuit(
                circuit,
                path,
                begin,
                row_ns,
                first,
                blocks,
                rows,
                since,
                until,
                chord,
                inverse,
                weights,
                inner,
                curve,
                spread,
                contrast,
                edge,
                seen,
                base_ns,
                pixels,
                events,
                n,
            )
            if capacity < events.shape[0]:
                capacity = events.shape[0]
                other = np.empty(capacity, np.int64)
        for i in range(path.shape[0] if circuit is None else 0):
            if stands_still(path, i, begin, stop):
                continue
            fit_blocks(path, i, begin, first, blocks, chord, inverse, weights, inner, curve)
            strays, off_chord = excursion(rows, curve, last, spread)
            column, row, radius = path[i, 0, begin], path[i, 1, begin], path[i, 2, begin]
            listed = reaches(i, column, row, radius, strays, origin)
            if not listed and strays <= REACH_PX:
                listed = make_list(i, column, row, radius, state, edge, pixels, origin, aim, place)
            end_x, end_y, end_r = path[i, 0, stop], path[i, 1, stop], path[i, 2, stop]
            count = 0
            if listed:
                count = may_fire(
                    i,
                    column,
                    row,
                    radius,
                    end_x - column,
                    end_y - row,
                    end_r - radius,
                    off_chord,
                    origin,
                    aim,
                    place,
                    hit,
                    slots,
                    pixels,
                )
                if count == 0:
                    continue
            else:
                origin[i, 3] = 0.0
            widen(i, column, row, radius + reach + strays, seen)
            amount = np.int64(0)
            for block in range(blocks):
                amount = cut_block(
                    first[block],
                    first[block + 1],
                    block,
                    rows[first[block]],
                    reach,
                    since,
                    until,
                    curve,
                    spread,
                    segments,
                    amount,
                )
                behind[block] = amount
            pack_steps(last, since, inverse, curve, steps)
            # pixels that are not from a list are those near the rim, block by block
            done = np.int64(0)
            for block in range(blocks):
                end = amount if listed else behind[block]
                whole = 0.0
                for k in range(done, end):
                    whole += farthest(segments[k])
                if not listed:
                    at = begin + first[block]
                    x, y, r, band = path[i, 0, at], path[i, 1, at], path[i, 2, at], reach + whole
                    count = near_rim(x, y, r, band, height, width, pixels)
                    if count > pixels.shape[0]:
                        pixels, gaps = np.empty(2 * count, np.int64), np.empty(2 * count)
                        near_rim(x, y, r, band, height, width, pixels)
                most = n + count * (int(steepest * whole / camera.lowest) + 2)
                if most > capacity:
                    capacity = 2 * most
                    events, other = larger(events, capacity), np.empty(capacity, np.int64)
                n = events_of_pixels(
                    pixels,
                    count,
                    segments[done:end],
                    first,
                    since,
                    until,
                    inverse,
                    curve,
                    steps,
                    tree,
                    threshold,
                    contrast,
                    edge,
                    lead_ns,
                    stack,
                    tile,
                    fire,
                    wait,
                    state,
                    gaps,
                    events,
                    n,
                )
                done = end
                if listed:
                    break
            if listed:
                renew(i, end_x, end_y, end_r, slots, pixels, gaps, count, state, edge, origin, aim)
        if stored + n > room:
            room = 2 * (stored + n)
            t_ns, ps = larger(t_ns, room), larger(ps, room)
            xs, ys = larger(xs, room), larger(ys, room)
        if period_ns > 0:
            stored, waiting = read_scans(
                events,
                n,
                other,
                base_ns,
                end_ns,
                period_ns,
                phase_ns,
                column_ns,
                camera.refractory_ns,
                fired,
                t_ns,
                xs,
                ys,
                ps,
                stored,
            )
            for k in range(waiting):
                events[k] -= (end_ns - row_ns[begin]) << 25
        else:
            stored = read_each(
                events,
                n,
                other,
                base_ns,
                end_ns - base_ns,
                camera.refractory_ns,
                fired,
                t_ns,
                xs,
                ys,
                ps,
                stored,
            )
        begin = stop
    return (
        t_ns[:stored].copy(),
        xs[:stored].copy(),
        ys[:stored].copy(),
        ps[:stored].copy(),
        events[:waiting].copy(),
    )
