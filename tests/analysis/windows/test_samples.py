"""Sampling of windows: each lies inside its phase, and no two overlap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.windows import samples
from sliplab.analysis.windows.samples import INCIPIENT, NO_SLIP, choose_windows, consecutive_windows

MS = 1_000_000
WINDOW = 30 * MS
T0 = 2**62


@given(
    start=st.integers(0, 2**62),
    phases=st.tuples(*[st.integers(0, 4_000) for _ in range(3)]),
    per_class=st.integers(1, 60),
    seed=st.integers(0, 2**63),
)
def test_windows_stay_in_their_phase(
    start: int, phases: tuple[int, int, int], per_class: int, seed: int
) -> None:
    incipient = start + phases[0] * MS
    gross = incipient + phases[1] * MS
    end = gross + phases[2] * MS
    chosen = choose_windows(start, end, incipient, gross, WINDOW, per_class, seed)
    edges = [start, incipient, gross, end]
    for label, phase_ms in enumerate(phases):
        starts = chosen[label]
        assert starts.dtype == np.int64
        assert len(starts) == min(per_class, phase_ms // 30)
        assert (np.diff(starts) >= WINDOW).all()
        assert (starts >= edges[label]).all()
        assert (starts + WINDOW <= edges[label + 1]).all()


def test_the_papers_case() -> None:
    incipient, gross, end = T0 + 2_000 * MS, T0 + 5_000 * MS, T0 + 9_000 * MS
    chosen = choose_windows(T0, end, incipient, gross, WINDOW, 50, seed=3)
    assert chosen[NO_SLIP][-1] + WINDOW == incipient
    assert chosen[NO_SLIP][0] == incipient - 50 * WINDOW
    assert chosen[samples.GROSS].tolist() == [gross + i * WINDOW for i in range(50)]
    gaps = np.diff(chosen[INCIPIENT]) - WINDOW
    assert len(chosen[INCIPIENT]) == 50
    assert gaps.min() >= 0
    assert len(set(gaps.tolist())) > 40  # random, not a comb


def test_a_short_incipient_phase_gives_all_its_consecutive_windows() -> None:
    incipient, gross = T0 + 2_000 * MS, T0 + 2_000 * MS + 50 * WINDOW - 1
    chosen = choose_windows(T0, T0 + 9_000 * MS, incipient, gross, WINDOW, 50, seed=3)
    assert chosen[INCIPIENT].tolist() == [incipient + i * WINDOW for i in range(49)]
    # one nanosecond more and 50 fit, in one way only
    chosen = choose_windows(T0, T0 + 9_000 * MS, incipient, gross + 1, WINDOW, 50, seed=3)
    assert chosen[INCIPIENT].tolist() == [incipient + i * WINDOW for i in range(50)]


def test_random_windows_cover_the_phase_evenly() -> None:
    incipient, gross = T0, T0 + 10_000 * MS
    share = np.zeros(10)
    for seed in range(200):
        chosen = choose_windows(T0, gross, incipient, gross, WINDOW, 50, seed)
        share += np.histogram(chosen[INCIPIENT] - T0, 10, (0, 10_000 * MS - WINDOW))[0]
    np.testing.assert_allclose(share / share.mean(), 1, atol=0.1)


def test_a_seed_gives_the_same_windows_and_another_seed_others() -> None:
    def drawn(seed: int) -> list[int]:
        chosen = choose_windows(0, 9_000 * MS, 1_500 * MS, 6_000 * MS, WINDOW, 50, seed)
        starts: list[int] = chosen[INCIPIENT].tolist()
        return starts

    assert drawn(1) == drawn(1) != drawn(2)
    # written down once: the same on every machine and numpy
    assert drawn(1)[:3] == FIRST_OF_SEED_1


FIRST_OF_SEED_1 = [1559467604, 1612677339, 1664557657]


def test_unknown_onsets_give_nothing_that_is_not_certain() -> None:
    chosen = choose_windows(0, 9_000 * MS, 3_000 * MS, None, WINDOW, 50, 0)
    assert [len(chosen[label]) for label in (NO_SLIP, INCIPIENT, samples.GROSS)] == [50, 0, 0]
    chosen = choose_windows(0, 9_000 * MS, None, None, WINDOW, 50, 0)
    assert [len(chosen[label]) for label in (NO_SLIP, INCIPIENT, samples.GROSS)] == [0, 0, 0]


def test_the_centre_first_leaves_no_incipient_phase() -> None:
    chosen = choose_windows(0, 9_000 * MS, 3_000 * MS, 3_000 * MS, WINDOW, 50, 0)
    assert [len(chosen[label]) for label in (NO_SLIP, INCIPIENT, samples.GROSS)] == [50, 0, 50]


@pytest.mark.parametrize(
    ("incipient", "gross"), [(None, 5), (6, 5), (-1, 5), (5, 1_001), (1_001, None)]
)
def test_impossible_onsets(incipient: int | None, gross: int | None) -> None:
    with pytest.raises(ValueError, match="onset"):
        choose_windows(0, 1_000, incipient, gross, 10, 5, 0)


def test_consecutive_windows() -> None:
    assert consecutive_windows(T0, T0 + 99, 30).tolist() == [T0, T0 + 30, T0 + 60]
    assert consecutive_windows(0, 90, 30).tolist() == [0, 30, 60]
    assert consecutive_windows(0, 29, 30).size == 0
    assert consecutive_windows(100, 0, 30).size == 0
    with pytest.raises(ValueError, match="window_ns"):
        consecutive_windows(0, 90, 0)
    with pytest.raises(ValueError, match="per_class"):
        choose_windows(0, 90, 30, 60, 10, 0, 0)


@given(st.integers(0, 2**62), st.integers(-5, 300), st.integers(1, 60), st.integers(1, 60))
def test_strided_windows_are_all_that_fit(start: int, span: int, window: int, stride: int) -> None:
    found = samples.strided_windows(start, start + span, window, stride)
    expected = [k for k in range(0, max(span, 0) + 1, stride) if k + window <= span]
    assert (found - start).tolist() == expected
    same = samples.strided_windows(start, start + span, window, window)
    assert same.tolist() == consecutive_windows(start, start + span, window).tolist()


@pytest.mark.parametrize(("window", "stride"), [(0, 10), (10, 0), (10, -1)])
def test_no_window_and_no_stride(window: int, stride: int) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        samples.strided_windows(0, 90, window, stride)
