"""Figures of a campaign that nothing was chosen by: another skin and seed, once a release.

Test trials of a study judge every change of the program, so what is kept of these changes is what
test trials liked: after some years of it they choose the design, a little. The trials here have a
seed and a skin of the simulated rig that stand nowhere else. The study's own network and detection
settings are judged on them, as they are, once with each version of the program; each time stands in
the ledger beside the figures, so that a reader sees how often somebody looked.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from sliplab.analysis.campaigns import Collected, collected, training_campaigns
from sliplab.analysis.labels import labelling
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import model_file
from sliplab.analysis.windows import dataset
from sliplab.flows.collect import collect
from sliplab.flows.labelling.label import label
from sliplab.flows.learning.evaluate import choose_model, evaluation_of
from sliplab.flows.learning.samples import several
from sliplab.flows.learning.train import wanted_models
from sliplab.flows.learning.trial_scores import summaries
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import console
from sliplab.flows.searching.other_rig import judge, other_request
from sliplab.flows.searching.scene_runs import sample_trials
from sliplab.protocols.settings import Detection
from sliplab.storage.files import make_folder, read_json, write_json
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import Store, StoreError

STEP, FILE, VERSION = "holdout", "results.json", 1
PROTOCOL_SEED, SKIN_SEED = 904_117_233, 730_915_402
"""Of trials and of the skin. They must not stand anywhere else: not in a protocol, a rig file, a
test, or a search. Whoever has looked at single trials of it replaces both."""

Json = dict[str, Any]


class Holdout:
    """The campaign and what is kept of it.

    Args:
        store: evaluated, its slides simulated.
        trials: how many, spread over the conditions of the first campaign of slides.
        seeds: of trials and skin; others than the release's are for tests of this program.

    Raises:
        StoreError: not simulated, or not evaluated yet.
    """

    def __init__(
        self,
        store: Store,
        campaigns: list[Collected],
        trials: int,
        seeds: tuple[int, int] = (PROTOCOL_SEED, SKIN_SEED),
    ) -> None:
        self.store, self.seeds = store, seeds
        self.path = store.folder / STEP / FILE
        self.item = training_campaigns(campaigns)[0]
        if not self.item.info.get("simulated"):
            raise StoreError(
                f"{store.folder}: its slides are real; a campaign of another skin has to be "
                "collected with another protocol seed, into a store of its own"
            )
        _, evaluated = evaluation_of(store)
        self.detection = Detection.model_validate(evaluated["detection"][self.item.name])
        reviewed = evaluated.get("reviewed") is not None
        self.model = choose_model(wanted_models(store, campaigns, reviewed))
        made_of = [self.item.plan.collection_hash, self.item.info["rig_hash"], trials, seeds]
        used = [labelling.VERSION, dataset.VERSION, *several(campaigns)]
        rule = self.detection.model_dump(mode="json")
        self.key = make_key(STEP, VERSION, [self.model.key, made_of, *used], rule)
        self.trials = trials

    def kept(self) -> Json | None:
        """The result of the last time; None where it was never judged."""
        try:
            found: Json = read_json(self.path)
        except FileNotFoundError:
            return None
        return found

    def run_request(self) -> RunRequest:
        """The study's protocol and rig with another seed and skin, all trials for the test."""
        trials, skin = self.seeds
        split = {"method": "ranked", "train": 0.0, "validation": 0.0, "test": 1.0}
        run_request = other_request(
            self.item,
            {"mock": {"scene": {"skin": {"seed": skin}}}},
            self.store.folder / STEP,
            protocol={
                "collection": {"seed": trials},
                "analysis": {"split": split},
            },
        )
        chosen = sample_trials(run_request.plan, self.trials)
        return replace(run_request, only=frozenset(trial.id for trial in chosen))

    def measure(self) -> Json:
        """Take what is missing of the trials, label and judge them; keep figures and ledger."""
        run_request = self.run_request()
        collect(run_request)
        store = Store.open(run_request.store)
        campaigns = collected(store, [run_request.campaign])
        label(store, campaigns)
        fitted = model_file.load(self.model.path)
        judged = judge(fitted, {run_request.campaign: self.detection}, store, campaigns)
        rows = [row for row, _ in judged.trials]
        windows = metrics.score(judged.counts, judged.samples.y, self.detection.margin)
        before = self.kept()
        now = {
            "version": version("sliplab"),
            "at": datetime.now(UTC).isoformat(timespec="seconds"),
            "model": self.model.key,
            "strict": windows.accuracy.strict,
        }
        found = {
            "key": self.key,
            "simulated": True,
            "trials": len(rows),
            "protocol_seed": self.seeds[0],
            "skin_seed": self.seeds[1],
            "model": self.model.key,
            "windows": {
                **windows.as_dict(),
                "strict": window_groups.share(
                    window_groups.strict_hits(judged.counts, judged.samples.y), judged.samples.trial
                ),
                "argmax": window_groups.share(
                    window_groups.credit(judged.counts, judged.samples.y), judged.samples.trial
                ),
            },
            "rows": rows,
            "kinematic": summaries(rows)["kinematic"],
            "evaluations": [*([] if before is None else before["evaluations"]), now],
        }
        make_folder(self.path.parent)
        write_json(self.path, found)
        return found


def measure_holdout(
    store: Store,
    campaigns: list[Collected],
    trials: int,
    again: bool = False,
    seeds: tuple[int, int] = (PROTOCOL_SEED, SKIN_SEED),
) -> Json:
    """Judge the campaign, unless this version of the program did so already.

    Args:
        again: also where it did, with another network or other settings: the ledger has it.

    Returns:
        ``done`` (0 or 1), ``file`` and ``result``.
    """
    work = Holdout(store, campaigns, trials, seeds)
    kept, done = work.kept(), 0
    if kept is None or kept["key"] != work.key:
        versions = [] if kept is None else [each["version"] for each in kept["evaluations"]]
        if kept is not None and version("sliplab") in versions and not again:
            console.say(
                f"the hold-out campaign was judged with version {version('sliplab')} already, with "
                "another network or other settings; a second look would begin to choose by it. "
                f"`sliplab holdout {store.folder} --again` takes it and writes it down"
            )
        else:
            kept, done = work.measure(), 1
    return {"step": STEP, "done": done, "file": str(work.path), "result": kept}
