"""The trade-off of a scene: small runs of the command's own code, and what it writes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import scene_parameters as sensitivity
from benchmarks.scene_tradeoff import run as tradeoff
from benchmarks.scene_tradeoff import sensitivity as scene_sensitivity
from benchmarks.scene_tradeoff.page import render, sensitivity_markdown
from benchmarks.scene_tradeoff.running import closed_form
from benchmarks.scene_tradeoff.variants import Variant
from sliplab.analysis.sweeps.runner import sample_trials
from sliplab.flows.running import stopping
from sliplab.plugins.simulation.scene_runs import changed, ideal, run
from sliplab.protocols.errors import InputError
from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import load_rig_file
from tests.flows.conftest import tiny, tiny_gravity, write

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def protocol(tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = tiny()
    data["collection"]["factors"]["depth"]["values"] = [2.4, 2.8]
    return write(tmp_path_factory.mktemp("protocol") / "tiny.yaml", data)


@pytest.fixture(scope="module")
def result(protocol: Path, rig_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("trade") / "new"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tradeoff, "ROUNDS", 1)
        found = tradeoff.tradeoff_scene(protocol, rig_path, folder, 1, steps=(1, 8))
    return found, folder


def test_trials_are_spread_over_the_levels(protocol: Path) -> None:
    plan = load_plan(protocol)
    chosen = sample_trials(plan, 6)
    assert len({dict(trial.condition)["direction"] for trial in chosen}) == 6
    depths = [str(dict(trial.condition)["depth"]) for trial in chosen]
    assert (depths.count("2.4"), depths.count("2.8")) == (3, 3)
    assert sample_trials(plan, 3) == chosen[:3]
    assert len(sample_trials(plan, 1000)) == len(plan)


def test_a_run_is_of_its_seed_alone_and_has_signal_only(protocol: Path, rig_path: Path) -> None:
    plan, (rig, _) = load_plan(protocol), load_rig_file(rig_path)
    (trial,) = sample_trials(plan, 1)
    variant = Variant(3, 4)
    still = ideal(changed(rig, variant.change))
    one, two = (run(still, plan, trial, variant.seed(trial)) for _ in range(2))
    assert one.events is not None
    assert two.events is not None
    assert np.array_equal(one.events.t_us, two.events.t_us)
    assert (one.slips, one.markers) == (two.slips, two.markers)
    # 1.5 s of hold, 7 mm at 1.6 mm/s; nothing but noise could fire before the motion
    assert (one.begin_us, one.end_us) == (-1_500_000, 4_375_000)
    assert one.events.t_us.min() > 0
    assert one.events.t_us.max() < one.end_us
    other = run(still, plan, trial, Variant(3, 4, other_seed=True).seed(trial))
    assert other.slips != one.slips


def test_closed_forms_are_near_the_scene_that_they_are_for(protocol: Path, rig_path: Path) -> None:
    plan, (rig, _) = load_plan(protocol), load_rig_file(rig_path)
    (trial,) = sample_trials(plan, 1)
    even = changed(rig, {"scene": {"friction": {"path_variation": 0.0, "strengthening": 0.0}}})
    reported = closed_form(even, plan, trial)
    assert reported is not None
    seen = run(ideal(changed(even, Variant(3, 1).change)), plan, trial, 1)
    assert None not in (*reported.onsets, *seen.slips)
    assert seen.slips == pytest.approx(reported.onsets, rel=0.01)


def test_the_numbers_say_what_was_asked(result: Any) -> None:
    found, folder = result
    assert found == json.loads((folder / tradeoff.NUMBERS).read_text())
    assert found["simulated"]
    assert len(found["trials"]) == 1
    rows = {(row["family"], row["name"]): row for row in found["variants"]}
    assert set(rows) == {
        ("levels", "L0"),
        ("levels", "L1"),
        ("levels", "L2"),
        ("levels", "L3"),
        ("cubic", "1"),
        ("cubic", "8"),
        ("chord", "1"),
        ("chord", "8"),
    }
    assert all(row["wall_s"] > 0 for row in rows.values())
    assert set(rows["cubic", "1"]["error"].values()) == {0.0}
    # the path between rows is the camera's alone
    for name in ("first_slip_ms", "centre_slip_ms", "flipped"):
        assert rows["chord", "8"]["error"][name] == rows["cubic", "8"]["error"][name]
    assert rows["chord", "1"]["error"]["event_median_us"] < 100
    assert rows["levels", "L0"]["error"]["tensor_l1"] is None
    levels = [rows["levels", f"L{k}"]["error"]["tensor_l1"] for k in (1, 2, 3)]
    assert levels[2] < min(levels[:2])
    assert found["choice"]["measured"]["level"] in {"L1", "L2", "L3"}
    agree = found["choice"]["measured"]["level"] == found["choice"]["closed_form"]["level"]
    assert found["choice"]["agree"] == agree
    windows = found["windows"]
    assert windows["ceiling"] == pytest.approx(1 - windows["hold_share"] / 3)
    assert windows["events_per_s"]["hold"] == 0.0
    assert windows["events_per_s"]["loading"] > 1000


def test_the_page_stands_alone_and_says_simulated(result: Any) -> None:
    found, folder = result
    page = (folder / tradeoff.PAGE).read_text()
    assert page == render(found)
    headings = re.findall(r"<h[12]>.*?</h[12]>", page)
    assert len(headings) == 4
    assert all("simulated" in heading for heading in headings)
    assert page.count("<svg") == 1
    outside = re.findall(r"(?:src|href)=\"(?!#)([^\"]*)", page)
    assert outside == []
    assert sorted(item.name for item in folder.iterdir()) == [tradeoff.PAGE, tradeoff.NUMBERS]


@pytest.mark.long
def test_a_falling_plate_is_measured_at_its_own_step(
    tmp_path: Path, rig_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tradeoff, "ROUNDS", 1)
    path = write(tmp_path / "p.yaml", tiny_gravity())
    found = tradeoff.tradeoff_scene(path, rig_path, tmp_path / "out", 1)
    families = [(row["family"], row["name"]) for row in found["variants"]]
    assert families == [
        *(("levels", f"L{k}") for k in range(4)),
        ("cubic", "2"),
        ("chord", "2"),
    ]
    assert any("by a millisecond" in sentence for sentence in found["left_out"])
    assert found["windows"]["samples"]["incipient"] > 0


def test_sensitivity_of_what_follows_from_the_law(
    protocol: Path, rig_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, (rig, _) = load_plan(protocol), load_rig_file(rig_path)
    monkeypatch.setattr(sensitivity, "CONTACT", ("scene.friction.kinetic",))
    camera = ("event_camera.shift_mm_per_n", "event_camera.noise_hz")
    monkeypatch.setattr(sensitivity, "CAMERA", camera)
    monkeypatch.setattr(scene_sensitivity, "EVENT_TRIALS", 1)
    quiet = changed(rig, {"event_camera": {"noise_hz": 0.0}})
    runs: list[int] = []
    found = scene_sensitivity.measure_sensitivity(quiet, plan, lambda: runs.append(1))
    rows = {row["parameter"]: row["change"] for row in found["rows"]}
    grip, shift = rows["scene.friction.kinetic"], rows["event_camera.shift_mm_per_n"]
    # u = mu N / k_t: slip comes later, nearly in proportion, with more friction
    assert grip[0]["first_slip_percent"] == pytest.approx(-20, abs=3)
    assert grip[1]["first_slip_percent"] == pytest.approx(20, abs=3)
    assert grip[1]["first_slip_ms"] > 0
    # the camera moves no onset; a longer way in the image crosses more thresholds
    assert [change["first_slip_ms"] for change in shift] == [0.0, 0.0]
    assert shift[0]["percent"]["loading"] < -10 < 10 < shift[1]["percent"]["loading"]
    assert rows["event_camera.noise_hz"] == [None, None]
    assert len(rows[sensitivity.OTHER_SEED]) == 1
    assert len(runs) == 2 + 4
    text = sensitivity_markdown(found)
    assert "simulated" in text
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len(table) == 2 + 4
    assert len({line.count("|") for line in table}) == 1


def test_a_stop_leaves_nothing_behind(
    protocol: Path, rig_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[int] = []

    def check() -> None:
        done.append(1)
        if len(done) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(stopping, "check", check)
    with pytest.raises(KeyboardInterrupt):
        tradeoff.tradeoff_scene(protocol, rig_path, tmp_path / "out", 1)
    assert len(done) == 2
    assert not (tmp_path / "out").exists()


def test_a_rig_that_is_none_is_said(protocol: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file, and not one of the shipped rigs"):
        tradeoff.tradeoff_scene(protocol, Path("nowhere"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    taken = tmp_path / "a file"
    taken.write_text("mine")
    with pytest.raises(InputError, match="--out"):
        tradeoff.tradeoff_scene(protocol, Path("mock"), taken)
    assert taken.read_text() == "mine"
