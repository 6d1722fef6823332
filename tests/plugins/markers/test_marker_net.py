"""The classifier on marker displacements, held against scikit-learn, and its file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sklearn.neural_network import MLPClassifier

from sliplab.analysis.windows.dataset import TrialId
from sliplab.plugins.markers import marker_net
from sliplab.plugins.markers.displacement import FRAMES, MarkerSamples, cut_frames


def samples(n: int, seed: int, markers: int = 5) -> MarkerSamples:
    """No marker moved, some did, or all did: by 2 px and more, in random directions."""
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 3, n)
    moved = np.zeros((n * FRAMES, markers, 2))
    for k, kind in enumerate(y):
        many = [0, int(rng.integers(1, markers - 1)), markers][kind]
        angle = rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(2, 30)
        rows = slice(k * FRAMES, (k + 1) * FRAMES)
        which = rng.permutation(markers)[:many]
        moved[rows, which] = way
    moved += 0.05 * rng.normal(size=moved.shape)
    x = cut_frames(moved, np.arange(FRAMES - 1, len(moved), FRAMES))
    none = np.zeros(n, np.int64)
    return MarkerSamples(x, y, none, none, (TrialId("a", "b"),))


@pytest.fixture(scope="module")
def net() -> marker_net.MarkerNet:
    return marker_net.fit(samples(600, 1), samples(200, 2), seed=4)


def test_it_learns_what_moved_in_directions_that_it_never_saw(net: marker_net.MarkerNet) -> None:
    test = samples(400, 3)
    right = net.probabilities(test.x).argmax(axis=1) == test.y
    assert right.mean() > 0.97
    assert net.history[net.chosen_epoch - 1].val_strict == max(e.val_strict for e in net.history)
    points = net.points(test.x)
    assert points.dtype == np.int64
    assert np.abs(points.sum(axis=1) - marker_net.POINTS).max() <= 1


def test_probabilities_are_those_of_scikit_learn() -> None:
    """The same data, seed and epochs by its own interface give the same probabilities."""
    train, validation = samples(300, 5), samples(100, 6)
    ours = marker_net.fit(train, validation, seed=9)
    model = MLPClassifier(
        (marker_net.HIDDEN,),
        alpha=marker_net.RIDGE,
        batch_size=marker_net.BATCH,
        learning_rate_init=marker_net.LEARNING_RATE,
        random_state=9,
    )
    z = np.arcsinh(train.x.reshape(len(train), -1).astype(float))
    for _ in range(ours.chosen_epoch):
        model.partial_fit(z, train.y, classes=[0, 1, 2])
    theirs = model.predict_proba(np.arcsinh(validation.x.reshape(100, -1).astype(float)))
    assert np.abs(ours.probabilities(validation.x) - theirs).max() < 1e-9


def test_the_file_holds_the_model_and_says_what_it_is(
    net: marker_net.MarkerNet, tmp_path: Path
) -> None:
    path, again = tmp_path / "one.model", tmp_path / "two.model"
    marker_net.save(path, net)
    marker_net.save(again, marker_net.fit(samples(600, 1), samples(200, 2), seed=4))
    assert path.read_bytes() == again.read_bytes()
    found = marker_net.load(path)
    test = samples(50, 7)
    assert (found.probabilities(test.x) == net.probabilities(test.x)).all()
    assert found.history == net.history
    assert found.title.startswith("multilayer perceptron on marker displacements: 50 inputs")
    with pytest.raises(ValueError, match="this network takes"):
        found.probabilities(samples(3, 1, markers=6).x)


@pytest.mark.parametrize("harm", ["cut", "other", "text"])
def test_a_damaged_file_is_refused(net: marker_net.MarkerNet, tmp_path: Path, harm: str) -> None:
    path = tmp_path / "one.model"
    marker_net.save(path, net)
    data = path.read_bytes()
    other = data.replace(b"sliplab-marker-model-1", b"sliplab-marker-model-9")
    path.write_bytes({"cut": data[:-300], "other": other, "text": b"no model"}[harm])
    with pytest.raises(ValueError, match=r"one\.model"):
        marker_net.load(path)


def test_too_few_samples_are_named() -> None:
    some = samples(60, 1)
    two = MarkerSamples(
        some.x[some.y < 2],
        some.y[some.y < 2],
        some.trial[some.y < 2],
        some.newest_ns[some.y < 2],
        some.trials,
    )
    with pytest.raises(ValueError, match="no training samples of gross"):
        marker_net.fit(two, some, seed=0)
    with pytest.raises(ValueError, match="no validation samples"):
        marker_net.fit(some, samples(0, 1), seed=0)
