"""The report of a period: what was taken, set aside and logged in it, and nothing else."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import uuid4

import pytest

from sliplab.flows.log import add_note
from sliplab.flows.period import days, period_before, period_report, write_period_report
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.running import run_records
from sliplab.protocols import InputError
from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer, here
from tests.flows.collecting.test_session import session, short
from tests.flows.test_status import ended
from tests.storage.trial_files import fail


def test_a_week_says_what_happened_in_it(tmp_path: Path) -> None:
    work, campaign = session(tmp_path, short())
    store = TrialStore.open(tmp_path / "store")
    work.take(pending_trials(work.plan, campaign))
    now = datetime.now().astimezone()
    since, until = now - timedelta(days=7), now + timedelta(minutes=5)
    trials = [trial.id for trial in work.plan]
    ended(campaign, trials, now - timedelta(days=8), now - timedelta(days=2), now)
    fail(campaign, trials[2], 1)
    add_note(store, "torn <b>", who="anna", context={"skin": "0043"})
    add_note(store, "old", who="ben")
    path = store.folder / "log" / "000002.json"
    write_json(path, {**read_json(path), "when": (now - timedelta(days=30)).isoformat()})
    run = str(uuid4())
    run_records.begin(store.folder, run, "collect", run_records.EMBEDDED, "nightly")
    run_records.end(store.folder, run, "FAILED", "the arm did not answer", "flow")
    found = period_report(store, since, until, now)
    (item,) = found.campaigns
    assert sum(item.trials.values()) == 2
    assert list(item.causes.values()) == [1]
    assert item.status.context == {"skin": "0043"}
    assert (found.runs, len(found.failed)) == (1, 1)
    assert "the arm did not answer" in found.failed[0]
    assert [(entry.who, entry.text) for entry in found.log] == [("anna", "skin 0043, torn <b>")]
    page = write_period_report(store, since, until, now)
    text = page.read_text()
    assert "torn &lt;b&gt;" in text
    assert "simulated" in text
    assert read_json(page.with_suffix(".json"))["runs"] == 1


def test_days_and_periods_begin_at_midnight() -> None:
    now = datetime(2026, 3, 31, 7, 30).astimezone()
    begin, end = days("2026-03-02", None, now)
    assert (f"{begin:%m-%d %H:%M}", f"{end:%m-%d %H:%M}") == ("03-02 00:00", "04-01 00:00")
    begin, end = period_before(now, "week")
    assert (f"{begin:%m-%d}", f"{end:%m-%d %H:%M}") == ("03-24", "03-31 00:00")
    assert f"{period_before(now, 'month')[0]:%m-%d}" == "02-28"
    assert begin.tzinfo is not None


@pytest.mark.parametrize(
    ("since", "until", "says"),
    [
        ("yesterday", None, "must be a day such as"),
        ("2026-03-02", "2026-03-01", "is before --since"),
        (None, "2026-03-01", "is required"),
        ("9999-01-01", None, "^--since = 9999-01-01: is in the future"),
    ],
)
def test_wrong_days_are_named(since: str | None, until: str | None, says: str) -> None:
    with pytest.raises(InputError, match=says):
        days(since, until, datetime.now(UTC))


def test_the_command_needs_no_analysis(tmp_path: Path) -> None:
    TrialStore.create(tmp_path / "s")
    done = answer("report", tmp_path / "s", "--since", "2026-03-02", "--until", "2026-03-08")
    assert Path(done["page"]).name == "2026-03-02_2026-03-08.html"
    assert done["campaigns"] == []
    both = ("--since", "2026-03-02", "--campaign", "c")
    assert here("report", tmp_path / "s", *both).returncode == 2
