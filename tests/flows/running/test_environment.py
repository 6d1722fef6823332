"""Stores in odd places, and proxies, certificates and settings that cannot be used."""

from __future__ import annotations

import os
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest
from prefect import flow
from prefect.exceptions import Abort, CancelledRun, PausedRun

from sliplab.flows.running import orchestration, run_records
from sliplab.flows.running.embedded_server import EmbeddedServer, ServerError
from sliplab.flows.running.orchestration import WorkNotBegun, run
from sliplab.protocols import InputError
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import TrialStore
from tests.command_line import SLIPLAB, answer, here
from tests.conftest import ROOT
from tests.flows.programs import NO_SERVER, ended, environment

ODD = "lab.db?new #2 50%41 'q' [x]:\n"
SOCKS = {"ALL_PROXY": "socks5://127.0.0.1:9"}
POSIX = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
BYTES = os.fsdecode(b"Gr\xf6\xdfe")
"""A Latin-1 name."""


@pytest.mark.long
def test_server_keeps_its_database_in_an_oddly_named_home(tmp_path: Path) -> None:
    name = f"{BYTES} {ODD}"
    with closing(sqlite3.connect(tmp_path / "lab.db")) as other, other:
        other.execute("create table runs (id text)")
    before = (tmp_path / "lab.db").read_bytes()
    home = tmp_path / name / ".prefect"
    home.mkdir(parents=True)
    server = EmbeddedServer(home)
    try:
        assert server.url.startswith("http://127.0.0.1:")
    finally:
        server.stop()
    with closing(sqlite3.connect(home / "prefect.db")) as file:
        tables = {name for (name,) in file.execute("select name from sqlite_master")}
    assert "flow_run" in tables
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["lab.db", name])
    assert (tmp_path / "lab.db").read_bytes() == before


def test_server_in_a_home_that_is_missing_says_so(tmp_path: Path) -> None:
    with pytest.raises(ServerError, match=r"none/server\.log: cannot be written: No such file"):
        EmbeddedServer(tmp_path / "none")


@flow(name="counted", validate_parameters=False, persist_result=False)
def counted(done: list[str]) -> int:
    """Count how often the work was done."""
    done.append("done")
    return len(done)


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(orchestration, "_store", TrialStore.create(tmp_path).folder)
    return tmp_path


def test_failed_record_of_a_begin_is_the_error_of_the_run(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_records, "begin", refuse)
    done: list[str] = []
    with pytest.raises(OSError, match="No space left"):
        run(counted, done)
    assert done == []


