"""What a twin's pilot asks for: pilots that were simulated with an effect, and without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.scene_tradeoff.page import choice_pairs
from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.document import CheapestScene, EffectNeed
from sliplab.plugins.twin.effects import EFFECTS
from sliplab.plugins.twin.needs import flow as needs
from sliplab.plugins.twin.needs.judging import Marks, Need, marks
from sliplab.plugins.twin.worlds import DrawnWorld, Slides, guess_of, other_rig
from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import load_rig_file
from tests.flows.conftest import tiny, write
from tests.patching import loose

pytestmark = pytest.mark.long

WORLDS, TRIALS = 5, 6
STILL = {"arm": {"vibration_um": 0.0}}
TREMBLING, ROUGH = "vibration of the arm", "friction that varies along a path"


@pytest.fixture(scope="module")
def worlds(rig_path: Path, tmp_path_factory: pytest.TempPathFactory) -> list[DrawnWorld]:
    """A twin whose arm trembles strongly, without an event camera, which takes most of the time."""
    plan = load_plan(write(tmp_path_factory.mktemp("needs") / "tiny.yaml", tiny()))
    own, _ = load_rig_file(rig_path)
    rig = changed(other_rig(own, {}, {}), {"arm": {"vibration_um": 60.0}})
    slides = Slides(plan, tuple(plan.trials[:TRIALS]), frozenset())
    return [DrawnWorld(rig, slides, seed, guess_of(own)) for seed in range(WORLDS)]


@pytest.fixture(scope="module")
def taken(worlds: list[DrawnWorld]) -> list[list[Marks]]:
    return [[marks(trial) for trial in world.take()] for world in worlds]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two effects, worlds in this process, and scenes that take the stated times."""

    def seconds(rig: Any, *_: Any) -> float:
        trembles = scene_of(rig).arm.vibration_um > 0.0
        return 0.1 + 0.1 * trembles + 0.05 * (scene_of(rig).scene.friction.path_variation > 0.0)

    two = tuple(it for it in EFFECTS if it.key in {"vibration", "path"})
    monkeypatch.setattr("sliplab.plugins.twin.effects.EFFECTS", two)
    monkeypatch.setattr("sliplab.plugins.twin.effects.LONG_STEP_MS", 0)
    monkeypatch.setattr(needs, "everywhere", lambda _, work, jobs: [work(job) for job in jobs])
    monkeypatch.setattr(needs, "timed", seconds)


def written(twin: Path, found: needs.Needs) -> Path:
    twin.write_text("extends: rehearsal\nname: twin\nmock: {scene: {level: L3}}\n")
    needs.write_cheapest(twin, found)
    return needs.cheapest_path(twin)


def test_effects_that_the_pilot_has_are_asked_for(
    worlds: list[DrawnWorld], taken: list[list[Marks]], quick: None, tmp_path: Path
) -> None:
    pilot = replace(worlds[0], seed=99).take()
    found = needs.measure_needs(pilot, worlds, taken)
    said = {it.title: (it.verdict, it.shown_by) for it in found.effects}
    assert said[TREMBLING] == said[ROUGH] == ("asked for", "motion")
    assert said["dynamics of the falling plate"] == ("not shown", "gravity trials")
    # nothing can be left out: a file of an earlier fit would say otherwise
    assert found.cheapest is None
    needs.cheapest_path(tmp_path / "twin.yaml").write_text("extends: twin.yaml\n")
    assert not written(tmp_path / "twin.yaml", found).exists()


