"""How the tips lie in memory while they are advanced: side by side, a row a quantity.

A processor computes four or eight numbers at once if they lie next to each other and if it is
known beforehand how many there are. So up to `LANES` tips share a block with one row for each
column of the state, each constant and each intermediate result; lanes that are left over hold
papillae out of reach. Who calls the solver sees one row a papilla, as everywhere else.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from sliplab.rigs.scene.friction import cubic_at, knot_at
from sliplab.rigs.scene.springs import FREE, GAP, MODE, PATH

LANES = 20
"""Nineteen papillae, and one more for whole registers of four."""

STATES, CONSTANTS = 18, 8
# constants of `rigs.scene.springs`' table stand behind the state
TABLE = STATES
# where the base comes to, and the depth; force along the papilla; soft part across it
(
    TO_X, TO_Y, DEEP, PRESSED, SOFT,
    # friction behind a knot of the path, and the knot that is needed
    KNOT, C0, C1, C2, C3, WANTED,
    # what becomes of the tip (`rigs.scene.tip.tip_step`)
    END_MODE, END_X, END_Y, END_FORCE_X, END_FORCE_Y, END_NORMAL, END_BENT, SLIP, SHARE, GAIN,
    # of a tip that seeks its bend, and of one that seeks its slip (`rigs.scene.sliding`)
    LOW, HIGH, SEEKS, STRETCH, BEFORE, AFTER, UNIT_X, UNIT_Y, TOP, BOTTOM, WAY,
    AHEAD, ASIDE, REST_X, REST_Y, SOFT_X, SOFT_Y, QUICK, LAG, GRIP, GRIP_SLOPE, FAR,
    # of a tip that lets go (`rigs.scene.tip`)
    KICK,
) = range(STATES + CONSTANTS, STATES + CONSTANTS + 44)  # fmt: skip
ROWS = STATES + CONSTANTS + 44

ALONE = 3.0
"""END_MODE of a tip that must be computed alone."""
_AWAY_MM = 1e6


@intrinsic
def block_of(typing, flat):  # type: ignore[no-untyped-def]
    """A block as (ROWS, LANES), whose shape the compiler knows: a reshaped array would hide it.

    A view that does not keep the block alive, and so costs nothing.
    """
    kind = types.Array(types.float64, 2, "C")

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        source = context.make_array(signature.args[0])(context, builder, arguments[0])
        block = context.make_array(kind)(context, builder)
        whole = context.get_value_type(types.intp)
        populate_array(
            block, data=source.data, shape=[whole(ROWS), whole(LANES)],
            strides=[whole(8 * LANES), whole(8)], itemsize=whole(8), meminfo=None,
        )  # fmt: skip
        return block._getvalue()

    return kind(flat), build


@njit(cache=True, nogil=True, error_model="numpy")
def spread(table, field, state):  # type: ignore[no-untyped-def]
    """Blocks of lanes for n tips, (blocks, ROWS * LANES)."""
    n = state.shape[0]
    blocks = (n + LANES - 1) // LANES
    lanes = np.zeros((blocks, ROWS * LANES))
    for k in range(blocks):
        block = block_of(lanes[k])
        for j in range(LANES):
            block[MODE, j], block[TABLE + GAP, j] = FREE, _AWAY_MM
        for i in range(k * LANES, min(n, (k + 1) * LANES)):
            j = i - k * LANES
            for c in range(STATES):
                block[c, j] = state[i, c]
            for c in range(CONSTANTS):
                block[TABLE + c, j] = table[i, c]
            take_knot(block, field, i, j, knot_at(state[i, PATH]))
    return lanes


@njit(cache=True, nogil=True, error_model="numpy")
def gather(lanes, state):  # type: ignore[no-untyped-def]
    """Write the state of the tips in `lanes` back into rows of their own."""
    for i in range(state.shape[0]):
        block = lanes[i // LANES]
        for c in range(STATES):
            state[i, c] = block[c * LANES + i % LANES]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def take_knot(w, field, i, j, knot):  # type: ignore[no-untyped-def]
    """Have lane `j` hold the friction of tip `i` behind a knot."""
    w[KNOT, j] = knot
    w[C0, j], w[C1, j], w[C2, j], w[C3, j] = cubic_at(field, i, knot)
