"""How fast the network learns at each step of a training: up in a line, down along a cosine."""

from __future__ import annotations

import math

from sliplab.protocols.settings import Training


def learning_rate(training: Training, done: int, step: int = 0, steps: int = 1) -> float:
    """Of a step in the epoch after `done` epochs.

    Constant, or falling from the full rate to nothing along half a cosine over all steps of all
    epochs (Loshchilov and Hutter, 2017, without restarts); and at the very beginning rising in a
    line. The last steps are nearly none: weights come to rest instead of being caught in a jump
    (docs/decisions/0057).

    Args:
        step, steps: done in this epoch, and all of an epoch.
    """
    rising = training.warm_up * training.epochs * steps
    rate = training.learning_rate * min(1.0, (done * steps + step + 1) / max(rising, 1.0))
    if training.schedule == "constant":
        return rate
    return rate * 0.5 * (1.0 + math.cos(math.pi * (done + step / steps) / training.epochs))
