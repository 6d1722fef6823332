"""Keys of the environment are neither kept nor said."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from sliplab.flows.collecting.requests import store_lock
from sliplab.flows.planning.run_request import describe_campaign, make_request
from sliplab.flows.running import console
from sliplab.protocols import InputError
from sliplab.protocols.shown import MASK
from sliplab.rigs.rig_file import load_rig_file, rig_hash
from sliplab.storage.errors import masked
from sliplab.storage.files import read_json
from sliplab.storage.process import this_process
from sliplab.storage.trials.store import StoreError, TrialStore
from tests.conftest import ROOT
from tests.storage.trial_files import campaign, commit

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
    store = TrialStore.open(tmp_path / "store")
    error = OSError(f"cannot reach {os.environ['PREFECT_API_URL']}")
    with store_lock(store):
        target = where.quarantine(folder, f"{type(error).__name__}: {error}")
        assert SECRET not in (store.folder / ".lock").read_text()
    assert MASK in read_json(target / "cause.json")["cause"]
    console.say(str(error))
    assert SECRET not in capsys.readouterr().err
    assert SECRET not in str(this_process())
    kept = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert kept
    assert not [path for path in kept if SECRET.encode() in path.read_bytes()]


def abb(folder: Path, password: str, **more: str) -> Path:
    """A rig file with a login of its own, and other values by what they replace."""
    text = (ROOT / "rigs" / "irb120.yaml").read_text()
    text = text.replace("extends: ur5.yaml", f"extends: {ROOT}/rigs/ur5.yaml")
    text = text.replace("password: robotics", f"password: {password}  # of anna")
    for new, old in more.items():
        text = text.replace(old, f"{new}: x")
    folder.mkdir(exist_ok=True)
    path = folder / "rig.yaml"
    path.write_text(text)
    return path


def test_a_store_keeps_no_password_of_a_rig_file(tmp_path: Path) -> None:
    protocol, store = ROOT / "protocols" / "pilot.yaml", TrialStore.create(tmp_path / "store")
    run_request = make_request(protocol, abb(tmp_path / "lab", SECRET), store.folder)
    assert SECRET in run_request.rig_text
    assert run_request.rig.devices is not None
    assert SECRET not in repr(run_request.rig)
    where = describe_campaign(store, run_request)
    kept = [path for path in tmp_path.rglob("*") if path.is_file() and "lab" not in path.parts]
    assert len(kept) > 3
    assert not [path for path in kept if SECRET.encode() in path.read_bytes()]
    copy = where.folder / "rig.yaml"
    known, text = load_rig_file(copy, stored=True)
    assert known.model_copy(update={"devices": None}) == run_request.rig.model_copy(
        update={"devices": None}
    )
    assert rig_hash(text) == where.info["rig_hash"]
    with pytest.raises(InputError, match=r"arm\.password = \*\*\*\*: .* the rig's password"):
        load_rig_file(copy)  # it would not log in


def test_another_password_is_no_other_rig(tmp_path: Path) -> None:
    protocol, store = ROOT / "protocols" / "pilot.yaml", TrialStore.create(tmp_path / "store")
    run_request = make_request(protocol, abb(tmp_path / "lab", SECRET), store.folder)
    campaign = describe_campaign(store, run_request)
    make_request(protocol, abb(tmp_path / "lab", "another-one"), store.folder)
    # a store of before, with the password in its copy
    info = {**campaign.info, "rig_hash": "0" * 64}
    campaign.update(info, protocol.read_text(), run_request.rig_text)
    make_request(protocol, abb(tmp_path / "lab", "another-one"), store.folder)
    wrong = abb(tmp_path / "lab", "another-one", sensor="name: irb120 ")
    with pytest.raises(StoreError) as caught:
        make_request(protocol, wrong, store.folder)
    assert "sensor: sensor-1 -> x" in str(caught.value)
    assert SECRET not in str(caught.value)
    assert "another-one" not in str(caught.value)
