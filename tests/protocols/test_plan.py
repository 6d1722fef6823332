"""Plans: the product of the factors, balanced blocks, an order and a split that never move."""

import copy
import json
from collections import Counter
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.protocols import Dwell, InputError, Move, Plan, Protocol, load_plan, make_plan
from sliplab.protocols.yaml_file import validate
from tests.conftest import ROOT, SMALL
from tests.protocols.planning import said_by


def plan_of(data: dict[str, Any]) -> Plan:
    """A plan from protocol data."""
    return make_plan(validate(Protocol, data, "test.yaml"), "test.yaml")


def order_of(plan: Plan) -> list[str]:
    """Ids in order."""
    return [trial.id for trial in plan]


levels = st.lists(st.integers(1, 35), min_size=1, max_size=4, unique=True)


@st.composite
def protocols(draw: st.DrawFn) -> dict[str, Any]:
    """The pilot with other levels, repetitions, seed and order; some with changeovers."""
    data = copy.deepcopy(SMALL)
    collection = data["collection"]
    collection["factors"]["depth"]["values"] = [x / 10 for x in draw(levels)]
    collection["factors"]["speed"]["values"] = [x / 4 for x in draw(levels)]
    collection["factors"]["direction"]["values"] = [x * 10 for x in draw(levels)]
    collection["limits"]["duration"] = "1000 s"
    collection["repetitions"] = draw(st.integers(1, 4))
    collection["seed"] = draw(st.integers(0, 2**40))
    collection["order"] = draw(st.sampled_from(["shuffled", "listed"]))
    if draw(st.booleans()):
        collection["factors"]["speed"]["changeover"] = "person"
    return data


@given(protocols())
def test_a_plan_is_the_product_in_balanced_blocks(data: dict[str, Any]) -> None:
    plan = plan_of(data)
    factors = data["collection"]["factors"]
    repetitions = data["collection"]["repetitions"]
    cells = 1
    for factor in factors.values():
        cells *= len(factor["values"])
    assert len(plan) == cells * repetitions
    assert len({trial.id for trial in plan}) == len(plan)
    assert [trial.index for trial in plan] == list(range(len(plan)))
    conditions = Counter(trial.condition for trial in plan)
    assert len(conditions) == cells
    assert set(conditions.values()) == {repetitions}
    outer = [n for n in factors if factors[n].get("changeover") == "person"]
    blocks: dict[int, list[Any]] = {}
    for trial in plan:
        blocks.setdefault(trial.block, []).append(trial)
    share = cells
    for name in outer:
        share //= len(factors[name]["values"])
    for block in blocks.values():
        assert [t.index for t in block] == list(range(block[0].index, block[0].index + len(block)))
        assert len({t.condition for t in block}) == len(block) == share
        assert len({t.repetition for t in block}) == 1
        for name in outer:
            assert len({dict(t.condition)[name] for t in block}) == 1
    swaps = sum(len(plan.changeovers(a, b)) for a, b in pairwise(plan.trials))
    assert swaps == (len(factors[outer[0]]["values"]) - 1 if outer else 0)


@given(protocols(), st.sampled_from(["depth", "speed", "direction"]), st.integers(0, 3))
def test_an_added_level_moves_nothing(data: dict[str, Any], name: str, place: int) -> None:
    before = plan_of(data)
    new = {"depth": 0.05, "speed": 9.5, "direction": 359.5}[name]
    data["collection"]["factors"][name]["values"].insert(place, new)
    after = plan_of(data)
    old_ids = set(order_of(before))
    assert [i for i in order_of(after) if i in old_ids] == order_of(before)
    splits, seeds = ({t.id: getattr(t, key) for t in after} for key in ("split", "seed"))
    assert all(splits[t.id] == t.split and seeds[t.id] == t.seed for t in before)
    assert after.collection_hash == before.collection_hash


@pytest.mark.quick(1)
@pytest.mark.parametrize("hash_seed", ["0", "1", "4242"])
def test_the_order_is_the_same_in_any_process(hash_seed: str) -> None:
    code = (
        "import json; from pathlib import Path; from sliplab.protocols import load_plan;"
        "p = load_plan(Path('protocols/kinematic.yaml'));"
        "print(json.dumps([[t.id, t.split, t.seed] for t in p]))"
    )
    said = said_by(code, PYTHONHASHSEED=hash_seed)
    here = load_plan(ROOT / "protocols" / "kinematic.yaml")
    assert json.loads(said) == [[t.id, t.split, t.seed] for t in here]


SHIPPED = {"kinematic": 864, "gravity": 180, "disturbance": 80, "pilot": 36, "pilot_gravity": 8}


@pytest.mark.parametrize(("name", "count"), [*SHIPPED.items(), ("press_twist", 54)])
def test_shipped_protocols(name: str, count: int) -> None:
    plan = load_plan(ROOT / "protocols" / f"{name}.yaml")
    assert (plan.protocol.name, len(plan), plan.warnings()) == (name, count, [])


def test_the_optional_disturbance_level_adds_trials_only() -> None:
    path = ROOT / "protocols" / "disturbance.yaml"
    plain, more = load_plan(path), load_plan(path, ["disturbance=125"])
    assert len(more) == 100
    ids = set(order_of(plain))
    assert [i for i in order_of(more) if i in ids] == order_of(plain)
    assert more.collection_hash == plain.collection_hash
    with pytest.raises(InputError, match="optional levels: 125 percent"):
        load_plan(path, ["disturbance=130"])


