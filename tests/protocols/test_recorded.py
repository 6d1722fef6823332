"""The split of recorded trials: shares as stated, a function of names alone, groups together."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.protocols import InputError
from sliplab.protocols.adapter import Adapter
from sliplab.protocols.recorded import RecordedPlan, TrialProperties, natural, split_recorded
from sliplab.protocols.yaml_file import validate

HEAD: dict[str, Any] = {"adapter": 1, "name": "touch", "experiment": "classes"}
HEAD |= {"trials": {"files": "*.raw"}, "streams": {"events": {"format": "raw"}}}


def head(**keys: Any) -> Adapter:
    """An adapter's head with other keys."""
    return Adapter.model_validate({**HEAD, **keys})


def trial(name: str, label: str | None = "a", **fields: str) -> TrialProperties:
    """A recorded trial of one class."""
    condition = {} if label is None else {"object": label}
    return TrialProperties(name, condition, fields, label, 1.0, () if label is None else (label,))


@given(st.integers(1, 12), st.integers(1, 30), st.sampled_from([(0.7, 0.15), (0.5, 0.25)]))
def test_each_class_gets_its_shares(classes: int, each: int, shares: tuple[float, float]) -> None:
    split = {"train": shares[0], "validation": shares[1], "test": 1 - sum(shares)}
    trials = [trial(f"{k}-{n}", str(k)) for k in range(classes) for n in range(each)]
    found = split_recorded(head(split=split), trials, "a.yaml")
    assert found == split_recorded(head(split=split), trials[::-1], "a.yaml")
    for k in range(classes):
        counts = Counter(part for name, part in found.items() if name.startswith(f"{k}-"))
        for part, share in split.items():
            assert abs(counts[part] - share * each) <= 1 + 1e-9


def test_a_split_of_the_data_set_is_kept_and_validation_taken_from_its_training() -> None:
    trials = [
        trial(f"{part}{k}-{n}", str(k), part=part)
        for part, count in (("train", 20), ("test", 5))
        for k in range(4)
        for n in range(count)
    ]
    found = split_recorded(head(split={"given": "part"}), trials, "a.yaml")
    assert all((part == "test") == name.startswith("test") for name, part in found.items())
    for k in range(4):
        taken = sum(found[f"train{k}-{n}"] == "validation" for n in range(20))
        assert abs(taken - 20 * 0.15 / 0.85) <= 1
    named = [trial("a", part="1"), trial("b", part="2"), trial("c", part="3")]
    parts = {"1": "train", "2": "validation", "3": "test"}
    kept = split_recorded(head(split={"given": "part", "parts": parts}), named, "a.yaml")
    assert kept == {"a": "train", "b": "validation", "c": "test"}


@given(st.integers(2, 20), st.integers(1, 6))
def test_what_belongs_together_stays_together(objects: int, each: int) -> None:
    trials = [
        trial(f"{k}-{n}", "a" if k % 2 else "b", session=str(k))
        for k in range(objects)
        for n in range(each)
    ]
    found = split_recorded(head(split={"together": "session"}), trials, "a.yaml")
    for k in range(objects):
        assert len({found[f"{k}-{n}"] for n in range(each)}) == 1


def test_fields_and_parts_that_are_none_are_named() -> None:
    for split, said in (
        ({"given": "fold"}, "split.given = fold: is no field of trial a; it has object, part"),
        ({"together": "skin"}, "split.together = skin: is no field"),
        ({"given": "part"}, "is holdout, which is neither train, validation nor test"),
    ):
        with pytest.raises(InputError, match=said):
            split_recorded(head(split=split), [trial("a", part="holdout")], "a.yaml")
    for split, said in (
        ({"train": 0.5}, r"split.train = .*: train, validation and test must add up to 1"),
        ({"parts": {"1": "train"}}, r"split.parts = .*: needs the key 'given'"),
    ):
        with pytest.raises(InputError, match=said):
            validate(Adapter, {**HEAD, "split": split}, Path("a.yaml"))
    with pytest.raises(InputError, match=r"classes = .*is for experiment: classes"):
        validate(Adapter, {**HEAD, "experiment": "gravity", "classes": ["a"]}, Path("a.yaml"))


def test_a_plan_describes_its_trials_in_natural_order() -> None:
    recorded = tuple(
        TrialProperties(f"s{n}", {"speed": f"{n} mm/s", "side": "left"}, {}, None, 2.0)
        for n in (10, 9, 1)
    )
    plan = RecordedPlan(Adapter.model_validate({**HEAD, "experiment": "kinematic"}), "a", recorded)
    assert [each.id for each in plan] == ["s1", "s9", "s10"]
    assert plan.levels == {"speed": ("1 mm/s", "9 mm/s", "10 mm/s"), "side": ("left",)}
    first = next(iter(plan))
    assert plan.describe(first) == {"speed": "1 mm/s", "side": "left"}
    assert plan.seconds(first) == 2.0
    assert plan.classes == ()
    assert sorted(["b10", "b9", "a"], key=natural) == ["a", "b9", "b10"]


def test_classes_are_those_that_occur_or_those_listed() -> None:
    recorded = tuple(trial(str(n), str(n % 11)) for n in range(22))
    plan = RecordedPlan(head(), "a.yaml", recorded)
    assert plan.classes == tuple(map(str, range(11)))
    listed = head(classes=["10", *map(str, range(10)), "nothing"])
    assert RecordedPlan(listed, "a.yaml", recorded).classes[0] == "10"
    with pytest.raises(InputError, match=r"a.yaml: classes = .*does not list 2"):
        _ = RecordedPlan(head(classes=["0", "1"]), "a.yaml", recorded).classes


def test_analysis_and_split_do_not_change_what_was_recorded() -> None:
    one = RecordedPlan(head(), "a", ())
    other = RecordedPlan(head(split={"given": "part"}, title="x"), "a", ())
    assert one.collection_hash == other.collection_hash
    assert one.analysis_hash != other.analysis_hash
    assert one.collection_hash != RecordedPlan(head(name="else"), "a", ()).collection_hash
    assert one.adapter.analysis.labelling.rule == "given"
    paper = head(analysis={"labelling": {"rule": "paper"}})
    assert paper.analysis.labelling.rule == "paper"
