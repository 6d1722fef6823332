"""Analysis that is killed in its middle: the next run makes the rest, and closes the last one."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing import active_children
from pathlib import Path
from random import Random

import pytest

from sliplab.analysis.campaigns import collected
from sliplab.flows.label import label
from sliplab.flows.running import parallel_map
from sliplab.flows.running.parallel_map import WorkerKilled
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import TrialStore
from tests.command_line import SLIPLAB
from tests.flows.conftest import six_trials
from tests.flows.programs import ended, running
from tests.plugins.web.server.serving import until

pytestmark = pytest.mark.programs

STEPS = ("sync", "label", "train", "evaluate", "report")
FILES = {"sync": 6, "label": 6, "train": 5, "evaluate": 4, "report": 3}
"""Fewer than how many files each has written when it is killed."""


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory, rig_path: Path) -> Path:
    """A store with six trials, and nothing derived from them."""
    return six_trials(tmp_path_factory.mktemp("killed"), rig_path)


@pytest.mark.parametrize(
    ("seed", "steps"),
    [(0, STEPS[:1]), *(pytest.param(s, STEPS, marks=pytest.mark.long) for s in range(6))],
)
def test_every_step_goes_on_after_it_was_killed(
    seed: int, steps: Sequence[str], taken: Path, tmp_path: Path
) -> None:
    """Each is killed with all its processes once it has written a random number of files."""
    folder = shutil.copytree(taken, tmp_path / "store")
    runs = folder / "control" / "runs"
    random = Random(seed)

    def begun() -> set[str]:
        found = {path.name for path in runs.glob("*.json")} if runs.is_dir() else set()
        return {name for name in found if name.count(".") == 1}

    def results() -> set[tuple[Path, int]]:
        """Every version of a result: what is written anew counts, too."""
        found = set()
        for name in ("derived", "models", "report"):
            for path in (folder / name).rglob("*"):
                with suppress(FileNotFoundError):  # renamed meanwhile
                    found.add((path, path.stat().st_mtime_ns))
        return found

    for step in steps:
        command = [*SLIPLAB, step, folder, "--json"]
        runs_before, results_before = begun(), results()
        wanted = random.randrange(FILES[step])
        with running(command, tmp_path / "messages") as process:

            def far_enough() -> bool:
                if process.poll() is not None:
                    return True
                return bool(begun() - runs_before) and len(results() - results_before) >= wanted  # noqa: B023

            until(f"{step} has written {wanted} files", far_enough)
        assert process.returncode == -signal.SIGKILL, f"{step} was over before {wanted} files"
        (killed,) = begun() - runs_before
        done = ended(command)
        assert done.returncode == 0, done.stderr
        assert "Prefect server" not in done.stderr
        made = json.loads(done.stdout)
        assert made["done"] + made.get("fresh", 0) >= 1, made
        if made["done"]:  # else it was killed when all was there, and the next start closes it
            end = read_json(runs / killed.replace(".json", ".end.json"))
            assert (end["state"], end["by"]) == ("CRASHED", "next start")


@pytest.mark.long
def test_a_worker_process_that_is_killed_is_said_and_the_rest_is_made(
    taken: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = TrialStore.open(taken)
    for path in (taken / "derived" / "labels").rglob("*"):
        if path.is_file():
            path.unlink()
    monkeypatch.setattr(parallel_map, "START_S", 0.0)
    over = threading.Event()
    others = set(active_children())

    def kill() -> None:
        """Kill one when all have been started: before that Python's pool may stumble over it."""
        while not over.wait(0.01):
            workers = set(active_children()) - others
            if len(workers) == min(6, os.cpu_count() or 1):
                os.kill(workers.pop().pid or 0, signal.SIGKILL)
                return

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        with pytest.raises(WorkerKilled, match="run the same command to resume"):
            label(store, collected(store))
    finally:
        over.set()
        killer.join()
    made = label(store, collected(store))
    assert made["done"] + made["fresh"] == 6
    assert label(store, collected(store))["fresh"] == 6