def test_an_effect_that_the_pilot_lacks_is_left_out_of_the_cheapest_scene(
    worlds: list[DrawnWorld], taken: list[list[Marks]], quick: None, tmp_path: Path
) -> None:
    pilot = replace(worlds[0], rig=changed(worlds[0].rig, STILL), seed=99).take()
    found = needs.measure_needs(pilot, worlds, taken)
    said = {it.title: (it.verdict, it.left_out) for it in found.effects}
    assert said[TREMBLING] == ("not asked for", True)
    assert said[ROUGH] == ("asked for", False)
    assert found.cheapest is not None
    assert found.cheapest.time == pytest.approx(0.6)
    assert found.cheapest.loss < 0.0
    path = written(tmp_path / "twin.yaml", found)
    said_of_it = f"twin.yaml without\n#   {TREMBLING}\n# A slide takes 0.60 of the twin's time"
    assert said_of_it in path.read_text()
    rig, _ = load_rig_file(path)
    assert rig.name == "twin-cheapest"
    assert scene_of(rig).arm.vibration_um == 0.0
    assert scene_of(rig).scene.friction.path_variation > 0.0
    assert scene_of(rig).scene.level == "L3"


def test_what_is_asked_for_together_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three effects two stand for each other: one of them, the one with more loss, is kept."""
    one, two, three = EFFECTS[:3]
    alone = {effect: _need(loss) for effect, loss in ((one, -0.1), (two, 0.01), (three, 0.0))}

    class Judged:
        def without(self, effects: Sequence[Any], beside: Any) -> list[Any]:
            skin = effects[0].without["scene"].get("skin", {})
            friction = effects[0].without["scene"].get("friction", {})
            both = "relaxation_share" in skin and "static_excess" in friction
            return [_need(0.5 if both else 0.0)]

        def seconds(self, settings: Sequence[Any]) -> list[float]:
            return [1.0, 0.5]

    left, cheapest = loose(needs)._cheapest(Judged(), [one, two, three], alone, {})
    assert left == [one, three]
    assert cheapest is not None
    assert cheapest.time == 0.5


def _need(loss: float) -> Need:
    return Need(loss, loss - 0.01, loss + 0.01, 0.02, 1.0, "slips")


def test_large_deflection_is_only_left_out_with_all_that_its_level_lacks() -> None:
    chosen = {effect.key: effect for effect in EFFECTS}
    bending = chosen["bending"]
    assert needs._whole([bending, chosen["relaxation"]]) == [chosen["relaxation"]]
    rich = [chosen[key] for key in ("relaxation", "stick_slip", "speed")]
    assert needs._whole([bending, *rich]) == [bending, *rich]


def test_too_few_test_trials_say_nothing(
    worlds: list[DrawnWorld], taken: list[list[Marks]], tmp_path: Path
) -> None:
    pilot = worlds[0].take()[:2]
    found = needs.measure_needs(pilot, worlds, [world[:2] for world in taken])
    assert found == needs.Needs()
    assert not written(tmp_path / "twin.yaml", found).exists()


def test_a_trade_off_on_a_twin_says_what_its_pilot_asked_for() -> None:
    choice = {"level": "L2", "reason": "so"}
    result = {"choice": {"measured": choice, "closed_form": choice}}
    assert "asked for by the twin's pilot" not in choice_pairs({**result, "needs": {}})
    found = {"relaxation": "asked for", "hot pixels": "not shown"}
    assert choice_pairs({**result, "needs": found})["asked for by the twin's pilot"] == "relaxation"
    none = {"relaxation": "not asked for"}
    assert choice_pairs({**result, "needs": none})["asked for by the twin's pilot"] == "no effect"


def test_documents_of_needs_are_read_as_they_were_written() -> None:
    whole = EffectNeed(
        title="a",
        verdict="asked for",
        shown_by="slips",
        loss=1.0,
        low=0.5,
        high=1.5,
        limit=0.1,
        time=0.9,
    )
    for it in (whole, EffectNeed(title="b", verdict="not in the scene")):
        assert EffectNeed.model_validate(it.model_dump(mode="json")) == it
    cheap = CheapestScene(loss=0.0, low=-0.1, high=0.1, seconds=0.2, time=0.8)
    assert CheapestScene.model_validate(cheap.model_dump(mode="json")) == cheap
