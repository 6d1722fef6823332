"""A permanent server as labs run it: Prefect on PostgreSQL, a campaign paused and cancelled."""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from sliplab.flows.running.embedded_server import EmbeddedServer
from sliplab.storage.files import read_json
from sliplab.storage.trials import control
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.crash import campaign
from tests.plugins.web.server.serving import LIMIT_S, Page, serving, until
from tests.rigs.waiting import free_port

TRIALS = 40
BIN = max(Path("/usr/lib/postgresql").glob("*/bin"), default=None)


def as_user(command: list[str]) -> list[str]:
    """PostgreSQL does not run as root; Debian's package has a user for it."""
    return ["runuser", "-u", "postgres", "--", *command] if os.getuid() == 0 else command


@pytest.fixture(scope="module")
def password() -> str:
    return secrets.token_hex(16)


@pytest.fixture(scope="module")
def database(password: str) -> Iterator[str]:
    """The address of a database of our own, with a password, on a port of the loopback."""
    if BIN is None:
        pytest.skip("no PostgreSQL: apt-get install postgresql")
    if os.getuid() == 0 and shutil.which("runuser") is None:
        pytest.skip("PostgreSQL does not run as root, and there is no runuser")
    port = free_port()
    folder = Path(tempfile.mkdtemp(prefix="sliplab-postgres-"))  # where its user may go
    secret = folder / "password"
    secret.write_text(password)
    if os.getuid() == 0:
        shutil.chown(folder, "postgres")
        shutil.chown(secret, "postgres")
    data, control_program = str(folder / "data"), str(BIN / "pg_ctl")
    options = f"-c listen_addresses=127.0.0.1 -c port={port} -c fsync=off"

    def call(*command: str) -> None:
        done = subprocess.run(
            as_user(list(command)), cwd=folder, capture_output=True, text=True, timeout=LIMIT_S
        )
        assert done.returncode == 0, done.stderr

    try:
        login = ("-U", "prefect", "-A", "scram-sha-256", "--pwfile", str(secret))
        call(str(BIN / "initdb"), "-D", data, *login, "--no-sync", "--locale=C.UTF-8")
        options += f" -c unix_socket_directories={folder}"
        log = str(folder / "log")
        call(control_program, "start", "-w", "-s", "-D", data, "-l", log, "-o", options)
        try:
            yield f"postgresql+asyncpg://prefect:{password}@127.0.0.1:{port}/postgres"
        finally:
            call(control_program, "stop", "-D", data, "-m", "immediate")
    finally:
        shutil.rmtree(folder)


@pytest.fixture(scope="module")
def server(database: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Address and password of a Prefect server on that database."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PREFECT_SERVER_DATABASE_CONNECTION_URL", database)
        running = EmbeddedServer(tmp_path_factory.mktemp("server"))
        patch.delenv("PREFECT_SERVER_DATABASE_CONNECTION_URL")  # nobody else needs to know
        try:
            yield running.url, running.password
        finally:
            running.stop()


@pytest.mark.long
@pytest.mark.realtime
def test_a_campaign_is_paused_and_cancelled_and_goes_on(
    server: tuple[str, str], password: str, tmp_path: Path
) -> None:
    protocol = campaign.protocol(TRIALS)
    protocol["collection"]["motion"][3]["distance"] = "8 mm"  # long enough to be paused in
    file = tmp_path / "protocol.yaml"
    file.write_text(yaml.safe_dump(protocol))
    rig = ROOT / "rigs" / "rehearsal.yaml"
    store = tmp_path / "store"

    def committed() -> int:
        folder = store / "campaigns" / campaign.NAME / "trials"
        return len(list(folder.iterdir())) if folder.is_dir() else 0

    nights = tmp_path / "schedules.yaml"  # its folder is one from which protocols may be named
    nights.write_text("timezone: UTC\nschedules: []\n")
    with serving(store, rig, "postgres", server, tmp_path / "serve.log", nights) as page:
        page_collects(page, file, committed)

    reference = campaign.make_request(file, rig, tmp_path / "undisturbed")
    campaign.collect(reference)
    whole = campaign.hashes(tmp_path / "undisturbed")
    assert len(whole) == TRIALS
    assert campaign.hashes(store) == whole
    asked = [(item.kind, item.who) for item in control.requests(TrialStore.open(store))]
    assert asked == [("pause", "anna"), ("resume", "Prefect's page")]
    assert not campaign.wrong(store, whole)
    ends = [read_json(path) for path in (store / "control" / "runs").glob("*.end.json")]
    assert sorted(end["state"] for end in ends) == ["CANCELLED", *["COMPLETED"] * 3]
    reported = [path for path in store.rglob("*") if path.is_file()]
    assert not [path for path in reported if password.encode() in path.read_bytes()]


def page_collects(page: Page, file: Path, committed: Callable[[], int]) -> None:
    """Run, pause, resume, cancel, run again."""
    first = page.run("collect", protocol=str(file))["id"]
    until("two trials", lambda: committed() >= 2)
    paused = page.ended(page.run("pause", who="anna", why="lunch")["id"])
    assert "'paused': True, 'running': True" in paused["message"]
    stood = committed()
    assert stood < TRIALS
    assert page.state(first)["type"] == "RUNNING"
    assert committed() == stood  # it stands still
    assert page.ended(page.run("resume")["id"])["type"] == "COMPLETED"

    until("another trial", lambda: committed() > stood)
    page.cancel(first)
    assert page.ended(first)["type"] == "CANCELLED"
    assert stood < committed() < TRIALS

    last = page.run("collect", protocol=str(file))["id"]
    ended = page.ended(last)
    assert ended["type"] == "COMPLETED", ended
    assert f"{TRIALS} of {TRIALS} committed" in ended["message"]
    made = page.artifacts(last)
    assert made["progress"]["data"] == 100
    assert {"table", "image"} <= made.keys()
