"""Trees and ordinary networks learn what can be learned, repeat, and say what they cost."""

from typing import Any

import numpy as np
import pytest
import torch

from sliplab.analysis.metrics.classification import accuracy
from sliplab.analysis.networks import baseline_nets
from sliplab.analysis.networks.baseline_nets import EPOCHS, KINDS, TAXEL_KINDS, fitted_net
from sliplab.analysis.networks.baselines import boosted
from sliplab.analysis.windows.dataset import SampleSet, TrialId
from sliplab.analysis.windows.sparse import SparseWindows

pytestmark = pytest.mark.usefixtures("one_thread")

SHAPE = (6, 2, 5, 5)


def events(n: int, seed: int) -> SampleSet:
    """Class 1 and 2 have as many events at the same cells, early and late; class 0 has noise."""
    rng = np.random.default_rng(seed)
    y = rng.permutation(np.arange(n) % 3)
    x = rng.poisson(0.05, (n, *SHAPE)).astype(np.uint8)
    x[y == 1, :3, 0, :3] += rng.poisson(0.8, (int((y == 1).sum()), 3, 3, 5)).astype(np.uint8)
    x[y == 2, 3:, 0, :3] += rng.poisson(0.8, (int((y == 2).sum()), 3, 3, 5)).astype(np.uint8)
    return SampleSet(
        SparseWindows.of(x), y, np.zeros(n, np.int64), np.arange(n), (TrialId("made", "one"),)
    )


TRAIN, VALIDATION, TEST = events(240, 0), events(60, 1), events(90, 2)


def trained_net(
    kind: str,
    train: SampleSet,
    validation: SampleSet,
    test: SparseWindows,
    epochs: int = EPOCHS,
    seed: int = 0,
) -> tuple[Any, dict[str, Any]]:
    """Votes of a trained network on test windows, and what it was."""
    net, said = fitted_net(kind, train, validation, epochs, seed)
    return baseline_nets.net_votes(net, test, 3), said


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", sorted(KINDS | TAXEL_KINDS))
def test_each_network_finds_what_it_can_see(kind: str) -> None:
    epochs = 40  # of two steps each, of which the last few are small
    votes, said = trained_net(kind, TRAIN, VALIDATION, TEST.windows, epochs)
    strict = accuracy(votes, TEST.y).strict
    assert strict is not None
    if kind == "cnn_frame":  # cannot tell early from late
        assert 0.5 < strict < 0.9
    else:
        assert strict > 0.85
    assert 1 <= said["chosen_epoch"] <= said["epochs"] == epochs
    again, _ = trained_net(kind, TRAIN, VALIDATION, TEST.windows, epochs)
    np.testing.assert_array_equal(votes, again)
    other, _ = trained_net(kind, TRAIN, VALIDATION, TEST.windows, epochs, seed=1)
    assert not np.array_equal(votes, other)


def test_multiply_adds_are_those_of_the_formulas() -> None:
    cells = 2 * 5 * 5
    found = {
        kind: baseline_nets.multiply_adds(make(SHAPE, 3), SHAPE) for kind, make in KINDS.items()
    }
    assert found == {
        "cnn_frame": 25 * 8 * 2 * 25 + 9 * 16 * 8 * 9 + 16 * 9 * 32 + 32 * 3,
        "cnn_volume": 27 * 8 * 2 * 27 + 8 * 16 * 8 * 27 + 16 * 8 * 32 + 32 * 3,
        "gru": 6 * 3 * 48 * (cells + 48) + 48 * 3,
    }


def test_training_leaves_torchs_random_state_alone() -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    trained_net("cnn_frame", TRAIN, VALIDATION, TEST.windows, 1)
    assert torch.equal(before, torch.get_rng_state())


def test_boosting_learns_and_repeats() -> None:
    votes, said = boosted(TRAIN, VALIDATION, TEST.windows, 15)
    strict = accuracy(votes, TEST.y).strict
    assert strict > 0.9
    assert 0 < said["rounds"] <= 15
    np.testing.assert_array_equal(votes, boosted(TRAIN, VALIDATION, TEST.windows, 15)[0])
    assert boosted(TRAIN, VALIDATION, TEST.windows.take(np.arange(0)), 2)[0].shape == (0, 3)


def test_wrong_input_is_named() -> None:
    no = TRAIN.y[:0]
    none = SampleSet(TRAIN.windows.take(np.arange(0)), no, no, no, ())
    with pytest.raises(ValueError, match="gru: 0 training"):
        trained_net("gru", none, VALIDATION, TEST.windows)
    with pytest.raises(ValueError, match="gru: 0 epochs"):
        trained_net("gru", TRAIN, VALIDATION, TEST.windows, 0)
    with pytest.raises(ValueError, match="every class"):
        boosted(none, VALIDATION, TEST.windows)
