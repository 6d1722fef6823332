"""A small network on the counts of single papillae: alone, and joined with their Page's tests.

The tests of `papillae` compare two likelihoods that were written down. This network is trained on
the first tip's sliding instead, with nuisances. Each millisecond it sees, of each place, the events
of the last 3, 10 and 30 ms against those that the place's share of the 100 ms before lets expect.
The same two layers look at each place. What they find is pooled by maximum and mean, so that number
and order of the places do not matter (Zaheer et al. 2017, Deep Sets, NeurIPS 30).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from sliplab.analysis.detectors.alarms import SceneEvidence, level_at
from sliplab.analysis.detectors.detector import Cost, DetectorError, Scene
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.papillae import BIN_US, FEWEST_EVENTS, GAP_MS, MEMORY_MS, Papillae
from sliplab.plugins.bench.definition import DEFINITION, ScenePart, Size
from sliplab.plugins.bench.scenes import nuisance_scenes, simulated

SPANS_MS = (3, 10, 30)
OF_PLACE, OF_ALL = 2 * len(SPANS_MS) + 3, len(SPANS_MS) + 5
"""Inputs of a place, and of all."""
HIDDEN = 16
LARGEST = 6.0
"""Standard deviations that an input is off at most."""
SLIDING_MS, LOADED_MS = 200, 400
"""Time after the first slip, and before it, of which more is taken to train."""
LATE, EARLY, AFTER = 150, 300, 120
"""Milliseconds of a scene that train: just before the slip, at any time before it, and after it."""
SEEN = 0.1
"""Share of the milliseconds at any time before the slip that are looked at."""
EPOCHS, BATCH, RATE, DECAY = 20, 512, 1e-2, 1e-3
SMOOTHED_MS = 5
"""Time over which log odds are averaged."""
LOWEST = -30.0
"""Log odds of slip while nothing moves."""
NUISANCE_SEED = 2**31 + DEFINITION.train_seed
"""No seed of a test is as large."""
NUISANCE_WORLDS, DISTURBED = "hard", 24
"""Worlds of the scenes with nuisances, and how many there are with each."""
HELD_OUT, ALLOWED = 3, 1
"""One of so many scenes with nuisances does not train: the least evidence has so many false alarms
in these."""
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Inputs:
    """What the network sees of one millisecond, float32.

    Attributes:
        places: of each place that moves, (n, `OF_PLACE`). whole: of all, (`OF_ALL`,).
    """

    places: F32
    whole: F32


def inputs_of(counts: I64, noise: F64, dispersion: float, one_way: float, tested: float) -> Inputs:
    """Return the inputs of the last of some milliseconds.

    Args:
        counts: events by millisecond and place, `MEMORY_MS` + `GAP_MS` before the last one.
        noise: events a millisecond of each place. one_way: by how much each cell has one polarity.
        tested: the evidence of `Papillae`.
    """
    memory = counts[:MEMORY_MS].sum(axis=0)
    moving = memory >= FEWEST_EVENTS
    memory = memory[moving]
    total = memory.sum() + 1.0
    places = [np.log(memory + 1.0) / 5, np.log((memory + 1.0) * len(memory) / total)]
    places.append(np.minimum(noise[moving] * MEMORY_MS / (memory + 1.0), 1.0))
    whole = [len(memory) / 20, np.log(dispersion), one_way, np.log(total) / 5, tested / 10]
    for span_ms in SPANS_MS:
        seen = counts[-span_ms:].sum(axis=0)[moving]
        expected = seen.sum() * memory / total
        deviation = (seen - expected) / np.sqrt(expected + 1) / 2
        places.append(np.log((seen + 0.5) / (expected + 0.5)))
        places.append(np.clip(deviation, -LARGEST / 2, LARGEST / 2))
        whole.append(np.log((seen.sum() + 1) / (total * span_ms / MEMORY_MS + 1)))
    return Inputs(np.array(places, np.float32).T, np.array(whole, np.float32))


class TipNet(nn.Module):
    """The layers."""

    def __init__(self) -> None:
        super().__init__()
        self.place = nn.Sequential(
            nn.Linear(OF_PLACE + OF_ALL, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU()
        )
        self.whole = nn.Sequential(
            nn.Linear(2 * HIDDEN + OF_ALL, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1)
        )

    def forward(
        self, places: torch.Tensor, whole: torch.Tensor, there: torch.Tensor
    ) -> torch.Tensor:
        """Return log odds of slip, (m,).

        Args:
            places, whole: (m, n, `OF_PLACE`), (m, `OF_ALL`).
            there: 1 for a place, 0 for none, (m, n).
        """
        around = whole[:, None].expand(-1, places.shape[1], -1)
        found = self.place(torch.cat([places, around], 2)) * there[:, :, None]
        mean = found.sum(1) / there.sum(1, keepdim=True)
        return self.whole(torch.cat([found.amax(1), mean, whole], 1))[:, 0]


def log_odds(w: Sequence[F32], seen: Inputs) -> float:
    """Return `TipNet.forward` of one millisecond, without the cost of tensors.

    Args:
        w: weights and biases of the layers, in their order.
    """
    around = np.broadcast_to(seen.whole, (len(seen.places), OF_ALL))
    found = np.concatenate([seen.places, around], axis=1)
    for weight, bias in ((w[0], w[1]), (w[2], w[3])):
        found = np.maximum(found @ weight.T + bias, 0)
    pooled = np.concatenate([found.max(axis=0), found.mean(axis=0), seen.whole])
    hidden = np.maximum(w[4] @ pooled + w[5], 0)
    return float((w[6] @ hidden + w[7])[0])


class TipNetwork(Papillae):
    """Log odds of slip by the network, every millisecond.

    Args:
        joined: the network sees the evidence of `Papillae`, too. seed: of weights and batches.
        disturbed: simulated worlds with each nuisance that train, too.
    """

    def __init__(self, *, joined: bool = False, seed: int = 0, disturbed: int = 0) -> None:
        super().__init__()
        self._joined, self._seed, self._disturbed = joined, seed, disturbed
        self._weights: list[F32] | None = None
        self._least = LOWEST
        self._wanted: set[int] = set()
        self._seen: list[tuple[int, Inputs]] = []

    def begin(self, width: int, height: int) -> None:
        """See `Detector`."""
        super().begin(width, height)
        self._odds = np.full(SMOOTHED_MS - 1, LOWEST)

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`. Raises DetectorError: too few places move in the scenes, or none slip."""
        none = ScenePart(0, 0, 0)
        size = Size(none, none, none, self._disturbed)
        drawn = nuisance_scenes(size, NUISANCE_SEED, NUISANCE_WORLDS)
        disturbed = [simulated(one) for each in drawn.values() for one in each]
        others = [scene for k, scene in enumerate(disturbed) if k % HELD_OUT]
        rng = np.random.default_rng(self._seed)
        self._weights, self._least = None, LOWEST
        samples = [one for scene in [*scenes, *others] for one in self._samples(scene, rng)]
        self._wanted, self._seen = set(), []
        slips = sum(slip for _, slip in samples)
        if not 0 < slips < len(samples):
            raise DetectorError(
                f"{self.settings.fewest_places} papillae move at once in {len(samples) - slips} "
                f"milliseconds before the slip and {slips} after it, of {len(scenes)} scenes; some "
                "of both must train it: does the sensor show single markers?"
            )
        net = fitted(samples, self._seed)
        self._weights = [one.detach().numpy() for one in net.parameters()]
        held_out = disturbed[::HELD_OUT]
        found = [SceneEvidence(feed(self, scene), scene.slip) for scene in held_out]
        self._least = level_at(found, ALLOWED)

    def _samples(self, scene: Scene, rng: np.random.Generator) -> list[tuple[Inputs, bool]]:
        """Return milliseconds of a scene in which enough moves, and whether slip has begun."""
        slip_ms = scene.slip.physical_us // BIN_US
        early = np.flatnonzero(rng.uniform(size=slip_ms) < SEEN)
        near = np.arange(max(slip_ms - LOADED_MS, 0), slip_ms + SLIDING_MS)
        self._wanted, self._seen = set(early.tolist() + near.tolist()), []
        feed(self, scene)
        ms = np.array([at for at, _ in self._seen])
        before = ms < slip_ms
        parts = (before, EARLY), (before & (ms >= near[0]), LATE), (~before, AFTER)
        chosen = [rng.permutation(np.flatnonzero(among))[:most] for among, most in parts]
        return [(self._seen[k][1], bool(~before[k])) for k in np.concatenate(chosen).tolist()]

    def cost(self) -> Cost:
        """Return the multiply-adds of a millisecond with 20 places, and the bytes of weights."""
        of_place, of_all = (OF_PLACE + OF_ALL + HIDDEN) * HIDDEN, (2 * HIDDEN + OF_ALL + 1) * HIDDEN
        weights = sum(one.numel() for one in TipNet().parameters())
        return Cost(operations=20.0 * of_place + of_all, memory_bytes=4 * weights)

    def _advance(self, first: int, value: F64) -> None:
        """See `Papillae`; the evidence is the network's in place of it.

        Raises DetectorError: it is not trained.
        """
        if self._weights is None and not self._wanted:
            raise DetectorError("is not trained")
        super()._advance(first, value)
        odds = np.full(len(value), LOWEST)
        for k, tested in enumerate(value.tolist()):
            if self._weights is None and first + k not in self._wanted:
                continue
            if (seen := self._look(first + k, tested)) is None:
                continue
            if self._weights is None:
                self._seen.append((first + k, seen))
            else:
                odds[k] = max(log_odds(self._weights, seen), LOWEST)
        every = np.concatenate([self._odds, odds])
        self._odds = every[-SMOOTHED_MS + 1 :]
        # each sum by itself, so that it is the same in chunks of any length
        value[:] = sum(every[k : k + len(value)] for k in range(SMOOTHED_MS)) / SMOOTHED_MS
        value[value <= self._least] = LOWEST

    def _look(self, ms: int, tested: float) -> Inputs | None:
        """Return what the network sees of a millisecond; None while too few places move."""
        fewest, at = self.settings.fewest_places, ms - self._placed
        if len(self._rest) < fewest:
            return None
        counts = self._counts[at : at + MEMORY_MS + GAP_MS + 1]
        tested = tested if self._joined else 0.0
        seen = inputs_of(counts, self._noise, self._dispersion(), self._one_way, tested)
        return seen if len(seen.places) >= fewest else None


