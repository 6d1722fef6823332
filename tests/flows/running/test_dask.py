"""Steps on a Dask cluster of two worker processes: the same bytes, whatever happens to a worker."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import distributed
import pytest

from benchmarks.scene_tradeoff.run import everywhere
from sliplab.analysis.campaigns import collected
from sliplab.flows.evaluate import evaluate
from sliplab.flows.label import label
from sliplab.flows.running import cluster as clusters
from sliplab.flows.running import parallel_map, stopping
from sliplab.flows.running.cluster import Cluster, ClusterError, connected
from sliplab.flows.train import train
from sliplab.protocols.errors import InputError
from sliplab.storage.remote.mirror import open_mirror
from sliplab.storage.remote.objects import Remote
from sliplab.storage.remote.push import push
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.flows.conftest import six_trials
from tests.flows.listening import listening
from tests.flows.programs import ended, running
from tests.plugins.web.server.serving import until
from tests.storage.remote.remotes import tree

pytestmark = pytest.mark.programs

WAIT_S = 30.0
STEPS = (label, train, evaluate)


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory, rig_path: Path) -> Path:
    """A store with six trials, and nothing derived from them."""
    return six_trials(tmp_path_factory.mktemp("dask"), rig_path)


@pytest.fixture(scope="module")
def here(taken: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The results of the steps without a cluster, in this process alone."""
    folder = tmp_path_factory.mktemp("here") / "store"
    shutil.copytree(taken, folder)
    return run_steps(folder, None)


@pytest.fixture(scope="module")
def workers_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The workers' download cache, separate from this process's."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def address(workers_cache: Path) -> Iterator[str]:
    """The scheduler of two workers in processes of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SLIPLAB_CACHE", str(workers_cache))
        with distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
        ) as cluster:
            yield cluster.scheduler_address


@pytest.fixture
def cluster(address: str) -> Iterator[Cluster]:
    """The two workers, looked at, once one that a test ended has been replaced."""
    with distributed.Client(address, timeout="30s") as client:
        client.wait_for_workers(2, timeout=60)
    with connected(address) as found:
        assert found.cores == 2
        yield found


def run_steps(folder: Path, cluster: Cluster | None) -> dict[str, bytes]:
    """Every file that the steps made."""
    store = TrialStore.open(folder)
    for step in STEPS:
        result = step(store, collected(store), cluster=cluster)
        assert result["done"]
    made = tree(folder, "derived", "models")
    return {name: data for name, data in made.items() if name != "derived/timing.json"}


def test_two_workers_make_the_same_bytes(
    taken: Path, here: dict[str, bytes], tmp_path: Path, cluster: Cluster
) -> None:
    shutil.copytree(taken, tmp_path / "there")
    there = run_steps(tmp_path / "there", cluster)
    assert {"derived/evaluation/evaluation.json", "models/seed0.pt"} <= here.keys()
    assert len([name for name in here if name.startswith("derived/counts/")]) == 4
    assert len([name for name in here if name.startswith("derived/labels/")]) == 12
    assert here == there


def met(folder: str) -> int:
    """The number of this process, once two processes have come here."""
    (Path(folder) / str(os.getpid())).touch()
    for _ in range(round(WAIT_S / 0.05)):
        if len(list(Path(folder).iterdir())) == 2:
            return os.getpid()
        threading.Event().wait(0.05)
    raise TimeoutError("nobody else came")


def test_both_workers_work_at_once(tmp_path: Path, cluster: Cluster) -> None:
    pids = everywhere(met, [str(tmp_path)] * 8, cluster, lambda: None)
    assert len(set(pids)) == 2
    assert os.getpid() not in pids


def square_or_die(job: tuple[int, str]) -> int:
    """A number's square; whoever gets 5 first is killed."""
    number, marker = job
    if number == 5:
        try:
            os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    return number**2


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning:distributed")
def test_a_worker_that_dies_is_replaced(tmp_path: Path, cluster: Cluster) -> None:
    jobs = [(number, str(tmp_path / "died")) for number in range(24)]
    assert everywhere(square_or_die, jobs, cluster, lambda: None) == [n**2 for n in range(24)]
    assert (tmp_path / "died").exists()


def mark(job: tuple[str, int]) -> None:
    """Leave a file, and go on once somebody has asked for it, or time is up."""
    folder, number = Path(job[0]), job[1]
    (folder / str(number)).touch()
    if number:
        for _ in range(round(WAIT_S / 0.05)):
            if (folder / "go").exists():
                return
            threading.Event().wait(0.05)


