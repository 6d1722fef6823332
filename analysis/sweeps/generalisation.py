"""Generalisation: networks trained without a level of a factor, and tested on it alone.

15 % of the other trials choose the epoch. Results of other skins stand in the same table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import training
from sliplab.analysis.networks.training import EpochRecord
from sliplab.analysis.sweeps.runner import Json
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.quantity import level_order
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.files import write_bytes

VALIDATION = 0.15
COLUMNS = ["left out, or other skin", "trials", "windows", "strict (%)", "95 %", "argmax (%)",
           "seen (%)"]  # fmt: skip

I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TrialSamples:
    """Samples of trials; `samples.trial` is a sample's place in `ids` and `conditions`.

    Attributes:
        ids: of the trials.
        conditions: level by factor of each trial, in words.
    """

    samples: SampleSet
    ids: Sequence[str]
    conditions: Sequence[Mapping[str, str]]

    def levels(self, factor: str) -> list[str]:
        """Return a factor's levels among the trials, the lowest first; none where it is unknown."""
        found = {condition[factor] for condition in self.conditions if factor in condition}
        return sorted(found, key=level_order)

    def without(self, factor: str, level: str) -> dict[str, I64]:
        """Return the samples of each part of the split that leaves a level out: their places."""
        parts = np.array([
            "test"
            if condition.get(factor) == level
            else "validation"
            if hash_integer("generalisation", trial) < VALIDATION * 2**63
            else "train"
            for trial, condition in zip(self.ids, self.conditions, strict=True)
        ])  # fmt: skip
        of_sample = parts[self.samples.trial]
        return {part: np.flatnonzero(of_sample == part) for part in ("train", "validation", "test")}


def train_without(
    trials: TrialSamples,
    factor: str,
    level: str,
    settings: AnalysisSettings,
    state: Path,
    on_epoch: Callable[[EpochRecord], None],
) -> Json:
    """Train without a level, test on it; ``left out`` says why where that cannot be.

    Args:
        state: file that keeps the training after each epoch; goes when the training is over.
    """
    rows = trials.without(factor, level)
    lacking = sorted(part for part, of in rows.items() if not len(of))
    if lacking:
        return {"left out": f"no {' and no '.join(lacking)} trials"}
    x, y, trial = trials.samples.windows, trials.samples.y, trials.samples.trial
    train, validation, test = rows["train"], rows["validation"], rows["test"]
    fitted = training.fit(
        x.take(train), y[train], x.take(validation), y[validation],
        settings.network, settings.windows, settings.training, settings.training.seeds[0],
        on_epoch=on_epoch,
        on_state=partial(write_bytes, state),
        state=state.read_bytes() if state.exists() else None,
    )  # fmt: skip
    state.unlink(missing_ok=True)
    counts = training.predict_counts(fitted, x.take(test))
    return {
        "trained_on": len(np.unique(trial[train])),
        "seen": fitted.chosen.val_strict,
        **scored(counts, y[test], trial[test]),
    }


def scored(counts: I64, y: I64, trial: I64) -> Json:
    """Return strict accuracy with its interval over trials, argmax accuracy, recall by class."""
    found = metrics.score(counts, y)
    return {
        **window_groups.share(window_groups.strict_hits(counts, y), trial).to_json(),
        "argmax": found.accuracy.argmax,
        "recall": found.recall,
    }


def row_cells(name: str, row: Json) -> list[str]:
    """Return a result as the cells of a table, see `COLUMNS`."""
    if "left out" in row:
        return [name, row["left out"], "", "", "", "", ""]
    span = "–" if row["low"] is None else f"{100 * row['low']:.1f} to {100 * row['high']:.1f}"
    values = [row["share"], row["argmax"], row.get("seen")]
    strict, argmax, seen = ("–" if v is None else f"{100 * v:.1f}" for v in values)
    return [name, str(row["trials"]), str(row["n"]), strict, span, argmax, seen]


def markdown(results: Mapping[str, Json], simulated: bool) -> str:
    """Return all results as a table in Markdown."""
    lines = [
        f"Strict accuracy on windows{' (simulated)' if simulated else ''}; intervals are 95 %, "
        "over trials. Seen: validation windows of the levels that were trained on.",
        "",
        f"| {' | '.join(COLUMNS)} |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        *(f"| {' | '.join(row_cells(name, row))} |" for name, row in results.items()),
    ]
    return "\n".join(lines) + "\n"