class DisturbedTipNetwork(TipNetwork):
    """`TipNetwork` that simulated scenes with nuisances train, too."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed=seed, disturbed=DISTURBED)


class JoinedTipNetwork(TipNetwork):
    """`DisturbedTipNetwork` that sees the evidence of `Papillae`, too."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__(joined=True, seed=seed, disturbed=DISTURBED)


def fitted(samples: Sequence[tuple[Inputs, bool]], seed: int) -> TipNet:
    """Return the network, trained on milliseconds and whether slip had begun.

    Args:
        seed: of weights and batches.
    """
    most = max(len(seen.places) for seen, _ in samples)
    places, there = torch.zeros(len(samples), most, OF_PLACE), torch.zeros(len(samples), most)
    for k, (seen, _) in enumerate(samples):
        n = len(seen.places)
        places[k, :n], there[k, :n] = torch.from_numpy(seen.places), 1.0
    whole = torch.from_numpy(np.array([seen.whole for seen, _ in samples]))
    slips = torch.tensor([slip for _, slip in samples], dtype=torch.float32)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = TipNet()
        steps = EPOCHS * max(len(samples) // BATCH, 1)
        optimiser = torch.optim.AdamW(net.parameters(), weight_decay=DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
        for _ in range(EPOCHS):
            order = torch.randperm(len(samples))
            for k in range(steps // EPOCHS):
                batch = order[k * BATCH : (k + 1) * BATCH]
                odds = net(places[batch], whole[batch], there[batch])
                loss = nn.functional.binary_cross_entropy_with_logits(odds, slips[batch])
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
    return net.eval()
