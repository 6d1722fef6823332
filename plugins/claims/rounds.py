"""Claims of a campaign while it is collected: which trials next, and when it may end.

Figures of each trial are computed in another process while the arm continues. Between two rounds
the claims are evaluated, by methods that allow interim looks. An adaptive campaign chooses a batch
by the figures of the batches before the last one, so that it need not wait for the last one's
figures, and a resumed campaign chooses the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np

from sliplab.analysis.trial_work import TrialWork
from sliplab.flows.collecting.requests import CampaignStopped
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.running import console, stopping
from sliplab.plugins.claims import trial_figures as figures
from sliplab.plugins.claims.blocks import F64
from sliplab.plugins.claims.choosing import next_batch
from sliplab.plugins.claims.document import (
    TARGET,
    ChoiceRecord,
    ClaimState,
    Look,
    StoppingRecord,
    TrialFigures,
)
from sliplab.plugins.claims.evidence import ClaimEvidence, TrialGrid
from sliplab.plugins.claims.shown import count_text, verdict_text
from sliplab.plugins.claims.states import Fits, settled, states
from sliplab.protocols import PlannedTrial
from sliplab.protocols.claims import Stopping, section_hash
from sliplab.storage.files import write_json
from sliplab.storage.process import out_of_reach
from sliplab.storage.schema.campaign_end import CHOICES, STOPPING, Verdict
from sliplab.storage.spawn_context import WORKERS
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Campaign, TrialStore

WAIT_S = 600.0
"""Longest wait for the figures of a trial."""


class ClaimWatch:
    """Decides which trials of a protocol with claims are taken, and when the campaign ends.

    Use as a context: it owns the process that makes the figures. It is the hook `more_trials`.
    """

    def __init__(self, run_request: RunRequest, store: TrialStore, campaign: Campaign) -> None:
        collection = run_request.plan.protocol.collection
        assert collection.stopping is not None
        self._run_request, self._store, self._campaign = run_request, store, campaign
        self._stopping: Stopping = collection.stopping
        self._choice = collection.adaptive
        analysis = run_request.plan.protocol.analysis
        self._judge = figures.Judge(analysis, run_request.judging_model)
        self._grid = TrialGrid.of(run_request.plan)
        self._batches = ChoiceRecord.of(campaign.folder).batches
        self._kept = Derived.of(store, figures.STEP, campaign.name)
        self._making: dict[str, Future[TrialFigures]] = {}
        self._fits: Fits = {}
        self._known = False
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        """Begin the process that makes figures."""
        self._pool = ProcessPoolExecutor(1, WORKERS, initializer=stopping.leave_to_parent)
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=not stopping.requested(), cancel_futures=True)

    def committed(self, trial: PlannedTrial) -> None:
        """Begin to make the figures of a trial that was just committed."""
        from sliplab.flows.running.parallel_map import make_in_process, trial_job  # loads Prefect

        self._known = False
        if trial.role == "measured" and trial.id not in self._making and self._pool is not None:
            work = self._work(trial.id)
            if not self._kept.fresh(trial.id, work.key):
                job = trial_job(self._store, work, figures.trial_figures)
                with out_of_reach():  # the first one starts the process
                    self._making[trial.id] = self._pool.submit(make_in_process, job)

    def _work(self, trial: str) -> TrialWork:
        return self._judge.work(self._campaign.recording(trial), self._campaign.name)

    def _figures(self, trial: str) -> TrialFigures:
        """Return the figures of a committed trial; make them if need be.

        Raises:
            CampaignStopped: they cannot be made.
        """
        work = self._work(trial)
        if not self._kept.fresh(trial, work.key):
            self.committed(self._grid.trials[self._grid.number[trial]])
            try:
                made = self._making.pop(trial).result(timeout=WAIT_S)
            except Exception as error:
                raise CampaignStopped(
                    f"campaign {self._campaign.name}: the figures of {trial} that its claims need "
                    f"could not be made: {type(error).__name__}: {error}. `sliplab skip` leaves it "
                    "out, --no-stopping continues without looking at the claims"
                ) from error
            self._kept.write(trial, work.key, made)
        return TrialFigures.model_validate(self._kept.read(trial))

    def next_trials(self) -> list[PlannedTrial]:
        """Return the pending trials of the earliest incomplete round; none at the end."""
        pending = {trial.id for trial in pending_trials(self._run_request.plan, self._campaign)}
        begun, last = 0, -1
        for last, trials in enumerate(self._rounds()):
            if left := [trial for trial in trials if trial.id in pending]:
                return left
            begun += sum(trial.role == "measured" for trial in trials)
            room = (
                self._stopping.most is None
                or begun + self._round_size(last + 1) <= self._stopping.most
            )
            if self._look(last - self._late, "open" if room else "most") in ("settled", "most"):
                self._look(last, "most")
                return []
        self._look(last, "all")
        return []

    @property
    def _late(self) -> int:
        """Number of rounds whose figures are waited for while the next one is taken."""
        return 0 if self._choice is None else 1

    def _rounds(self) -> Iterator[list[PlannedTrial]]:
        """Yield the trials of each round, references among them; an adaptive one is chosen then."""
        if self._choice is None:
            yield from self._planned
            return
        stretches = self._grid.stretches
        number = 0
        while (chosen := self._chosen(number * stretches, stretches)) is not None:
            yield chosen
            number += 1

    @cached_property
    def _planned(self) -> list[list[PlannedTrial]]:
        """The plan's trials by round."""
        rounds: list[list[PlannedTrial]] = []
        waiting: list[
            PlannedTrial
        ] = []  # a reference trial comes before the one that it belongs to
        for trial in self._run_request.plan:
            waiting.append(trial)
            if trial.role == "measured":
                number = (trial.repetition - 1) // self._stopping.repetitions
                rounds += [[] for _ in range(number + 1 - len(rounds))]
                rounds[number] += waiting
                waiting = []
        return rounds

    # choice

    def _chosen(self, first: int, count: int) -> list[PlannedTrial] | None:
        """Return the trials of some batches by number; choose those that are missing."""
        assert self._choice is not None
        batches = list(self._batches)
        seed = self._run_request.plan.seed
        known = self._evidence(first // count - 2)
        while len(batches) < first + count:
            batch = next_batch(known, batches, self._stopping, self._choice, seed, self._fits)
            if batch is None:
                break
            batches.append(batch)
        if len(batches) > len(self._batches):
            self._batches = tuple(batches)
            record = ChoiceRecord(simulated=self._run_request.rig.simulated, batches=self._batches)
            write_json(self._campaign.folder / CHOICES, record.to_json())
        found = self._in_order()
        wanted = {item.trial for batch in batches[first : first + count] for item in batch.trials}
        return [trial for before, trial in found if before in wanted] or None

    def _in_order(self) -> list[tuple[str, PlannedTrial]]:
        """Return chosen trials and references by place, each with the chosen one it belongs to."""
        plan = self._run_request.plan
        every = plan.protocol.collection.references
        references = iter([trial for trial in plan if trial.role == "reference"])
        found: list[tuple[str, PlannedTrial]] = []
        ids = [item.trial for batch in self._batches for item in batch.trials]
        for taken, name in enumerate(ids):
            if every is not None and taken % every.every == 0:
                found.append((name, next(references)))
            found.append((name, self._grid.trials[self._grid.number[name]]))
        return [(name, replace(trial, index=place)) for place, (name, trial) in enumerate(found)]

    # evidence and looks

    def _evidence(self, last: int) -> ClaimEvidence:
        """Return the evidence of the rounds up to one."""
        grid, there = self._grid, self._campaign.committed()
        taken: list[int] = []
        looks: list[int] = []
        chances: F64 | None = None
        if self._choice is None:
            for trials in self._planned[: last + 1]:
                ids = [trial.id for trial in trials if trial.role == "measured"]
                taken += [grid.number[name] for name in ids]
                looks.append(len(taken))
        else:
            batches = self._batches[: max(last + 1, 0) * grid.stretches]
            items = [item for batch in batches for item in batch.trials]
            taken = [grid.number[item.trial] for item in items]
            sizes = np.cumsum([len(batch.trials) for batch in batches])
            looks = [int(n) for n in sizes[grid.stretches - 1 :: grid.stretches]]
            if len(sizes) % grid.stretches:
                looks.append(int(sizes[-1]))
            chances = np.array([_number(item.chance) for item in items], np.float64)
        none = TrialFigures(values={})
        names = [grid.trials[k].id for k in taken]
        made = [self._figures(name) if name in there else none for name in names]
        values: dict[str, F64] = {
            claim.figure: np.array([each.of(claim.figure) for each in made], np.float64)
            for claim in self._stopping.claims
        }
        return ClaimEvidence(
            grid,
            np.array(taken, np.int64),
            np.array(looks, np.int64),
            values,
            chances,
            self._stopping.block,
        )

    def _look(self, number: int, otherwise: Verdict) -> Verdict:
        """Look at the claims after a round, and all before it; keep what was seen.

        Args:
            otherwise: the verdict where not all claims are settled.
        """
        if number < 0:
            return otherwise
        record = self.record()
        looks = list(record.looks)
        if len(looks) <= number:
            evidence, there = self._evidence(number), self._campaign.committed()
            for n in range(len(looks), len(evidence.looks)):
                seen = evidence.until(n)
                before = looks[-1].claims if looks else ()
                found = states(seen, self._stopping, self._fits, before)
                taken = sum(self._grid.trials[k].id in there for k in seen.taken)
                look = Look(round=n + 1, taken=taken, evidence=seen.digest(), claims=found)
                looks.append(look)
                self._say(looks[-1])
        done = looks[number].taken >= self._stopping.least and settled(looks[number].claims)
        verdict: Verdict = "settled" if done else otherwise
        if self._run_request.claims == "overrule" and verdict in ("settled", "most"):
            verdict = "overruled"
        if (verdict, len(looks)) != (record.verdict, len(record.looks)):
            made = record.model_copy(update={"verdict": verdict, "looks": tuple(looks)})
            write_json(self._campaign.folder / STOPPING, made.to_json())
        return verdict

    def _round_size(self, number: int) -> int:
        if self._choice is not None:
            return self._choice.batch * self._grid.stretches
        following = self._planned[number : number + 1]
        return sum(trial.role == "measured" for trials in following for trial in trials)

    def record(self) -> StoppingRecord:
        """Return the looks so far; none where claims, network or figures are other ones now."""
        empty = StoppingRecord(
            simulated=self._run_request.rig.simulated,
            section=section_hash(self._stopping),
            model=self._judge.model_hash,
            verdict="open",
            looks=(),
        )
        found = StoppingRecord.of(self._campaign.folder)
        if found is None or (found.section, found.model) != (empty.section, empty.model):
            return empty
        if found.looks and not self._known:  # a trial may have been taken again since
            seen = self._evidence(len(found.looks) - 1)
            if seen.digest() != found.looks[-1].evidence:
                return empty
        self._known = True
        return found

    def _say(self, look: Look) -> None:
        simulated = "simulated " if self._run_request.rig.simulated else ""
        console.say(f"after {look.taken} {simulated}trials, of {TARGET}:")
        for state in look.claims:
            console.say(f"  {stated(state)}")


def stated(state: ClaimState) -> str:
    """Return a claim's state as a line of text."""
    ends = ["-" if end is None else f"{end:.4g}" for end in (state.low, state.high)]
    value = "-" if state.estimate is None else f"{state.estimate:.4g}"
    found = f"{value} ({ends[0]} to {ends[1]})"
    return f"{state.claim}: {verdict_text(state)}; {found}; {count_text(state)}"


def _number(value: float | None) -> float:
    return math.nan if value is None else value
