"""Slip by what single papillae do while the others go on: fall silent, or turn back.

While the skin is loaded, the markers of all papillae move in the image, and their edges cause
events. A tip that slides is loaded no further, so its marker comes to rest: the first sign of slip
is that one place causes no more events while the others cause as many as before. While the skin is
unloaded, as by a sensor that retracts from a plate that hangs on it, all markers merely shrink. A
tip that slides then follows its normal force, so its marker moves back, and its place causes more
events than the others. Nothing is trained, and nothing is known of the sensor but its size, that
its markers are brighter than its skin, and what `sliplab calibrate detector` finds of its skin
(`PapillaeSettings`).

Every millisecond:

1. **Places** are cells of the image with more events in the last quarter of a second than noise
   has, and that touch each other: the ring of a marker's edge, or a part of it. They are found anew
   every 10 ms. Noise is what the median cell has.
2. A place's **share** is what it had of all places' events in 100 ms, 5 ms ago. What moves all
   papillae alike leaves the shares as they were.
3. **Page's test** (Page 1954, Biometrika 41): a place's share of the current millisecond's events
   is a tenth of what it was, or its noise, against as it was; the likelihoods are binomial. Places
   that may be at rest, or that cause twice the events, do not count as the others. A millisecond
   with more events than usual says no more than a usual one: events of a knock come in bursts that
   are not independent.
4. **Dispersion**: a millisecond's log likelihood ratio is divided by the square of how much more
   the other places' shares vary than by chance (Pearson's statistic per degree of freedom,
   McCullagh & Nelder 1989, section 4.5): what was doubtful when it came stays so. The half of the
   places that differ most is left out: they may be the tips that slide. While an object brushes
   over single papillae, which shows by places with far more events than before for longer than
   `JUMP_MS`, it is divided by `DISTURBED_SCALE` too. So it is while the papillae move to and fro,
   as after a knock: then the same cells have ON and OFF events. A tip that jumps and sticks again
   causes as many, but for a few milliseconds: then its marker must come back before the same pixels
   see it move, and its place is silent for so long.

While most events of the places are OFF, the skin is unloaded, and the test is another: a place
causes twice the events that its number of cells lets expect, and its share of ON events is `TURNED`
times the others' by odds. Both likelihoods are binomial. The statistic is divided by the dispersion
alone, not by its square: what pushes all papillae causes ON events.

Evidence is the sum of the two largest statistics of all places from `LEAST` on, since tips let go
one after the other; 0 below, and while fewer than `fewest_places` of them move. From the first
evidence on, until the skin is unloaded, the share of tips that have let go is known, too
(`slipped_tips`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import Cost, Detector, Evidence
from sliplab.analysis.detectors.slipped_tips import SlippedTips, regions
from sliplab.storage.kernels import njit
from sliplab.storage.streams import EventChunk

VERSION = 4
"""Incremented when the evidence of the same events is another."""
BIN_US = 1000
CELLS_ACROSS = 80
"""Cells along the image's width: a marker's edge has some ten of them."""
MEMORY_MS, GAP_MS = 100, 5
SEEN_MS = 250
"""Time in which places are looked for: slow markers are rings only then."""
PLACES_MS = 10
"""Interval of finding the places, and of measuring the dispersion."""
KEPT_MS = SEEN_MS + PLACES_MS
SEEN_BLOCKS = SEEN_MS // PLACES_MS
DISPERSION_MS = 60
"""Time over which the dispersion is averaged."""
FEWEST_PLACES = 10
"""Moving at once: a slide moves all papillae, an object that brushes over them a few. A calibrated
skin may need fewer: `skin_measurement.fewest_places`. A change increments `VERSION`."""
FEWEST_EVENTS = 20
"""Of a place in the memory, so that it says something."""
CELL_EVENTS, PLACE_CELLS = 2, 4
"""Events of a cell of a place beyond noise; cells of a place: hot pixels have fewer."""
NOISE_DEVIATIONS = 3.0
"""Standard deviations of noise (Poisson) that a cell of a place exceeds."""
AT_REST, DISTURBED = 0.1, 2.0
"""Rates of a place whose tip slides, and of one that is pushed, by what it had before."""
SUSPECTED = 6.0
"""Statistic from which a place does not count as one of the others."""
LEAST = 12.0
"""Statistic below which nothing is evidence: a knock against the arm reaches up to this."""
TOUCHED = 20.0
"""Statistic of a pushed place from which another object touches it; slides reach about 15."""
JUMP_MS = 20
"""Time for which a place is pushed while its tip jumps from stick to stick; objects push longer."""
TOUCHED_MS = 300
"""An object that let go pulls the papillae's motion about for so long."""
DISTURBED_SCALE = 9.0
"""The square of the dispersion is so much larger while an object touches or the papillae move to
and fro."""
LARGEST = 30.0
"""Statistic of a pushed place at which it stays, so that it counts again soon afterwards."""
UNLOADED = 0.9
"""Share of OFF events from which the skin is unloaded. Markers that move have half, but at first
one side of each is seen alone: up to 0.85 when ten places move."""
ONE_WAY = 0.4
"""By how much each cell has one polarity, under which the papillae move to and fro: a marker's edge
that passes a cell leaves one, an edge that comes back the other. Slides have 0.93 and more, what
rings after a knock up to 0.25."""
TURNED = 4.0
"""Ratio of the odds of ON events where a marker turns back."""
FEW_ON, OF_SEEN, OF_NOW = 0.05, 100.0, 5.0
"""Share of ON events before anything is seen, and of how many events; weight of those in memory."""
MOST = 0.95
"""Of a share, so that a place's rate can change."""
BEFORE_MS, SINCE_MS = 120, 20
"""Before the first evidence of slip: the time in which the rates of tips that stick are measured.
"""
REPLAYED_MS = 30
"""Before it, for which tips are followed afterwards."""
TAKEN_BACK_MS = 250
"""Time without a tip that has probably let go, after which the evidence was a false alarm."""
PRIOR_DISPERSION = 4.0
"""Before anything is measured: the weight of one measurement."""
REMAINING_MEAN = 0.1427
"""Mean of the lower half of squared normal deviates: F(0.455) / 0.5, with F the distribution
function of chi-squared with 3 degrees of freedom."""

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class PapillaeSettings:
    """What is known of a skin.

    Attributes:
        size_px: width and height of the sensor; None: any.
        hot: cells, row by row, whose events say nothing.
        fewest_places: that move at once in a slide.
    """

    size_px: tuple[int, int] | None = None
    hot: tuple[int, ...] = ()
    fewest_places: int = FEWEST_PLACES


