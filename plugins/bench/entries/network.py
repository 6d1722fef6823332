"""The spiking network as an entry: the paper's with the paper's rule, and ours with Page's test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import Cost, Scene
from sliplab.analysis.detectors.detectors import DetectionRule, Predictions, TrialWithSlip, learn
from sliplab.analysis.detectors.latency import TrueSlip
from sliplab.analysis.detectors.smoothing_rule import paper_level, paper_rule
from sliplab.analysis.metrics.classification import winners
from sliplab.analysis.networks import training
from sliplab.analysis.networks.network import parameters
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.networks.synaptic import count_net_work
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.analysis.windows.windows import list_events
from sliplab.plugins.bench.windowed import WindowDetector, samples
from sliplab.protocols.settings import AnalysisSettings

COUNTED = 200
"""Windows of which synaptic operations are counted."""
WEIGHT_BYTES = 4
EPOCHS = 8
"""As in the shipped protocols."""


def _settings(**data: Any) -> AnalysisSettings:
    return AnalysisSettings.model_validate({**data, "training": {"epochs": EPOCHS}})


class Spiking(WindowDetector):
    """The spiking network, trained on the bench's scenes.

    Args:
        settings: network, training and rule.
        stride_ms: from one window's start to the next one's.
        by_paper: trained on the 2-pixel onset and not on the first tip's sliding.
    """

    def __init__(self, settings: AnalysisSettings, stride_ms: int, by_paper: bool) -> None:
        super().__init__(settings.windows, stride_ms)
        self.settings, self._by_paper = settings, by_paper
        self._engine: SpikeEngine | None = None
        self._rule: DetectionRule = paper_rule(settings.detection).detector

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`."""
        settings = self.settings
        train, val = (
            samples(part, settings.windows, by_paper=self._by_paper)
            for part in (scenes, validation)
        )
        self.fitted = training.fit(
            train.windows,
            train.y,
            val.windows,
            val.y,
            settings.network,
            settings.windows,
            settings.training,
            settings.training.seeds[0],
        )
        self._net = training.restore(self.fitted)
        self._engine = SpikeEngine(self._net, settings.windows.cells)
        rows = np.random.default_rng(0).permutation(len(val))[:COUNTED]
        self._counted = val.windows.take(rows)

    def counts(self, x: SparseWindows) -> npt.NDArray[np.int64]:
        """Return output spikes (n, 3) of windows, computed in this thread alone."""
        assert self._engine is not None, "it was trained"
        return self._engine.counts(x, 1)

    def decide(self, x: SparseWindows) -> tuple[npt.ArrayLike, npt.ArrayLike | None]:
        """See `WindowDetector`."""
        counts = self.counts(x)
        return self.read(Predictions(counts, x.totals, np.arange(len(counts)))), winners(counts)

    def restart(self) -> None:
        """See `WindowDetector`."""
        self._state = self._rule.begin()

    def read(self, windows: Predictions) -> npt.NDArray[np.float64]:
        """Return evidence (n,) of the next windows, by the rule."""
        self._state, found = self._rule.push(self._state, windows)
        return found.incipient

    def cost(self) -> Cost:
        """Return synaptic operations of a window, and the size of float32 weights."""
        work = count_net_work(self._net, self.windows.cells, self._counted)
        weights = sum(p.numel() for p in parameters(self._net).values())
        operations = None if work is None else work.synaptic_operations["all"]
        return Cost(operations, weights * WEIGHT_BYTES)


class PaperEntry(Spiking):
    """The paper's network and rule as published (`analysis: {preset: paper}`).

    The evidence is the lead of incipient slip where the rule calls it, and nothing elsewhere: the
    bench may raise the rule's margin, and cannot lower it.
    """

    def __init__(self, *, by_paper: bool = True) -> None:
        settings = _settings(preset="paper")
        super().__init__(settings, settings.stride_ms, by_paper)

    def read(self, windows: Predictions) -> npt.NDArray[np.float64]:
        """See `Spiking`."""
        lead = super().read(windows)
        return np.where(lead > paper_level(self.settings.detection.margin), lead, -np.inf)


class Ours(Spiking):
    """This program's network, trained on the first tip's sliding, with Page's test on its spikes.

    Windows overlap, and log likelihoods are those of a regression on the three counts.
    """

    def __init__(self, stride_ms: int = 10, *, by_paper: bool = False) -> None:
        super().__init__(_settings(), stride_ms, by_paper)
        self._share = stride_ms / self.windows.length_ms

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`."""
        super().train(scenes, validation)
        learned = learn(
            [self._labelled(scene) for scene in scenes],
            self.windows.length_ms * 1_000_000,
            self.settings.most_spikes,
        )
        self._rule = learned.detectors(self._share)["cusum counts"]

    def _labelled(self, scene: Scene) -> TrialWithSlip:
        """Return a scene's consecutive windows with its true slip."""
        length_us = self.windows.length_ms * 1000
        starts = np.arange(0, scene.end_us - length_us + 1, length_us, dtype=np.int64)
        x = list_events(scene.events, starts, self.windows, scene.width, scene.height)
        slip = scene.slip
        predictions = Predictions(self.counts(x), x.totals, (starts + length_us) * 1000)
        onset_us = slip.incipient_us(self._by_paper)
        true = TrueSlip(onset_us * 1000, slip.gross_us * 1000, scene.end_us * 1000)
        return TrialWithSlip(predictions, true)


class PaperByPhysicalOnset(PaperEntry):
    """`PaperEntry`, trained on the first tip's sliding: what the label alone changes."""

    def __init__(self) -> None:
        super().__init__(by_paper=False)


class OursByPaperOnset(Ours):
    """`Ours`, trained on the 2-pixel onset."""

    def __init__(self) -> None:
        super().__init__(by_paper=True)
