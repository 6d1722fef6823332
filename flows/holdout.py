"""`sliplab holdout`: figures of a campaign that is used for no selection, once per release.

Every change of the program is evaluated on a study's test trials, so the design slowly overfits to
them. The trials here have a seed and a skin of the simulated rig that are used nowhere else. The
study's own network and detection settings are evaluated on them unchanged, once with each version
of the program. The ledger next to the figures lists each evaluation, so that a reader sees their
number.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import version

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation.holdout import NAME, STEP, Holdout
from sliplab.analysis.sweeps.runner import SweepTask, sample_trials, task_sweep
from sliplab.flows.other_rig import other_request, retake
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import console
from sliplab.flows.steps import StepDone
from sliplab.storage.schema.holdout import HoldoutResult
from sliplab.storage.trials.store import TrialStore

PROTOCOL_SEED, SKIN_SEED = 904_117_233, 730_915_402
"""Seeds of trials and of the skin. They must not be used anywhere else: not in a protocol, a rig, a
test, or a search. Replace both after looking at single trials of it."""


class HeldOut(StepDone):
    """The figures of the campaign, and the file that stores them; `done` is 1 if made now."""

    file: str
    result: HoldoutResult


def measure_holdout(
    store: TrialStore,
    campaigns: list[Collected],
    trials: int,
    again: bool = False,
    seeds: tuple[int, int] = (PROTOCOL_SEED, SKIN_SEED),
) -> HeldOut:
    """Judge the campaign, unless this version of the program did so already.

    Args:
        trials: how many, spread over the conditions of the first campaign of slides.
        again: also where it did, with another network or other settings: the ledger has it.
        seeds: of trials and skin; others than the release's are for tests of this program.

    Raises:
        StoreError: not simulated, or not evaluated yet.
    """
    work, current = Holdout(store, campaigns, trials, seeds), version("sliplab")

    def measure() -> HoldoutResult:
        """Take the missing trials, label and judge them."""
        return work.score(*retake([holdout_request(work)]))

    sweep = task_sweep([SweepTask(NAME, work.key, measure)], work.results)
    done = 0
    if sweep.pending and work.judged_by(current) and not again:
        console.say(
            f"the hold-out campaign was judged with version {current} already, with "
            "another network or other settings; a second look would begin to choose by it. "
            f"`sliplab holdout {store.folder} --again` takes it and writes it down"
        )
    else:
        done = sweep.run()
    file = str(work.folder / f"{NAME}.json")
    return {"step": STEP, "done": done, "file": file, "result": work.result()}


def holdout_request(work: Holdout) -> RunRequest:
    """Return the study's protocol and rig with another seed and skin; all trials test."""
    trials, skin = work.seeds
    split = {"method": "ranked", "train": 0.0, "validation": 0.0, "test": 1.0}
    run_request = other_request(
        work.item,
        {"mock": {"scene": {"skin": {"seed": skin}}}},
        work.folder,
        protocol={"collection": {"seed": trials}, "analysis": {"split": split}},
    )
    chosen = sample_trials(run_request.plan, work.trials)
    return replace(run_request, only=frozenset(trial.id for trial in chosen))
