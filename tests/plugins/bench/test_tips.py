"""The network on single papillae, on drawn events of markers of which some fall silent."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sliplab.analysis.detectors.detector import DetectorError, Scene, Slip
from sliplab.analysis.detectors.feeding import feed, steady
from sliplab.analysis.detectors.papillae import GAP_MS, MEMORY_MS
from sliplab.plugins.bench.entries import tips
from sliplab.plugins.bench.entries.tips import (
    OF_ALL,
    OF_PLACE,
    SPANS_MS,
    TipNet,
    TipNetwork,
    inputs_of,
    log_odds,
)
from sliplab.storage.streams import EventChunk
from tests.analysis.detectors import test_papillae as made

PLACES = 12
ROWS = MEMORY_MS + GAP_MS + 1
END_US, SLIP_US = round(made.END_S * 1e6), round(made.SLIP_S * 1e6)


def slide(seed: int) -> Scene:
    """Markers move for 1.2 s; after 0.8 s three of them fall silent."""
    rng = np.random.default_rng(seed)
    slid = rng.permutation(len(made.CENTRES))[:3]

    def rates(t: np.ndarray) -> np.ndarray:
        found = np.full((len(t), len(made.CENTRES)), made.RATE_HZ)
        found[np.ix_(t > made.SLIP_S, slid)] = 0.0
        return found

    slip = Slip(SLIP_US, SLIP_US + 100_000, END_US)
    return Scene(f"slide {seed}", made.drawn(rng, rates), made.WIDTH, made.HEIGHT, END_US, slip)


@pytest.fixture(scope="module")
def network() -> TipNetwork:
    made_one = TipNetwork()
    made_one.train([slide(seed) for seed in range(10)], [])
    return made_one


def weights(net: TipNet) -> list[np.ndarray]:
    return [one.detach().numpy() for one in net.parameters()]


def steady_counts(rng: np.random.Generator) -> np.ndarray:
    return rng.poisson(np.linspace(2.0, 6.0, PLACES), (ROWS, PLACES))


def test_motion_of_all_is_no_news_of_a_place() -> None:
    # the same share in each span, whether all move as before or twice as fast
    counts = np.tile(np.arange(10, 10 + PLACES), (ROWS, 1))
    for faster in (1, 2):
        counts[-40:] = faster * np.arange(10, 10 + PLACES)
        seen = inputs_of(counts, np.zeros(PLACES), 1.0, 1.0, 0.0)
        assert seen.places.shape == (PLACES, OF_PLACE)
        assert seen.whole.shape == (OF_ALL,)
        assert seen.places[:, 3:] == pytest.approx(0.0, abs=0.02)


def test_a_silent_place_stands_out_in_each_span() -> None:
    counts = steady_counts(np.random.default_rng(1))
    counts[-30:, 4] = 0
    seen = inputs_of(counts, np.zeros(PLACES), 1.0, 1.0, 0.0).places
    for k in range(len(SPANS_MS)):
        assert seen[:, 3 + 2 * k].argmin() == 4
    assert seen[4, -2] < -4, "log of half an event against about 80 expected ones"
    assert seen[4, -1] == -tips.LARGEST / 2, "bounded"


def test_the_order_of_places_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    counts, order = steady_counts(rng), rng.permutation(PLACES)
    counts[-20:, :2] = 0
    noise = rng.uniform(0, 0.1, PLACES)
    one = inputs_of(counts, noise, 1.3, 1.0, 0.0)
    other = inputs_of(counts[:, order], noise[order], 1.3, 1.0, 0.0)
    net = weights(TipNet())
    assert log_odds(net, other) == pytest.approx(log_odds(net, one), abs=1e-4)


def test_one_millisecond_has_the_log_odds_of_the_layers() -> None:
    seen = inputs_of(steady_counts(np.random.default_rng(4)), np.zeros(PLACES), 2.0, 0.5, 3.0)
    net, places = TipNet(), torch.from_numpy(seen.places)[None]
    expected = net(places, torch.from_numpy(seen.whole)[None], torch.ones(1, PLACES))
    assert log_odds(weights(net), seen) == pytest.approx(float(expected.detach()), abs=1e-4)


def test_it_learns_what_slip_looks_like(network: TipNetwork) -> None:
    for seed in (20, 21):
        scene = slide(seed)
        found = feed(network, scene)
        before = found.value[found.t_us <= SLIP_US].max()
        above = found.t_us[found.value > max(before, 0.0)]
        assert SLIP_US < above[0] < SLIP_US + 30_000


def test_evidence_does_not_depend_on_chunks(network: TipNetwork) -> None:
    scene = slide(30)
    whole, parts = (feed(network, scene, steady(scene, us)) for us in (1_000_000, 3_700))
    assert np.array_equal(whole.t_us, parts.t_us)
    assert np.array_equal(whole.value, parts.value)


@pytest.mark.quick(1)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_seed_gives_the_same_network(seed: int) -> None:
    scenes, one = [slide(k) for k in range(3)], slide(40)
    found = []
    for _ in range(2):
        detector = TipNetwork(seed=seed)
        detector.train(scenes, [])
        found.append(feed(detector, one).value)
    assert np.array_equal(*found)


def test_scenes_that_train_are_none_of_a_test() -> None:
    assert tips.NUISANCE_SEED > 2**31, "the largest seed that the command takes"


def test_evidence_is_the_lowest_where_nothing_moves(network: TipNetwork) -> None:
    rng = np.random.default_rng(3)
    still = made.drawn(rng, lambda t: np.zeros((len(t), len(made.CENTRES))))
    scene = Scene("still", still, made.WIDTH, made.HEIGHT, END_US, Slip(END_US, END_US, END_US))
    assert (feed(network, scene).value == tips.LOWEST).all()


def test_what_cannot_train_it_is_named() -> None:
    still = Scene("still", EventChunk.empty(), 640, 480, END_US, Slip(SLIP_US, SLIP_US, END_US))
    with pytest.raises(DetectorError, match="in 0 milliseconds before the slip and 0 after"):
        TipNetwork().train([still], [])


def test_without_training_it_does_not_keep_silent() -> None:
    with pytest.raises(DetectorError, match="not trained"):
        feed(TipNetwork(), slide(50))


def test_the_cost_is_that_of_the_layers() -> None:
    cost = TipNetwork().cost()
    weights = 17 * 16 + 16 + 16 * 16 + 16 + 40 * 16 + 16 + 16 + 1
    assert cost.memory_bytes == 4 * weights
    assert cost.operations == 20 * (17 * 16 + 16 * 16) + 40 * 16 + 16
