"""Analysis that is killed in its middle: the next run makes the rest, and closes the last one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from multiprocessing import active_children
from pathlib import Path

import pytest

from flows.collecting.collect import collect
from flows.labelling.label import label
from flows.planning.orders import make_order
from flows.running import trial_work
from flows.running.campaigns import collected
from flows.running.spread import WorkerKilled
from storage.files import read_json
from storage.store import Store
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.flows.serving.serving import until

STEPS = ("sync", "label", "train", "evaluate", "report")


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory, rig_path: Path) -> Path:
    """A store with six trials, and nothing derived from them."""
    folder = tmp_path_factory.mktemp("killed")
    collect(make_order(write(folder / "tiny.yaml", tiny()), rig_path, folder / "store"))
    return folder / "store"


def test_every_step_goes_on_after_it_was_killed(taken: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    environment.pop("PREFECT_HOME", None)
    runs = taken / "control" / "runs"

    def begun() -> set[str]:
        found = {path.name for path in runs.glob("*.json")} if runs.is_dir() else set()
        return {name for name in found if name.count(".") == 1}

    for step in STEPS:
        command = [sys.executable, "-m", "flows", step, str(taken), "--json"]
        before = begun()
        process = subprocess.Popen(
            command, cwd=ROOT, env=environment, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            until(f"{step} begins", lambda: begun() - before or process.poll() is not None)  # noqa: B023
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait(60)
        (killed,) = begun() - before
        done = subprocess.run(
            command, cwd=ROOT, env=environment, text=True, capture_output=True, timeout=240,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert "Prefect server" not in done.stderr
        assert json.loads(done.stdout)["done"] >= 1, done.stdout
        end = read_json(runs / killed.replace(".json", ".end.json"))
        assert (end["state"], end["by"]) == ("CRASHED", "next start")


def test_a_worker_process_that_is_killed_is_said_and_the_rest_is_made(
    taken: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store.open(taken)
    for path in (taken / "derived" / "labels").rglob("*"):
        if path.is_file():
            path.unlink()
    monkeypatch.setattr(trial_work, "START_S", 0.0)
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
        with pytest.raises(WorkerKilled, match="run the same command to go on"):
            label(store, collected(store))
    finally:
        over.set()
        killer.join()
    made = label(store, collected(store))
    assert made["done"] + made["fresh"] == 6
    assert label(store, collected(store))["fresh"] == 6
