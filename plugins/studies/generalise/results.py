"""Generalisation: networks trained without a level of a factor, and tested on it alone.

15 % of the other trials choose the epoch. Results of other skins are in the same table. Each result
is stored as soon as it is complete; a stopped training resumes at its last epoch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import training
from sliplab.analysis.networks.models import training_settings
from sliplab.analysis.networks.training import EpochRecord
from sliplab.analysis.sweeps.runner import Arrays, ResultFile, SweepTask
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import (
    TrialRef,
    by_id,
    load_samples,
    several,
    split_trials,
)
from sliplab.plugins.studies.generalise.document import (
    GeneralisationResults,
    NotTrained,
    UnseenScores,
)
from sliplab.protocols.errors import InputError
from sliplab.protocols.factors import in_canonical_unit
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.quantity import level_order
from sliplab.protocols.settings import AnalysisSettings
from sliplab.protocols.shown import did_you_mean
from sliplab.storage.files import make_folder, write_bytes, write_text
from sliplab.storage.schema.document import Part
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import StoreError, TrialStore

STEP, FILE, TABLE, VERSION = "generalisation", "results.json", "results.md", 1
SPLITS = ("train", "validation", "test")
VALIDATION = 0.15
COLUMNS = [
    "left out, or other skin",
    "trials",
    "windows",
    "strict (%)",
    "95 %",
    "argmax (%)",
    "seen (%)",
]

I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class TrialSamples:
    """Samples of trials; `samples.trial` is a sample's place in `ids` and `conditions`.

    Attributes:
        ids: of the trials.
        conditions: level by factor of each trial, as text.
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
        parts = np.array(
            [
                "test"
                if condition.get(factor) == level
                else "validation"
                if hash_integer("generalisation", trial) < VALIDATION * 2**63
                else "train"
                for trial, condition in zip(self.ids, self.conditions, strict=True)
            ]
        )
        of_sample = parts[self.samples.trial]
        return {part: np.flatnonzero(of_sample == part) for part in SPLITS}


def train_without(
    trials: TrialSamples,
    factor: str,
    level: str,
    settings: AnalysisSettings,
    state: Path,
    on_epoch: Callable[[EpochRecord], None],
) -> UnseenScores | NotTrained:
    """Train without a level and test on it, or say why that cannot be.

    Args:
        state: checkpoint file, written after each epoch and deleted when the training is over.
    """
    rows = trials.without(factor, level)
    lacking = sorted(part for part, of in rows.items() if not len(of))
    if lacking:
        return NotTrained(why=f"no {' and no '.join(lacking)} trials")
    x, y, trial = trials.samples.windows, trials.samples.y, trials.samples.trial
    train, validation, test = rows["train"], rows["validation"], rows["test"]
    fitted = training.fit(
        x.take(train),
        y[train],
        x.take(validation),
        y[validation],
        settings.network,
        settings.windows,
        settings.training,
        settings.training.seeds[0],
        on_epoch=on_epoch,
        on_state=partial(write_bytes, state),
        state=state.read_bytes() if state.exists() else None,
    )
    state.unlink(missing_ok=True)
    counts = training.predict_counts(fitted, x.take(test))
    unseen = score_windows(counts, y[test], trial[test])
    seen, trained_on = fitted.chosen.val_strict, len(np.unique(trial[train]))
    return unseen.model_copy(update={"seen": seen, "trained_on": trained_on})


def score_windows(counts: I64, y: I64, trial: I64) -> UnseenScores:
    """Return strict accuracy with its interval over trials, argmax accuracy, recall by class."""
    found = metrics.score(counts, y)
    strict = window_groups.share(window_groups.strict_hits(counts, y), trial)
    return UnseenScores(**dict(strict), argmax=found.accuracy.argmax, recall=found.recall)


def row_cells(name: str, row: UnseenScores | NotTrained) -> list[str]:
    """Return a result as the cells of a table, see `COLUMNS`."""
    if isinstance(row, NotTrained):
        return [name, row.why, "", "", "", "", ""]
    strict, low, high, argmax, seen = (
        "–" if value is None else f"{100 * value:.1f}"
        for value in (row.share, row.low, row.high, row.argmax, row.seen)
    )
    span = "–" if row.low is None else f"{low} to {high}"
    return [name, str(row.trials), str(row.n), strict, span, argmax, seen]


def markdown(results: Mapping[str, UnseenScores | NotTrained], simulated: bool) -> str:
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


class _Results(ResultFile[GeneralisationResults]):
    """The results, and a table of all of them."""

    def write(self, name: str, key: str, data: Json | Part, arrays: Arrays | None = None) -> None:
        super().write(name, key, data, arrays)
        found = self.load()
        write_text(self.path.with_name(TABLE), markdown(found.results, found.simulated))


