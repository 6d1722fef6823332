"""`sliplab register` as a person meets it, to the report, the copies and a real time stamp."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from sliplab.analysis.campaigns import collected
from sliplab.analysis.report.page import render_section
from sliplab.analysis.report.registration import registration_key, registration_section
from sliplab.storage.files import read_json, sha256, write_json
from sliplab.storage.trials.registration import add_registration, registration_problems
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer, here
from tests.flows.collecting.test_session import short
from tests.flows.conftest import write
from tests.flows.older import older_store
from tests.plugins.claims.test_rounds import RIG, SURE, in_a_thread
from tests.storage.trials.test_registration import CONTENT

__all__ = ["in_a_thread"]


def words(text: str) -> str:
    """A terminal's text in one line."""
    return " ".join(text.split())


def section(store: Path) -> str:
    """The report's section, in one line."""
    opened = TrialStore.open(store)
    found = registration_section(opened, collected(opened))
    assert found is not None
    return words(str(render_section(found, simulated=True).html))


def key(store: Path) -> list[str]:
    """What the report's freshness depends on."""
    opened = TrialStore.open(store)
    return registration_key(opened, collected(opened))


@pytest.mark.usefixtures("in_a_thread")
def test_registered_campaign_is_collected_and_deviations_are_reported(tmp_path: Path) -> None:
    data = short()
    data["collection"] |= {"repetitions": 2, "maintenance": {}}
    data["collection"]["stopping"] = {"error": 0.3, "claims": [SURE]}
    protocol, store = write(tmp_path / "p.yaml", data), tmp_path / "store"
    rig = write(tmp_path / "rig.yaml", RIG)
    made = answer("register", protocol, "--store", store, "--rig", rig)
    path = store / "campaigns" / "tiny" / "registrations" / "0001.json"
    assert made["file"] == str(path)
    assert made["sha256"] == sha256(path)
    assert (made["number"], made["when"], made["planned"]) == (1, "before the first trial", 6)
    assert answer("verify", store)["problems"] == []
    before = path.read_bytes()
    shown = answer("register", protocol, "--store", store, "--show")
    assert "was registered before the first trial, " in shown["registered"]
    assert shown["deviations"] == []

    done = here("collect", protocol, "--rig", rig, "--store", store, "--trials", 1)
    assert done.returncode == 0, done.stderr
    assert "campaign tiny was registered before the first trial, " in words(done.stderr)
    assert "deviates" not in done.stderr
    session = read_json(store / "campaigns" / "tiny" / "bench" / "0001.json")
    assert session["registration"] == made["sha256"]
    assert "no_stopping" not in session
    assert "was registered before the first trial." in section(store)
    old = key(store)
    assert old == key(store) != []

    data["collection"]["stopping"]["error"] = 0.4
    write(protocol, data)
    collect = ("collect", protocol, "--rig", rig, "--store", store, "--trials", 1)
    done = here(*collect, "--no-stopping")
    assert done.returncode == 0, done.stderr
    assert "the protocol deviates from it" in words(done.stderr)
    assert read_json(store / "campaigns" / "tiny" / "bench" / "0002.json")["no_stopping"]
    page = section(store)
    for text in ("error level of claims", "stopping overruled", "fewer trials than registered"):
        assert text in page
    assert key(store) != old

    shown = here("register", protocol, "--store", store, "--show")  # nothing was evaluated
    assert shown.returncode == 0, shown.stderr
    assert "was registered before the first trial, " in words(shown.stdout)
    found = answer("register", protocol, "--store", store, "--show")
    for text in ("error level of claims", "stopping overruled", "fewer trials than registered"):
        assert any(text in row["deviation"] for row in found["deviations"])
    (row,) = (row for row in found["deviations"] if row["deviation"] == "stopping overruled")
    assert row["registered"] == "–"

    again = here("register", protocol, "--store", store)
    assert again.returncode == 0
    assert "warning: registered after 2 trials" in words(again.stderr)
    assert "was registered before: " in words(again.stderr)
    assert path.read_bytes() == before
    page = section(store)
    assert "It was registered 2 times" in page
    assert "after 2 trials" in page
    assert "error level of claims" in page  # from the first one
    assert "2 registrations, this is the first" in words(here(*collect).stderr)
    assert answer("verify", store)["ok"]

    path.unlink()
    lost = here("verify", store)
    assert lost.returncode == 1
    assert "0001.json" not in lost.stderr
    assert "missing or changed" in words(lost.stdout)


