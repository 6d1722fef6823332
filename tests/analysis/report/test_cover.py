"""The first sentences of a report: of trials that were tested, and of those that were not."""

from __future__ import annotations

import pytest

from sliplab.analysis.report.cover import slip_answer
from sliplab.analysis.report.outcomes import OUTCOMES
from sliplab.storage.schema.summary import Accounts, Experiment, Summary


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ({"not_taken": 1}, "Slides: 1 test trial planned, none taken and evaluated."),
        (
            {"not_taken": 2, "not_evaluated": 1},
            "Slides: 3 test trials planned, none taken and evaluated.",
        ),
        ({}, "There is no test trial: nothing was tested."),
    ],
)
def test_a_trial_that_was_not_taken_is_no_missed_one(counts: dict[str, int], said: str) -> None:
    accounts = Accounts(planned=sum(counts.values()), **(dict.fromkeys(OUTCOMES, 0) | counts))
    none = Experiment.model_construct(accounted=Accounts(planned=0, **dict.fromkeys(OUTCOMES, 0)))
    summary = Summary.model_construct(
        kinematic=Experiment.model_construct(accounted=accounts),
        gravity=none,
        disturbance=none,
        trials=(),
    )
    answer = slip_answer(summary)
    assert list(answer.sentences) == [said]
    assert answer.figure is None
