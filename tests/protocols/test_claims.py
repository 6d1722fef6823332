"""Claims in a protocol: what is refused, and what they leave as it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, load_plan

CLAIM = {"figure": "lead", "statistic": "p05", "at_least": "360 ms"}


def written(folder: Path, data: dict[str, Any], **collection: Any) -> Path:
    """A protocol file with other keys of its collection."""
    data["collection"] |= collection
    path = folder / "p.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return path


@pytest.mark.parametrize(
    ("stopping", "key", "right"),
    [
        ({"claims": []}, "claims", "at least 1"),
        ({"claims": [{**CLAIM, "figure": "led"}]}, "claims[0].figure", "'lead'"),
        ({"claims": [{**CLAIM, "statistic": "mean"}]}, "claims[0].statistic", "'median'"),
        ({"claims": [{"figure": "accuracy", "statistic": "p05", "within": "1 %"}]},
         "claims[0].statistic", "'mean'"),
        ({"claims": [{**CLAIM, "at_most": "1 s"}]}, "claims[0]", "exactly one of"),
        ({"claims": [{"figure": "lead"}]}, "claims[0]", "exactly one of"),
        ({"claims": [{**CLAIM, "at_least": "360"}]}, "claims[0].at_least", "unit"),
        ({"claims": [{**CLAIM, "at_least": "36 mm"}]}, "claims[0].at_least", "s, ms, min"),
        ({"claims": [{"figure": "lead", "within": "0 ms"}]}, "claims[0].within", "more than 0"),
        ({"claims": [CLAIM], "error": 0}, "error", "greater than 0"),
        ({"claims": [CLAIM], "error": 0.51}, "error", "0.5"),
        ({"claims": [CLAIM], "least": 10, "most": 9}, "most", "at least"),
        ({"claims": [CLAIM], "repetitions": 0}, "repetitions", "1"),
        ({"claims": [{**CLAIM, "between": {"factor": "dept", "levels": [2.4, 2.8]}}]},
         "claims[0].between.factor", "depth"),
        ({"claims": [{**CLAIM, "between": {"factor": "depth", "levels": [2.4, 2.5]}}]},
         "claims[0].between.levels[1]", "2.4 mm, 2.8 mm, 3.4 mm"),
        ({"claims": [{**CLAIM, "between": {"factor": "depth", "levels": [2.4, 2.4]}}]},
         "claims[0].between.levels", "different"),
        ({"claims": [{**CLAIM, "between": {"factor": "depth", "levels": []}}]},
         "claims[0].between.levels[0]", "missing"),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_with_its_key(
    tmp_path: Path, small: dict[str, Any], stopping: dict[str, Any], key: str, right: str
) -> None:
    with pytest.raises(InputError) as caught:
        load_plan(written(tmp_path, small, stopping=stopping))
    assert caught.value.key == f"collection.stopping.{key}"
    assert right in str(caught.value)


def test_adaptive_order_needs_claims_and_a_choice_needs_it(
    tmp_path: Path, small: dict[str, Any]
) -> None:
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


def test_rounds_go_through_all_levels_that_a_person_changes(
    tmp_path: Path, small: dict[str, Any]
) -> None:
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
