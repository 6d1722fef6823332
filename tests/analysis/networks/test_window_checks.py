"""The checks pass where all is well, and fail loudly where somebody cheats."""

import numpy as np
import pytest

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics.classification import CLASSES, score
from sliplab.analysis.networks import window_checks
from sliplab.analysis.networks.training import Fitted, fit
from sliplab.analysis.networks.window_checks import CheckFailed, check_chance, check_permutations
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows
from sliplab.storage.schema.evaluation import Classification

pytestmark = pytest.mark.usefixtures("one_thread")

NETWORK = NetworkSettings(conv1_channels=2, conv2_channels=2, hidden=8, conv1_kernel=3)
WINDOWS = Windows(length_ms=6, crop_px=80)  # (6, 1, 4, 4)
HOW = Training(
    epochs=8, batch=16, learning_rate=2e-2, patience=8, schedule="constant", gain=1.0, mirror=False
)


def places(n: int, seed: int) -> window_checks.Part:
    """Each class has events of its own corner."""
    rng = np.random.default_rng(seed)
    y = rng.permutation(np.arange(n) % 3)
    x = rng.poisson(0.02, (n, 6, 1, 4, 4)).astype(np.uint8)
    for sample, label in zip(x[:, :, 0], y, strict=True):
        row, column = ((0, 0), (0, 2), (2, 0))[label]
        sample[:, row : row + 2, column : column + 2] += rng.poisson(0.5, (6, 2, 2)).astype("u1")
    return SparseWindows.of(x), y


TRAIN, VALIDATION, TEST = places(150, 0), places(60, 1), places(90, 2)


def chance(**changes: object) -> window_checks.Chance:
    return window_checks.shuffled_chance(
        TRAIN, VALIDATION, TEST, NETWORK, WINDOWS, HOW, runs=8, per_class=40, level=0.99, **changes
    )  # type: ignore[arg-type]  # whatever the test changes


@pytest.mark.long
def test_shuffled_labels_are_at_chance_and_true_ones_are_not() -> None:
    found = chance()
    check_chance(found)
    assert found.low <= 1 / 3 <= found.high
    assert found.true > 0.8
    assert len(set(found.shuffled)) > 1
    assert chance() == found


@pytest.mark.long
def test_labels_that_were_not_really_shuffled_are_found_out() -> None:
    with pytest.raises(CheckFailed, match="something other than the training labels"):
        check_chance(chance(deal=lambda labels, seed: labels))


def test_a_training_that_learns_nothing_checks_nothing() -> None:
    with pytest.raises(CheckFailed, match="learned nothing"):
        check_chance(window_checks.Chance((0.33, 0.34), 0.2, 0.5, 0.4, 0.999))


def test_balanced_parts_have_as_many_of_each_class() -> None:
    x, y = TRAIN
    rows = np.flatnonzero((y != 2) | (np.arange(len(y)) % 5 == 0))
    windows, labels = window_checks.balanced((x.take(rows), y[rows]), 30, 0)
    sizes = np.bincount(labels)
    assert set(sizes.tolist()) == {min(30, int((y[rows] == 2).sum()))}
    assert len(windows) == sizes.sum()
    with pytest.raises(ValueError, match="every class"):
        window_checks.balanced((x, np.zeros(len(y), np.int64)), 30, 0)


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    return fit(*TRAIN, *VALIDATION, NETWORK, WINDOWS, HOW.model_copy(update={"epochs": 2}), 0)


def test_permuted_outputs_change_no_figure(fitted: Fitted) -> None:
    assert check_permutations(window_checks.permuted(fitted, TEST[0]), TEST[1], score) == 6
    straight, turned = (
        window_checks.permuted(fitted, TEST[0])(order) for order in ((0, 1, 2), (2, 0, 1))
    )
    np.testing.assert_array_equal(turned, straight[:, [2, 0, 1]])
    assert straight.any()


def test_an_argmax_that_favours_class_0_is_found_out() -> None:
    """A common mistake in evaluations: scoring a silent network as class 0."""

    def naive(counts: np.ndarray, labels: np.ndarray) -> Classification:
        votes = np.eye(3, dtype=int)[counts.argmax(axis=1)]
        return score(votes, labels)

    silent = np.zeros((90, 3), np.int64)
    labels = np.repeat([0, 1, 2], [60, 20, 10])
    assert naive(silent, labels).accuracy.strict == 2 / 3
    with pytest.raises(CheckFailed, match="which class comes first"):
        check_permutations(lambda order: silent, labels, naive)
    assert check_permutations(lambda order: silent, labels, score) == 6
    assert len(CLASSES) == 3
    assert metrics.accuracy(silent, labels).strict == 0.0
