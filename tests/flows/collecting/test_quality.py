"""What the gates count, against the plain way to count it."""

import numpy as np
import pytest

from flows.collecting.quality import BURST_US, _event_burst


@pytest.mark.parametrize("count", [0, 1, 2, 500])
def test_the_fullest_stretch_is_what_a_search_finds(count: int) -> None:
    times = np.sort(np.random.default_rng(count).integers(0, 200_000, count)).astype(np.int64)
    times[count // 2 :] += BURST_US  # an edge falls on an event
    counts = [int(((times >= t) & (times < t + BURST_US)).sum()) for t in times]
    assert _event_burst(times) == max(counts, default=0)
