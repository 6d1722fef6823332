"""The file of schedules, windows by the clock on the wall, and the compose file."""

from __future__ import annotations

import copy
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sliplab.plugins.web.server.schedules import DAYS, load_schedules, upcoming_runs, window_end
from sliplab.protocols import InputError
from tests.command_line import answer, here
from tests.conftest import ROOT

ROME = "Europe/Rome"
RIG = ROOT / "rigs" / "rehearsal.yaml"
NIGHT: dict[str, Any] = {
    "name": "nights",
    "flow": "collect",
    "protocol": str(ROOT / "protocols" / "pilot.yaml"),
    "days": ["mon", "thu"],
    "from": "22:00",
    "until": "06:00",
}


PUSH: dict[str, Any] = {"flow": "push", "protocol": None, "until": None}
ODD_CRONS = ("RRULE:FREQ=DAILY", "\u0663 22 * * *")


def write(folder: Path, *schedules: dict[str, Any], timezone: str = ROME) -> Path:
    path = folder / "schedules.yaml"
    path.write_text(yaml.safe_dump({"timezone": timezone, "schedules": list(schedules)}))
    return path


def test_the_shipped_example_is_right() -> None:
    nights, weekend, report = load_schedules(ROOT / "docs" / "schedules.yaml")
    assert (nights.flow, nights.cron) == ("collect", "0 22 * * mon,tue,wed,thu")
    protocol = str(ROOT / "protocols" / "kinematic.yaml")
    assert nights.parameters == {"protocol": protocol, "until": "06:00", "timezone": ROME}
    assert (weekend.flow, weekend.parameters["until"]) == ("chain", "mon 06:00")
    assert (report.cron, report.active, report.parameters) == ("30 8 * * tue-sat", False, {})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"flow": "colect"}, "schedules[0].flow = colect: must be one of collect, label"),
        ({"protcol": "x"}, "schedules[0].protcol = x: unknown key; did you mean 'protocol'?"),
        ({"protocol": "none.yaml"}, "schedules[0].protocol = none.yaml: no such file"),
        ({"days": ["mo"]}, "schedules[0].days[0] = mo"),
        ({"days": []}, "schedules[0].days = []"),
        ({"days": None}, "schedules[0].days: is missing"),
        ({"from": None}, "schedules[0].from: is missing"),
        ({"from": "24:00"}, 'schedules[0].from = 24:00: must be a time like "22:00"'),
        ({"until": "monday 6:00"}, "schedules[0].until = monday 6:00: must be a time like"),
        ({"cron": "0 22 * * *"}, "schedules[0].days"),
        *(
            ({"cron": cron, "days": None, "from": None}, f".cron = {cron}: must have five fields")
            for cron in ("0 0 22 * * *", "*/10 * * * * *", "0 22 * *", "@daily", *ODD_CRONS)
        ),
        *(
            ({**PUSH, "url": url}, f"schedules[0].url{says}")
            for url, says in (
                (None, ": is missing; give one like s3"),
                ("http://lab/x", " = http://lab/x: is a web page's address"),
                ("s3://key:hunter2@lab/x", " = "),
            )
        ),
        ({"timezone": "UTC"}, "schedules[0].timezone = UTC: applies to the whole file"),
        ({"trials": 0}, "schedules[0].trials = 0"),
        ({"name": "Nights!"}, "schedules[0].name = Nights!"),
        ({"flow": "pause"}, "schedules[0].flow = pause: must be one of"),
        ({"flow": "label"}, "schedules[0].protocol"),
        ({"flow": ["collect"]}, "schedules[0].flow = [collect]: must be one of collect, label"),
        ({"name": False}, "schedules[0].name = false: must be text and reads as a switch: quote"),
        ({"trials": True}, "schedules[0].trials = true: must be a number"),
        ({"trials": 10**12}, "schedules[0].trials = 1000000000000"),
        ({"temperature_c": float("inf")}, "schedules[0].temperature_c = .inf: must be a finite"),
        ({"temperature_c": 300}, "schedules[0].temperature_c = 300"),
        ({"patience_min": float("nan")}, "schedules[0].patience_min = .nan: must be a finite"),
        ({"active": 3}, "schedules[0].active = 3: must be true or false"),
        ({"enable": ["dept=3"]}, "schedules[0].enable = [dept=3]: unknown factor dept; "),
        ({"enable": ["depth=9"]}, "schedules[0].enable = [depth=9]: is not an optional level"),
        ({"campaign": "../x"}, "schedules[0].campaign = ../x: '../x' cannot be the name"),
        ({"from": "2\u0662:00"}, "schedules[0].from = 2\u0662:00: must be a time like"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    wrong = {key: value for key, value in {**NIGHT, **change}.items() if value is not None}
    with pytest.raises(InputError) as error:
        load_schedules(write(tmp_path, wrong))
    assert said in error.value.message
    assert "hunter2" not in error.value.message


def test_a_push_and_a_report_of_a_period_are_scheduled(tmp_path: Path) -> None:
    push = {"name": "copy", "flow": "push", "url": "s3://lab/one", "cron": "5 6 * * *"}
    week = {"name": "weekly", "flow": "report", "period": "week", "cron": "0 8 * * mon"}
    copy, weekly = load_schedules(write(tmp_path, push, week))
    assert (copy.flow, copy.parameters) == ("push", {"url": "s3://lab/one"})
    assert (weekly.flow, weekly.parameters) == ("report", {"period": "week"})


def test_a_value_is_shown_as_it_was_written(tmp_path: Path) -> None:
    path = write(tmp_path, NIGHT)
    path.write_text(path.read_text().replace("name: nights", "name: off"))
    with pytest.raises(InputError, match=r"schedules\[0\]\.name = off: must be text"):
        load_schedules(path)
    path.write_text(path.read_text().replace("name: off", "name: n").replace("'22:00'", "22:00"))
    with pytest.raises(InputError, match=r"schedules\[0\]\.from = 22:00: reads as a base-60"):
        load_schedules(path)


def test_all_faults_of_all_schedules_are_named_with_the_nearest_names(tmp_path: Path) -> None:
    night = {**NIGHT, "name": "Nights!", "days": ["mon", "thuu"], "trials": 0}
    report = {"name": "Report!", "flow": "reprt", "cron": "0 22 * * *"}
    both = {"name": "Both!", "flow": "label", "cron": "0 22 * * * *"}
    with pytest.raises(InputError) as caught:
        load_schedules(write(tmp_path, night, report, both))
    for said in (
        "schedules[0].name = Nights!",
        "schedules[0].days[1] = thuu",
        "; did you mean 'thu'?",
        "schedules[0].trials = 0",
        "schedules[1].flow = reprt",
        "; did you mean 'report'?",
        "schedules[2].name = Both!",
        "schedules[2].cron = 0 22 * * * *: must have five fields",
    ):
        assert said in caught.value.message
    with pytest.raises(InputError, match=r"is not a time zone; .*; did you mean 'Europe/Rome'\?"):
        load_schedules(write(tmp_path, NIGHT, timezone="Europe/rome"))


def test_all_cron_lines_without_a_run_are_named(tmp_path: Path) -> None:
    path = write(tmp_path, weekly("0 3 30 2 *"), {**weekly("61 3 * * *"), "name": "other"})
    with pytest.raises(InputError) as caught:
        upcoming_runs(path, load_schedules(path), 2)
    keys = [fault.key for fault in caught.value.faults]
    assert keys == ["schedules[0].cron", "schedules[1].cron"]


def test_a_wrong_protocol_is_named_with_its_own_key(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text((ROOT / "protocols/pilot.yaml").read_text()[:-10])
    with pytest.raises(InputError) as caught:
        load_schedules(write(tmp_path, {**NIGHT, "protocol": "mine.yaml"}))
    assert caught.value.key == "schedules[0].protocol"
    assert caught.value.value == "mine.yaml"
    assert f"{tmp_path / 'mine.yaml'}: " in caught.value.message


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("pilot", ROOT / "protocols/pilot.yaml"),
        ("pilot-gravity", ROOT / "protocols/pilot_gravity.yaml"),
        ("reflex", "reflex"),  # a file beside the schedules comes first
        ("gravity.yaml", None),
    ],
)
def test_a_built_in_protocol_is_named_without_a_path(
    name: str, found: Path | str | None, tmp_path: Path
) -> None:
    (tmp_path / "reflex").write_text((ROOT / "protocols/reflex.yaml").read_text())
    path = write(tmp_path, {**NIGHT, "protocol": name})
    if found is None:
        with pytest.raises(InputError, match=r"protocol = gravity.yaml: no such file"):
            load_schedules(path)
    else:
        (one,) = load_schedules(path)
        assert one.parameters["protocol"] == str(tmp_path / found)


