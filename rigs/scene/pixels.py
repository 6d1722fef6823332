"""Events of one marker's pixels over the blocks of a look: tiles of pixels through all pieces.

What is done on a piece follows from the rows of its block alone, to the bit, and pixels do not
wait for each other, so neither the cut of a trial into calls nor the order of pixels matters.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene import edges, roots
from sliplab.rigs.scene import pieces as of
from sliplab.rigs.scene import pixel_lanes as lanes
from sliplab.rigs.scene.crossings import events_of_piece
from sliplab.rigs.scene.edges import CUT
from sliplab.rigs.scene.marker_path import bound_rates
from sliplab.rigs.scene.pixel_lanes import COMES, DOUBT, LANES, NOTHING, classify, place_pixels
from sliplab.rigs.scene.roots import (
    begin_piece,
    fetch,
    finish,
    guess,
    move,
    next_thresholds,
    refine,
)


@njit(cache=True, nogil=True, error_model="numpy")
def events_of_pixels(  # type: ignore[no-untyped-def]
    pixels, count, pieces, first, since, until, inverse, curve, steps, tree, threshold,
    contrast, edge, origin, stack, tile, fire, wait, state, gaps, out, n,
):  # fmt: skip
    """Events of pixels over some blocks.

    Args:
        pixels: column << 12 | row, the first `count` of them.
        pieces: of the blocks, in order, see `pieces`.
        first: first row of each block, and the last row of all, (blocks + 1,).
        since, until: when each step begins and ends, ns after the begin of its block.
        inverse, curve: see `marker_path.fit_block`.
        steps: when each step begins, one over its length, and its coefficients, (r, 14).
        tree: scratch for `marker_path.bound_rates`; that of block b begins at 4 first[b].
        threshold, state: of all pixels, (height, width) and (height, width, 4); written.
        origin: ns to add to every time.
        stack: scratch, (160, 3).
        tile, fire, wait: scratch, tiles of the fields in `pixel_lanes` and `roots`.
        gaps: distance of each pixel from the rim at the end, px; written.
        out: packed events as in `sorting`, written from `n` on.

    Returns:
        how many events `out` holds now.
    """
    reach, amount = CUT * edge, pieces.shape[0]
    waiting = 0
    active = np.empty(LANES + 1, np.int64)
    for index in range(amount):
        # a tree's node 0, which it has no use for, says whether there is one
        tree[4 * first[int(pieces[index, of.BLOCK])], 0] = 0.0
    for at in range(0, count, LANES):
        size = min(count - at, LANES)
        for j in range(size):
            pixel = pixels[at + j]
            x, y = pixel >> 12, pixel & 4095
            tile[lanes.X + j], tile[lanes.Y + j] = x, y
            tile[lanes.ON + j], tile[lanes.OFF + j] = (
                state[y, x, edges.ON],
                state[y, x, edges.OFF],
            )
            tile[lanes.LAST + j] = state[y, x, edges.LAST]
            tile[lanes.LEVEL + j] = state[y, x, edges.LEVEL]
            tile[lanes.STEP + j] = threshold[y, x]
            tile[lanes.CODE + j] = x << 13 | y << 1
        place_pixels(tile, size, pieces[0, of.X0], pieces[0, of.Y0], pieces[0, of.R0])
        for number in range(amount):
            piece = pieces[number]
            classify(tile, size, piece, reach)
            head = (piece[of.ZERO] + origin) * float(1 << 25)
            firing = 0
            busy = 0
            for j in range(size):
                active[busy] = j
                busy += tile[lanes.KIND + j] != NOTHING
            for index in range(busy):
                j = active[index]
                kind = tile[lanes.KIND + j]
                if kind == DOUBT:
                    block = int(piece[of.BLOCK])
                    begin, final = first[block], first[block + 1]
                    if tree[4 * begin, 0] == 0.0:
                        bound_rates(curve, begin, final, 4 * begin, tree)
                        tree[4 * begin, 0] = 1.0
                    on, off, last, level, n = events_of_piece(
                        tile[lanes.X + j], tile[lanes.Y + j], tile[lanes.ON + j],
                        tile[lanes.OFF + j], tile[lanes.LAST + j], tile[lanes.LEVEL + j],
                        tile[lanes.STEP + j], tile[lanes.BEGIN + j], piece, 4 * begin, begin, final,
                        since, until, inverse, curve, tree, contrast, edge,
                        np.int64(head + tile[lanes.CODE + j]), stack, out, n,
                    )  # fmt: skip
                    tile[lanes.ON + j], tile[lanes.OFF + j] = on, off
                    tile[lanes.LAST + j], tile[lanes.LEVEL + j] = last, level
                    continue
                falls = kind == COMES
                fire[roots.X + firing] = tile[lanes.X + j]
                fire[roots.Y + firing] = tile[lanes.Y + j]
                fire[roots.BEGIN + firing] = tile[lanes.BEGIN + j]
                fire[roots.END + firing] = tile[lanes.END + j]
                fire[roots.TARGET + firing] = tile[(lanes.ON if falls else lanes.OFF) + j]
                fire[roots.LAST + firing] = tile[lanes.LAST + j]
                fire[roots.LEVEL + firing] = tile[lanes.LEVEL + j]
                step = tile[lanes.STEP + j]
                fire[roots.RISE + firing] = step if falls else -step
                fire[roots.HEAD + firing] = head + tile[lanes.CODE + j] + falls
                fire[roots.LANE + firing] = j
                firing += 1
            if firing == 0:
                continue
            begin_piece(fire, firing, piece)
            pace = inverse[int(piece[of.K0])]
            while firing > 0:
                guess(fire, firing, piece, pace)
                fetch(fire, firing, since, until, steps)
                refine(fire, firing)
                if waiting + firing > LANES:
                    n = finish(wait, waiting, since, until, steps, inverse, curve, out, n)
                    waiting = 0
                for j in range(firing):
                    if fire[roots.GOOD + j] > 0.0:
                        out[n] = np.int64(fire[roots.SINCE + j])
                        n += 1
                    else:
                        move(fire, j, wait, waiting)
                        waiting += 1
                next_thresholds(fire, firing, contrast, edge)
                firing = settle(tile, fire, firing)
        for j in range(size):
            pixel = pixels[at + j]
            x, y = pixel >> 12, pixel & 4095
            state[y, x, edges.ON], state[y, x, edges.OFF] = (
                tile[lanes.ON + j],
                tile[lanes.OFF + j],
            )
            state[y, x, edges.LAST] = tile[lanes.LAST + j]
            state[y, x, edges.LEVEL] = tile[lanes.LEVEL + j]
            gaps[at + j] = tile[lanes.END + j]
    if waiting > 0:
        n = finish(wait, waiting, since, until, steps, inverse, curve, out, n)
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def settle(tile, fire, n):  # type: ignore[no-untyped-def]
    """After an event of each of n pixels: those that have another one go on, the others go back.

    Returns:
        how many go on.
    """
    left = 0
    for j in range(n):
        target, following = fire[roots.TARGET + j], fire[roots.NEXT + j]
        end, comes = fire[roots.END + j], fire[roots.RISE + j] > 0.0
        if (following >= end) if comes else (following <= end):
            for field in (
                roots.X, roots.Y, roots.HEAD, roots.BEGIN, roots.END, roots.LEVEL, roots.RISE,
                roots.LANE, roots.SCALE_A, roots.SCALE_B,
            ):  # fmt: skip
                fire[field + left] = fire[field + j]
            fire[roots.LAST + left], fire[roots.TARGET + left] = target, following
            left += 1
        else:
            lane = int(fire[roots.LANE + j])
            before = fire[roots.LAST + j]
            tile[lanes.ON + lane] = following if comes else before
            tile[lanes.OFF + lane] = before if comes else following
            tile[lanes.LAST + lane], tile[lanes.LEVEL + lane] = (
                target,
                fire[roots.LEVEL + j],
            )
    return left
