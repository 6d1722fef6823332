"""Claims in a protocol: what is refused, and what they leave as it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, load_plan
from sliplab.protocols.claims import Claim
from tests.protocols.planning import rows

CLAIM = {"figure": "lead", "statistic": "p05", "at_least": "360 ms"}
SHARE = {"figure": "accuracy", "at_least": "90 %"}


def written(folder: Path, data: dict[str, Any], **collection: Any) -> Path:
    """A protocol file with other keys of its collection."""
    data["collection"] |= collection
    path = folder / "p.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return path


# what a claim about the lead says beside or in place of its own keys | key | what would be right
CLAIMS = """
    figure: led | .figure | 'lead'
    statistic: mean | .statistic | 'median'
    figure: accuracy, at_least: , statistic: p05, within: 1 % | .statistic | 'mean'
    at_most: 1 s | | exactly one of
    at_least: , statistic: | | exactly one of
    at_least: '360' | .at_least | unit
    at_least: 36 mm | .at_least | s, ms, min
    at_least: , statistic: , within: 0 ms | .within | more than 0
    statistic: p50 | .statistic | must be 'median'
    statistic: p94 | .statistic | 'p95'
    between: ~ | .between | empty
    between: {factor: dept, levels: [2.4, 2.8]} | .between.factor | depth
    between: {factor: depth, levels: [2.4, 2.5]} | .between.levels[1] | 2.4 mm, 2.8 mm, 3.4 mm
    between: {factor: depth, levels: [2.4, 2.4]} | .between.levels | different
    between: {factor: depth, levels: []} | .between.levels[0] | missing
"""
STOPPING = """
    claims: [] | claims | must have at least 1 item
    block: ~ | block | empty
    most: ~ | most | empty
    most: 35 | most | at least 36
    error: 0 | error | greater than 0
    error: 0.51 | error | 0.5
    least: 10, most: 9 | most | at least
    repetitions: 0 | repetitions | 1
"""


def read(table: str) -> list[Any]:
    """Return the rows of a table: a mapping, and texts."""
    return [(yaml.safe_load(f"{{{first}}}"), *others) for first, *others in rows(table)]


def claim(change: dict[str, Any]) -> dict[str, Any]:
    """The claim with other keys; without those that are empty, unless that is the point."""
    return {k: v for k, v in {**CLAIM, **change}.items() if v is not None or k == "between"}


WRONG = [
    *(({"claims": [claim(change)]}, f"claims[0]{key}", said) for change, key, said in read(CLAIMS)),
    *(({"claims": [CLAIM], **change}, key, right) for change, key, right in read(STOPPING)),
    (
        {"claims": [CLAIM, SHARE, {**CLAIM, "at_least": "0.36 s"}]},
        "claims[2]",
        "is the same as claims[0]",
    ),
]


@pytest.mark.parametrize(("stopping", "key", "right"), WRONG)
def test_what_cannot_be_meant_is_refused_with_its_key(
    tmp_path: Path, small: dict[str, Any], stopping: dict[str, Any], key: str, right: str
) -> None:
    with pytest.raises(InputError) as caught:
        load_plan(written(tmp_path, small, stopping=stopping))
    assert caught.value.key == f"collection.stopping.{key}"
    assert right in str(caught.value)
    more = [fault.key for fault in caught.value.more]
    assert more == ([f"collection.stopping.{key[:-3]}[1]"] if key.endswith("levels[0]") else [])


def test_adaptive_order_needs_claims_and_a_choice_needs_it(tmp_path: Path, small: Any) -> None:
    with pytest.raises(InputError, match=r"collection\.stopping.*is needed by order: adaptive"):
        load_plan(written(tmp_path, small, order="adaptive"))
    with pytest.raises(InputError, match=r"collection\.choice.*only used by order: adaptive"):
        load_plan(written(tmp_path, small, order="shuffled", choice={"batch": 3}))
    stopping = {"claims": [CLAIM], "block": 4}
    with pytest.raises(InputError, match=r"stopping\.block.*whose batches are the blocks"):
        load_plan(written(tmp_path, small, order="adaptive", stopping=stopping))


def test_claims_change_no_trial_and_no_hash(tmp_path: Path, small: dict[str, Any]) -> None:
    small["collection"]["repetitions"] = 3
    plain = load_plan(written(tmp_path, small))
    stopping = {"claims": [CLAIM], "model": "m.pt"}
    claimed = load_plan(written(tmp_path, small, stopping=stopping))
    chosen = load_plan(written(tmp_path, small, order="adaptive", choice={"batch": 4}))
    assert list(claimed) == list(plain)  # nobody changes a level: blocks follow each other anyhow
    assert {(t.id, t.split, t.seed) for t in chosen} == {(t.id, t.split, t.seed) for t in plain}
    assert claimed.collection_hash == chosen.collection_hash == plain.collection_hash


def test_rounds_go_through_all_levels_that_a_person_changes(tmp_path: Path, small: Any) -> None:
    small["collection"]["context"] = {"skin": {"values": ["a", "b"], "changeover": "person"}}
    small["collection"]["repetitions"] = 4
    plain = load_plan(written(tmp_path, small))
    stopping = {"claims": [CLAIM], "repetitions": 2}
    plan = load_plan(written(tmp_path, small, stopping=stopping))
    assert {(t.id, t.split, t.seed) for t in plan} == {(t.id, t.split, t.seed) for t in plain}
    skins = [dict(trial.condition)["skin"] for trial in plan]
    assert skins == ["a"] * 72 + ["b"] * 72 + ["a"] * 72 + ["b"] * 72
    assert [trial.repetition for trial in plan][:144:36] == [1, 2, 1, 2]
    blocks = [trial.block for trial in plan]
    assert blocks == sorted(blocks)
    assert len(set(blocks)) == 8


def test_stored_protocol_with_repeated_claim_empty_key_and_low_most_is_read(
    tmp_path: Path, small: dict[str, Any]
) -> None:
    stopping = {"claims": [CLAIM, {**CLAIM}], "block": None, "most": 3}
    path = written(tmp_path, small, stopping=stopping)
    assert len(load_plan(path, stored=True)) == 36
    with pytest.raises(InputError) as caught:
        load_plan(path, judged=True)
    keys = [fault.key.removeprefix("collection.stopping.") for fault in caught.value.faults]
    assert keys == ["block", "claims[1]", "most", "model"]


def test_first_round_with_enabled_levels_above_most_is_refused(tmp_path: Path, small: Any) -> None:
    small["collection"]["factors"]["depth"]["optional"] = [3.0]
    path = written(tmp_path, small, stopping={"claims": [CLAIM], "most": 40})
    assert len(load_plan(path)) == 36
    with pytest.raises(InputError, match=r"collection\.stopping\.most = 40: must be at least 48"):
        load_plan(path, ["depth=3.0"])


def test_least_blocks_of_each_statistic() -> None:
    statistics = (None, "median", "p25", "p90", "p05")
    found = [Claim.model_validate({**CLAIM, "statistic": each}) for each in statistics]
    assert [claim.least_blocks for claim in found] == [6, 6, 12, 30, 60]
    assert Claim.model_validate(SHARE).least_blocks == 6


# of the collection | of its stopping | what is said of its blocks, if they are too few
FEW = """
    repetitions: 6 | | ~
    repetitions: 5 | | the plan has 5, so it cannot be called: collection.repetitions = 5 must be \
