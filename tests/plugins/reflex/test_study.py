"""`sliplab reflex`: detectors that know nothing, resuming, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from sliplab.analysis.campaigns import collected
from sliplab.analysis.detectors.detectors import Tuned
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.registry import make_detector
from sliplab.analysis.detectors.stored_scenes import scenes
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.study import Finding
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.study import StudyOutcome
from sliplab.plugins.reflex import flow
from sliplab.plugins.reflex.rows import reflex_rows
from sliplab.plugins.reflex.study import STUDY
from sliplab.protocols import InputError
from sliplab.protocols.detection import Detection
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here
from tests.conftest import ROOT
from tests.flows.conftest import write
from tests.patching import loose

RIG = Path("mock-gripper")


@pytest.fixture(scope="module")
def fast(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped protocol with one condition that is over soon."""
    data = yaml.safe_load((ROOT / "protocols" / "reflex.yaml").read_text())
    factors = data["collection"]["factors"]
    factors["mass"]["values"], factors["speed"]["values"] = [0.205], [4]
    return write(tmp_path_factory.mktemp("protocol") / "reflex.yaml", data)


def said(state: int) -> np.ndarray:
    counts = np.zeros((1, 3), np.int64)
    counts[0, state] = 9
    return counts


@pytest.mark.long
def test_who_cries_always_or_never_is_at_the_bottom(
    model: Path, fast: Path, tmp_path: Path
) -> None:
    asked = flow.request(model, RIG, tmp_path, fast, ("stop", "grip:0.4"))
    name = next(iter(asked.requests))
    bare = [case for case in asked.cases if case.reflex is None]
    countings = {"always": lambda x: said(1), "never": lambda x: said(0)}
    trials = [flow.measure(asked, case, {}) for case in bare]
    for detector, counting in countings.items():
        for case in asked.cases:
            if case.reflex is not None:
                made = flow.measure(
                    asked, case, {name: asked.requests[name].source.detector(counting)}
                )
                trials.append(made.model_copy(update={"detector": detector}))
    rows = {(row.detector, row.reflex): row for row in reflex_rows(trials)}
    assert rows[None, None].dropped == 1
    for reflex in ("stop", "grip:0.4"):
        always, never = rows["always", reflex], rows["never", reflex]
        # held from the very beginning, and no answer to slip
        assert (always.dropped, always.early, always.prevented) == (0, 1, 0)
        assert (never.dropped, never.missed, never.prevented) == (1, 1, 0)


