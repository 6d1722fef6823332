"""Events of all markers along their paths, block by block: what `rigs.scene.events` runs on.

In a block each marker's path is fitted and cut into pieces, the pixels that may fire are picked
from its list, and tiles of them go through the pieces. Noise is added, and the block is read out.
Blocks lie on a grid of true time and nothing looks past their borders.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene.circuit import events_of_circuit
from sliplab.rigs.scene.edges import CUT, widen
from sliplab.rigs.scene.marker_path import (
    excursion,
    fit_blocks,
    inner_weights,
    markers_in_image,
    slope_weights,
    stands_still,
)
from sliplab.rigs.scene.noise import noise_events
from sliplab.rigs.scene.pieces import FIELDS, cut_block, farthest
from sliplab.rigs.scene.pixel_lanes import PIXEL_FIELDS, STRIDE
from sliplab.rigs.scene.pixels import events_of_pixels
from sliplab.rigs.scene.readout import read_each, read_scans
from sliplab.rigs.scene.roots import FIRE_FIELDS, STEP_FIELDS, WAIT_FIELDS, pack_steps
from sliplab.rigs.scene.sorting import larger
from sliplab.rigs.scene.watch import REACH_PX, make_list, may_fire, near_rim, reaches, renew

SPAN_NS = 96_000_000
"""As long a time is looked at in one go; a packed event has room for 134 ms."""


@njit(cache=True, nogil=True, error_model="numpy")
def find_blocks(row_ns, begin, block_ns, first):  # type: ignore[no-untyped-def]
    """Blocks of a grid of `block_ns` from row `begin` on, as many as are looked at together.

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
def trace(  # type: ignore[no-untyped-def]
    loads, layout_mm, projection, row_ns, block_ns, chord, contrast, edge, refractory_ns, period_ns,
    column_ns, phase_ns, lowest, threshold, state, fired, seen, origin, aim, place, pending,
    noise_t, noise_place, noise_lot, leak_below, circuit,
):  # fmt: skip
    """Signal and noise under `loads`, as the camera hands them over.

    Args:
        loads, layout_mm, projection: see `marker_path.markers_in_image`.
        row_ns: true times of the rows, (m,); one lies on each border of a block in between.
        chord: straight lines between rows in place of cubics.
        period_ns, column_ns, phase_ns: see `readout.Scans`.
        lowest: the lowest threshold of all.
        threshold, fired: (height, width); state: (height, width, 4), written.
        seen: rectangles in which markers have been, see `edges.darken`; widened.
        origin, aim, place: the lists of `watch`, written.
        pending: packed events of scans that were not complete, ns after `row_ns[0]`, less a period
            and the time to read all columns.
        noise_t, noise_place, noise_lot: of `noise.candidates`, at least those of this time.
        leak_below: of `noise.NoiseRates`.
        circuit: pixels of `circuit`, which do all signal events where there are any.

    Returns:
        time (ns, int64), column, row (uint16), polarity (uint8), each (k,), and what is pending.
    """
    path = markers_in_image(loads, layout_mm, projection)
    total, height, width = row_ns.shape[0], threshold.shape[0], threshold.shape[1]
    rows, inverse = np.empty(total), np.empty(total)
    since, until = np.empty(total), np.empty(total)
    curve, weights, spread = np.empty((12, total)), np.empty((4, 2 * total)), np.empty((4, total))
    tree, stack, pieces = np.empty((4 * total, 7)), np.empty((160, 3)), np.empty((total, FIELDS))
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
    waiting, kept, begin = pending.shape[0], 0, 0
    lead_ns = period_ns + np.int64(width * column_ns)
    noise_at = np.searchsorted(noise_t, row_ns[0])
    events[:waiting] = pending
    while begin < total - 1:
        blocks = find_blocks(row_ns, begin, block_ns, first)
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
                noise_t, noise_place, noise_lot, noise_at, row_ns[begin + first[block + 1]],
                base_ns, leak_below, contrast, edge, path[:, :, begin + first[block]], events, n,
            )  # fmt: skip
        for block in range(blocks):
            a, b = first[block], first[block + 1]
            slope_weights(rows, a, b, block, inverse, weights)
            for k in range(a, b):
                since[k], until[k] = rows[k] - rows[a], rows[k + 1] - rows[a]
        inner_weights(first, blocks, weights, inner)
        if circuit.awake.shape[0] > 0:
            events, n = events_of_circuit(
                circuit, path, begin, row_ns, first, blocks, rows, since, until, chord, inverse,
                weights, inner, curve, spread, contrast, edge, seen, base_ns, pixels, events, n,
            )  # fmt: skip
            if capacity < events.shape[0]:
                capacity = events.shape[0]
                other = np.empty(capacity, np.int64)
        for i in range(path.shape[0] if circuit.awake.shape[0] == 0 else 0):
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
                    i, column, row, radius, end_x - column, end_y - row, end_r - radius,
                    off_chord, origin, aim, place, hit, slots, pixels,
                )  # fmt: skip
                if count == 0:
                    continue
            else:
                origin[i, 3] = 0.0
            widen(i, column, row, radius + reach + strays, seen)
            amount = 0
            for block in range(blocks):
                amount = cut_block(
                    first[block], first[block + 1], block, rows[first[block]], reach, since,
                    until, curve, spread, pieces, amount,
                )  # fmt: skip
                behind[block] = amount
            pack_steps(last, since, inverse, curve, steps)
            # pixels that are not from a list are those near the rim, block by block
            piece = 0
            for block in range(blocks):
                end = amount if listed else behind[block]
                whole = 0.0
                for k in range(piece, end):
                    whole += farthest(pieces[k])
                if not listed:
                    at = begin + first[block]
                    x, y, r, band = path[i, 0, at], path[i, 1, at], path[i, 2, at], reach + whole
                    count = near_rim(x, y, r, band, height, width, pixels)
                    if count > pixels.shape[0]:
                        pixels, gaps = np.empty(2 * count, np.int64), np.empty(2 * count)
                        near_rim(x, y, r, band, height, width, pixels)
                most = n + count * (int(steepest * whole / lowest) + 2)
                if most > capacity:
                    capacity = 2 * most
                    events, other = larger(events, capacity), np.empty(capacity, np.int64)
                n = events_of_pixels(
                    pixels, count, pieces[piece:end], first, since, until, inverse, curve, steps,
                    tree, threshold, contrast, edge, lead_ns, stack, tile, fire, wait, state,
                    gaps, events, n,
                )  # fmt: skip
                piece = end
                if listed:
                    break
            if listed:
                renew(i, end_x, end_y, end_r, slots, pixels, gaps, count, state, edge, origin, aim)
        if kept + n > room:
            room = 2 * (kept + n)
            t_ns, ps = larger(t_ns, room), larger(ps, room)
            xs, ys = larger(xs, room), larger(ys, room)
        if period_ns > 0:
            kept, waiting = read_scans(
                events, n, other, base_ns, end_ns, period_ns, phase_ns, column_ns, refractory_ns,
                fired, t_ns, xs, ys, ps, kept,
            )  # fmt: skip
            for k in range(waiting):
                events[k] -= (end_ns - row_ns[begin]) << 25
        else:
            kept = read_each(
                events, n, other, base_ns, end_ns - base_ns, refractory_ns, fired, t_ns, xs, ys,
                ps, kept,
            )  # fmt: skip
        begin = stop
    return (
        t_ns[:kept].copy(), xs[:kept].copy(), ys[:kept].copy(), ps[:kept].copy(),
        events[:waiting].copy(),
    )  # fmt: skip
