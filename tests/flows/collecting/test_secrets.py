"""Keys of the environment are neither kept nor said."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from flows.collecting.stretch import owned
from flows.running import console
from storage.files import read_json
from storage.process import this_process
from storage.secrets import MASK, masked
from storage.store import Store
from tests.storage.trials import campaign, commit

SECRET = "marked-secret-7f3a"
VARIABLES = ("PREFECT_API_KEY", "AWS_SECRET_ACCESS_KEY", "MY_TOKEN", "DB_PASSWORD")


@pytest.mark.parametrize("name", VARIABLES)
def test_values_of_variables_that_are_named_as_secrets(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, SECRET)
    assert masked(f"refused: key {SECRET} is wrong") == f"refused: key {MASK} is wrong"


def test_passwords_in_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    assert masked(f"http://anna:{SECRET}@host:4200/api") == f"http://anna:{MASK}@host:4200/api"
    assert masked("http://host:4200/api at 12:30") == "http://host:4200/api at 12:30"
    monkeypatch.setenv("PREFECT_API_URL", f"http://anna:{SECRET}@host/api")
    assert masked(f"no such user: {SECRET}") == f"no such user: {MASK}"


def test_data_are_no_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("KEYBOARD", "kinematic"), ("A_KEY", "on"), ("SSH_KEY", "/home/a/key")):
        monkeypatch.setenv(name, value)
    assert masked("kinematic on /home/a/key") == "kinematic on /home/a/key"


def test_nothing_of_it_stays_in_a_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in VARIABLES:
        monkeypatch.setenv(name, SECRET)
    monkeypatch.setenv("PREFECT_API_URL", f"http://anna:{SECRET}@127.0.0.1:9/api")
    monkeypatch.setattr(sys, "argv", ["sliplab", "collect", f"s3://key:{SECRET}@host/x"])
    where = campaign(tmp_path / "store")
    folder = commit(where, "t")
    store = Store.open(tmp_path / "store")
    error = OSError(f"cannot reach {os.environ['PREFECT_API_URL']}")
    with owned(store):
        target = where.quarantine(folder, f"{type(error).__name__}: {error}")
        assert SECRET not in (store.folder / ".lock").read_text()
    assert MASK in read_json(target / "cause.json")["cause"]
    console.say(str(error))
    assert SECRET not in capsys.readouterr().err
    assert SECRET not in str(this_process())
    kept = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert kept
    assert not [path for path in kept if SECRET.encode() in path.read_bytes()]