@pytest.mark.long
def test_what_was_done_is_kept_and_not_done_again(
    model: Path, fast: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop after the first trial loses it not; another reflex adds to what there is."""
    measured: list[str] = []
    measure = flow.measure

    def counting(asked: flow.Request, case: flow.ReflexCase, *rest: object) -> object:
        if measured and measured[-1] == "stop":
            measured.append("go")
            raise KeyboardInterrupt
        made = loose(measure)(asked, case, *rest)
        measured.append(case.reflex or "none")
        return made

    monkeypatch.setattr(flow, "measure", counting)
    asked = flow.request(model, RIG, tmp_path, fast, ("stop", "press:0.2"))
    with pytest.raises(KeyboardInterrupt):
        flow.measure_reflexes(asked)
    assert measured == ["none", "stop", "go"]
    found = flow.measure_reflexes(asked)
    assert measured == ["none", "stop", "go", "press:0.2"]
    assert [row.reflex for row in found.rows] == [None, "stop", "press:0.2"]
    STUDY.write(Finding(found, tmp_path))
    again = flow.measure_reflexes(replace(asked, cases=asked.cases[:2]))
    assert len(measured) == 4
    assert [row.reflex for row in again.rows] == [None, "stop"]
    assert (tmp_path / "reflex.html").is_file()


@pytest.mark.long
def test_a_store_has_all_its_detectors(
    ran: tuple[list[RunRequest], StudyOutcome], fast: Path, tmp_path: Path
) -> None:
    """Each at its level and stride; one reacts in a trial, and another one's name is refused."""
    place = ran[0][0].store
    rule, tuned = "network", "cusum counts"
    asked = flow.request(place, RIG, tmp_path, fast, ("stop",), detectors=[rule, tuned])
    assert [it.detector for it in asked.cases] == [None, rule, tuned]
    assert isinstance(asked.requests[rule].source.detection, Detection)
    found = asked.requests[tuned].source
    assert isinstance(found.detection, Tuned)
    assert found.stride_ms == 10
    detectors = {tuned: found.detector()}
    made = [flow.measure(asked, case, detectors) for case in asked.cases[::2]]
    assert made[0].detected_ms is None
    assert made[1].detected_ms is not None
    with pytest.raises(InputError, match="must be one of network, paper, smoothing, "):
        flow.request(place, RIG, tmp_path, fast, detectors=["smooth"])
    with pytest.raises(InputError, match="elsewhere: is not there"):
        flow.request(place / "elsewhere", RIG, tmp_path, fast, detectors=["papillae"])
    keys = {it.key for it in asked.cases}
    assert len(keys) == len(asked.cases)


@pytest.mark.long
def test_a_store_detects_by_any_of_its_detectors(
    ran: tuple[list[RunRequest], StudyOutcome], fast: Path
) -> None:
    place = ran[0][0].store
    asked = ("detect", "--rig", RIG, "--protocol", fast, "--trial", "speed=4mmps", "--json")
    done = here(*asked, "--model", place, "--detector", "cusum counts", "--reflex", "stop")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert Path(result["model"]["file"]).name == "seed0.pt"
    assert result["states"]["undecided"] == 0  # that is the rule's
    model = place / "models" / "seed0.pt"
    for options, right in (
        (("--model", place, "--detector", "cusum"), "must be one of network, paper, smoothing"),
        (
            ("--model", model, "--detector", "hmm counts"),
            "of a store needs the store as --model",
        ),
        (("--model", place, "--detector", "hmm counts", "--margin", "2"), "is of the rule"),
    ):
        done = here(*asked, *options)
        assert done.returncode == 2
        assert right in json.loads(done.stdout)["error"]["message"]


@pytest.mark.long
def test_a_detector_of_the_bench_is_set_by_the_store_and_reacts(
    ran: tuple[list[RunRequest], StudyOutcome], fast: Path, tmp_path: Path
) -> None:
    place = ran[0][0].store
    asked = flow.request(place, RIG, tmp_path, fast, ("stop",), detectors=["network", "rate"])
    assert [it.detector for it in asked.cases] == [None, "network", "rate"]
    assert len({it.key for it in asked.cases}) == 3
    fitted = asked.requests["rate"].source.detector()
    validation = scenes(StoreLabels(TrialStore(place)), collected(TrialStore(place)), "validation")
    for one in validation:  # as many as are allowed, none of so few, are false early
        found = feed(make_detector("rate"), one)
        early = found.t_us < one.slip.paper_us - 30_000
        assert found.value[early].max() <= fitted.level
    made = flow.measure(asked, asked.cases[-1], {"rate": fitted})
    assert made.detector == "rate"
    with pytest.raises(InputError, match="did you mean 'rate'"):
        flow.request(place, RIG, tmp_path, fast, detectors=["rat"])


def test_the_command(model: Path, fast: Path, tmp_path: Path) -> None:
    done = here(
        "reflex", model, "--protocol", fast, "--reflex", "stop", "--out", tmp_path / "r", "--json"
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["simulated"] is True
    assert result["virtual_time"] is True
    assert [row["reflex"] for row in result["rows"]] == [None, "stop"]
    assert result["rows"][0]["dropped"] == 1
    assert "simulated" in (tmp_path / "r" / "reflex.html").read_text()


def test_wrong_input_is_said(model: Path, fast: Path, tmp_path: Path) -> None:
    for place, rig, protocol, reflexes, right in (
        (tmp_path, RIG, fast, (), r"has no models/\*\.pt"),
        (model, Path("ur5"), fast, (), "must be a simulated rig"),
        (model, RIG, Path("pilot"), (), "must be of gravity trials"),
        (model, Path("mock"), fast, ("grip:0.4",), "needs a gripper"),
        (model, RIG, fast, ("press:9",), "at most press:"),
    ):
        with pytest.raises(InputError, match=right):
            flow.request(place, rig, tmp_path / "out", protocol, reflexes)
    assert [case.reflex for case in flow.request(model, Path("mock"), tmp_path, fast).cases] == [
        None,
        "stop",
        "press:0.4",
    ]
