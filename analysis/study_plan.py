"""A study before it begins: how long each step is to take.

Seconds are expected from nothing, on two cores, where trials are simulated; trials of a real rig
take what is planned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation import holdout as held_out
from sliplab.analysis.labels.label_errors import CHECK
from sliplab.protocols import Plan
from sliplab.storage.trials.store import TrialStore

COLLECT_S = {"tracks": 0.3, "video": 5.0}
"""Of a simulated trial, by the camera's source. Likewise:"""
LABEL_S = {"tracks": 0.2, "video": 1.5}
SYNC_S = 0.03
SAMPLES_PER_S = 1500.0
EVALUATE_S = 0.045
START_S = 4.0
"""Fixed time of a step: processes, kernels, pages."""


@dataclass(frozen=True)
class PlannedCampaign:
    """A campaign that a study is to take.

    Attributes:
        source: what its outside camera provides, `tracks` or `video`.
        in_virtual_time: its rig runs as fast as it can.
    """

    name: str
    plan: Plan
    source: str
    simulated: bool
    in_virtual_time: bool

    @property
    def collect_s(self) -> float:
        """Seconds of taking its trials."""
        simulated = COLLECT_S[self.source] * len(self.plan.trials)
        return simulated if self.in_virtual_time else self.plan.total_seconds

    @property
    def training_windows(self) -> int:
        """Number of windows that a network learns from, as planned."""
        trials = sum(trial.split == "train" for trial in self.plan)
        return 3 * self.plan.protocol.analysis.samples.per_class * trials


@dataclass(frozen=True)
class Search:
    """A search that a study does before its report.

    Attributes:
        name: of the step.
        unit: noun in plural that its work is counted in.
        seconds: expected from nothing.
        run: does what is missing of a store's campaigns, and returns how much that was.
    """

    name: str
    unit: str
    seconds: float
    run: Callable[[TrialStore, list[Collected]], int]


@dataclass(frozen=True)
class StudyPlan:
    """The campaigns of a study, in the order in which they are taken."""

    campaigns: Sequence[PlannedCampaign]

    @property
    def slides(self) -> list[PlannedCampaign]:
        """The kinematic campaigns, which train the network."""
        return [
            item
            for item in self.campaigns
            if item.plan.protocol.collection.experiment == "kinematic"
        ]

    @property
    def training_windows(self) -> int:
        """Number of windows that a network learns from."""
        return sum(item.training_windows for item in self.slides)

    def expected(
        self, check: int, more: Sequence[Search] = (), holdout: int = 0
    ) -> dict[str, float]:
        """Return the seconds that each step is expected to take, in the steps' order.

        Args:
            check: trials whose labels are checked with video.
            more: searches before the report.
            holdout: trials of the hold-out campaign.
        """
        seconds = {f"collect {item.name}": item.collect_s for item in self.campaigns}
        trials = sum(len(item.plan.trials) for item in self.campaigns)
        seconds["sync"] = SYNC_S * trials
        seconds["label"] = sum(
            LABEL_S[item.source] * len(item.plan.trials) for item in self.campaigns
        )
        if check:
            seconds[CHECK] = (COLLECT_S["video"] + LABEL_S["video"]) * check
        seconds["train"] = self._training_s()
        seconds["evaluate"] = EVALUATE_S * trials
        if holdout:
            source = self.campaigns[0].source
            each = COLLECT_S[source] + LABEL_S[source] + EVALUATE_S
            seconds[held_out.STEP] = each * holdout
        seconds |= {search.name: search.seconds for search in more}
        seconds["report"] = 0.0
        return {name: START_S + each for name, each in seconds.items()}

    def _training_s(self) -> float:
        if not self.slides:
            return 0.0
        settings = self.slides[0].plan.protocol.analysis
        training = settings.training
        networks = len(training.seeds) + (settings.comparison_settings() is not None)
        return self.training_windows * training.epochs * networks / SAMPLES_PER_S
