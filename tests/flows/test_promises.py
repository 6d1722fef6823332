"""Detectors of a small store at a promise of false alarms, and a calibrated one on its trials."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from sliplab.analysis.detectors.detector import Detector, Evidence, Scene
from sliplab.analysis.detectors.stored_scenes import fitted_to
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.flows.detecting.sources import named_source
from sliplab.flows.evaluations import run_evaluation
from sliplab.flows.store_detectors import detectors_of
from sliplab.protocols import InputError
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.flows.conftest import Ran
from tests.patching import loose


@pytest.fixture(scope="module")
def store(ran: Ran) -> TrialStore:
    return TrialStore.open(ran[0][0].store)


def test_evaluate_says_that_two_trials_promise_nothing(store: TrialStore) -> None:
    before = evaluation_of(store)
    done = run_evaluation(store.folder, None, promise=1.0)
    assert evaluation_of(store) == before, "what is stored stays the same"
    rows = done["promise"]
    assert [row["detector"] for row in rows] == [
        entry.name for entry in before.detectors.detectors if entry.stride_ms == 10
    ]
    for row in rows:
        assert not row["promised"]
        assert row["validation"]["alarms"] == 0
        assert row["validation"]["hours"] < 0.01
        assert row["says"].startswith("a rate of 1 an hour cannot be promised: ")
        assert row["says"].endswith("it takes 3.69 h without an alarm")
    assert "promise" not in run_evaluation(store.folder, None)


def test_a_promise_that_the_trials_support_is_made(store: TrialStore) -> None:
    rows = run_evaluation(store.folder, None, promise=1e5)["promise"]
    assert all(row["promised"] for row in rows)
    assert {row["says"] for row in rows} == {"at most 100000 false alarms an hour, 95 % sure"}


def test_the_command_shows_it(store: TrialStore) -> None:
    done = here("evaluate", store.folder, "--promise", "1")
    assert done.returncode == 0
    assert "hmm counts" in done.stdout
    assert "(simulated)" in done.stdout
    assert done.stderr.count("cannot be promised") == 1
    wrong = here("evaluate", store.folder, "--model", "x.pt", "--promise", "1", "--json")
    assert json.loads(wrong.stdout)["error"]["key"] == "--promise"


def test_detect_has_the_same_levels(store: TrialStore) -> None:
    rows = {
        row["detector"]: row for row in run_evaluation(store.folder, None, promise=30)["promise"]
    }
    chosen = detectors_of(store.folder, ["cusum counts"], promise=30)["cusum counts"]
    assert chosen.set_by is not None
    assert chosen.set_by.words == rows["cusum counts"]["says"]
    assert loose(chosen.detector.levels).incipient == rows["cusum counts"]["level"]
    made = named_source("papillae", None, store.folder, promise=30).detector()
    assert made.set_by is not None
    assert not made.set_by.promised
    assert made.level == made.set_by.value


class SeesTheSlip(Detector):
    """Evidence 1 while surely nothing slips, and 9 from then on, ahead of the label's onset."""

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        self.coming = list(validation)

    def begin(self, width: int, height: int) -> None:
        self.scene = self.coming.pop(0)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        still_us = self.scene.still_us
        assert still_us is not None
        assert still_us < self.scene.slip.paper_us
        t_us = np.arange(until_us - 999_999, until_us + 1, 1000)
        t_us = t_us[t_us > (until_us - 1) // 1_000_000 * 1_000_000]
        return Evidence.of(t_us, np.where(t_us < still_us, 1.0, 9.0))


def test_an_alarm_before_the_label_is_false_only_while_surely_nothing_slips(
    store: TrialStore,
) -> None:
    assert fitted_to(store, SeesTheSlip()).level == 1.0


def test_a_calibrated_detector_is_judged_on_stored_trials(
    store: TrialStore, document: Path
) -> None:
    done = run_evaluation(store.folder, None, model=document)
    assert done["trials"] == 2
    assert done["simulated"]
    assert done["missed"] <= 1
    assert done["false_alarms"].clusters == 2
    said = here("evaluate", store.folder, "--model", document)
    assert said.returncode == 0
    assert "(simulated)" in said.stdout
    assert "promised of holding" in said.stdout
    with pytest.raises(InputError, match="--margin = 2: is of networks"):
        run_evaluation(store.folder, None, model=document, margin=2)
