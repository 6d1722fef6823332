"""How far a network carries: to levels that it never saw, and to skins that it never touched.

For a level of a factor a network is trained without its trials (`leave_conditions_out`, with 15 %
of the other trials to choose an epoch by) and tested on them. For other skins, which differ by the
scatter of their making (`mock.scene.skin.seed`), some of the same trials are taken on each and the
store's own network is tested on them. Each result is kept as soon as it is there; a training goes
on after a stop at its last epoch, a collection at its last trial.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, collected, training_campaigns
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.training import EpochRecord
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.flows.collect import collect
from sliplab.flows.labelling.label import label
from sliplab.flows.labelling.reviewed import Labels
from sliplab.flows.learning.evaluate import choose_model
from sliplab.flows.learning.samples import (
    TrialRef,
    by_id,
    load_samples,
    several,
    split_trials,
)
from sliplab.flows.learning.train import training_settings, wanted_models
from sliplab.flows.running import console
from sliplab.flows.searching.other_rig import other_request
from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.quantity import level_order
from sliplab.storage.files import make_folder, read_json, write_bytes, write_json, write_text
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import Store

STEP, FILE, TABLE, VERSION = "generalisation", "results.json", "results.md", 1
VALIDATION = 0.15
SKIN_SEEDS = 101
"""Seed of the first other skin."""
SKINS, TRIALS = 5, 36
"""Other skins, and trials on each, unless others are asked for."""

Result = dict[str, Any]
I64 = npt.NDArray[np.int64]


class Generalisation:
    """A store's samples with the trial of each, and the results that are kept.

    Args:
        store: labelled, with a trained network.
        epochs: of each training, instead of the protocol's.
    """

    def __init__(self, store: Store, campaigns: list[Collected], epochs: int | None = None) -> None:
        self.store, self.folder = store, store.folder / "derived" / STEP
        make_folder(self.folder)
        self.campaigns = training_campaigns(campaigns)
        self.settings = training_settings(self.campaigns)
        if epochs is not None:
            change = {"epochs": epochs, "patience": epochs}
            how = self.settings.training.model_copy(update=change)
            self.settings = self.settings.model_copy(update={"training": how})
        self.samples, self.place, self.known = all_samples(store, self.campaigns)
        ids = [[item.name, trial.id, recording.checksum] for item, trial, recording in self.known]
        self.inputs = [
            VERSION,
            dataset.VERSION,
            *several(campaigns),
            ids,
            self.settings.model_dump(mode="json"),
        ]
        self.made = 0

    def results(self) -> dict[str, Result]:
        """Results by name, as they were kept."""
        try:
            found: dict[str, Result] = read_json(self.folder / FILE)["results"]
        except FileNotFoundError:
            return {}
        return found

    def once(self, name: str, inputs: Any, work: Callable[[str], Result]) -> Result:
        """The result of `work`, or the one that was kept for the same inputs."""
        key = make_key(STEP, VERSION, self.inputs, [name, inputs])
        found = self.results().get(name)
        if found is None or found["key"] != key:
            console.say(f"{name} ...")
            found = {"key": key, **work(key)}
            self.made += 1
            results = {**self.results(), name: found}
            write_json(self.folder / FILE, {"simulated": self.store.simulated, "results": results})
            write_text(self.folder / TABLE, table(results, self.store.simulated))
        return found

    def levels(self, factor: str) -> list[str]:
        """A factor's levels among the trials, in words, the lowest first.

        Raises:
            InputError: no trial has such a factor.
        """
        texts = (item.plan.describe(trial).get(factor) for item, trial, _ in self.known)
        found = {text for text in texts if text is not None}
        if not found:
            known = ", ".join(self.factors())
            raise InputError("--factor", "", factor, f"must be a factor of the slides: {known}")
        return sorted(found, key=level_order)

    def factors(self) -> list[str]:
        """All factors of two levels or more."""
        names = (name for item in self.campaigns for name in item.plan.protocol.collection.factors)
        return [name for name in dict.fromkeys(names) if len(self.levels(name)) > 1]

    def without(self, factor: str, level: str) -> Result:
        """Train without a level, test on it."""
        parts = np.array(
            [
                "test"
                if item.plan.describe(trial).get(factor) == level
                else "validation"
                if hash_integer("generalisation", trial.id) < VALIDATION * 2**63
                else "train"
                for item, trial, _ in self.known
            ]
        )
        name = f"{factor} {level}"
        return self.once(name, training.VERSION, lambda key: self._train(name, key, parts))

    def _train(self, name: str, key: str, parts: npt.NDArray[np.str_]) -> Result:
        rows = {part: np.flatnonzero(parts[self.place] == part) for part in np.unique(parts)}
        lacking = {"train", "validation", "test"} - {part for part, of in rows.items() if len(of)}
        if lacking:
            return {"left out": f"no {' and no '.join(sorted(lacking))} trials"}
        state = self.folder / f"{key[:16]}.state"
        x, y = self.samples.windows, self.samples.y
        how = self.settings.training

        def on_epoch(record: EpochRecord) -> None:
            share = f"validation {100 * record.val_strict:.1f} %"
            console.say(f"without {name}: epoch {record.epoch} of at most {how.epochs}, {share}")

        fitted = training.fit(
            x.take(rows["train"]),
            y[rows["train"]],
            x.take(rows["validation"]),
            y[rows["validation"]],
            self.settings.network,
            self.settings.windows,
            how,
            how.seeds[0],
            on_epoch=on_epoch,
            on_state=partial(write_bytes, state),
            state=state.read_bytes() if state.exists() else None,
        )
        state.unlink(missing_ok=True)
        counts = training.predict_counts(fitted, x.take(rows["test"]))
        return {
            "trained_on": len(np.unique(self.place[rows["train"]])),
            "seen": fitted.chosen.val_strict,
            **scored(counts, y[rows["test"]], self.place[rows["test"]]),
        }

    def skin(self, seed: int, trials: int) -> Result:
        """Test the store's network on another skin of the same design.

        Raises:
            InputError: the store's trials are real.
        """
        if not self.store.simulated:
            raise InputError("--skins", "", 1, "must be 0: only a simulated rig has other skins")
        model = choose_model(wanted_models(self.store, self.campaigns))
        rig = self.campaigns[0].info["rig_hash"]

        def touch(_: str) -> Result:
            samples, place = self._touch(seed, trials)
            fitted = model_file.load(model.path)
            return scored(training.predict_counts(fitted, samples.windows), samples.y, place)

        found = self.once(f"skin {seed}", [rig, trials, model.key], touch)
        shutil.rmtree(self.folder / f"skin{seed}", ignore_errors=True)
        return found

    def _touch(self, seed: int, trials: int) -> tuple[SampleSet, I64]:
        """Samples of some of the same trials on another skin, which go when they are judged."""
        item, folder = self.campaigns[0], self.folder / f"skin{seed}"
        store = Store.create(folder / "store")
        missing = trials - len(store.campaign(item.name).committed())
        if missing > 0:
            change = {"mock": {"scene": {"skin": {"seed": seed}}}}
            collect(other_request(item, change, folder, most=missing))
        campaigns = collected(store)
        label(store, campaigns)
        samples, place, _ = all_samples(store, campaigns)
        return samples, place


def all_samples(store: Store, campaigns: list[Collected]) -> tuple[SampleSet, I64, list[Any]]:
    """Samples of all parts of the split, the index of each one's trial, and the trials."""
    labels = Labels(store)
    parts = []
    known: list[TrialRef] = []
    for split in ("train", "validation", "test"):
        parts.append(load_samples(labels, campaigns, split))
        known += split_trials(campaigns, split)
    joined, found = SampleSet.join(parts, campaigns[0].settings.windows), by_id(known)
    return joined, joined.trial, [found[name] for name in joined.trials]


