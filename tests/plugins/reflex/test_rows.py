"""What counts as a drop that was prevented, and what trials come to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sliplab.plugins.reflex.document import ReactionParts, ReflexStudy, ReflexTrial
from sliplab.plugins.reflex.rows import dropped, extra_force_n, reflex_rows
from sliplab.plugins.reflex.study import STUDY

T_MS = np.arange(0.0, 1000.0).tolist()


def trial(number: int, reflex: str | None = "stop", **said: Any) -> ReflexTrial:
    """A trial in which a reflex held the plate 100 ms after the first tip's slip."""
    parts = ReactionParts(window=100.0, sensor=20.0, network=1.0, command=0.5, actuator=30.0)
    data: dict[str, Any] = {
        "trial": f"r={number}",
        "mass_kg": 0.2,
        "speed_mm_s": 1.0,
        "detector": None if reflex is None else "network",
        "reflex": reflex,
        "slip_ms": 300.0,
        "detected_ms": None if reflex is None else 400.0,
        "gross_ms": None,
        "dropped": reflex is None,
        "fallen_mm": 25.0 if reflex is None else 0.2,
        "extra_n": None if reflex is None else 1.0,
        "parts": None if reflex is None else parts,
        "heights_mm": (0.0, -0.1),
        "step_ms": 20,
    }
    return ReflexTrial.model_validate({**data, **said})


def never(number: int, detector: str) -> ReflexTrial:
    """A trial whose detector said nothing."""
    return trial(
        number, detector=detector, detected_ms=None, parts=None, dropped=True, extra_n=None
    )


# -- detectors that know nothing -------------------------------------------------------------


def test_who_cries_always_or_never_prevents_nothing() -> None:
    """A reflex before any slip holds every plate, and is no answer to slip."""
    bare = [trial(k, None) for k in range(4)]
    always = [trial(k, detector="always", detected_ms=10.0) for k in range(4)]
    silent = [never(k, "never") for k in range(4)]
    slips = [trial(k, detector="slip") for k in range(4)]
    none, cries, says_nothing, sees = reflex_rows([*bare, *always, *silent, *slips])
    assert (none.dropped, none.prevented, none.missed) == (4, 0, 4)
    assert (cries.dropped, cries.early, cries.prevented, cries.share) == (0, 4, 0, 0.0)
    assert cries.reaction is None
    assert (says_nothing.missed, says_nothing.prevented) == (4, 0)
    assert (sees.prevented, sees.share) == (4, 1.0)
    assert sees.low == pytest.approx(0.025**0.25)  # Clopper and Pearson of 4 of 4
    assert sees.total_ms == pytest.approx(151.5)
    assert sees.computer_p99_ms == pytest.approx(1.5)


def test_a_plate_that_nothing_drops_is_no_drop_prevented() -> None:
    bare = [trial(0, None), trial(1, None, dropped=False)]
    held = [trial(0), trial(1)]
    row = reflex_rows([*bare, *held])[1]
    assert (row.would_drop, row.prevented) == (1, 1)


def test_a_reflex_where_nothing_slipped_is_early() -> None:
    assert trial(0, slip_ms=None).early
    assert trial(0, detected_ms=299.0).early
    assert not trial(0, detected_ms=300.0).early
    assert not trial(0, None).early


# -- drops and forces ------------------------------------------------------------------------


def test_a_plate_that_still_slides_has_dropped() -> None:
    creeping = [-1.0 - 0.05e-3 * t for t in T_MS]  # 0.05 mm/s
    sliding = [-1.0 - 0.2e-3 * t for t in T_MS]
    at_stop = [max(-25.0, -0.1 * t) for t in T_MS]
    caught = [max(-10.0, -0.1 * t) for t in T_MS]
    assert [dropped(T_MS, it, 25.0) for it in (creeping, sliding, at_stop, caught)] == [
        False,
        True,
        True,
        False,
    ]


def test_extra_force_is_that_after_the_trigger() -> None:
    before = [5.0 if t < 400 else 3.0 for t in T_MS]
    assert extra_force_n(T_MS, before, 500.0) == 0.0
    gripped = [3.0 if t < 600 else 4.5 for t in T_MS]
    assert extra_force_n(T_MS, gripped, 500.0) == pytest.approx(1.5)
    assert extra_force_n(T_MS, gripped, 5000.0) == 0.0


# -- the page --------------------------------------------------------------------------------


def test_the_page_says_that_it_is_simulated_and_holds_every_row() -> None:
    trials = {f"{k} {r}": trial(k, r) for k in range(3) for r in (None, "stop", "grip:0.4")}
    study = ReflexStudy(
        simulated=True,
        rig="mock-gripper",
        protocol="reflex",
        virtual_time=True,
        detectors={"network": "0" * 64},
        rows=reflex_rows(trials.values()),
        trials=trials,
    )
    text = STUDY.render(study)
    for part in ("simulated", "grip:0.4 (network)", "3 of 3 (29 to 100 %)", "no reflex", "p99"):
        assert part in text
    again = ReflexStudy.model_validate(study.to_json())
    assert again.rows == study.rows


def test_a_study_without_a_reflex_has_a_page() -> None:
    trials = {"0": trial(0, None, dropped=False)}
    study = ReflexStudy(
        simulated=True,
        rig="r",
        protocol="p",
        virtual_time=False,
        detectors={},
        rows=reflex_rows(trials.values()),
        trials=trials,
    )
    assert "Reaction time" not in STUDY.render(study)