def test_names_and_zones_are_checked(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"schedules\[1\]\.name = nights: is used twice"):
        load_schedules(write(tmp_path, NIGHT, copy.deepcopy(NIGHT)))
    names = ("my night", "my-night")  # Prefect would be given one name for both
    with pytest.raises(InputError, match=r"schedules\[1\]\.name = my-night: is used twice"):
        load_schedules(write(tmp_path, *({**copy.deepcopy(NIGHT), "name": n} for n in names)))
    for zone in ("Europe/Rom", "posixrules"):  # the second is this computer's only
        with pytest.raises(InputError, match=f"timezone = {zone}: is not a time zone"):
            load_schedules(write(tmp_path, NIGHT, timezone=zone))


def weekly(cron: str) -> dict[str, Any]:
    return {"name": "weekly", "flow": "report", "cron": cron}


@pytest.mark.parametrize(
    ("schedule", "key", "said"),
    [
        (weekly("0 25 * * *"), "cron", "must have five fields"),
        (weekly("*/0 * * * *"), "cron", "must have five fields"),
        (weekly("R R * * *"), "cron", "must have five fields"),
        (weekly("0 3 30 2 *"), "cron", "never runs"),
        (weekly("0 3 31 4,6,9,11 *"), "cron", "never runs"),
        ({**NIGHT, "until": "22:00"}, "until", "is when the window begins"),
        ({**NIGHT, "until": "thu 22:00"}, "until", "is when the window begins"),
    ],
)
def test_schedule_without_a_run_is_refused(
    schedule: dict[str, Any], key: str, said: str, tmp_path: Path
) -> None:
    path = write(tmp_path, weekly("0 8 * * *") | {"name": "daily"}, schedule)
    with pytest.raises(InputError, match=said) as error:
        upcoming_runs(path, load_schedules(path), 3)
    assert (error.value.file, error.value.key) == (str(path), f"schedules[1].{key}")