class Papillae(Detector):
    """Detector by the silence of single papillae; see the module."""

    def __init__(self, settings: PapillaeSettings | None = None) -> None:
        self.settings = settings or PapillaeSettings()

    def begin(self, width: int, height: int) -> None:
        """See `Detector`. Raises ValueError for a sensor of another size."""
        size_px = self.settings.size_px
        if size_px is not None and size_px != (width, height):
            raise ValueError(
                f"the sensor has {width} x {height} pixels; the skin was measured with "
                f"{size_px[0]} x {size_px[1]}"
            )
        self._cell_px = max(round(width / CELLS_ACROSS), 1)
        self._shape = -(-height // self._cell_px), -(-width // self._cell_px)
        self._done = self._placed = 0
        cells = self._shape[0] * self._shape[1]
        self._held = EventChunk.empty()
        self._kept = np.zeros((KEPT_MS, 2, cells), np.uint32)
        self._blocks = np.zeros((SEEN_BLOCKS + 1, 2, cells), np.uint32)
        self._events = np.zeros((2, cells), np.int64)
        self._place = np.full(cells, -1)
        self._rest, self._pushed, self._noise = np.zeros(0), np.zeros(0), np.zeros(0)
        self._cells, self._unloaded, self._one_way = np.zeros(0), False, 1.0
        self._hot = np.array(self.settings.hot, np.int64)
        self._dispersions = np.full(DISPERSION_MS // PLACES_MS, np.nan)
        self._age = np.zeros(3, np.int64)
        self._tips: SlippedTips | None = None
        self._tip_of_cells, self._tip_cells = np.full(cells, -1), np.zeros(0, np.int64)
        self._found_slip, self._last_slid = False, 0

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`."""
        events = EventChunk.concatenate([self._held, events]) if len(self._held) else events
        first, last = self._done, int(until_us) // BIN_US
        value, slipped = np.zeros(last - first), np.zeros(last - first)
        if first == last:  # no millisecond ends
            self._held = events
            return replace(Evidence.of([], value), slipped=slipped)
        cells = self._cells_of(events)
        ms, on = events.t_us // BIN_US, events.p > 0
        at, done = first, 0
        while at < last:
            if at % PLACES_MS == 0:
                self._find_places(at)
            end = min(at - at % PLACES_MS + PLACES_MS, last)
            part = slice(done, done := int(np.searchsorted(ms, end)))
            _keep(ms[part], cells[part], on[part], at, end, self._kept, self._blocks)
            self._advance(at, value[at - first : end - first])
            self._follow_tips(at, slipped[at - first : end - first])
            if end % PLACES_MS == 0:
                self._measure_dispersion()
            at = end
        self._done, self._held = last, events[done:]
        found = Evidence.of((np.arange(first, last) + 1) * BIN_US, value)
        return replace(found, slipped=slipped)

    def _cells_of(self, events: EventChunk) -> I64:
        row, column = events.y // self._cell_px, events.x // self._cell_px
        return row.astype(np.int64) * self._shape[1] + column

    def cost(self) -> Cost:
        """Return the operations of a millisecond with 20 places, and the bytes of its numbers.

        About 30 for each place, and 4 for each cell every 10 ms.
        """
        cells = CELLS_ACROSS**2 * 0.75
        return Cost(operations=20.0 * 30 + 4 * cells / PLACES_MS, memory_bytes=8 * 14)

    @property
    def columns(self) -> int:
        """Cells of a row."""
        return self._shape[1]

    @property
    def cell_px(self) -> int:
        """Side of a cell."""
        return self._cell_px

    @property
    def tips(self) -> SlippedTips | None:
        """The tips since the first evidence of slip; None before it, and while unloaded."""
        return self._tips

    @property
    def place_of_cells(self) -> I64:
        """The present place of each cell, row by row; negative for none."""
        return self._place

    @property
    def recent_events(self) -> I64:
        """Events of each cell in the last quarter of a second."""
        oldest = max(self._done - SEEN_MS, 0)
        found = self._kept[np.arange(oldest, self._done) % KEPT_MS, 0].sum(axis=0, dtype=np.int64)
        return found + np.bincount(self._cells_of(self._held), minlength=len(found))

    def _find_places(self, at: int) -> None:
        """Find the places at a millisecond; each takes over the statistics of its cells."""
        if block := at // PLACES_MS:
            _replace_block(self._events, self._blocks, block)
        self._placed = at
        found = _places(
            self._events, self._hot, self._shape[1], self._place, self._rest, self._pushed
        )
        self._place, self._placed_cells, self._rest, self._pushed, self._noise, self._cells = found
        share_off, self._one_way = _polarities(self._events, self._placed_cells)
        self._unloaded = share_off >= UNLOADED
        shape = MEMORY_MS + GAP_MS + PLACES_MS, len(self._noise)
        self._counts, self._back = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        # single milliseconds only where the memory will begin and end: the sum of the others counts
        self._count_places(at - MEMORY_MS - GAP_MS, at - MEMORY_MS + PLACES_MS)
        self._count_places(at - MEMORY_MS + PLACES_MS, at - PLACES_MS, PLACES_MS)
        self._count_places(at - PLACES_MS, at)
        if self._tips is not None:
            if (self._tips.probability > 0.5).any():
                self._last_slid = at
            if self._unloaded or at - self._last_slid > TAKEN_BACK_MS:
                self._tips = None
        if self._tips is None and self._found_slip and len(self._rest) and not self._unloaded:
            self._begin_tips(at)
        self._found_slip = False

    def _begin_tips(self, at: int) -> None:
        """Begin to follow the tips of the present places, from a little before."""
        self._tip_of_cells = regions(self._place, self._shape[1])
        self._tip_cells = np.flatnonzero(self._tip_of_cells >= 0)
        cells = np.bincount(self._tip_of_cells[self._tip_cells])
        rate = self._count_tips(at - BEFORE_MS, at - SINCE_MS).mean(axis=0)
        self._tips = SlippedTips(rate, cells * (self._noise[0] / self._cells[0]))
        self._tips.push(self._count_tips(at - REPLAYED_MS, at))
        self._last_slid = at

    def _count_tips(self, first: int, last: int) -> I64:
        """Return the events by millisecond and tip."""
        tip = self._tip_of_cells
        counts = np.zeros((last - first, tip.max() + 1), np.int64)
        _count(self._kept, 0, first, last, 1, first, self._tip_cells, tip, counts)
        return counts

    def _follow_tips(self, first: int, slipped: F64) -> None:
        """Write the share of the tips that have let go, in the milliseconds from `first` on."""
        if self._unloaded:
            slipped[:] = np.nan
        elif self._tips is not None:
            slipped[:] = self._tips.push(self._count_tips(first, first + len(slipped)))

    def _count_places(self, first: int, last: int, step: int = 1) -> None:
        """Count the events of some milliseconds by place: all, and those that are ON.

        With a step of `PLACES_MS` all events of a block stand in its first millisecond.
        """
        oldest = self._placed - MEMORY_MS - GAP_MS
        kept = self._kept if step == 1 else self._blocks
        cells = self._placed_cells
        for kind, counts in enumerate((self._counts, self._back)[: 1 + self._unloaded]):
            _count(kept, kind, first, last, step, oldest, cells, self._place, counts)

    def _advance(self, first: int, value: F64) -> None:
        """Write the evidence of the milliseconds from `first` on."""
        self._count_places(first, first + len(value))
        if len(self._rest) < self.settings.fewest_places:
            self._rest[:] = self._pushed[:] = 0.0
            return
        at = first - self._placed
        part = slice(at, at + MEMORY_MS + GAP_MS + len(value))
        counts, noise = self._counts[part], self._noise
        scale, fewest = self._dispersion(), self.settings.fewest_places
        rest, pushed = self._rest, self._pushed
        if self._unloaded:
            rest[:] = self._age[:] = 0
            back = self._back[part]
            _advance_unloaded(counts, back, noise, self._cells, pushed, scale, fewest, value)
        else:
            doubt = scale**2 * (DISTURBED_SCALE if self._one_way < ONE_WAY else 1.0)
            _advance(counts, noise, rest, pushed, self._age, doubt, fewest, value)
        self._found_slip |= bool(value.any())

    def _dispersion(self) -> float:
        """Return how much more the shares vary than by chance, at least 1."""
        known = self._dispersions[~np.isnan(self._dispersions)]
        return max((known.sum() + PRIOR_DISPERSION) / (len(known) + 1), 1.0)

    def _measure_dispersion(self) -> None:
        """Compare the shares of the places in the last 10 ms with those of the memory."""
        found = np.nan
        fewest, counts = self.settings.fewest_places, self._counts
        if len(self._rest) >= fewest:
            n = counts[-PLACES_MS:].sum(axis=0)
            w = counts[PLACES_MS:-GAP_MS].sum(axis=0)
            # a tip that jumps makes the shares of all others small
            known = (w >= FEWEST_EVENTS) & (self._pushed < SUSPECTED)
            n, w = n[known], w[known]
            if len(w) >= fewest and n.sum() > 0:
                expected = n.sum() * w / w.sum()
                squares = np.sort((n - expected) ** 2 / expected)
                found = squares[: len(w) - len(w) // 2].mean() / REMAINING_MEAN
        self._dispersions = np.append(self._dispersions[1:], found)


@njit(cache=True, nogil=True)
def _replace_block(events: I64, blocks: npt.NDArray[np.uint32], block: int) -> None:
    """Add the block that ended before `block`, and take away the oldest.

    Args:
        events: sums, which are changed. blocks: as of `_keep`. The oldest has the place of the
            next one, and is empty at first.
    """
    came, left = blocks[(block - 1) % len(blocks)], blocks[block % len(blocks)]
    for kind in range(2):
        for cell in range(events.shape[1]):
            events[kind, cell] += np.int64(came[kind, cell]) - np.int64(left[kind, cell])


@njit(cache=True, nogil=True)
def _polarities(events: I64, cells: I64) -> tuple[float, float]:
    """Return the share of OFF events in some cells, and by how much each cell has one polarity.

    The second is 1 where each cell has ON events alone or OFF events alone, and 0 where each has as
    many of both. Without events there are 0 and 1.
    """
    seen, on, more = 0, 0, 0
    for cell in cells:
        seen += events[0, cell]
        on += events[1, cell]
        more += abs(2 * events[1, cell] - events[0, cell])
    return (1 - on / seen, more / seen) if seen else (0.0, 1.0)


@njit(cache=True, nogil=True)
def _places(
    every: I64, hot: I64, columns: int, before: I64, rest: F64, pushed: F64
) -> tuple[I64, I64, F64, F64, F64, F64]:
    """Return the place of each cell, negative for none, and the cells with one.

    Returns the places' statistics, noise and numbers of cells, too.

    Args:
        every: events, all in the first row, of each cell. hot: cells that do not count.
        before: the cells' former places. rest, pushed: statistics of the former places.
    """
    events = every[0].copy()
    for cell in hot:
        events[cell] = 0
    noise = _median(events)
    least = noise + NOISE_DEVIATIONS * math.sqrt(noise) + CELL_EVENTS
    place = np.full(len(events), -1)
    stack, members = np.empty(len(events), np.int64), np.empty(len(events), np.int64)
    placed, n_placed = np.empty(len(events), np.int64), 0
    most, places = len(events) // PLACE_CELLS, 0
    new_rest, new_pushed = np.zeros(most), np.zeros(most)
    new_noise, cells = np.zeros(most), np.zeros(most)
    for start in range(len(events)):
        if events[start] < least or place[start] != -1:
            continue
        place[start], stack[0], waiting, size = places, start, 1, 0
        while waiting > 0:  # all cells that touch each other
            waiting -= 1
            cell = stack[waiting]
            members[size] = cell
            size += 1
            row, column = cell // columns, cell % columns
            for other_row in range(max(row - 1, 0), min(row + 2, len(events) // columns)):
                for other_column in range(max(column - 1, 0), min(column + 2, columns)):
                    other = other_row * columns + other_column
                    if events[other] >= least and place[other] == -1:
                        place[other] = places
                        stack[waiting] = other
                        waiting += 1
        if size < PLACE_CELLS:
            place[members[:size]] = -2
            continue
        total = 0.0
        for cell in members[:size]:
            placed[n_placed] = cell
            n_placed += 1
            total += events[cell]
            if before[cell] >= 0:
                new_rest[places] += events[cell] * rest[before[cell]]
                new_pushed[places] += events[cell] * pushed[before[cell]]
        new_rest[places] /= total
        new_pushed[places] /= total
        new_noise[places], cells[places] = size * noise / SEEN_MS, size
        places += 1
    part = slice(places)
    return place, placed[:n_placed], new_rest[part], new_pushed[part], new_noise[part], cells[part]


@njit(cache=True, nogil=True)
def _median(counts: I64) -> float:
    """Return the median of counts, most of which are small."""
    number = np.zeros(counts.max() + 1, np.int64)
    for count in counts:
        number[count] += 1
    lower, upper = (len(counts) - 1) // 2, len(counts) // 2
    found, below = 0.0, 0
    for count in range(len(number)):
        for place in (lower, upper):
            if below <= place < below + number[count]:
                found += count / 2
        below += number[count]
        if below > upper:
            break
    return found


@njit(cache=True, nogil=True)
def _keep(
    ms: I64,
    cell: I64,
    on: npt.NDArray[np.bool_],
    first: int,
    last: int,
    kept: npt.NDArray[np.uint32],
    blocks: npt.NDArray[np.uint32],
) -> None:
    """Count the events of the milliseconds from `first` on, before `last`, in place of the oldest.

    Args:
        kept: by millisecond, modulo its length; all events and those that are ON; and cell.
        blocks: sums of `kept` over `PLACES_MS`, modulo its length.
    """
    for k in range(first, last):
        kept[k % len(kept)] = 0
    for k in range(len(ms)):
        row = kept[ms[k] % len(kept)]
        row[0, cell[k]] += 1
        if on[k]:
            row[1, cell[k]] += 1
    for k in range(first, last):
        block = blocks[k // PLACES_MS % len(blocks)]
        if k % PLACES_MS == 0:
            block[:] = 0
        block += kept[k % len(kept)]


@njit(cache=True, nogil=True)
def _count(
    kept: npt.NDArray[np.uint32],
    kind: int,
    first: int,
    last: int,
    step: int,
    oldest: int,
    cells: I64,
    place: I64,
    counts: I64,
) -> None:
    """Count the events of some milliseconds by place, the first row of `counts` being `oldest`.

    Args:
        kept: `kept` or `blocks` as of `_keep`, of `step` milliseconds each, and which `kind` of
            them. cells: that have a place.
    """
    for ms in range(max(first, 0), last, step):
        row, to = kept[ms // step % len(kept), kind], counts[ms - oldest]
        for cell in cells:
            to[place[cell]] += row[cell]


@njit(cache=True, nogil=True)
def _advance(
    counts: I64,
    noise: F64,
    rest: F64,
    pushed: F64,
    age: I64,
    scale: float,
    fewest: int,
    value: F64,
) -> None:
    """Advance the statistics of the places, and write the evidence.

    Args:
        counts: events of each place, in the memory, the gap and the milliseconds of `value`.
        noise: events a millisecond of each place.
        rest, pushed: statistics, which are changed. scale: square of the dispersion.
        age: changed, shape (3,): milliseconds for which an object still counts as touching, since
            enough places move (in the first ones all cause more events than before), and for
            which a place has been pushed.
        fewest: places that must move. value: of each millisecond.
    """
    places = len(rest)
    memory = counts[: MEMORY_MS - 1].sum(axis=0)
    for k in range(len(value)):
        memory += counts[k + MEMORY_MS - 1]
        n = counts[k + MEMORY_MS + GAP_MS]
        moving = memory >= FEWEST_EVENTS
        others = moving & (rest < SUSPECTED) & (pushed < SUSPECTED)
        if moving.sum() < fewest or not others.any():
            rest[:] = 0.0
            pushed[:] = 0.0
            age[1:] = 0
        else:
            all_n, all_w = n[others].sum(), memory[others].sum()
            weight = min(all_w / MEMORY_MS / max(all_n, 1), 1.0)
            doubt = scale * (DISTURBED_SCALE if age[0] > 0 else 1.0)
            for j in range(places):
                if not moving[j]:
                    rest[j] = pushed[j] = 0.0
                    continue
                w = float(memory[j])
                alone = 0 if others[j] else 1
                total = all_n + alone * n[j]
                share = min(w / (all_w + alone * w), MOST)
                silent = min(AT_REST + (1 - AT_REST) * noise[j] * MEMORY_MS / w, MOST)
                seen, all_seen = weight * n[j], weight * total
                ratio = _log_ratio(silent * share, share, seen, all_seen)
                rest[j] = max(rest[j] + ratio / doubt, 0.0)
                share = min(share, MOST / DISTURBED)
                ratio = _log_ratio(DISTURBED * share, share, seen, all_seen)
                pushed[j] = min(max(pushed[j] + ratio, 0.0), LARGEST)
            age[1] += 1
            if age[1] < MEMORY_MS:
                pushed[:] = 0.0
            age[2] = age[2] + 1 if pushed.max() >= TOUCHED else 0
            age[0] = TOUCHED_MS if age[2] > JUMP_MS else max(age[0] - 1, 0)
            most = np.sort(rest)[-2:].sum()
            value[k] = most if most >= LEAST else 0.0
        memory -= counts[k]


@njit(cache=True, nogil=True)
def _advance_unloaded(
    counts: I64,
    back: I64,
    noise: F64,
    cells: F64,
    pushed: F64,
    scale: float,
    fewest: int,
    value: F64,
) -> None:
    """Advance the statistics of places whose markers turn back, and write the evidence.

    Args:
        counts, back: as of `_advance`, and those that are ON.
        noise: events a millisecond of each place. cells: of each place.
        pushed: statistics, which are changed. scale: the dispersion.
        fewest: places that must move. value: of each millisecond.
    """
    memory = counts[: MEMORY_MS - 1].sum(axis=0)
    memory_back = back[: MEMORY_MS - 1].sum(axis=0)
    for k in range(len(value)):
        memory += counts[k + MEMORY_MS - 1]
        memory_back += back[k + MEMORY_MS - 1]
        n, n_back = counts[k + MEMORY_MS + GAP_MS], back[k + MEMORY_MS + GAP_MS]
        # a place that is ON alone is the other side of a marker that begins to move
        moving = (memory >= FEWEST_EVENTS) & (2 * memory_back < memory)
        others = moving & (pushed < SUSPECTED)
        if moving.sum() < fewest or not others.any():
            pushed[:] = 0.0
        else:
            all_n, all_w = n[others].sum(), memory[others].sum()
            weight = min(all_w / MEMORY_MS / max(all_n, 1), 1.0)
            on = (memory_back[others].sum() + FEW_ON * OF_SEEN) / (all_w + OF_SEEN)
            on = (n_back[others].sum() + on * OF_NOW) / (all_n + OF_NOW)
            turned = TURNED * on / (1 + (TURNED - 1) * on)
            rate, mean = all_w / MEMORY_MS, cells[others].mean()
            shrinking = max(rate - noise[others].sum(), 0.0) / cells[others].sum()
            for j in range(len(pushed)):
                if not moving[j]:
                    pushed[j] = 0.0
                    continue
                # markers that touch are one place; one that begins to move has few cells yet
                expected = shrinking * max(cells[j], mean) + noise[j]
                alone = 0 if others[j] else 1
                share = min(expected / (rate + alone * expected), MOST / DISTURBED)
                total = all_n + alone * n[j]
                ratio = _log_ratio(DISTURBED * share, share, n[j], total)
                ratio += _log_ratio(turned, on, n_back[j], n[j])
                pushed[j] = max(pushed[j] + weight * ratio, 0.0)
            most = np.sort(pushed)[-2:].sum() / scale
            value[k] = most if most >= LEAST else 0.0
        memory -= counts[k]
        memory_back -= back[k]


@njit(cache=True, nogil=True)
def _log_ratio(share: float, other: float, n: float, total: float) -> float:
    """Return the log of the ratio of two shares' likelihoods, by binomial counts."""
    return n * math.log(share / other) + (total - n) * math.log((1 - share) / (1 - other))