def scored(counts: I64, y: I64, trial: I64) -> Result:
    """Strict accuracy with its interval over trials, argmax accuracy, recall of each class."""
    found = metrics.score(counts, y)
    return {
        **window_groups.share(window_groups.strict_hits(counts, y), trial),
        "argmax": found.accuracy.argmax,
        "recall": found.recall,
    }


def row_cells(name: str, row: Result) -> list[str]:
    """A result as the cells of a table, see `COLUMNS`."""
    if "left out" in row:
        return [name, row["left out"], "", "", "", "", ""]
    span = "–" if row["low"] is None else f"{100 * row['low']:.1f} to {100 * row['high']:.1f}"
    values = [row["share"], row["argmax"], row.get("seen")]
    strict, argmax, seen = ("–" if v is None else f"{100 * v:.1f}" for v in values)
    return [name, str(row["trials"]), str(row["n"]), strict, span, argmax, seen]


COLUMNS = ["left out, or other skin", "trials", "windows", "strict (%)", "95 %", "argmax (%)",
           "seen (%)"]  # fmt: skip


def table(results: dict[str, Result], simulated: bool) -> str:
    """All results as a table in Markdown."""
    lines = [
        f"Strict accuracy on windows{' (simulated)' if simulated else ''}; intervals are 95 %, "
        "over trials. Seen: validation windows of the levels that were trained on.",
        "",
        f"| {' | '.join(COLUMNS)} |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        *(f"| {' | '.join(row_cells(name, row))} |" for name, row in results.items()),
    ]
    return "\n".join(lines) + "\n"


def measure_generalisation(
    store: Store,
    campaigns: list[Collected],
    factors: Sequence[str] = (),
    levels: Sequence[str] = (),
    every: bool = False,
    skins: int | None = None,
    trials: int = TRIALS,
    epochs: int | None = None,
) -> dict[str, Any]:
    """Measure what is missing of what is asked for.

    Args:
        factors: these; all by default.
        levels: these levels of them.
        every: all levels; by default, the lowest of each factor.
        skins: how many others; by default `SKINS` where trials are simulated, else none.
        trials: on each other skin.
        epochs: of each training, instead of the protocol's.

    Raises:
        InputError: no such factor or level, or other skins of a real rig.
    """
    work = Generalisation(store, campaigns, epochs)
    asked: list[tuple[str, str]] = []
    for factor in factors or work.factors():
        there = work.levels(factor)
        asked += [
            (factor, level)
            for level in there
            if (level in levels if levels else every or level == there[0])
        ]
    unknown = set(levels) - {level for _, level in asked}
    if unknown:
        there = [level for factor in factors or work.factors() for level in work.levels(factor)]
        raise InputError("--level", "", min(unknown), f"must be one of {', '.join(there)}")
    count = skins if skins is not None else SKINS if store.simulated else 0
    found = {f"{factor} {level}": work.without(factor, level) for factor, level in asked}
    for seed in range(SKIN_SEEDS, SKIN_SEEDS + count):
        found[f"skin {seed}"] = work.skin(seed, trials)
    return {
        "step": STEP,
        "simulated": store.simulated,
        "made": work.made,
        "results": found,
        "file": str(work.folder / FILE),
    }
