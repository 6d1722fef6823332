"""A problem: whether a touched object is a box, in recordings whose labels name the objects."""

from __future__ import annotations

from dataclasses import dataclass

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.plugins.classes.problem import ClassesOfRecordings
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.trials.recording import Recording

CAMPAIGN = "boxes"
"""Beginning of the names of campaigns that pose this problem."""


@dataclass(frozen=True)
class BoxLabels(StoreLabels):
    """Labels that name two classes instead of the objects."""

    def key(self, item: Collected, recording: Recording) -> str:
        """Return the key of the label; it must change with what `read` changes."""
        return f"box or not, 1: {super().key(item, recording)}"

    def read(self, item: Collected, recording: Recording) -> TrialLabel:
        """Return the label with its classes replaced."""
        label = super().read(item, recording)
        names = ["box" if span.name.startswith("box") else "other" for span in label.spans]
        spans = [
            span.model_copy(update={"name": name})
            for span, name in zip(label.spans, names, strict=True)
        ]
        return label.model_copy(update={"spans": tuple(spans)})


class Boxes(ClassesOfRecordings):
    """Boxes, and everything else."""

    def classes(self) -> tuple[str, ...]:
        """Return the names of the classes."""
        return "box", "other"


def boxes(labels: StoreLabels, campaigns: list[Collected]) -> Boxes | None:
    """Return the problem, where all campaigns pose it."""
    if not all(item.name.startswith(CAMPAIGN) for item in campaigns):
        return None
    return Boxes(BoxLabels(labels.store, labels.reviewed), campaigns)
