"""The page about clocks with what a good rig never shows: no wire, lost pulses, refusals."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report import clocks
from sliplab.analysis.report.clock_page import render
from sliplab.analysis.report.clock_trials import DeviceClocks, TrialClocks
from sliplab.analysis.report.figures.clocks import pooled
from sliplab.storage.files import write_json
from sliplab.storage.schema.summary import Sync
from sliplab.storage.trials.checksums import RECORD
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Campaign
from tests.storage.trial_files import record


@dataclass(frozen=True)
class Made(TrialClocks):
    """A trial whose residuals are here, not in a store."""

    given: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def residuals(self) -> dict[str, Any]:
        """As if read from the store."""
        return self.given


@dataclass(frozen=True)
class Folder:
    """A campaign of which the page needs no more than its quarantine."""

    name: str
    campaign: Campaign


def device(
    grade: str, uncertainty: float, gate: float, drift: float, pulses: tuple[int, int, int] | None
) -> DeviceClocks:
    """One device; without pulses it has no wire."""
    kinds = ("missed", "late", "spurious")
    known = None if pulses is None else {"seen": 90, **dict(zip(kinds, pulses, strict=True))}
    kind = "95 %" if pulses is not None else "hard bound"
    return DeviceClocks(grade, kind, uncertainty, gate, drift, known)


def made(campaign: str, count: int, *, wired: bool) -> list[TrialClocks]:
    """Trials whose clocks wander; the third one missed pulses, the second is refused now."""
    rng = np.random.default_rng(5)
    trials: list[TrialClocks] = []
    for k in range(count):
        time_s = np.linspace(0, 6, 90)
        warm = 3 * (1 - np.exp(-k / 40)) + rng.normal(0, 0.05)
        grade, wide = ("exposure line", 1.0) if wired else ("device time stamps", 600.0)
        arm = ("digital input", 2.0, 1000.0) if wired else ("host time", 9000.0, 15000.0)
        missed = (int(rng.poisson(0.4)) + 9 * (k == 2), int(rng.poisson(0.1)), 0)
        pulses = (0, 1, 0) if wired else None
        shown = {
            "events": ("trigger input", 0.6 + rng.exponential(0.2), 1000.0, warm - 25, missed),
            "frames": (grade, wide * (1 + rng.exponential(0.3)), 5000.0, warm, pulses),
            "arm": (arm[0], arm[1] * (1 + rng.exponential(0.1)), arm[2], warm - 43, pulses),
        }
        devices = {name: device(*values) for name, values in shown.items()}
        refused = {"frames": "residuals: a clock jumped"} if k == 1 else {}
        late = int(rng.poisson(0.05))
        residuals = {
            f"{name}{unit}": values
            for name in (("events", "frames", "arm") if wired else ("events",))
            for unit, values in (("_s", time_s), ("_us", rng.normal(0, 2, 90)))
        }
        name, where = f"depth=2.4mm,direction={k}deg,r=1", Derived(Path("nowhere"))
        known = (campaign, name, k + 1, devices, k == 0, refused, late, where, residuals)
        trials.append(Made(*known))
    return trials


def set_aside(folder: Path, name: str, gates: dict[str, Any]) -> None:
    """An attempt in quarantine."""
    path = folder / "quarantine" / f"{name}.1"
    path.mkdir(parents=True)
    write_json(path / RECORD, record(name, quality={"passed": False, "gates": gates}).to_json())
    write_json(path / "cause.json", {"cause": "gate: something", "trial": name, "attempt": 1})


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two campaigns, of which the second has wires to the event camera alone."""
    tmp_path = tmp_path_factory.mktemp("page")
    far = {"value": 0.0042, "limit": 0.001, "grade": "digital input", "passed": False}
    none = {"value": "ambiguous: the train fits twice", "limit": None, "passed": False}
    set_aside(tmp_path, "r=1", {"sync_uncertainty_arm_s": far})
    set_aside(tmp_path, "r=2", {"sync_uncertainty_frames_s": none})
    beyond = {"value": 0.75, "limit": 0.3, "passed": False}
    set_aside(tmp_path, "r=3", {"sync_unvouched_s": beyond})
    lost = {"value": 3, "limit": 0, "passed": False}
    set_aside(tmp_path, "r=4", {"frames_lost": lost})
    campaigns = [
        Folder(name, Campaign(where))
        for name, where in (("wired", tmp_path), ("unwired", tmp_path / "none"))
    ]
    trials = {"wired": made("wired", 120, wired=True), "unwired": made("unwired", 60, wired=False)}
    return render(cast("list[Collected]", campaigns), trials, simulated=False)


def test_grades_stand_wherever_an_uncertainty_does(page: str) -> None:
    for words in ("frames, device time stamps or exposure line", "arm, digital input or host time"):
        assert page.count(words) >= 4  # the numbers on top, and three figures
    assert page.count("(host time)</td>") == page.count("(device time stamps)</td>") == 10
    assert '<td class="text">host time</td><td>hard bound</td>' in page
    assert ">simulated<" not in page


def test_quarantine_is_told_in_words(page: str) -> None:
    assert "arm (digital input): uncertain by 4200.0 µs, 1000 µs are allowed" in page
    assert "frames has no clock: ambiguous: the train fits twice" in page
    assert "continues for 0.75 s beyond the pulses" in page
    assert ">r=4</td>" not in page  # lost frames are no matter of clocks


def test_a_refusal_of_a_committed_trial_is_told(page: str) -> None:
    assert "frames cannot be fitted again (residuals: a clock jumped)" in page
    assert page.count("the record&#39;s clock is in use") == 2


def test_the_worst_trials_come_first(page: str) -> None:
    rows = page[: page.index("most missed first")].rpartition("<tbody>")[2].split("</tr>")
    assert all("direction=2deg" in row for row in rows[:2])
    assert "direction=2deg" not in rows[2]


def test_pooled_residuals_are_the_quantiles_of_every_stretch() -> None:
    rng = np.random.default_rng(1)
    time_s = rng.uniform(0, 10, 200_000)
    values = rng.normal(time_s, 2.0)
    middle, low, median, high = pooled(time_s, values)
    assert len(middle) == 40
    np.testing.assert_allclose(median, middle, atol=0.15)
    np.testing.assert_allclose(high - low, 2 * 1.96 * 2.0, rtol=0.1)


def sync(grade: str, uncertainty: float) -> Sync:
    """The clocks of a summary."""
    return Sync(
        grade=grade,
        grades={"events": "trigger input", "frames": grade, "arm": "digital input"},
        worst_uncertainty_us=uncertainty,
        worst_against_events_us={"events": 0.5, "frames": uncertainty, "arm": 1.0},
    )


def test_a_latency_without_a_wire_says_so() -> None:
    wired, unwired = sync("hardware trigger", 2.0), sync("host arrival", 12_345.6)
    assert clocks.short_note(wired) == "frames: hardware trigger"
    assert "No wire" not in clocks.latency_note(wired)
    assert clocks.figure_note(wired) == ""
    assert clocks.short_note(unwired) == "frames: host arrival, within 12345.6 µs"
    for note in (clocks.latency_note(unwired), clocks.figure_note(unwired)):
        assert "host arrival" in note
        assert "within 12345.6 µs" in note
        assert "No wire ties these frames to the events" in note
    assert clocks.unwired(sync("hardware trigger or host arrival", 1.0))
    assert clocks.worst_clock(unwired) == ("12345.6 µs", "events against frames (host arrival)")