def test_splits_of_the_full_grid() -> None:
    plan = load_plan(ROOT / "protocols" / "kinematic.yaml")
    whole = Counter(trial.split for trial in plan)
    assert abs(whole["train"] - 0.70 * 864) < 3
    assert abs(whole["validation"] - 0.15 * 864) < 6
    assert abs(whole["test"] - 0.15 * 864) < 6
    strata: dict[Any, Counter[str]] = {}
    for trial in plan:
        condition = dict(trial.condition)
        key = (condition["depth"], condition["speed"])
        strata.setdefault(key, Counter())[trial.split] += 1
    for counts in strata.values():
        assert 16 <= counts["train"] <= 18
        assert counts["validation"] >= 2
        assert counts["test"] >= 2


def test_conditions_can_be_left_out() -> None:
    data = copy.deepcopy(SMALL)
    split = {"method": "leave_conditions_out", "validation_levels": {"direction": ["90.0 deg"]}}
    data["analysis"]["split"] = {**split, "test_levels": {"depth": ["3.40 mm"]}}
    for trial in plan_of(data):
        condition = dict(trial.condition)
        held = condition["depth"] == Decimal("3.4")
        chosen = condition["direction"] == 90
        assert trial.split == ("test" if held else "validation" if chosen else "train")


def test_analysis_cannot_touch_the_collection() -> None:
    data = copy.deepcopy(SMALL)
    before = plan_of(data)
    data["analysis"]["detection"]["margin"] = 3
    after = plan_of(data)
    assert after.collection_hash == before.collection_hash
    assert after.analysis_hash != before.analysis_hash
    data["collection"]["motion"][1]["speed"] = "3 mm/s"
    assert plan_of(data).collection_hash != before.collection_hash


def test_ids_are_decimal_text_with_units() -> None:
    ids = set(order_of(plan_of(copy.deepcopy(SMALL))))
    assert "depth=2.4mm,direction=270deg,speed=0.6mmps,r=1" in ids


def test_references_come_every_so_often() -> None:
    data = copy.deepcopy(SMALL)
    condition = {"depth": 2.8, "speed": 1.0, "direction": 0}
    data["collection"]["references"] = {"every": 10, "condition": condition}
    plan = plan_of(data)
    taken = 0
    for trial in plan:
        if trial.role == "reference":
            assert taken % 10 == 0
            assert trial.split == "none"
        taken += trial.role == "measured"
    assert sum(t.role == "reference" for t in plan) == 4


def test_a_slide_is_centred_and_only_hold_and_slide_are_recorded() -> None:
    plan = plan_of(copy.deepcopy(SMALL))
    for trial in plan:
        condition = dict(trial.condition)
        program = plan.program(trial)
        moves = [step for step in program.steps if isinstance(step, Move)]
        press = next(step for step in moves if step.phase == "press")
        slide = next(step for step in moves if step.phase == "slide")
        assert press.to.x_mm == pytest.approx(-slide.to.x_mm, abs=1e-12)
        assert press.to.y_mm == pytest.approx(-slide.to.y_mm, abs=1e-12)
        assert press.to.distance_mm(slide.to) == pytest.approx(9.0, rel=1e-12)
        assert slide.to.depth_mm == press.to.depth_mm == float(str(condition["depth"]))
        recorded = [step.phase for step in program.steps if step.recorded]
        assert recorded == ["hold", "slide"]
        hold = next(s for s in program.steps if isinstance(s, Dwell) and s.recorded)
        assert hold.seconds == 2.0


def test_a_disturbance_is_sideways_motion_at_its_share_of_the_speed() -> None:
    plan = load_plan(ROOT / "protocols" / "disturbance.yaml")
    for trial in plan:
        share = float(str(dict(trial.condition)["disturbance"])) / 100
        side = 1 if dict(trial.condition)["side"] == "right" else -1
        retract = next(s for s in plan.program(trial).steps if s.phase == "retract")
        assert isinstance(retract, Move)
        assert retract.to.x_mm == pytest.approx(side * share * 4.2)
        seconds = 4.2 / 0.5
        assert retract.speed_mm_s * seconds == pytest.approx(4.2 * (1 + share**2) ** 0.5)


def test_people_are_asked_in_outer_blocks_only() -> None:
    plan = load_plan(ROOT / "protocols" / "gravity.yaml")
    assert [last - first + 1 for first, last in plan.stretches()] == [60, 60, 60]
    asked = [task for trial in plan for task in plan.tasks_before(trial) if task.by_person]
    assert [task.expected for task in asked] == ["0.165 kg", "0.205 kg", "0.245 kg"]


def test_the_plan_is_read_without_heavy_libraries() -> None:
    code = (
        "import sys; import sliplab.flows.cli.app; from pathlib import Path;"
        "from sliplab.protocols import load_plan;"
        "from sliplab.rigs.rig_file import load_rig_file;"
        "load_plan(Path('protocols/kinematic.yaml')); load_rig_file(Path('rigs/mock.yaml'));"
        "heavy = {'torch', 'numba', 'cv2', 'prefect', 'pandas', 'scipy', 'h5py', 'samna'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    assert said_by(code).strip() == "[]"


def test_a_plan_file_says_where_it_came_from(tmp_path: Path) -> None:
    path = tmp_path / "copy.yaml"
    path.write_text((ROOT / "protocols" / "pilot.yaml").read_text())
    assert load_plan(path).file == str(path)
