"""The hold-out campaign: its inputs, its figures, and the history of its evaluations."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib.metadata import version

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.evaluation.trials import judge, quiet_alarms, summaries
from sliplab.analysis.labels import labelling
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import choose_model, wanted_models
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.sample_sets import several
from sliplab.storage.schema.holdout import HoldoutLook, HoldoutResult
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import StoreError, TrialStore

STEP, NAME, VERSION = "holdout", "results", 1


class Holdout:
    """The hold-out campaign of a study, and its stored results.

    Args:
        store: evaluated, its slides simulated.
        trials: how many, spread over the conditions of the first campaign of slides.
        seeds: of trials and skin.

    Raises:
        StoreError: not simulated, or not evaluated yet.
    """

    def __init__(
        self, store: TrialStore, campaigns: list[Collected], trials: int, seeds: tuple[int, int]
    ) -> None:
        self.folder, self.seeds, self.trials = store.folder / STEP, seeds, trials
        self.results = Derived(self.folder)
        self.item = training_campaigns(campaigns)[0]
        if not self.item.info.get("simulated"):
            raise StoreError(
                f"{store.folder}: its slides are real; a campaign of another skin has to be "
                "collected with another protocol seed, into a separate store"
            )
        evaluated = evaluation_of(store)
        self.detection = evaluated.detection[self.item.name]
        reviewed = evaluated.reviewed is not None
        self.model = choose_model(wanted_models(store, campaigns, reviewed))
        made_of = [self.item.plan.collection_hash, self.item.info["rig_hash"], trials, seeds]
        used = [labelling.VERSION, dataset.VERSION, *several(campaigns)]
        rule = self.detection.model_dump(mode="json")
        self.key = make_key(STEP, VERSION, [self.model.key, made_of, *used], rule)

    def result(self) -> HoldoutResult:
        """Read the stored result.

        Raises:
            FileNotFoundError: the campaign was never evaluated.
            StoreError: it is damaged.
        """
        return self.results.load(NAME, HoldoutResult)

    def evaluations(self) -> tuple[HoldoutLook, ...]:
        """Return each time that the campaign was evaluated."""
        try:
            return self.result().evaluations
        except FileNotFoundError:
            return ()

    def judged_by(self, program: str) -> bool:
        """Return whether a version of the program evaluated the campaign already."""
        return program in [each.version for each in self.evaluations()]

    def score(self, store: TrialStore, campaigns: list[Collected]) -> HoldoutResult:
        """Score the labelled trials of the campaign; return figures and ledger."""
        fitted = model_file.load(self.model.path)
        judged = judge(fitted, {self.item.name: self.detection}, store, campaigns)
        windows = judged.window_scores(self.detection.margin)
        look = HoldoutLook(
            version=version("sliplab"),
            at=datetime.now(UTC).isoformat(timespec="seconds"),
            model=self.model.key,
            strict=windows.accuracy.strict,
        )
        return HoldoutResult(
            simulated=True,
            trials=len(judged.rows),
            protocol_seed=self.seeds[0],
            skin_seed=self.seeds[1],
            model=self.model.key,
            windows=windows,
            rows=tuple(judged.rows),
            kinematic=summaries(judged.rows)["kinematic"],
            evaluations=(*self.evaluations(), look),
            false_alarms=quiet_alarms(judged.trials),
        )