at least 6, or collection.stopping.block must be at most 35
    repetitions: 1 | block: 6 | ~
    repetitions: 1 | block: 36 | collection.repetitions = 1 must be at least 6, or \
collection.stopping.block = 36 must be at most 7
    repetitions: 9 | most: 200 | the plan has 5, so it cannot be called: collection.stopping.most \
= 200 must be at least 216
    repetitions: 9 | most: 216 | ~
    repetitions: 9 | most: 216, repetitions: 4 | the plan has 4, so it cannot be called: \
collection.stopping.most = 216 must be at least 288
    repetitions: 3, order: adaptive | | ~
    repetitions: 2, order: adaptive | | the plan has 4, so it cannot be called: \
collection.repetitions = 2 must be at least 3, or collection.choice.batch = 12 must be at most 8
    repetitions: 3, order: adaptive | most: 95 | collection.stopping.most = 95 must be at least 96
"""


@pytest.mark.parametrize(("collection", "stopping", "lacks"), read(FEW))
def test_warning_of_claim_with_too_few_blocks_names_key_and_remedy(
    tmp_path: Path, small: dict[str, Any], collection: dict[str, Any], stopping: str, lacks: str
) -> None:
    claims = {"claims": [{**CLAIM, "statistic": "median"}, SHARE]}
    claims |= yaml.safe_load(f"{{{stopping}}}")
    plan = load_plan(written(tmp_path, small, stopping=claims, **collection))
    found = [line for line in plan.warnings() if line.startswith("collection.stopping.claims[")]
    assert len(found) == (0 if lacks == "~" else 2)
    for number, line in enumerate(found):
        assert line.startswith(f"collection.stopping.claims[{number}] (")
        assert "needs 6 blocks" in line
        assert lacks in line


def test_warning_counts_blocks_of_each_level_that_a_person_changes(
    tmp_path: Path, small: dict[str, Any]
) -> None:
    small["collection"]["context"] = {"skin": {"values": ["a", "b"], "changeover": "person"}}
    claims = [{**CLAIM, "statistic": "median"}]
    few = load_plan(
        written(tmp_path, small, repetitions=2, stopping={"claims": claims, "block": 36})
    )
    assert "the plan has 4" in few.warnings()[-1]
    enough = written(tmp_path, small, repetitions=3, stopping={"claims": claims, "block": 36})
    assert load_plan(enough).warnings() == []