@pytest.mark.parametrize(
    ("schedule", "runs"),
    [
        (weekly("0 3 29 2 *"), ["2028-02-29 03:00:00+01:00", "2032-02-29 03:00:00+01:00"]),
        (weekly("0  3 * *  7"), ["2026-03-29 03:00:00+02:00", "2026-04-05 03:00:00+02:00"]),
        (weekly("30 8 * * fri-mon"), ["2026-03-28 08:30:00+01:00", "2026-03-29 08:30:00+02:00"]),
        (NIGHT, ["2026-03-30 22:00:00+02:00", "2026-04-02 22:00:00+02:00"]),
    ],
)
def test_upcoming_runs_are_local_times(
    schedule: dict[str, Any], runs: list[str], tmp_path: Path
) -> None:
    path = write(tmp_path, schedule)
    after = datetime(2026, 3, 27, 12, tzinfo=UTC)
    (found,) = upcoming_runs(path, load_schedules(path), 2, after)
    assert [str(time) for time in found] == runs


@pytest.mark.parametrize(
    ("zone", "cron", "after", "begins"),
    [
        (ROME, "30 2 * * *", "2027-03-27T12:00", ["03:30:00+02:00", "02:30:00+02:00"]),
        (ROME, "0 2 * * *", "2027-03-27T12:00", ["03:00:00+02:00", "02:00:00+02:00"]),
        (ROME, "30 1 * * *", "2027-03-27T12:00", ["01:30:00+01:00", "01:30:00+02:00"]),
        (ROME, "30 2 * * *", "2026-10-24T12:00", ["02:30:00+02:00", "02:30:00+01:00"]),
        ("Australia/Lord_Howe", "15 2 * * *", "2027-10-02T12:00", ["02:45:00+11:00"]),
    ],
)
def test_no_run_begins_earlier_than_written(
    zone: str, cron: str, after: str, begins: list[str], tmp_path: Path
) -> None:
    """Prefect plans an hour that the clocks leave out for the hour before."""
    path = write(tmp_path, weekly(cron), timezone=zone)
    moment = datetime.fromisoformat(after).replace(tzinfo=UTC)
    (found,) = upcoming_runs(path, load_schedules(path), len(begins), moment)
    assert [str(time)[11:] for time in found] == begins


@pytest.mark.parametrize(
    ("begin", "until", "ends"),
    [
        ("02:30", "03:30", ["28 03:30:00+02:00", "29 03:30:00+02:00"]),  # the hour left out
        ("02:30", "03:00", ["28 03:00:00+02:00", "29 03:00:00+02:00"]),
        ("02:30", "06:00", ["28 06:00:00+02:00", "29 06:00:00+02:00"]),
        ("03:30", "03:00", ["29 03:00:00+02:00", "30 03:00:00+02:00"]),  # a day less half an hour
    ],
)
def test_a_window_that_begins_in_an_hour_left_out_ends_as_written(
    begin: str, until: str, ends: list[str], tmp_path: Path
) -> None:
    days = {"name": "nights", "from": begin, "until": until, "days": list(DAYS)}
    path = write(tmp_path, {**NIGHT, **days})
    (item,) = load_schedules(path)
    (found,) = upcoming_runs(path, [item], 2, datetime(2027, 3, 27, 12, tzinfo=UTC))
    assert [str(item.end(time))[8:] for time in found] == ends


