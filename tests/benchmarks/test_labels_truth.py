"""A small share of what `python -m benchmarks labels_truth` measures: labels against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.labels_summary import summary, tables, verdicts
from benchmarks.labels_truth import GLARE, NUISANCES, ROOT, check
from sliplab.analysis.sweeps.runner import sample_trials
from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import load_rig_file


@pytest.mark.long
def test_two_slides_against_the_truth() -> None:
    """One as the rig gives it, one with glare, hidden markers and a trembling camera."""
    plan = load_plan(ROOT / "protocols" / "kinematic.yaml")
    rig, _ = load_rig_file(ROOT / "rigs" / "mock.yaml")
    fast = [trial for trial in sample_trials(plan, 12) if "speed=1.6" in trial.id]
    clean = check((rig, plan, fast[0], NUISANCES, False))
    assert clean.error_px < 0.05
    assert clean.swaps == 0
    assert np.nanmax(np.abs(clean.crossed_ms)) <= 20.0
    assert np.nanmedian(np.abs(clean.slip_ms)) < np.nanmedian(clean.paper_ms) / 3
    assert set(clean.wrong.values()) == {"right"}
    figures = summary([clean])
    assert figures["slips"] == 19
    assert figures["coverage_95"] > 0.75
    hard = check((rig, plan, fast[1], GLARE, True))
    assert hard.swaps == 0
    assert all(counts["wrong"] == 0 for counts in verdicts([hard]).values())
    assert "1.6 mm/s" in tables(([clean], [], [hard]))