def test_campaign_without_registration_is_said_to_have_none(tmp_path: Path) -> None:
    store, protocol = tmp_path / "store", write(tmp_path / "p.yaml", short())
    done = here("collect", protocol, "--rig", "rehearsal", "--store", store, "--trials", 1)
    assert "campaign tiny is not registered" in words(done.stderr)
    assert "was not registered" in section(store)
    assert key(store) == []
    made = here("register", protocol, "--store", store)
    assert "registered after 1 trial" in words(made.stderr)
    page = section(store)
    assert "Campaign tiny was registered after 1 trial." in page
    assert "No rig file was registered." in page


def test_damaged_registration_does_not_stop_a_collection(tmp_path: Path) -> None:
    store, protocol = tmp_path / "store", write(tmp_path / "p.yaml", short())
    path = Path(answer("register", protocol, "--store", store)["file"])
    path.chmod(0o644)
    path.write_text("{}")
    done = here("collect", protocol, "--rig", "rehearsal", "--store", store, "--trials", 1)
    assert done.returncode == 0, done.stderr
    assert "its registration is damaged" in words(done.stderr)
    assert "but cannot be read" in section(store)
    refused = here("register", protocol, "--store", store)
    assert (refused.returncode, list(path.parent.iterdir())) == (1, [path])


def test_registered_campaign_that_is_not_reported_is_named(tmp_path: Path) -> None:
    store = older_store(tmp_path / "store")
    assert key(store) == []
    answer("register", write(tmp_path / "p.yaml", short()), "--store", store, "--campaign", "lost")
    assert "not in this report: lost" in section(store)
    assert len(key(store)) == 1


def test_another_protocol_or_an_imported_campaign_is_refused(tmp_path: Path) -> None:
    store, protocol = tmp_path / "store", write(tmp_path / "p.yaml", short())
    assert (
        here("collect", protocol, "--rig", "rehearsal", "--store", store, "--trials", 1).returncode
        == 0
    )
    answer("export", store, "tiny", "--output", tmp_path / "out")
    answer("import", tmp_path / "out", "--store", store, "--name", "theirs")
    data = short()
    data["collection"]["motion"][3]["distance"] = "1.7 mm"
    other = write(tmp_path / "other.yaml", data)
    for words_ in (("register", other), ("register", protocol, "--campaign", "theirs")):
        done = here(*words_, "--store", store)
        assert done.returncode == 1
        assert "under its own name with --campaign" in words(done.stderr)
    assert answer("register", other, "--store", store, "--campaign", "b")["number"] == 1


def test_wrong_input_registers_nothing(tmp_path: Path) -> None:
    data = short()
    data["collection"]["repetitions"] = "many"
    wrong, store = write(tmp_path / "p.yaml", data), tmp_path / "store"
    done = here("register", wrong, "--store", store)
    assert done.returncode == 2
    assert "collection.repetitions" in done.stderr
    done = here("register", "pilot_gravity", "--store", store, "--rig", tmp_path / "none.yaml")
    assert done.returncode == 2
    assert not store.exists()


