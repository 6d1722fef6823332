"""Windows of marker displacements: which frames, in what direction, and in what order."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.plugins.markers import displacement
from sliplab.plugins.markers.displacement import FRAMES, _held, choose_frames, cut_frames


def slide(frames: int = 12, markers: int = 4, seed: int = 1) -> np.ndarray:
    """Markers that begin to move to the right one after the other, each at its own speed."""
    rng = np.random.default_rng(seed)
    start, speed = rng.integers(2, 8, markers), rng.uniform(0.5, 2.0, markers)
    moved = np.maximum(np.arange(frames)[:, None] - start, 0) * speed
    return np.stack([moved, 0.01 * rng.normal(size=moved.shape)], axis=-1)


def test_a_turned_slide_with_other_markers_gives_the_same_windows() -> None:
    """Neither the direction of a slide nor the markers' numbers matter; its size does."""
    moved = slide()
    newest = np.arange(8, 12)
    c, s = np.cos(2.1), np.sin(2.1)
    turned = moved @ np.array([[c, s], [-s, c]])
    expected = cut_frames(moved, newest)
    assert expected.shape == (4, FRAMES, 4, 2)
    assert expected.dtype == np.float32
    assert np.allclose(cut_frames(turned[:, [2, 0, 3, 1]], newest), expected, atol=1e-5)
    assert not np.allclose(cut_frames(2 * moved, newest), expected, atol=0.1)


def test_lengths_are_kept_and_the_furthest_marker_comes_first() -> None:
    moved = slide(markers=7)
    x, newest = displacement.all_frames(moved)
    assert newest.tolist() == list(range(FRAMES - 1, 12))
    lengths = np.hypot(x[:, -1, :, 0], x[:, -1, :, 1])
    assert (np.diff(lengths, axis=1) <= 1e-6).all()
    true = np.hypot(*np.moveaxis(moved[newest], 2, 0))
    assert np.allclose(np.sort(lengths), np.sort(true), atol=1e-5)
    # the mean of the newest frame points along the first axis
    mean = x[:, -1].mean(axis=1)
    assert (mean[-4:, 0] > 0).all()
    assert np.allclose(mean[:, 1], 0, atol=1e-6)


def test_markers_at_rest_have_no_direction_and_stay_finite() -> None:
    assert (cut_frames(np.zeros((6, 3, 2)), np.array([4, 5])) == 0).all()


def test_a_hidden_marker_stays_where_it_was_last_seen() -> None:
    away = np.array([[[np.nan] * 2], [[1.0, 2.0]], [[np.nan] * 2], [[3.0, 4.0]]])
    assert _held(away)[:, 0].tolist() == [[0, 0], [1, 2], [1, 2], [3, 4]]


def test_samples_end_at_the_onsets_as_those_of_events_do() -> None:
    frame_ns = np.arange(100, dtype=np.int64) * 10
    chosen = choose_frames(frame_ns, 305, 700, per_class=5, seed=3)
    assert chosen[0].tolist() == [26, 27, 28, 29, 30]
    assert chosen[2].tolist() == [70, 71, 72, 73, 74]
    assert len(set(chosen[1].tolist())) == 5
    assert ((chosen[1] >= 31) & (chosen[1] < 70)).all()
    assert (np.diff(chosen[1]) > 0).all()
    again = choose_frames(frame_ns, 305, 700, per_class=5, seed=3)
    assert again[1].tolist() == chosen[1].tolist()
    # a short phase gives all that it has, and no window reaches before the first frame
    few = choose_frames(frame_ns, 25, 45, per_class=50, seed=0)
    assert [part.tolist() for part in few.values()][:2] == [[], [4]]
    assert few[2][0] == 5


@pytest.mark.parametrize(("incipient", "counts"), [(None, [0, 0, 0]), (500, [46, 0, 0])])
def test_what_an_unknown_onset_leaves_open_gives_no_sample(
    incipient: int | None, counts: list[int]
) -> None:
    frame_ns = np.arange(100, dtype=np.int64) * 10
    chosen = choose_frames(frame_ns, incipient, None, per_class=50, seed=0)
    assert [len(chosen[k]) for k in range(3)] == counts
    with pytest.raises(ValueError, match="per_class = 0"):
        choose_frames(frame_ns, incipient, None, per_class=0, seed=0)
