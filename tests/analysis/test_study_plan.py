"""A study's expected seconds by step."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sliplab.analysis.evaluation import holdout
from sliplab.analysis.labels.label_errors import CHECK
from sliplab.analysis.study_plan import PlannedCampaign, StudyPlan
from sliplab.protocols import load_plan
from sliplab.protocols.shipped import shipped_protocols

FILES = shipped_protocols()
SLIDES, FALLS = (
    PlannedCampaign(name, load_plan(FILES[name]), "tracks", simulated=True, in_virtual_time=True)
    for name in ("pilot", "pilot_gravity")
)


def test_seconds_stand_in_the_order_of_the_steps_and_grow_with_the_work() -> None:
    slides, falls = len(SLIDES.plan.trials), len(FALLS.plan.trials)
    plain = StudyPlan([SLIDES, FALLS]).expected(0)
    assert list(plain) == [
        "collect pilot",
        "collect pilot_gravity",
        "sync",
        "label",
        "train",
        "evaluate",
        "report",
    ]
    assert plain["collect pilot"] == pytest.approx(4.0 + 0.3 * slides)
    assert plain["label"] == pytest.approx(4.0 + 0.2 * (slides + falls))
    assert plain["report"] == 4.0
    settings = SLIDES.plan.protocol.analysis
    trained = [trial for trial in SLIDES.plan if trial.split == "train"]
    windows = 3 * settings.samples.per_class * len(trained)
    assert settings.comparison_settings() is not None  # one network more
    networks = len(settings.training.seeds) + 1
    seconds = windows * settings.training.epochs * networks / 1500.0
    assert plain["train"] == pytest.approx(4.0 + seconds)
    more = StudyPlan([SLIDES, FALLS]).expected(10, holdout=144)
    assert list(more)[4:8] == [CHECK, "train", "evaluate", holdout.STEP]
    assert more[CHECK] == pytest.approx(4.0 + 10 * 6.5)
    assert more[holdout.STEP] == pytest.approx(4.0 + 144 * 0.545)


def test_a_real_rig_takes_what_is_planned() -> None:
    real = replace(SLIDES, source="video", simulated=False, in_virtual_time=False)
    seconds = StudyPlan([real]).expected(0)
    assert seconds["collect pilot"] == pytest.approx(4.0 + real.plan.total_seconds)


def test_only_slides_are_trained_on() -> None:
    assert StudyPlan([FALLS]).training_windows == 0
    assert StudyPlan([FALLS]).expected(0)["train"] == 4.0
