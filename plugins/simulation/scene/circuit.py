"""Pixels with a bandwidth, a leaking reference, and individual ON and OFF thresholds.

As in v2e (Hu, Liu and Delbruck, CVPRW 2021). The log intensity u(t) that a pixel sees goes through
a low pass of first order whose cutoff is proportional to the intensity. The memorised level falls
at a steady rate, so that a pixel with constant input fires a positive event once in a while. An
event moves the memorised level by its threshold.

v2e steps all of this from frame to frame. Here a marker's path is cut into parts on which it moves
by a tenth of a pixel at most. On each the input is a parabola through three places of the path,
for which the low pass has a closed form (P(t) + K e^(-t / tau)); where that, less the memorised
level, meets a threshold is a root in a bracket. Only pixels near rims that move, and those whose
low pass has not settled yet, are computed. These pixels are off by default: thresholds and leak
cost about 20 times what `pixels` does, a low pass about 250 times (docs/scene.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.crossings import distance_at
from sliplab.plugins.simulation.scene.edges import CUT, level_at, widen
from sliplab.plugins.simulation.scene.marker_path import excursion, fit_blocks, stands_still
from sliplab.plugins.simulation.scene.readout import larger
from sliplab.plugins.simulation.scene.rim_pixels import near_rim
from sliplab.storage.kernels import njit

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

SEEN, INPUT, MEMORY, ON, OFF, LEAK = 0, 1, 2, 3, 4, 5
"""Columns of a cell: log intensity behind the low pass and in front of it, memorised level, both
thresholds, and how fast the memorised level falls, 1/ns."""
NEVER = np.iinfo(np.int64).max
RATE_DECADES = 0.1
"""Spread of leak rates between pixels, decades: v2e's noise_rate_cov_decades."""
_PART_PX = 0.1
_LINE_PX = 0.01  # a line is off by less than 1e-5 of the contrast then
_SETTLED = 1e-9  # of the contrast
_WHITE, _OFFSET = 255.0, 20.0  # v2e: a share (I + 20) / 275 of the cutoff at intensity I of 255


class Circuit(NamedTuple):
    """State of all pixels; shapes are (height, width) unless stated otherwise."""

    cells: F64
    """(height, width, 6)."""
    since: I64
    """True time of a cell, ns."""
    due: I64
    """Time at which a cell at rest leaks its next event, ns; `NEVER` for one not at rest."""
    mark: I64
    """Begin of the last block in which a rim was near, ns."""
    active: I64
    """Cells that are not at rest, column << 12 | row, (height * width,): the first `awake[0]`."""
    awake: I64
    """(1,)."""
    cutoff: float
    """Of the brightest pixels, rad/ns; 0: infinite."""
    lowest: float
    """The lowest threshold of all."""
    leaks: bool
    """True if any memorised level falls."""


