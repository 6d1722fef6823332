"""What one evaluation works on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.reviewed import Labels
from sliplab.flows.learning.detector_work import DetectorWork
from sliplab.flows.learning.train import Model
from sliplab.protocols import Trial
from sliplab.protocols.settings import Detection
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


@dataclass(frozen=True)
class Job:
    """Everything an evaluation depends on, found before anything is computed."""

    store: Store
    campaigns: list[Collected]
    labels: Labels
    model: Model
    models: list[Model]
    """Of all seeds, the chosen one among them."""
    detection: dict[str, Detection]
    trials: list[tuple[Collected, Trial, Recording, str]]
    """Campaign, trial, recording and key of its spike counts, of every trial that is scored."""
    detectors: DetectorWork
    key: str
    cluster: Cluster | None = None
