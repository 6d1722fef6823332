"""Selection of a trial's sample windows and their classes.

The paper takes 50 windows per class from every trial, and their positions determine what the
network can learn: no slip just before the first slip, where it is hardest; gross slip just after
the centre slipped; incipient slip anywhere between. The selection is a pure function of the onsets
and a seed, so that a data set can be reproduced from its protocol alone.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sliplab.analysis.metrics.classification import GROSS, INCIPIENT, NO_SLIP


def consecutive_windows(start_ns: int, end_ns: int, window_ns: int) -> NDArray[np.int64]:
    """Starts of all whole windows that lie one after the other in [start, end).

    Returns:
        (n,) int64, ns; empty when not even one fits.

    Raises:
        ValueError: the window is not positive.
    """
    return strided_windows(start_ns, end_ns, window_ns, window_ns)


def strided_windows(
    start_ns: int, end_ns: int, window_ns: int, stride_ns: int
) -> NDArray[np.int64]:
    """Starts of all whole windows in [start, end), one every stride; shorter ones overlap.

    Returns:
        (n,) int64, ns; empty when not even one fits.

    Raises:
        ValueError: window or stride is not positive.
    """
    if window_ns <= 0 or stride_ns <= 0:
        raise ValueError(f"window_ns = {window_ns}, stride_ns = {stride_ns}: must be positive")
    room = end_ns - start_ns - window_ns
    return _run(start_ns, 0 if room < 0 else room // stride_ns + 1, stride_ns)


def choose_windows(
    start_ns: int,
    end_ns: int,
    incipient_ns: int | None,
    gross_ns: int | None,
    window_ns: int,
    per_class: int,
    seed: int,
    no_slip: Literal["last", "spread"] = "last",
) -> dict[int, NDArray[np.int64]]:
    """The windows of one trial that become samples, by class.

    No slip: `per_class` consecutive windows, the last of which ends at the incipient onset; or, if
    they are to be spread, non-overlapping random ones before it where they fit. Gross:
    `per_class` consecutive ones from the gross onset on. Incipient: `per_class` non-overlapping
    random ones between the onsets where they fit, otherwise all consecutive ones from the incipient
    onset on. A recording that is too short gives fewer, and the lengths say how many. What an
    unknown onset leaves open gives none: without a gross onset only no slip is certain, without an
    incipient onset nothing is.

    Args:
        start_ns, end_ns: the recording, on the trial's time line, ns.
        incipient_ns, gross_ns: the label's onsets, ns.
        window_ns: a window's length.
        per_class: number of windows of each class.
        seed: of the random windows (PCG64).
        no_slip: as in `protocols.windows.SampleSettings`.

    Returns:
        class (0 no slip, 1 incipient, 2 gross) to (n,) int64 starts in ns, ascending, n at most
        `per_class`. All three keys are always there.

    Raises:
        ValueError: the window or `per_class` is not positive, the onsets lie outside the recording
            or in the wrong order.
    """
    if window_ns <= 0 or per_class <= 0:
        raise ValueError(f"window_ns = {window_ns}, per_class = {per_class}: must be positive")
    none = np.empty(0, np.int64)
    chosen = {NO_SLIP: none, INCIPIENT: none, GROSS: none}
    if incipient_ns is None:
        if gross_ns is not None:
            raise ValueError(f"gross_ns = {gross_ns} without an incipient onset")
        return chosen
    last = incipient_ns if gross_ns is None else gross_ns
    if not start_ns <= incipient_ns <= last <= end_ns:
        raise ValueError(
            f"onsets {incipient_ns} and {gross_ns} must lie in order inside the recording "
            f"[{start_ns}, {end_ns}]"
        )
    rng = np.random.Generator(np.random.PCG64(seed))

    def spread(begin_ns: int, until_ns: int) -> NDArray[np.int64]:
        spare = until_ns - begin_ns - per_class * window_ns
        if spare < 0:
            return consecutive_windows(begin_ns, until_ns, window_ns)
        # sorted places in what the windows leave free, each pushed on by the windows before it
        free = np.sort(rng.integers(0, spare, per_class, dtype=np.int64, endpoint=True))
        return free + _run(begin_ns, per_class, window_ns)

    if gross_ns is not None:
        after = min(per_class, (end_ns - gross_ns) // window_ns)
        chosen[GROSS] = _run(gross_ns, after, window_ns)
        chosen[INCIPIENT] = spread(incipient_ns, gross_ns)
    if no_slip == "spread":
        chosen[NO_SLIP] = spread(start_ns, incipient_ns)
    else:
        before = min(per_class, (incipient_ns - start_ns) // window_ns)
        chosen[NO_SLIP] = _run(incipient_ns - before * window_ns, before, window_ns)
    return chosen


def _run(first_ns: int, count: int, window_ns: int) -> NDArray[np.int64]:
    return first_ns + np.arange(count, dtype=np.int64) * window_ns