def test_check_prints_upcoming_runs_with_their_ends(tmp_path: Path) -> None:
    off = {**weekly("0 3 * * *"), "active": False}
    words = ("serve", write(tmp_path, NIGHT, off), "--store", tmp_path / "store", "--rig", RIG)
    shown = here(*words, "--check").stdout.partition("upcoming runs")[2]
    rows = re.findall(
        r"(Mon|Thu) \d{4}-\d\d-\d\d 22:00 CES?T +(Tue|Fri) \S+ 06:00 CES?T +nights", shown
    )
    assert len(rows) == 3
    assert {("Mon", "Tue"), ("Thu", "Fri")} == set(rows)
    assert "weekly" not in shown
    nights, report = answer(*words, "--check")["schedules"]
    assert [time[10:19] for time in nights["runs"]] == ["T22:00:00"] * 3
    assert report["runs"] == []
    assert not (tmp_path / "store").exists()
    none = here("serve", "--store", tmp_path / "store", "--rig", RIG, "--check").stdout
    assert "no file of schedules" in none
    assert "None" not in none


@pytest.mark.parametrize(
    ("due", "until", "end"),
    [
        ("2026-11-21 22:00", "06:00", "2026-11-22 06:00:00+01:00"),
        ("2026-11-21 06:00", "06:00", "2026-11-22 06:00:00+01:00"),  # a whole day
        ("2026-11-20 18:00", "mon 06:00", "2026-11-23 06:00:00+01:00"),
        ("2026-11-23 06:00", "mon 06:00", "2026-11-30 06:00:00+01:00"),
        ("2026-03-28 22:00", "06:00", "2026-03-29 06:00:00+02:00"),  # a night of seven hours
        ("2026-03-28 22:00", "02:30", "2026-03-29 03:30:00+02:00"),  # which that night has not
        ("2026-10-24 22:00", "06:00", "2026-10-25 06:00:00+01:00"),  # one of nine
    ],
)
def test_a_window_ends_by_the_clock_on_the_wall(due: str, until: str, end: str) -> None:
    begin = datetime.fromisoformat(due).replace(tzinfo=ZoneInfo(ROME))
    assert str(window_end(begin, until, ROME)) == end


@given(
    st.datetimes(datetime(2020, 1, 1), datetime(2035, 1, 1), timezones=st.just(UTC)),
    st.sampled_from(["", *(f"{day} " for day in DAYS)]),
    st.integers(0, 1439),
    st.sampled_from([ROME, "UTC", "America/New_York", "Australia/Lord_Howe", "Asia/Kathmandu"]),
)
def test_a_window_ends_after_it_began_and_once(due: datetime, day: str, m: int, zone: str) -> None:
    end = window_end(due, f"{day}{m // 60:02d}:{m % 60:02d}", zone)
    days = 7 if day else 1
    assert timedelta(0) < end.astimezone(UTC) - due <= timedelta(days=days, hours=1)
    shown = end.hour * 60 + end.minute
    assert shown == m or (shown - m) % 1440 in {30, 60}  # an hour that the clocks left out


def test_the_compose_file_binds_to_the_loopback_and_holds_no_secret() -> None:
    compose = yaml.safe_load((ROOT / "compose.yaml").read_text())
    ports = [port for service in compose["services"].values() for port in service.get("ports", ())]
    assert ports
    assert all(str(port).startswith("127.0.0.1:") for port in ports)
    names = ("postgres-password", "page-password")
    assert compose["secrets"] == {name: {"file": f"./secrets/{name}"} for name in names}
    assert "/secrets/" in (ROOT / ".gitignore").read_text().split()
    environments = [service.get("environment", {}) for service in compose["services"].values()]
    assert "POSTGRES_PASSWORD" not in {name for each in environments for name in each}
    prefect = compose["services"]["prefect"]
    assert 'PREFECT_SERVER_API_AUTH_STRING="$$(cat' in prefect["command"][0]
    assert prefect["environment"]["PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED"] == "true"
    assert "*" not in prefect["environment"]["PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS"]
