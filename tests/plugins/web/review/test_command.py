"""`sliplab review --next`: the table, its one JSON object, and the page's list in that order."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sliplab.plugins.web.pages import serving
from sliplab.plugins.web.pages.web import Web
from sliplab.plugins.web.review.trial_list import TrialList, filtered_rows
from tests.command_line import here
from tests.plugins.web.pages.opened import opened
from tests.plugins.web.review.evaluated import Evaluated


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    """A campaign without doubts."""
    return Evaluated(tmp_path_factory.mktemp("next") / "s")


@pytest.fixture
def made(whole: Evaluated, tmp_path: Path) -> Evaluated:
    """An evaluated campaign with three labels in doubt; one of these is decided."""
    made = whole.copied(tmp_path / "s")
    for trial, ms in zip(made.tests, (30.0, 60.0, 50.0), strict=False):
        made.widen(trial, ms)
    made.evaluate(np.linspace(20, 90, len(made.tests)).tolist())
    made.decide(made.tests[2], "accept")
    return made


def test_the_order_as_an_object_and_as_a_table(made: Evaluated) -> None:
    words = ("review", made.store.folder, "--next", "--no-page", "--count", "1")
    done = here(*words, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert list(found) == ["trials", "to_decide", "simulated", "in_doubt", "next", "gains", "notes"]
    assert (found["simulated"], found["in_doubt"], found["to_decide"]) == (True, 2, 109)
    (first,) = found["next"]
    about = ["campaign", "trial", "split", "spread_ms", "unusable", "score", "moves", "reasons"]
    assert list(first) == about
    assert first["spread_ms"] == {"incipient": 60.0, "gross": 0.0}
    assert first["score"] == first["moves"][0]["of_interval"] > 0
    assert found["gains"][0]["left"] < found["gains"][0]["label_width"]
    done = here(*words)
    assert done.returncode == 0, done.stderr
    assert first["trial"] in done.stdout
    assert "1 of 2 trials in doubt, by what a review would change (simulated)" in done.stdout
    assert "after this review" in done.stdout.splitlines()[-1]
    assert "1 decisions that there are" in done.stderr


def test_without_doubts_it_says_so(whole: Evaluated, tmp_path: Path) -> None:
    made = whole.copied(tmp_path / "s")
    made.evaluate(np.linspace(20, 90, len(made.tests)).tolist())
    done = here("review", made.store.folder, "--next", "--no-page")
    assert done.returncode == 0, done.stderr
    assert done.stdout == ("No label is in doubt: a review would change nothing (simulated).\n")


@pytest.mark.parametrize("option", [("--count", "3"), ("--no-page",)])
def test_its_options_go_with_it(option: tuple[str, ...], tmp_path: Path) -> None:
    done = here("review", tmp_path, *option, "--json")
    error = json.loads(done.stdout)["error"]
    assert (error["exit_code"], error["key"]) == (2, option[0])
    assert error["message"].endswith("goes with --next")


def test_the_page_lists_in_this_order(made: Evaluated) -> None:
    trials = TrialList(made.store)
    made.change(made.tests[5], flags=["knocked"])
    assert trials.refresh()
    assert filtered_rows(trials.rows)[0].trial == made.tests[5]
    two, one, decided = made.tests[1], made.tests[0], made.tests[2]
    trials.rank([(made.item.name, two), (made.item.name, one)])
    listed = [row.trial for row in filtered_rows(trials.rows)]
    assert listed[:3] == [two, one, made.tests[5]]
    assert listed[-1] == decided
    # what is decided in the meantime goes to the end, and the rest keep their places
    made.decide(two, "accept")
    assert trials.refresh()
    assert [row.trial for row in filtered_rows(trials.rows)][:2] == [one, made.tests[5]]
    made.change(one, flags=["knocked"])
    assert trials.refresh()
    assert filtered_rows(trials.rows)[0].trial == one
    page = opened(made.store, trials)
    rows = page.get("/review/rows?first=on").json()["rows"]
    assert [trial for _, trial, *_ in rows][:2] == [one, made.tests[5]]
    assert "most change first" in page.get("/review").text


def test_opened_with_it_the_page_has_the_order(
    made: Evaluated, monkeypatch: pytest.MonkeyPatch
) -> None:
    def serve(web: Web, *_: object) -> None:
        assert web.reviews is not None
        assert [row.trial for row in filtered_rows(web.reviews.rows)][:2] == made.tests[1::-1]
        raise KeyboardInterrupt

    monkeypatch.setattr(serving, "serve", serve)
    done = here("review", made.store.folder, "--next", "--json")
    assert done.returncode == 130
    found = json.loads(done.stdout)
    assert found["url"].endswith("&to=/review")
    assert len(found["next"]) == 2