@pytest.mark.parametrize("unreachable", [False, True])
def test_client_that_cannot_be_made_is_an_error(
    unreachable: bool, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a server too, Prefect makes a client for whatever it does."""

    def fail(*_: object, **__: object) -> None:
        raise ImportError("no SOCKS")

    if not unreachable:  # it fails after the run was made
        monkeypatch.setattr("prefect.flow_engine.run_flow", fail)
    monkeypatch.setattr(orchestration, "_lost_servers", set())
    done: list[str] = []
    if not unreachable:
        assert run(counted, done) == 1
    else:
        with monkeypatch.context() as patch:
            patch.setattr("prefect.context.get_client", fail)
            with pytest.raises(ImportError, match="no SOCKS"):
                run(counted, done)
    assert len(done) == (0 if unreachable else 1)


@pytest.mark.parametrize("answer", [None, Abort("not now"), CancelledRun(), PausedRun()])
def test_run_that_the_server_ends_before_its_work_raises(
    answer: BaseException | None, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(*_: object, **__: object) -> None:
        if answer is not None:
            raise answer

    monkeypatch.setattr("prefect.flow_engine.run_flow", end)
    done: list[str] = []
    with pytest.raises(WorkNotBegun, match="ended the run before its work began"):
        run(counted, done)
    assert done == []


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("ALL_PROXY", "socks4://127.0.0.1:9"),
        ("http_proxy", "http://anna:secret-word@host:port:9"),
        ("no_proxy", "[::1"),
        ("SSL_CERT_FILE", "/none.pem"),
        ("PREFECT_API_SSL_CERT_FILE", __file__),
        ("PREFECT_LOGGING_SETTINGS_PATH", "/"),
    ],
)
def test_unusable_connection_setting_is_named(
    variable: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(InputError, match=f"environment: .*{variable}.*: cannot be used") as error:
        orchestration.check_connections()
    assert "secret-word" not in error.value.message


def test_a_command_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", "socks4://127.0.0.1:9")
    store = tmp_path / "store"
    done = here("collect", "pilot", "--rig", "rehearsal", "--store", store, "--trials", 1)
    assert done.returncode == 2
    assert "environment: ALL_PROXY: cannot be used" in done.stderr
    assert "Traceback" not in done.stderr


def test_usable_connection_setting_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    proxy = "http://127.0.0.1:9"
    for setting in ({"ALL_PROXY": ""}, {"HTTPS_PROXY": proxy}, {"NO_PROXY": "*"}, SOCKS):
        with monkeypatch.context() as patch:
            for variable, value in setting.items():
                patch.setenv(variable, value)
            orchestration.check_connections()


def test_server_with_an_invalid_address_has_a_name() -> None:
    assert run_records.server_name("http://[") == "at an invalid address"


def operator(store: Path) -> object:
    """Return the operator's name in the store's only session."""
    (session,) = store.rglob("bench/*.json")
    return read_json(session)["operator"]


def test_command_works_on_paths_that_are_not_utf_8(tmp_path: Path) -> None:
    folder = tmp_path / BYTES
    folder.mkdir()
    store = folder / "store"
    protocol = folder / f"{BYTES}.yaml"
    protocol.write_bytes((ROOT / "protocols" / "pilot.yaml").read_bytes())
    words = ("--rig", "rehearsal", "--store", store, "--operator", "Zo\udceb", "--trials", 1)
    assert answer("collect", protocol, *words)["committed"] == 1
    assert answer("label", store)["done"] == 1
    assert answer("verify", store)["ok"]
    assert operator(store) == "Zo\udceb"


def test_text_that_is_not_utf_8_is_one_line_where_it_cannot_be_kept(tmp_path: Path) -> None:
    store = tmp_path / BYTES
    answer("collect", "pilot", "--rig", "rehearsal", "--store", store, "--trials", 1)
    output = ("--as", "croissant", "--output", store / "published", "--licence", "CC0-1.0")
    done = here("export", store, *output)
    assert done.returncode == 2
    assert "is not UTF-8; rename the file or folder" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.quick(1)
@pytest.mark.programs
@pytest.mark.parametrize(
    ("change", "code", "said"),
    [
        ({**SOCKS, **POSIX}, 0, ""),
        ({"PREFECT_API_REQUEST_TIMEOUT": "abc"}, 2, "Prefect's settings cannot be read: "),
        # `test_server_loss` has another server that cannot start
        pytest.param(
            {"PREFECT_HOME": "/proc/none"}, 0, "cannot be written", marks=pytest.mark.long
        ),
    ],
)
def test_command_in_an_odd_environment(
    change: dict[str, str], code: int, said: str, tmp_path: Path
) -> None:
    store = tmp_path / "Größe?"
    command = (*SLIPLAB, "collect", "pilot", "--rig", "rehearsal", "--trials", 1, "--json")
    done = ended(
        [*command, "--store", store, "--operator", "Zoë 木村"],
        env=environment(**change),
        text=False,
    )
    text = done.stderr.decode()
    assert done.returncode == code, text
    assert said in text
    assert "Traceback" not in text
    assert os.listdir(tmp_path) == ["Größe?"]
    if code == 0:
        assert operator(store) == "Zoë 木村"


SCRIPT = """
import sys
import sliplab
import sliplab.flows.running.parallel_map as parallel_map

parallel_map.START_S = 0  # what slow trials amount to
store = sliplab.collect("pilot", rig="rehearsal", store=sys.argv[1], trials=1)
store.label()
print(len(list(store)))
"""


@pytest.mark.long
@pytest.mark.programs
def test_label_in_a_script_without_a_guard_collects_once(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    command = (sys.executable, tmp_path / "script.py", tmp_path / "store")
    done = ended(command, 300, cwd=tmp_path, env=environment(**NO_SERVER))
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["1"]
    (campaign,) = TrialStore.open(tmp_path / "store").campaigns()
    assert len(campaign.committed()) == 1