def test_export_and_publish_take_registrations_along(tmp_path: Path) -> None:
    store = older_store(tmp_path / "store")
    path = add_registration(TrialStore.open(store).campaign("small"), CONTENT)
    path.with_name("0001.json.ots").write_bytes(bytes.fromhex(sha256(path)))
    answer("export", store, "small", "--output", tmp_path / "out")
    answer("export", store, "--as", "croissant", "--output", tmp_path / "data")
    places = ("out/registrations/small", "data/campaigns/small/registrations")
    for copy in (tmp_path / place for place in places):
        assert (copy / "0001.json").read_bytes() == path.read_bytes()
        assert (copy / "0001.json.ots").is_file()
    taken = answer("import", tmp_path / "out", "--store", tmp_path / "again", "--name", "small")
    assert "skipped" not in taken
    published = TrialStore.open(tmp_path / "data").campaign("small")
    assert list(registration_problems(published)) == []
    sums = (tmp_path / "data" / "checksums.sha256").read_text()
    assert "campaigns/small/registrations/0001.json.ots" in sums


@pytest.fixture
def authority(tmp_path: Path) -> Path:
    """The configuration of a time-stamping authority, with its key and certificate."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl")
    folder = tmp_path / "authority"
    folder.mkdir()
    made = ("-keyout", "key.pem", "-out", "authority.pem", "-subj", "/CN=test")
    use = ("-addext", "extendedKeyUsage=critical,timeStamping")
    openssl(folder, "req", "-x509", "-newkey", "rsa:2048", "-nodes", *made, *use)
    (folder / "serial").write_text("01\n")
    (folder / "tsa.cnf").write_text(
        "[tsa]\ndefault_tsa = own\n[own]\nserial = serial\nsigner_cert = authority.pem\n"
        "signer_key = key.pem\nsigner_digest = sha256\ndefault_policy = 1.2.3.4\n"
        "digests = sha256\n"
    )
    return folder


def openssl(folder: Path, *arguments: object) -> str:
    """Run openssl in a folder."""
    done = subprocess.run(
        ["openssl", *map(str, arguments)], cwd=folder, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_time_stamp_of_an_authority_is_attached_and_verified(
    tmp_path: Path, authority: Path
) -> None:
    store = tmp_path / "store"
    path = Path(answer("register", "pilot", "--store", store)["file"])
    answer("register", "pilot", "--store", store)
    openssl(authority, "ts", "-query", "-data", path, "-sha256", "-cert", "-out", "a.tsq")
    reply = ("ts", "-reply", "-queryfile", "a.tsq", "-config", "tsa.cnf", "-out", "a.tsr")
    openssl(authority, *reply)
    made = answer("register", "pilot", "--store", store, "--stamp", authority / "a.tsr")
    assert made["file"] == f"{path}.tsr"
    verify = ("ts", "-verify", "-data", path, "-in", f"{path}.tsr", "-CAfile", "authority.pem")
    assert "OK" in openssl(authority, *verify)
    assert answer("verify", store)["problems"] == []
    assert len(list(path.parent.glob("*.json"))) == 2  # a stamp is no registration

    (tmp_path / "other.txt").write_text("other")
    query = ("ts", "-query", "-data", tmp_path / "other.txt", "-sha256", "-out", "a.tsq")
    openssl(authority, *query)
    openssl(authority, *reply)
    done = here("register", "pilot", "--store", store, "--stamp", authority / "a.tsr")
    assert done.returncode == 2
    assert "does not contain the SHA-256" in words(done.stderr)
    stamp = ("--store", store, "--stamp", authority / "a.tsr")
    unregistered = here("register", "pilot_gravity", *stamp)
    assert unregistered.returncode == 2
    assert "has no registration yet" in words(unregistered.stderr)


def test_file_has_what_a_third_party_needs(tmp_path: Path) -> None:
    protocol = write(tmp_path / "p.yaml", short())
    path = Path(answer("register", protocol, "--store", tmp_path / "store")["file"])
    data = json.loads(path.read_text())
    assert data["protocol"]["file_sha256"] == sha256(protocol)
    assert data["protocol"]["text"] == protocol.read_text()
    assert data["analysis"]["windows"]["length_ms"] == 30
    assert data["versions"]["sliplab"]
    assert not {"host", "user", "who", "operator"} & data.keys()
    write_json(tmp_path / "copy.json", data)
    assert (tmp_path / "copy.json").read_bytes() == path.read_bytes()
