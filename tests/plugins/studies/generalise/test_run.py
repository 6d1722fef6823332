"""Other skins and levels left out: each measured once, kept, and told in a table."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sliplab.analysis.campaigns import collected
from sliplab.analysis.networks.models import choose_model, wanted_models
from sliplab.analysis.sweeps.runner import SweepTask, task_sweep
from sliplab.flows import other_rig
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.study import StudyOutcome
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.studies.generalise import results as generalisation
from sliplab.plugins.studies.generalise.document import (
    GeneralisationResults,
    NotTrained,
    UnseenScores,
)
from sliplab.plugins.studies.generalise.results import Generalisation, markdown
from sliplab.plugins.studies.generalise.run import measure_generalisation, skin_task
from sliplab.plugins.studies.generalise.section import RESULT
from sliplab.protocols.errors import InputError
from sliplab.storage.files import json_text, read_json
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.command_line import here
from tests.flows.conftest import shape_of

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def store(
    ran: tuple[list[RunRequest], StudyOutcome], tmp_path_factory: pytest.TempPathFactory
) -> TrialStore:
    """A copy of the small study, tried without one direction and on one other skin."""
    folder = tmp_path_factory.mktemp("generalisation") / "store"
    shutil.copytree(ran[0][0].store, folder)
    found = TrialStore.open(folder)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(generalisation, "VALIDATION", 0.4)  # of six trials
        measure_generalisation(found, collected(found), ("direction",), skins=1, trials=4, epochs=1)
    return found


def test_a_level_is_tested_on_and_not_trained_on(store: TrialStore) -> None:
    work = Generalisation(store, collected(store), 1)
    levels = work.levels("direction")
    assert levels == sorted(levels, key=lambda text: float(text.split()[0]))
    row = work.results.load().results[f"direction {levels[0]}"]
    assert isinstance(row, UnseenScores)
    assert row.trained_on is not None
    assert row.share is not None
    where = [condition["direction"] for condition in work.trials.conditions]
    assert row.trials == where.count(levels[0])
    assert (
        row.n
        == np.isin(work.trials.samples.trial, np.flatnonzero(np.array(where) == levels[0])).sum()
    )
    assert 0 < row.trained_on < len(where) - row.trials
    assert 0 <= row.share <= 1
    assert not list(work.folder.glob("*.state"))


def test_another_skin_is_another_skin_and_leaves_no_store(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = store.folder / "derived" / "generalisation"
    row = RESULT.read(store)["results"]["skin 101"]
    assert row["trials"] == 4
    assert not (folder / "skin101").exists()
    seen: list[str] = []
    monkeypatch.setattr(
        other_rig,
        "collect",
        lambda run_request: seen.append(scene_of(run_request.rig).scene.skin.seed),
    )
    model = choose_model(wanted_models(store, collected(store)))
    with pytest.raises(StoreError, match="holds no campaign yet"):
        skin_task(Generalisation(store, collected(store), 1), model, 102, 4).work()
    shutil.rmtree(folder / "skin102")
    assert seen == [102]


def test_what_is_kept_is_not_measured_again(store: TrialStore) -> None:
    asked = (store, collected(store), ("direction",))
    assert measure_generalisation(*asked, skins=1, trials=4, epochs=1).named["made"] == 0
    other = Generalisation(store, collected(store), 2)
    made: list[str] = []

    def work() -> NotTrained:
        made.append("made")
        return NotTrained(why="not tried")

    before = store.folder / "derived" / "generalisation" / "results.json"
    text = before.read_text()
    name = next(iter(other.results.load().results))
    for _ in range(2):
        task_sweep([SweepTask(name, "another key", work)], other.results).run()
    assert len(made) == 1
    before.write_text(text)


def test_what_is_not_there_is_refused(store: TrialStore) -> None:
    campaigns = collected(store)
    with pytest.raises(InputError, match=r"--factor.*must be a factor of the slides: "):
        measure_generalisation(store, campaigns, ("mass",))
    with pytest.raises(InputError, match=r"--level.*must be one of 0 deg"):
        measure_generalisation(store, campaigns, ("direction",), ("1 deg",))


def test_the_table_has_a_row_for_each_result() -> None:
    counts = np.array([[3, 0, 0], [0, 3, 0], [0, 0, 0], [0, 0, 5]])
    row = generalisation.score_windows(counts, np.array([0, 1, 1, 2]), np.array([0, 0, 1, 1]))
    assert (row.share, row.trials, row.n) == (0.75, 2, 4)
    seen = row.model_copy(update={"seen": 0.9})
    text = markdown({"depth 2 mm": seen, "speed 1": NotTrained(why="no trials")}, True)
    assert "(simulated)" in text
    assert "| depth 2 mm | 2 | 4 | 75.0 | 0.0 to 100.0 | 83.3 | 90.0 |" in text
    assert "| speed 1 | no trials |" in text


EXAMPLE = """{
 "results": {
  "skin 101": {
   "argmax": 0.8333333333333334,
   "high": null,
   "key": "k1",
   "low": null,
   "n": 4,
   "recall": {
    "gross": 1.0,
    "incipient": 0.5,
    "no_slip": 1.0
   },
   "share": 0.75,
   "trials": 1
  },
  "speed 1 mm/s": {
   "key": "k2",
   "left out": "no train trials"
  }
 },
 "simulated": true
}
"""


def test_the_file_is_the_same_to_the_byte(tmp_path: Path) -> None:
    results = generalisation._Results(
        tmp_path / "results.json", GeneralisationResults, "results", {"simulated": True}
    )
    counts = np.array([[3, 0, 0], [0, 3, 0], [0, 0, 0], [0, 0, 5]])
    y, trial = np.array([0, 1, 1, 2]), np.zeros(4, np.int64)
    tasks = [
        SweepTask("skin 101", "k1", lambda: generalisation.score_windows(counts, y, trial)),
        SweepTask("speed 1 mm/s", "k2", lambda: NotTrained(why="no train trials")),
    ]
    assert task_sweep(tasks, results).run() == 2
    assert results.path.read_text() == EXAMPLE == json_text(results.load().to_json())
    assert "| speed 1 mm/s | no train trials |" in (tmp_path / "results.md").read_text()


def test_a_trained_level_has_these_keys(store: TrialStore) -> None:
    kept = read_json(store.folder / "derived/generalisation/results.json")
    assert shape_of(kept["results"]["direction 0 deg"]) == {
        "argmax": "float",
        "high": "NoneType",
        "key": "str",
        "low": "NoneType",
        "n": "int",
        "recall": {"gross": "float", "incipient": "float", "no_slip": "float"},
        "seen": "float",
        "share": "float",
        "trained_on": "int",
        "trials": "int",
    }


def test_the_command_line(store: TrialStore, tmp_path: Path) -> None:
    asked = ("--factor", "direction", "--skins", "1", "--trials", "4", "--epochs", "1")
    done = here("generalise", str(store.folder), *asked, "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert set(said) == {"page", "step", "simulated", "made", "results", "file"}
    kept = read_json(Path(said["file"]))
    assert said["results"] == kept["results"]
    assert Path(said["page"]).read_text().count("<svg") == 1
    table = pd.read_parquet(store.folder / "derived/generalisation/tables/results.results.parquet")
    assert list(table["name"]) == list(kept["results"])
    assert table["simulated"].all()
    assert (said["simulated"], said["made"]) == (True, 0)
    assert "skin 101" in said["results"]
    shown = here("generalise", str(store.folder), *asked)
    assert "generalise, simulated" in shown.stdout
    assert "skin 101" in shown.stdout
    fewer = json.loads(
        here(
            "generalise", str(store.folder), *asked[:2], "--skins", "0", *asked[6:], "--json"
        ).stdout
    )
    assert "skin 101" not in fewer["results"]
    assert read_json(Path(said["file"])) == kept


def test_missing_label_names_the_trial_and_the_command(store: TrialStore, tmp_path: Path) -> None:
    shutil.copytree(store.folder, tmp_path / "store")
    shutil.rmtree(tmp_path / "store" / "derived" / "labels")
    done = here("generalise", str(tmp_path / "store"))
    assert done.returncode == 1
    assert "has no label yet; run `sliplab label`" in done.stderr
