"""Lists of non-empty cells say the same as dense samples, however they were made."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sliplab.analysis.windows.dataset import SampleSet, TrialId
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.analysis.windows.windows import bin_events, list_events
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import EventChunk

dense = hnp.arrays(
    np.uint8,
    st.tuples(st.integers(0, 4), st.integers(1, 3), st.integers(1, 2), st.just(3), st.just(3)),
    elements=st.sampled_from([0, 0, 0, 1, 7, 255]),
)


@given(dense, st.data())
def test_dense_there_and_back(x: np.ndarray, data: st.DataObject) -> None:
    found = SparseWindows.of(x)
    assert len(found) == len(x)
    np.testing.assert_array_equal(found.dense(), x)
    np.testing.assert_array_equal(found.totals, x.reshape(len(x), int(np.prod(x.shape[1:]))).sum(1))
    if len(x):
        rows = np.array(data.draw(st.lists(st.integers(0, len(x) - 1))), np.int64)
        np.testing.assert_array_equal(found.take(rows).dense(), x[rows])
    steps = data.draw(st.integers(1, x.shape[1]))
    begun = found.first_steps(steps)
    assert begun.shape == (steps, *found.shape[1:])
    np.testing.assert_array_equal(begun.dense(), x[:, :steps])
    joined = SparseWindows.join([found, SparseWindows.of(x[::-1])], found.shape)
    np.testing.assert_array_equal(joined.dense(), np.concatenate([x, x[::-1]]))


@given(dense, st.data())
def test_mirrored_is_reversed(x: np.ndarray, data: st.DataObject) -> None:
    found = SparseWindows.of(x)
    how = data.draw(hnp.arrays(np.uint8, len(x), elements=st.integers(0, 3)))
    expected = [
        one[..., :: (-1 if k & 2 else 1), :: (-1 if k & 1 else 1)]
        for one, k in zip(x, how, strict=True)
    ]
    mirrored = found.mirrored(how)
    np.testing.assert_array_equal(mirrored.dense(), np.reshape(expected, x.shape))
    again = SparseWindows.of(mirrored.dense())  # entries stand in order, as they are listed
    np.testing.assert_array_equal(mirrored.cell, again.cell)
    np.testing.assert_array_equal(mirrored.count, again.count)
    np.testing.assert_array_equal(mirrored.mirrored(how).dense(), x)
    np.testing.assert_array_equal(found.dense(), x)


@pytest.mark.parametrize("how", [[0], [0, 4], [-1, 0], [0, 0, 0]])
def test_there_are_four_ways_to_see_a_sample(how: list[int]) -> None:
    with pytest.raises(ValueError, match="mirrors of 0 to 3 for 2 samples"):
        SparseWindows.of(np.zeros((2, 1, 1, 3, 3), np.uint8)).mirrored(np.array(how))


def test_no_more_steps_than_there_are() -> None:
    two = SparseWindows.of(np.ones((1, 2, 1, 3, 3), np.uint8))
    for steps in (0, 3):
        with pytest.raises(ValueError, match=f"{steps} of 2 steps"):
            two.first_steps(steps)


def test_what_is_no_sample_is_refused() -> None:
    with pytest.raises(ValueError, match="expected uint8"):
        SparseWindows.of(np.zeros((1, 2, 3), np.uint8))
    with pytest.raises(ValueError, match="expected uint8"):
        SparseWindows.of(np.zeros((1, 2, 1, 3, 3)))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    how=st.sampled_from(
        [
            Windows(),
            Windows(length_ms=6, step_ms=2, crop_px=40, pool_px=10, polarity="both"),
            Windows(length_ms=4, step_ms=4, crop_px=60, pool_px=60, polarity="negative"),
        ]
    ),
    events=st.integers(0, 600),
)
def test_events_are_listed_as_they_are_binned(seed: int, how: Windows, events: int) -> None:
    rng = np.random.default_rng(seed)
    # a few places and times, so that cells fill over 255 and steps are empty
    x, y = rng.integers(0, 64, events), rng.integers(0, 64, events)
    if how.crop_px > 64:
        x, y = x + 280, y + 200
    if seed % 2:
        x, y = x // 16 * 16, y // 16 * 16
    t = np.sort(rng.integers(0, 40, events)) * 1000 + rng.integers(0, 2) * 999
    p = rng.integers(0, 2, events)
    size = (640, 480) if how.crop_px > 64 else (64, 64)
    starts = rng.integers(-5_000, 45_000, 5)
    got = list_events(EventChunk(x, y, p, t), starts, how, *size)
    np.testing.assert_array_equal(
        got.dense(), bin_events(EventChunk(x, y, p, t), starts, how, *size)
    )
    for a, b in zip(got.offsets[:-1], got.offsets[1:], strict=True):
        assert (np.diff(got.cell[a:b].astype(int)) > 0).all()
    assert (got.count > 0).all()


def test_samples_are_kept_in_a_file_that_maps(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    x = rng.poisson(0.05, (7, 30, 1, 20, 20)).astype(np.uint8)
    trials = tuple(TrialId("täglich", f"depth=2.4mm,r={k}") for k in range(7))
    made = SampleSet(
        SparseWindows.of(x), np.arange(7) % 3, np.arange(7), np.arange(7) * 10**9, trials
    )
    made.save(tmp_path / "train.arrays")
    found = SampleSet.load(tmp_path / "train.arrays")
    np.testing.assert_array_equal(found.x, x)
    for name in ("y", "trial", "start_ns"):
        np.testing.assert_array_equal(getattr(found, name), getattr(made, name))
    assert found.trials == trials
    assert isinstance(found.windows.cell.base, np.memmap)
    found.windows.count[:] = 9  # changes this process' memory and not the file
    np.testing.assert_array_equal(SampleSet.load(tmp_path / "train.arrays").x, x)


def test_joined_samples_keep_their_trials() -> None:
    """Two campaigns with a trial of the same id, one trial without samples, one trial twice."""

    def part(campaign: str, trial: str, n: int, start_ns: int) -> SampleSet:
        x = np.ones((n, 3, 1, 2, 2), np.uint8)
        starts = start_ns + np.arange(n)
        zeros = np.zeros(n, np.int64)
        return SampleSet(SparseWindows.of(x), zeros, zeros, starts, (TrialId(campaign, trial),))

    windows = Windows(length_ms=3, crop_px=40)
    parts = [part("a", "1", 2, 0), part("a", "2", 0, 10), part("b", "1", 1, 20)]
    half = SampleSet.join(parts, windows)
    found = SampleSet.join([half, part("a", "1", 1, 30)], windows)
    assert found.trials == (TrialId("a", "1"), TrialId("a", "2"), TrialId("b", "1"))
    carried = [found.trials[k] for k in found.trial.tolist()]
    assert carried == [("a", "1"), ("a", "1"), ("b", "1"), ("a", "1")]
    assert found.start_ns.tolist() == [0, 1, 20, 30]
    assert SampleSet.join([], windows).trials == ()


@pytest.mark.parametrize("kind", ["cut", "header", "other", "missing"])
def test_a_damaged_file_of_samples_is_named(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "train.arrays"
    none = np.empty(0, np.int64)
    windows = SparseWindows.of(np.ones((2, 3, 1, 2, 2), np.uint8))
    SampleSet(windows, none, none, none, ()).save(path)
    data = path.read_bytes()
    path.write_bytes(
        {
            "cut": data[:-65],
            "header": data.replace(b'"at": 0', b'"at": x', 1),
            "other": b"x" * 100,
            "missing": data.replace(b'"trial"', b'"trail"', 1),
        }[kind]
    )
    with pytest.raises(ValueError, match=r"train\.arrays"):
        SampleSet.load(path)
