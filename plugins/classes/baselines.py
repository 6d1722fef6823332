"""Ordinary methods on windows of recordings of classes: `sliplab evaluate --baselines`."""

from __future__ import annotations

from sliplab.analysis.campaigns import Collected, agreeing
from sliplab.analysis.evaluation.baselines import SEEDS, Methods
from sliplab.analysis.networks.baseline_nets import KINDS, TAXEL_KINDS
from sliplab.analysis.networks.baselines import ROUNDS
from sliplab.analysis.windows.sample_sets import CLASS_PREFIX
from sliplab.plugins.classes.evaluation import NAME

CLASS_EPOCHS, CLASS_BATCH = 40, 16
"""Of ordinary networks, for some hundreds of windows."""


def class_methods(campaigns: list[Collected], classes: int) -> Methods:
    """Return the methods on windows of recordings of classes; of taxels there is no frame."""
    windows = agreeing(campaigns)[0].settings.windows
    kinds = KINDS if windows.taxels is None else TAXEL_KINDS
    nets = {kind: [CLASS_EPOCHS, CLASS_BATCH, *SEEDS] for kind in kinds}
    names = {"boosting": [ROUNDS, classes], **nets}
    return Methods(names, classes, CLASS_PREFIX, NAME, CLASS_EPOCHS, CLASS_BATCH)
