"""How far a trained network carries: to levels it never saw, and to skins it never touched.

    python -m benchmarks.generalisation STORE --out DIR [--factor NAME ...] [--skins N] [--trials N]

STORE is a store whose trials are labelled and whose network is trained. For every level of a
factor a network is trained without its trials (`leave_conditions_out`, with 15 % of the other
trials to choose an epoch by) and tested on them. For other skins, which differ by the scatter of
their making (`mock.scene.skin.seed`), some of the same trials are taken on each and the store's own
network is tested on them. This takes hours and is no part of CI: every result is kept in
DIR/results.json as soon as it is there, a training goes on after a stop at its last epoch, a
collection at its last trial. All of it is simulated.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from analysis.nets import dataset, metrics, model_file, training, window_groups
from analysis.nets.dataset import SampleSet
from flows.running.orchestration import prepare
from protocols.hashing import hash_integer
from storage.derived import make_key
from storage.files import read_json, write_bytes, write_json, write_text
from storage.store import Store

VERSION = 1
VALIDATION = 0.15
SKIN_SEEDS = 101
"""Seed of the first other skin."""

Result = dict[str, Any]
I64 = npt.NDArray[np.int64]


class Bench:
    """A store's samples with the trial of each, and the results that are kept.

    Args:
        store: labelled, with a trained network.
        out: where results and other skins go.
        epochs: of each training, instead of the protocol's.
    """

    def __init__(self, store: Path, out: Path, epochs: int | None = None) -> None:
        self.out = out
        self.out.mkdir(parents=True, exist_ok=True)
        self.store = Store.open(store)
        prepare(self.store.folder)
        from flows.learning.train import training_settings
        from flows.running.campaigns import collected, training_campaigns

        self.campaigns = training_campaigns(collected(self.store))
        self.settings = training_settings(self.campaigns)
        if epochs is not None:
            change = {"epochs": epochs, "patience": epochs}
            how = self.settings.training.model_copy(update=change)
            self.settings = self.settings.model_copy(update={"training": how})
        self.samples, self.place, self.known = all_samples(self.store, self.campaigns)
        ids = [[item.name, trial.id, recording.checksum] for item, trial, recording in self.known]
        self.inputs = [VERSION, dataset.VERSION, ids, self.settings.model_dump(mode="json")]

    @property
    def kept(self) -> Path:
        """The file with all results."""
        return self.out / "results.json"

    def results(self) -> dict[str, Result]:
        """Results by name, as they were kept."""
        try:
            return read_json(self.kept)["results"]
        except FileNotFoundError:
            return {}

    def once(self, name: str, inputs: Any, work: Callable[[str], Result]) -> Result:
        """The result of `work`, or the one that was kept for the same inputs."""
        key = make_key("generalisation", VERSION, self.inputs, [name, inputs])
        found = self.results().get(name)
        if found is None or found["key"] != key:
            print(f"{name} ...", file=sys.stderr, flush=True)
            found = {"key": key, **work(key)}
            results = {**self.results(), name: found}
            write_json(self.kept, {"simulated": self.store.simulated, "results": results})
        return found

    def levels(self, factor: str) -> list[str]:
        """A factor's levels among the trials, in words."""
        texts = (item.plan.describe(trial).get(factor) for item, trial, _ in self.known)
        return list(dict.fromkeys(text for text in texts if text is not None))

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
        return self.once(f"{factor} {level}", None, lambda key: self._train(key, parts))

    def _train(self, key: str, parts: npt.NDArray[np.str_]) -> Result:
        rows = {name: np.flatnonzero(parts[self.place] == name) for name in np.unique(parts)}
        lacking = {"train", "validation", "test"} - {name for name, of in rows.items() if len(of)}
        if lacking:
            return {"left out": f"no {' and no '.join(sorted(lacking))} trials"}
        state = self.out / f"{key[:16]}.state"
        x, y = self.samples.windows, self.samples.y
        fitted = training.fit(
            x.take(rows["train"]),
            y[rows["train"]],
            x.take(rows["validation"]),
            y[rows["validation"]],
            self.settings.network,
            self.settings.windows,
            self.settings.training,
            self.settings.training.seeds[0],
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

    def skin(self, seed: int, rig: str, trials: int) -> Result:
        """Test the store's network on another skin of the same design."""
        return self.once(
            f"skin {seed}",
            [rig, trials, self._model()[1]],
            lambda _: self._touch(seed, rig, trials),
        )

    def _model(self) -> tuple[Path, str]:
        from flows.learning.evaluate import choose_model
        from flows.learning.train import wanted_models

        model = choose_model(wanted_models(self.store, self.campaigns))
        return model.path, model.key

    def _touch(self, seed: int, rig: str, trials: int) -> Result:
        from flows.collecting.collect import collect
        from flows.labelling.label import label
        from flows.planning.orders import make_order
        from flows.running.campaigns import collected
        from flows.syncing.sync import sync
        from rigs.rig_inheritance import rig_path

        folder = self.out / f"skin{seed}"
        other = self.out / f"skin{seed}.yaml"
        base = str(rig_path(Path(rig)).resolve())
        text = yaml.safe_dump({"extends": base, "mock": {"scene": {"skin": {"seed": seed}}}})
        write_text(other, text)
        item = self.campaigns[0]
        prepare(Store.create(folder).folder)
        store = Store.open(folder)
        missing = trials - len(store.campaign(item.name).committed())
        if missing > 0:
            enabled = tuple(item.campaign.info.get("enabled", ()))
            file = item.campaign.protocol_file
            collect(
                make_order(file, other, folder, enable=enabled, campaign=item.name, most=missing)
            )
        campaigns = collected(store)
        sync(store, campaigns)
        label(store, campaigns)
        samples, place, _ = all_samples(store, campaigns)
        fitted = model_file.load(self._model()[0])
        return scored(training.predict_counts(fitted, samples.windows), samples.y, place)


def all_samples(store: Store, campaigns: Sequence[Any]) -> tuple[SampleSet, I64, list[Any]]:
    """Samples of all parts of the split, the place of each one's trial, and the trials."""
    from flows.labelling.reviewed import Labels
    from flows.learning.samples import load_samples
    from flows.learning.window_scores import owners, whose

    labels, used = Labels(store), list(campaigns)
    parts, places, known = [], [], []
    for split in ("train", "validation", "test"):
        part, of = load_samples(labels, used, split), owners(used, split)
        parts.append(part)
        places.append(whose(of, part) + len(known))
        known += of
    windows = used[0].settings.windows
    return SampleSet.join(parts, windows), np.concatenate(places), known


def scored(counts: I64, y: I64, trial: I64) -> Result:
    """Strict accuracy with its interval over trials, argmax accuracy, recall of each class."""
    found = metrics.score(counts, y)
    return {
        **window_groups.share(window_groups.strict_hits(counts, y), trial),
        "argmax": found.accuracy.argmax,
        "recall": found.recall,
    }


def table(results: dict[str, Result], simulated: bool) -> str:
    """All results as a table in Markdown."""
    lines = [
        f"Strict accuracy on windows{' (simulated)' if simulated else ''}; intervals are 95 %, "
        "over trials. Seen: validation windows of the levels that were trained on.",
        "",
        "| left out, or other skin | trials | windows | strict | 95 % | argmax | seen |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, row in results.items():
        if "left out" in row:
            lines.append(f"| {name} | {row['left out']} | | | | | |")
            continue
        span = "–" if row["low"] is None else f"{100 * row['low']:.1f} to {100 * row['high']:.1f}"
        values = [row["share"], row["argmax"], row.get("seen")]
        strict, argmax, seen = ("–" if v is None else f"{100 * v:.1f}" for v in values)
        lines.append(
            f"| {name} | {row['trials']} | {row['n']} | {strict} | {span} | {argmax} | {seen} |"
        )
    return "\n".join(lines) + "\n"


def run(arguments: Sequence[str] | None = None) -> dict[str, Result]:
    """The program; returns all results that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.generalisation")
    parser.add_argument("store", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--factor", action="append", help="only this factor; may be given again")
    parser.add_argument("--level", action="append", help="only this level; may be given again")
    parser.add_argument("--skins", type=int, default=5)
    parser.add_argument("--trials", type=int, default=36, help="on each other skin")
    parser.add_argument("--rig", default="rehearsal", help="that the other skins are put on")
    parser.add_argument("--epochs", type=int)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args(arguments)
    bench = Bench(asked.store, asked.out, asked.epochs)
    found = {}
    for factor in bench.factors() if asked.factor is None else asked.factor:
        for level in bench.levels(factor):
            if asked.level is None or level in asked.level:
                found[f"{factor} {level}"] = bench.without(factor, level)
    for seed in range(SKIN_SEEDS, SKIN_SEEDS + asked.skins):
        found[f"skin {seed}"] = bench.skin(seed, asked.rig, asked.trials)
    text = table(found, bench.store.simulated)
    write_text(asked.out / "results.md", text)
    print(json.dumps(found) if asked.json else text)
    return found


if __name__ == "__main__":
    run()
