"""`sliplab holdout`: figures of a campaign that nothing was chosen by, once a release.

Test trials of a study judge every change of the program, so the changes that stayed are those that
test trials liked: after some years they choose the design, a little. The trials here have a seed
and a skin of the simulated rig that stand nowhere else. The study's own network and detection
settings are judged on them, as they are, once with each version of the program; each time stands in
the ledger next to the figures, so that a reader sees how often somebody looked.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.trials import summaries
from sliplab.analysis.labels import labelling
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import choose_model, wanted_models
from sliplab.analysis.sweeps.runner import Task, sample_trials, task_sweep
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.sample_sets import several
from sliplab.flows.other_rig import judge, other_request, retake
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import console
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import Store, StoreError

STEP, NAME, VERSION = "holdout", "results", 1
PROTOCOL_SEED, SKIN_SEED = 904_117_233, 730_915_402
"""Seeds of trials and of the skin. They must not be used anywhere else: not in a protocol, a rig, a
test, or a search. Replace both after looking at single trials of it."""

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
        self.folder, self.seeds, self.trials = store.folder / STEP, seeds, trials
        self.results = Derived(self.folder)
        self.item = training_campaigns(campaigns)[0]
        if not self.item.info.get("simulated"):
            raise StoreError(
                f"{store.folder}: its slides are real; a campaign of another skin has to be "
                "collected with another protocol seed, into a store of its own"
            )
        evaluated = evaluation_of(store)
        self.detection = evaluated.detection[self.item.name]
        reviewed = evaluated.reviewed is not None
        self.model = choose_model(wanted_models(store, campaigns, reviewed))
        made_of = [self.item.plan.collection_hash, self.item.info["rig_hash"], trials, seeds]
        used = [labelling.VERSION, dataset.VERSION, *several(campaigns)]
        rule = self.detection.model_dump(mode="json")
        key = make_key(STEP, VERSION, [self.model.key, made_of, *used], rule)
        self.sweep = task_sweep([Task(NAME, key, self.measure)], self.results)

    def evaluations(self) -> list[Json]:
        """Return each time that the campaign was judged."""
        try:
            found: list[Json] = self.results.read(NAME)["evaluations"]
        except FileNotFoundError:
            return []
        return found

    def run_request(self) -> RunRequest:
        """Return the study's protocol and rig with another seed and skin; all trials test."""
        trials, skin = self.seeds
        split = {"method": "ranked", "train": 0.0, "validation": 0.0, "test": 1.0}
        run_request = other_request(
            self.item,
            {"mock": {"scene": {"skin": {"seed": skin}}}},
            self.folder,
            protocol={"collection": {"seed": trials}, "analysis": {"split": split}},
        )
        chosen = sample_trials(run_request.plan, self.trials)
        return replace(run_request, only=frozenset(trial.id for trial in chosen))

    def measure(self) -> Json:
        """Take what is missing of the trials, label and judge them; return figures and ledger."""
        store, campaigns = retake([self.run_request()])
        fitted = model_file.load(self.model.path)
        judged = judge(fitted, {self.item.name: self.detection}, store, campaigns)
        rows = [row for row, _ in judged.trials]
        counts, y, trial = judged.counts, judged.samples.y, judged.samples.trial
        windows = metrics.score(counts, y, self.detection.margin)
        strict = window_groups.share(window_groups.strict_hits(counts, y), trial)
        now = {
            "version": version("sliplab"),
            "at": datetime.now(UTC).isoformat(timespec="seconds"),
            "model": self.model.key,
            "strict": windows.accuracy.strict,
        }
        return {
            "simulated": True,
            "trials": len(rows),
            "protocol_seed": self.seeds[0],
            "skin_seed": self.seeds[1],
            "model": self.model.key,
            "windows": {
                **windows.to_json(),
                "strict": strict.to_json(),
                "argmax": window_groups.share(window_groups.credit(counts, y), trial).to_json(),
            },
            "rows": [row.to_json() for row in rows],
            "kinematic": summaries(rows)["kinematic"].to_json(),
            "evaluations": [*self.evaluations(), now],
        }


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
    work, current = Holdout(store, campaigns, trials, seeds), version("sliplab")
    seen = current in [each["version"] for each in work.evaluations()]
    done = 0
    if work.sweep.pending and seen and not again:
        console.say(
            f"the hold-out campaign was judged with version {current} already, with "
            "another network or other settings; a second look would begin to choose by it. "
            f"`sliplab holdout {store.folder} --again` takes it and writes it down"
        )
    else:
        done = work.sweep.run()
    path = work.folder / f"{NAME}.json"
    return {"step": STEP, "done": done, "file": str(path), "result": work.results.read(NAME)}
