"""`sliplab push`, `pull`, and commands on the URL of a pushed store, as a program meets them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.cli.store import FOLLOW_S
from sliplab.flows.running import stopping
from sliplab.storage.trials.lock import STORE_LOCK, exclusive
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import outcome
from tests.storage.remote.remotes import tree
from tests.storage.trial_files import campaign, commit

TRIALS = ("depth=2.4mm,r=1", "depth=2.8mm,r=1")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with two trials."""
    folder = tmp_path_factory.mktemp("made") / "store"
    where = campaign(folder)
    for trial in TRIALS:
        commit(where, trial)
    return folder


def sliplab(*arguments: object) -> tuple[int, Any, str]:
    """Exit code, the JSON object, and what went to standard error."""
    return outcome(*arguments, "--json")


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Each test has a cache of its own."""
    monkeypatch.setenv("SLIPLAB_CACHE", str(tmp_path / "cache"))


def test_there_and_back(made: Path, tmp_path: Path) -> None:
    url = f"file://{tmp_path}/shared"
    code, sent, _ = sliplab("push", made, url)
    assert code == 0
    assert (sent["url"], sent["trials"], sent["pushed"], sent["problems"]) == (url, 2, 2, [])
    assert sent["simulated"] is True
    assert sliplab("push", made, url)[1]["there"] == 2
    code, back, _ = sliplab("pull", url, tmp_path / "back")
    assert (code, back["pulled"], back["files"]) == (0, 2, 14)
    assert tree(tmp_path / "back", "campaigns") == tree(made, "campaigns")
    assert verify(TrialStore.open(tmp_path / "back")) == []
    code, seen, _ = sliplab("verify", url)
    assert (code, seen["trials"], seen["whole"], seen["ok"]) == (0, 2, 2, True)


def test_a_url_stands_where_a_store_does(made: Path, tmp_path: Path) -> None:
    url = f"file://{tmp_path}/shared"
    sliplab("push", made, url)
    here, there = (sliplab("trials", place)[1] for place in (made, url))
    assert here["trials"] == there["trials"]
    assert here["count"] == there["count"] == 2
    code, _, reported = sliplab("trials", "file:///nothing/here")
    assert code == 2
    assert "does not contain a pushed store" in reported
    assert "\n" not in reported.strip()


def test_problems_are_told_and_exit_with_1(made: Path, tmp_path: Path) -> None:
    url, store = f"file://{tmp_path}/shared", Path(shutil.copytree(made, tmp_path / "s"))
    record = store / "campaigns/c/trials" / TRIALS[0] / "record.json"
    record.write_bytes(record.read_bytes().replace(b"left", b"rite"))
    code, sent, reported = sliplab("push", store, url)
    assert (code, sent["pushed"], len(sent["problems"])) == (1, 1, 1)
    assert "does not match its checksum" in reported
    (tmp_path / "shared/campaigns/c/objects").rename(tmp_path / "gone")
    code, seen, _ = sliplab("verify", url)
    assert (code, seen["ok"], seen["whole"]) == (1, False, 0)
    assert "is missing" in seen["problems"][0]["what"]
    for words in (
        ("push", store, "lab"),
        ("push", store, "s3://me:hunter2@lab/x"),
        ("pull", "nonsense://lab", tmp_path / "x"),
        ("verify", url, "--quarantine"),
        ("push", store, url, "--campaign", "other"),
        ("label", store, "--dask", "nonsense"),
    ):
        code, out, reported = sliplab(*words)
        assert code == 2, reported
        assert out["error"]["message"] in reported
        assert "hunter2" not in reported + str(out)


def test_follow_ends_with_the_collection(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Path(shutil.copytree(made, tmp_path / "s"))
    holding = exclusive(store / STORE_LOCK, "it", about={"collects": "c"})
    holding.__enter__()
    waited: list[float] = []

    def meanwhile(seconds: float) -> None:
        waited.append(seconds)
        commit(TrialStore.open(store).campaign("c"), f"depth={len(waited)}mm")
        if len(waited) == 2:
            holding.__exit__(None, None, None)

    monkeypatch.setattr(stopping, "wait", meanwhile)
    code, sent, _ = sliplab("push", store, f"file://{tmp_path}/shared", "--follow")
    assert (code, sent["trials"], sent["pushed"], sent["there"]) == (0, 4, 4, 3)
    assert waited == [FOLLOW_S] * 2
