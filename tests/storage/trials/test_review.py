"""Decisions about labels: kept apart, append only, and none lost between two reviewers."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from sliplab.storage.process import user_name
from sliplab.storage.trials import review
from sliplab.storage.trials.review import ReviewedOnsets
from sliplab.storage.trials.store import StoreError, TrialStore

OLD, NEW = ReviewedOnsets(100, 200), ReviewedOnsets(110, 250)


@pytest.fixture
def store(tmp_path: Path) -> TrialStore:
    """An empty one."""
    return TrialStore.create(tmp_path / "s")


def decide(store: TrialStore, seen: int, verdict: Any = "adjust", **more: Any) -> review.Decision:
    """One decision on the trial ``t``."""
    given = {"label": "k", "old": OLD, "new": NEW, "why": "blurred", **more}
    return review.decide(store, "c", "t", verdict, seen=seen, **given)


def test_the_history_is_kept_whole(store: TrialStore) -> None:
    assert review.history(store, "c", "t") == []
    assert review.last(store, "c", "t") is None
    made = [
        decide(store, 0, who="anna"),
        decide(store, 1, "reject", new=ReviewedOnsets(), label="k2"),
        decide(store, 2, "reopen"),
    ]
    assert review.history(store, "c", "t") == made
    assert review.last(store, "c", "t") == made[2]
    assert [item.number for item in made] == [1, 2, 3]
    assert (made[0].who, made[1].who) == ("anna", user_name())
    assert (made[0].old, made[0].new, made[1].label) == (OLD, NEW, "k2")
    assert review.counts(store, "c") == {"t": 3}
    assert review.counts(store, "other") == {}
    data = json.loads((store.folder / "review" / "c" / "t" / "000001.json").read_text())
    assert data["new"] == {"incipient_ns": 110, "gross_ns": 250}
    assert data["label"] == "k"
    assert data["when"].endswith("+00:00")


def test_who_looked_at_an_older_decision_is_told(store: TrialStore) -> None:
    decide(store, 0, who="anna", why="mine")
    with pytest.raises(review.Overtaken, match=r"adjust by anna, .*mine"):
        decide(store, 0, "accept")
    assert len(review.history(store, "c", "t")) == 1


def test_decisions_that_were_moved_away_are_missed_not_stumbled_over(store: TrialStore) -> None:
    """What the message of a damaged decision advises."""
    folder = store.folder / "review" / "c" / "t"
    for seen in range(2):
        decide(store, seen)
    (folder / "000001.json").unlink()
    assert review.counts(store, "c") == {"t": 2}
    assert decide(store, 2).number == 3
    for path in folder.iterdir():
        path.unlink()
    for seen in (3, 99, -1):
        with pytest.raises(review.Overtaken, match="is there no longer"):
            decide(store, seen)
    assert decide(store, 0).number == 1
    with pytest.raises(review.Overtaken, match="is there no longer"):
        decide(store, 99)


def test_of_many_who_decide_at_once_each_is_kept_or_told(store: TrialStore) -> None:
    def insist(name: str) -> int:
        for reported in range(100):
            try:
                decide(store, max(review.counts(store, "c").values(), default=0), who=name)
                return reported
            except review.Overtaken:
                continue
        raise AssertionError("never kept")

    names = [f"r{n}" for n in range(24)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(insist, names))
    kept = review.history(store, "c", "t")
    assert sorted(item.who for item in kept) == sorted(names)
    assert [item.number for item in kept] == list(range(1, 25))


@pytest.mark.parametrize(
    ("verdict", "more", "problem"),
    [
        ("reject", {"why": "  "}, "needs a reason"),
        ("adjust", {"new": ReviewedOnsets(None, 5)}, "needs an incipient one"),
        ("adjust", {"new": ReviewedOnsets(6, 5)}, "must not come before"),
        ("maybe", {}, "must be one of accept, adjust, reject, reopen"),
    ],
)
def test_what_cannot_be_is_not_kept(
    store: TrialStore, verdict: str, more: Any, problem: str
) -> None:
    with pytest.raises(ValueError, match=problem):
        decide(store, 0, verdict, **more)
    assert review.history(store, "c", "t") == []


def test_names_do_not_lead_out_of_the_store(store: TrialStore) -> None:
    for name in ("../x", "a/b", ""):
        with pytest.raises(StoreError, match="cannot be the name"):
            review.decide(store, "c", name, "accept", label="k", old=OLD, new=OLD, seen=0)


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", "null", "\x00", '{"format": 99}', '{"format": "1"}', "{" * 5000]
)
def test_what_is_damaged_is_named_and_never_passed_over(store: TrialStore, text: str) -> None:
    decide(store, 0)
    path = store.folder / "review" / "c" / "t" / "000001.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(StoreError, match=r"000001\.json"):
        review.last(store, "c", "t")
    assert decide(store, 1, "accept").number == 2  # a new decision counts, the damaged one stays


def test_onsets_are_whole_nanoseconds(store: TrialStore) -> None:
    decide(store, 0)
    path = store.folder / "review" / "c" / "t" / "000001.json"
    good = path.read_text()
    for bad in ("1.5", "true", '"110"'):
        path.write_text(good.replace('"incipient_ns": 110', f'"incipient_ns": {bad}'))
        with pytest.raises(StoreError, match="whole nanoseconds"):
            review.last(store, "c", "t")
    path.write_text(good.replace('"incipient_ns": 110', f'"incipient_ns": {2**63}'))
    with pytest.raises(StoreError, match="less than 2\\^63 ns"):
        review.last(store, "c", "t")