class Generalisation:
    """A store's samples, what can be left out of them, and the stored results.

    Args:
        store: labelled, with a trained network.
        epochs: of each training, instead of the protocol's.

    Raises:
        StoreError: a trial has no label yet.
    """

    def __init__(
        self, store: TrialStore, campaigns: list[Collected], epochs: int | None = None
    ) -> None:
        self.folder = store.folder / "derived" / STEP
        make_folder(self.folder)
        head = {"simulated": store.simulated}
        self.results = _Results(self.folder / FILE, GeneralisationResults, "results", head)
        self.campaigns = training_campaigns(campaigns)
        self.settings = training_settings(self.campaigns)
        if epochs is not None:
            change = {"epochs": epochs, "patience": epochs}
            how = self.settings.training.model_copy(update=change)
            self.settings = self.settings.model_copy(update={"training": how})
        samples, known = all_samples(store, self.campaigns)
        conditions = [item.describe(trial) for item, trial, _ in known]
        self.trials = TrialSamples(samples, [trial.id for _, trial, _ in known], conditions)
        ids = [[item.name, trial.id, recording.checksum] for item, trial, recording in known]
        settings = self.settings.model_dump(mode="json")
        self._inputs = [VERSION, dataset.VERSION, *several(campaigns), ids, settings]

    def levels(self, factor: str) -> list[str]:
        """Return a factor's levels among the trials, as text, the lowest first.

        Raises:
            InputError: no trial has such a factor.
        """
        found = self.trials.levels(factor)
        if not found:
            known = ", ".join(self.factors())
            raise InputError("--factor", "", factor, f"must be a factor of the slides: {known}")
        return found

    def factors(self) -> list[str]:
        """Return all factors of two levels or more."""
        names = (
            name for item in self.campaigns for name in item.plan.protocol.collection.all_factors
        )
        return [name for name in dict.fromkeys(names) if len(self.levels(name)) > 1]

    def choose(
        self, factors: Sequence[str], levels: Sequence[str], every: bool
    ) -> list[tuple[str, str]]:
        """Return the factors and levels to leave out, one after the other.

        Args:
            factors: these; all if empty.
            levels: these levels of them; if empty, the lowest of each factor.
            every: all levels instead of the lowest.

        Raises:
            InputError: no such factor or level.
        """
        known = [
            (factor, level) for factor in factors or self.factors() for level in self.levels(factor)
        ]
        texts = [level for _, level in known]
        wanted = {each for level in levels for each in _same_level(level, texts)}
        unknown = [level for level in levels if not _same_level(level, texts)]
        if unknown:
            text = f"must be one of {', '.join(texts)}{did_you_mean(min(unknown), texts)}"
            raise InputError("--level", "", min(unknown), text)
        if levels:
            return [pair for pair in known if pair[1] in wanted]
        return [pair for pair in known if every or pair[1] == self.levels(pair[0])[0]]

    def without(self, factor: str, level: str, say: Callable[[str], None]) -> SweepTask:
        """Return the task that trains without a level and tests on it.

        Args:
            say: called with a line after each epoch.
        """
        name = f"{factor} {level}"
        epochs = self.settings.training.epochs
        key = self.key(name, training.VERSION)

        def on_epoch(record: EpochRecord) -> None:
            share = f"validation {100 * record.val_strict:.1f} %"
            say(f"without {name}: epoch {record.epoch} of at most {epochs}, {share}")

        state = self.folder / f"{key[:16]}.state"
        work = partial(train_without, self.trials, factor, level, self.settings, state, on_epoch)
        return SweepTask(name, key, work)

    def key(self, name: str, inputs: Any) -> str:
        """Return the key of a result.

        Args:
            inputs: besides the samples and the settings of training.
        """
        return make_key(STEP, VERSION, self._inputs, [name, inputs])


def all_samples(store: TrialStore, campaigns: list[Collected]) -> tuple[SampleSet, list[TrialRef]]:
    """Return the samples of all parts of the split, and their trials in the samples' order.

    Raises:
        StoreError: a trial has no label yet.
    """
    labels = StoreLabels(store)
    refs = [ref for split in SPLITS for ref in split_trials(campaigns, split)]
    for item, trial, recording in refs:
        if not labels.fresh(item, recording):
            raise StoreError(f"{item.name}: {trial.id} has no label yet; run `sliplab label`")
    parts = [load_samples(labels, campaigns, split) for split in SPLITS]
    joined = SampleSet.join(parts, campaigns[0].settings.windows)
    found = by_id(refs)
    return joined, [found[name] for name in joined.trials]


def _same_level(given: str, texts: Sequence[str]) -> list[str]:
    """Return the levels, as text, that one matches: with their unit, another one, or none."""
    found = []
    for text in texts:
        number, _, unit = text.partition(" ")
        try:
            same = bool(unit) and Decimal(str(in_canonical_unit(given, unit))) == Decimal(number)
        except (ValueError, InvalidOperation):
            same = False
        if same or given == text:
            found.append(text)
    return found
