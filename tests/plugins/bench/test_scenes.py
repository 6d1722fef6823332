"""Scenes of the bench: frozen, drawn by seeds, with the truth at its time."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.detectors.detector import Scene
from sliplab.plugins.bench import definition, scenes
from sliplab.plugins.bench.definition import SIZES, ScenePart, Size
from sliplab.plugins.bench.nuisances import NUISANCES
from sliplab.protocols.hashing import hash_data

SIZE = Size(ScenePart(2, 2, 0), ScenePart(1, 2, 1), ScenePart(2, 2, 1), 1)


def test_version_2_is_frozen() -> None:
    sizes = {name: dataclasses.asdict(size) for name, size in SIZES.items()}
    found = hash_data([dataclasses.asdict(definition.DEFINITION), sizes])
    assert definition.VERSION == 2
    assert found[:16] == "9e1e3645dac66973", (
        "what changes the scenes is another version of the bench"
    )


def test_its_scenes_are_what_they_were() -> None:
    # another simulation gives other scenes: then it is another version, too
    first = scenes.simulated(scenes.training_scenes(SIZES["small"])[0][0])
    slip = first.slip
    assert (slip.physical_us, slip.paper_us, slip.gross_us) == pytest.approx(
        (7_805_270, 7_869_758, 13_419_878), abs=20
    )
    assert len(first.events) == pytest.approx(241_764, rel=1e-3)


def test_a_seed_draws_the_test_worlds_and_nothing_else() -> None:
    one, same, other = (scenes.test_scenes(SIZE, seed, "usual") for seed in (1, 1, 2))
    assert one == same
    assert not {drawn.rig.model_dump_json() for drawn in one} & {
        drawn.rig.model_dump_json() for drawn in other
    }
    known = {drawn.rig.model_dump_json() for part in scenes.training_scenes(SIZE) for drawn in part}
    assert not known & {drawn.rig.model_dump_json() for drawn in (*one, *other)}
    assert [drawn.name for drawn in one] == [drawn.name for drawn in other]


@pytest.mark.parametrize("worlds", ["creep", "stick-slip", "texture", "curved", "hard"])
def test_harder_worlds_differ_in_the_keys_of_their_effects_alone(worlds: str) -> None:
    usual, hard = (scenes.training_scenes(SIZE, it)[0] for it in ("usual", worlds))
    keys = {key for effect in definition.WORLDS[worlds] for key in definition.EFFECTS[effect]}
    for before, after in zip(usual, hard, strict=True):
        assert (after.seed, after.depth_mm, after.speed_mm_s) == (
            before.seed,
            before.depth_mm,
            before.speed_mm_s,
        )
        flat = [flattened(it.rig.model_dump()["mock"]) for it in (before, after)]
        changed = {key for key in flat[1] if flat[0].get(key) != flat[1][key]}
        assert changed <= keys
        assert len(changed) >= len(keys) - 1  # a draw may be the value that it was


def flattened(
    settings: Mapping[str, Any], above: tuple[str, ...] = ()
) -> dict[tuple[str, ...], Any]:
    """Return the values of nested settings by their keys."""
    found: dict[tuple[str, ...], Any] = {}
    for key, value in settings.items():
        inside = flattened(value, (*above, key)) if isinstance(value, dict) else None
        found |= inside if inside is not None else {(*above, key): value}
    return found


def test_a_larger_set_begins_with_the_worlds_of_a_smaller_one() -> None:
    more = dataclasses.replace(SIZE, train=ScenePart(3, 3, 0))
    few, many = scenes.training_scenes(SIZE)[0], scenes.training_scenes(more)[0]
    assert [drawn for drawn in many if drawn.name in {it.name for it in few}] == few


@pytest.fixture(scope="module")
def slides() -> list[Scene]:
    return [scenes.simulated(drawn) for drawn in scenes.test_scenes(SIZE, 1, "usual")]


def test_a_scene_repeats_to_the_event(slides: list[Scene]) -> None:
    again = scenes.simulated(scenes.test_scenes(SIZE, 1, "usual")[1])
    for name in ("x", "y", "p", "t_us"):
        assert np.array_equal(getattr(again.events, name), getattr(slides[1].events, name))
    assert again.slip == slides[1].slip


def test_a_tip_slips_in_the_motion_and_its_marker_moves_later(slides: list[Scene]) -> None:
    for drawn, scene in zip(scenes.test_scenes(SIZE, 1, "usual"), slides, strict=True):
        slip = scene.slip
        assert drawn.hold_s * 1e6 < slip.physical_us < slip.paper_us < slip.gross_us
        assert slip.gross_us <= scene.end_us
        # the marker of a tip that slides as fast as the arm needs 0.1 mm, as of the rig's 20 px/mm;
        # where friction falls, a bent tip springs ahead of it
        assert slip.paper_us - slip.physical_us >= 0.6e6 * 0.1 / drawn.speed_mm_s


def test_events_rise_when_the_arm_moves_and_not_before(slides: list[Scene]) -> None:
    for drawn, scene in zip(scenes.test_scenes(SIZE, 1, "usual"), slides, strict=True):
        moved_us = round(drawn.hold_s * 1e6)
        edges = np.searchsorted(
            scene.events.t_us, moved_us + np.array([-200_000, 0, 50_000, 250_000])
        )
        before, _, after = np.diff(edges)
        assert after > 1.5 * before


@pytest.mark.quick(2)
@pytest.mark.parametrize("name", NUISANCES)
def test_a_nuisance_changes_the_events_and_hardly_the_slip(name: str) -> None:
    (drawn,) = scenes.nuisance_scenes(SIZE, 1)[name]
    disturbed = scenes.simulated(drawn)
    clean = scenes.simulated(dataclasses.replace(drawn, faults=()))
    hold_us = 1e6 * drawn.hold_s
    if name in {"tap_table", "tap_arm", "vibration"}:  # these go through the contact
        assert disturbed.slip.gross_us == pytest.approx(clean.slip.gross_us, abs=5e5)
        assert disturbed.slip.physical_us >= 0.9 * hold_us
    else:
        assert disturbed.slip == clean.slip
    assert len(disturbed.events) != len(clean.events) or name == "flicker"