def test_a_stop_cancels_what_is_queued(tmp_path: Path, cluster: Cluster) -> None:
    jobs = [(str(tmp_path), k) for k in range(15)]  # few enough to be a chunk each
    with pytest.raises(KeyboardInterrupt):
        everywhere(mark, jobs, cluster, stopping.stop)
    stopping._requested.clear()
    (tmp_path / "go").touch()
    assert everywhere(abs, [-1, -2], cluster, lambda: None) == [1, 2]
    begun = len(list(tmp_path.iterdir())) - 1
    # the two running, the next ones that the workers hold already, and what those leave room for
    assert 0 < begun < 8


def test_a_pushed_store_is_labelled_where_its_trials_are_fetched(
    taken: Path,
    here: dict[str, bytes],
    tmp_path: Path,
    cluster: Cluster,
    workers_cache: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SLIPLAB_CACHE", str(tmp_path / "cache"))
    url = f"file://{tmp_path}/shared"
    push(TrialStore.open(taken), Remote(url))
    store, _ = open_mirror(url)
    assert label(store, collected(store), cluster)["done"] == 6
    labels = {name: data for name, data in here.items() if name.startswith("derived/labels")}
    assert tree(store.folder, "derived/labels") == labels
    assert not list(store.folder.rglob("data.h5"))
    assert len(list(workers_cache.rglob("data.h5"))) == 6


def test_what_cannot_be_used_is_said_at_once(
    taken: Path, tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="HOST:PORT"), connected("nonsense"):
        pass
    store = TrialStore.open(taken)
    with connected(address) as found, monkeypatch.context() as patch:
        patch.setattr(parallel_map, "place_of", lambda _: str(tmp_path / "elsewhere"))
        with pytest.raises(ClusterError, match=r"worker tcp://.* is not a store .*same path"):
            label(store, collected(store), found)
    with monkeypatch.context() as patch:
        patch.setattr(clusters, "this_program", lambda: {"numpy": "1.0"})
        with pytest.raises(ClusterError, match=r"numpy .* instead of 1\.0; install"):
            connected(address).__enter__()
    monkeypatch.setattr(clusters, "CONNECT_S", 0.5)
    with pytest.raises(ClusterError, match="no scheduler answers there"), connected("127.0.0.1:1"):
        pass
    with (
        distributed.LocalCluster(
            n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as empty,
        pytest.raises(ClusterError, match="has no worker; start some"),
        connected(empty.scheduler_address),
    ):
        pass
    assert not (taken / "derived" / "labels").exists()


@pytest.mark.long
def test_the_commands_of_the_docs_make_the_same_bytes(
    taken: Path, here: dict[str, bytes], tmp_path: Path
) -> None:
    places = ("docs/scale.md", "docs/howto/analyse-on-a-cluster.md")
    pages = [(ROOT / place).read_text() for place in places]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    store = shutil.copytree(taken, tmp_path / "store")

    def documented(command: str) -> list[str]:
        lines = [re.search(rf"^(?:\$ )?({command} .*)$", text, re.M)[1] for text in pages]  # type: ignore[index]
        # both pages have the same command, but for the store and how many workers there are
        for pattern, same in (("STORE| data", f" {store}"), (r"--nworkers \d+", "--nworkers 2")):
            lines = [re.sub(pattern, same, line) for line in lines]
        (words,) = {tuple(shlex.split(line, comments=True)) for line in lines}
        program, *rest = [word.replace("8786", port).replace("8787", "0") for word in words]
        return [str(Path(sys.executable).parent / program), *rest]

    log = tmp_path / "worker"
    with (
        running(documented("dask scheduler"), tmp_path / "scheduler", cwd=tmp_path) as scheduler,
        running(documented("dask worker"), log, cwd=tmp_path) as worker,
    ):
        until("two workers", lambda: log.read_text().count("Registered to") >= 2)
        done = ended(documented("sliplab label"), 180)
        assert done.returncode == 0, done.stderr + log.read_text()
        assert [listening(each.pid) for each in (scheduler, worker)] == [{"127.0.0.1"}] * 2
    labels = {name: data for name, data in here.items() if name.startswith("derived/labels")}
    assert tree(store, "derived/labels") == labels
