"""The same trials on a changed rig: only what was asked for differs."""

from __future__ import annotations

from pathlib import Path

from sliplab.analysis.campaigns import collected
from sliplab.flows.other_rig import other_request
from sliplab.plugins.simulation.settings import scene_of
from sliplab.storage.trials.store import TrialStore
from tests.flows.conftest import Ran


def test_only_what_is_asked_for_differs(ran: Ran, tmp_path: Path) -> None:
    (first, _), _ = ran
    (item,) = collected(TrialStore.open(first.store), [first.campaign])
    change = {"mock": {"scene": {"skin": {"seed": 77}}}}
    run_request = other_request(item, change, tmp_path / "other", most=3)
    assert (run_request.store, run_request.campaign, run_request.most) == (
        tmp_path / "other" / "store",
        "tiny",
        3,
    )
    assert run_request.plan.trials == first.plan.trials
    skin = scene_of(run_request.rig).scene.skin
    assert skin.seed == 77 != scene_of(first.rig).scene.skin.seed
    own = scene_of(first.rig).scene
    again = scene_of(run_request.rig).scene.model_copy(update={"skin": own.skin})
    assert skin.model_copy(update={"seed": own.skin.seed}) == own.skin
    assert again == own
    assert scene_of(other_request(item, {}, tmp_path / "same").rig) == scene_of(first.rig)