def new_circuit(on: F64, off: F64, leak_hz: F64, cutoff_hz: float) -> Circuit:
    """Return pixels with thresholds and leak rates, (height, width) each; dark so far."""
    cells = np.zeros((*on.shape, 6))
    cells[..., ON], cells[..., OFF], cells[..., LEAK] = on, off, leak_hz * on * 1e-9
    empty = np.zeros(on.shape, np.int64)
    return Circuit(
        cells,
        empty,
        np.full(on.shape, NEVER),
        empty.copy(),
        np.empty(on.size, np.int64),
        np.zeros(1, np.int64),
        2e-9 * np.pi * cutoff_hz,
        float(min(on.min(), off.min())),
        bool((leak_hz > 0.0).any()),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def memorise_image(circuit: Circuit, discs: F64, contrast: float, edge: float, phase: F64) -> None:
    """Set every cell to the image of `discs` (column, row, radius; (n, 3)), settled.

    Args:
        phase: how much of a threshold each memorised level has leaked already, 0 to 1, (height,
            width); counts where there is a leak.
    """
    cells = circuit.cells
    height, width = cells.shape[0], cells.shape[1]
    cells[:, :, INPUT] = 0.0
    for i in range(discs.shape[0]):
        column, row, radius = discs[i, 0], discs[i, 1], discs[i, 2]
        reach = radius + CUT * edge
        for y in range(max(int(row - reach), 0), min(int(row + reach) + 2, height)):
            for x in range(max(int(column - reach), 0), min(int(column + reach) + 2, width)):
                dx, dy = x - column, y - row
                here = level_at(np.sqrt(dx * dx + dy * dy) - radius, contrast, edge)
                cells[y, x, INPUT] = max(cells[y, x, INPUT], here)
    for y in range(height):
        for x in range(width):
            cell = cells[y, x]
            cell[SEEN] = cell[INPUT]
            cell[MEMORY] = cell[INPUT]
            if cell[LEAK] > 0.0:
                cell[MEMORY] -= phase[y, x] * cell[ON]
    circuit.awake[0] = 0
    circuit.mark[:] = -NEVER


@njit(cache=True, nogil=True, error_model="numpy")
def start_cells(circuit: Circuit, t_ns: int) -> None:
    """Set every cell to rest from `t_ns` on."""
    height, width = circuit.since.shape
    for y in range(height):
        for x in range(width):
            _rest(circuit, x, y, t_ns)


@njit(cache=True, nogil=True, error_model="numpy")
def _rest(circuit: Circuit, x: int, y: int, t_ns: int) -> None:
    """The cell's input does not change from `t_ns` on, and its low pass has settled."""
    cell = circuit.cells[y, x]
    circuit.since[y, x] = t_ns
    circuit.due[y, x] = NEVER - 1
    if cell[LEAK] > 0.0:
        wait = (cell[ON] - cell[SEEN] + cell[MEMORY]) / cell[LEAK]
        if wait < 1e18:
            circuit.due[y, x] = t_ns + np.int64(max(wait, 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _wake(circuit: Circuit, x: int, y: int, t_ns: int) -> None:
    """The cell's input may change from `t_ns` on."""
    if circuit.due[y, x] == NEVER:
        return
    cell = circuit.cells[y, x]
    cell[MEMORY] -= cell[LEAK] * (t_ns - circuit.since[y, x])
    circuit.due[y, x] = NEVER
    circuit.active[circuit.awake[0]] = x << 12 | y
    circuit.awake[0] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _difference(
    t: float, p0: float, p1: float, p2: float, rest: float, pace: float, leak: float
) -> tuple[float, float]:
    """Seen less memorised level of a pixel at t of a part, and its rate."""
    value, rate = p0 + t * (p1 + leak + t * p2), p1 + leak + 2.0 * t * p2
    if pace > 0.0:
        left = rest * np.exp(-t * pace)
        value += left
        rate -= left * pace
    return value, rate


@njit(cache=True, nogil=True, error_model="numpy")
def advance(
    cell: F64,
    h: float,
    middle: float,
    end: float,
    pace: float,
    contrast: float,
    fires: bool,
    head: int,
    begin: float,
    out: I64,
    n: int,
) -> int:
    """Apply a parabolic input to a cell for `h` ns.

    Args:
        middle, end: its input after half the time and after all of it; at first it is the cell's.
        pace: rate of the low pass, 1/ns; 0: there is none.
        fires: whether it may fire.
        head: packed event at the begin of the block; begin: of this part, ns after that.
        out: packed events, written from `n` on.

    Returns:
        how many events `out` holds now.
    """
    u0, leak = cell[INPUT], cell[LEAK]
    b = (4.0 * middle - 3.0 * u0 - end) / h
    c = 2.0 * (u0 + end - 2.0 * middle) / (h * h)
    p0, p1, rest = u0, b, 0.0
    if pace > 0.0:
        lag = 1.0 / pace
        p0, p1 = u0 - lag * (b - 2.0 * c * lag), b - 2.0 * c * lag
        rest = cell[SEEN] - p0
    spare = 1e-9 * contrast
    memory = cell[MEMORY]
    for half in range(2 if fires else 0):
        low, high = 0.5 * h * half, 0.5 * h * (half + 1)
        reached = _difference(high, p0, p1, c, rest, pace, leak)[0] - memory
        while True:
            rises = reached >= cell[ON] - spare
            if not rises and reached > spare - cell[OFF]:
                break
            target = memory + (cell[ON] if rises else -cell[OFF])
            sign = 1.0 if rises else -1.0
            a, z = low, high
            t = 0.5 * (a + z)
            for _ in range(80):
                value, rate = _difference(t, p0, p1, c, rest, pace, leak)
                miss = sign * (value - target)
                if miss < 0.0:
                    a = t
                else:
                    z = t
                before = t
                t -= miss / (sign * rate)
                # also where the rate is 0 and t is no number
                if not a <= t <= z:
                    t = 0.5 * (a + z)
                if abs(t - before) < 1e-3:
                    break
            low = t
            memory += sign * (cell[ON] if rises else cell[OFF])
            reached -= sign * (cell[ON] if rises else cell[OFF])
            out[n] = head + (np.int64(begin + t) << 25) | np.int64(rises)
            n += 1
    cell[SEEN] = end
    if pace > 0.0:
        cell[SEEN] = _difference(h, p0, p1, c, rest, pace, 0.0)[0]
    cell[INPUT], cell[MEMORY] = end, memory - leak * h
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _pace(cutoff: float, level: float, contrast: float) -> float:
    """Rate of the low pass of a pixel that sees `level`, 1/ns."""
    if cutoff <= 0.0:
        return 0.0
    return cutoff * (_WHITE * np.exp(level - contrast) + _OFFSET) / (_WHITE + _OFFSET)


@njit(cache=True, nogil=True, error_model="numpy")
def _pass_rim(
    cell: F64,
    x: int,
    y: int,
    first: int,
    last: int,
    fires: bool,
    since: F64,
    until: F64,
    inverse: F64,
    curve: F64,
    arcs: F64,
    cutoff: float,
    contrast: float,
    edge: float,
    head: int,
    out: I64,
    n: int,
) -> int:
    """Apply a passing marker to a cell; see `advance`. `arcs`: longest path per step, px."""
    for k in range(first, last):
        parts = max(int(np.ceil(arcs[k] / _PART_PX)), 1)
        h = (until[k] - since[k]) / parts
        for part in range(parts):
            t = since[k] + part * h
            gap = distance_at(x, y, t + h, k, since, inverse, curve)[0]
            end = level_at(gap, contrast, edge)
            middle = 0.5 * (cell[INPUT] + end)
            if arcs[k] > _LINE_PX:
                gap = distance_at(x, y, t + 0.5 * h, k, since, inverse, curve)[0]
                middle = level_at(gap, contrast, edge)
            pace = _pace(cutoff, middle, contrast)
            n = advance(cell, h, middle, end, pace, contrast, fires, head, t, out, n)
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def events_of_circuit(
    circuit: Circuit,
    path: F64,
    row: int,
    row_ns: I64,
    first: I64,
    blocks: int,
    rows: F64,
    since: F64,
    until: F64,
    chord: bool,
    inverse: F64,
    weights: F64,
    inner: F64,
    curve: F64,
    spread: F64,
    contrast: float,
    edge: float,
    seen: F64,
    base_ns: int,
    pixels: I64,
    events: I64,
    n: int,
) -> tuple[I64, int]:
    """Events of all pixels over some blocks.

    Args:
        path: column, row and radius of each marker, (n, 3, m).
        row: first row of all; row_ns: true time of each, (m,).
        first: first row of each block, counted from `row`, and the last row of all.
        rows: times of rows after the first, ns.
        since, until: when each step begins and ends, ns after the begin of its block.
        spread: scratch, (4, at least the rows).
        chord, inverse, weights, inner, curve: of `marker_path.fit_blocks`.
        seen: rectangles in which markers have been, see `edges.darken`; widened.
        base_ns: true time from which events count.
        pixels: scratch.
        events: packed events as in `readout`, the first `n` of them.

    Returns:
        the events, which may have moved, and how many there are.
    """
    cells, reach = circuit.cells, CUT * edge
    height, width = cells.shape[0], cells.shape[1]
    steepest, spare = 0.26 * contrast / edge, 1e-9 * contrast
    arcs = np.empty(since.shape[0])
    for block in range(blocks):
        a, b = first[block], first[block + 1]
        begin_ns, end_ns = row_ns[row + a], row_ns[row + b]
        start, length = (begin_ns - base_ns) << 25, float(end_ns - begin_ns)
        for i in range(path.shape[0]):
            if stands_still(path, i, row + a, row + b):
                continue
            fit_blocks(path, i, row, first, blocks, chord, inverse, weights, inner, curve)
            whole = 0.0
            for k in range(a, b):
                # no cubic between two rows is longer than its control polygon
                h = until[k] - since[k]
                arc = 0.0
                for c in range(0, 12, 4):
                    v, p, q = curve[c + 1, k], curve[c + 2, k], curve[c + 3, k]
                    arc += h * (abs(v) + abs(v + p) + abs(v + 2.0 * p + 3.0 * q)) / 3.0
                arcs[k] = arc
                whole += arc
            x0, y0, r0 = path[i, 0, row + a], path[i, 1, row + a], path[i, 2, row + a]
            x1, y1, r1 = path[i, 0, row + b], path[i, 1, row + b], path[i, 2, row + b]
            chord_px = np.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2)
            strays, off_chord = excursion(rows[a : b + 1], curve[:, a : b + 1], b - a, spread)
            widen(i, x0, y0, r0 + reach + whole, seen)
            count = near_rim(x0, y0, r0, reach + whole, height, width, pixels)
            if count > pixels.shape[0]:
                pixels = np.empty(2 * count, np.int64)
                near_rim(x0, y0, r0, reach + whole, height, width, pixels)
            most = int((steepest * whole + contrast) / circuit.lowest) + 4
            for index in range(count):
                x, y = pixels[index] >> 12, pixels[index] & 4095
                # where two rims are near, the first one counts: discs are farther apart than that
                if circuit.mark[y, x] == begin_ns:
                    continue
                circuit.mark[y, x] = begin_ns
                _wake(circuit, x, y, begin_ns)
                cell = cells[y, x]
                away = np.sqrt((x - x0) ** 2 + (y - y0) ** 2)
                gap, after = away - r0, np.sqrt((x - x1) ** 2 + (y - y1) ** 2) - r1
                # a pixel's distance from a chord is no line, but nearly
                bow = 0.125 * chord_px**2 / (away - strays) if away > strays else strays
                stray = off_chord + bow
                most_seen = level_at(min(gap, after) - stray, contrast, edge)
                least_seen = level_at(max(gap, after) + stray, contrast, edge)
                fallen = cell[MEMORY] - cell[LEAK] * length
                fires = (
                    max(most_seen, cell[SEEN]) >= fallen + cell[ON] - spare
                    or min(least_seen, cell[SEEN]) <= cell[MEMORY] - cell[OFF] + spare
                )
                if circuit.cutoff == 0.0 and not fires:
                    # without a low pass nothing but the end counts
                    cell[INPUT] = cell[SEEN] = level_at(after, contrast, edge)
                    cell[MEMORY] = fallen
                    continue
                if n + most > events.shape[0]:
                    events = larger(events, 2 * (n + most))
                n = _pass_rim(
                    cell,
                    x,
                    y,
                    a,
                    b,
                    fires,
                    since,
                    until,
                    inverse,
                    curve,
                    arcs,
                    circuit.cutoff,
                    contrast,
                    edge,
                    start + (x << 13 | y << 1),
                    events,
                    n,
                )
        left = 0
        most = int(contrast / circuit.lowest) + 4
        for index in range(circuit.awake[0]):
            place = circuit.active[index]
            x, y = place >> 12, place & 4095
            cell = cells[y, x]
            if circuit.mark[y, x] != begin_ns:
                if n + most > events.shape[0]:
                    events = larger(events, 2 * (n + most))
                pace = _pace(circuit.cutoff, cell[INPUT], contrast)
                n = advance(
                    cell,
                    length,
                    cell[INPUT],
                    cell[INPUT],
                    pace,
                    contrast,
                    True,
                    start + (x << 13 | y << 1),
                    0.0,
                    events,
                    n,
                )
                if abs(cell[SEEN] - cell[INPUT]) <= _SETTLED * contrast:
                    _rest(circuit, x, y, end_ns)
                    continue
            circuit.active[left] = place
            left += 1
        circuit.awake[0] = left
        for y in range(height if circuit.leaks else 0):
            for x in range(width):
                while circuit.due[y, x] < end_ns:
                    if n == events.shape[0]:
                        events = larger(events, 2 * n)
                    t, cell = circuit.due[y, x], cells[y, x]
                    events[n] = (t - base_ns) << 25 | x << 13 | y << 1 | 1
                    n += 1
                    cell[MEMORY] = cell[SEEN]
                    _rest(circuit, x, y, t)
    return events, n
