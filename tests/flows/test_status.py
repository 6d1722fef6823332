"""The state of a store: what is done, what is left, when it ends, who holds it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from sliplab.analysis.references import ReferenceDrift
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.status import StatusReader, night_of, nights_needed, pace_error, paces_of
from sliplab.storage.files import read_json, write_json
from sliplab.storage.trials import control
from sliplab.storage.trials.checksums import DATA, PROVENANCE
from sliplab.storage.trials.lock import STORE_LOCK, exclusive
from sliplab.storage.trials.store import Campaign, TrialStore
from tests.command_line import answer
from tests.flows.collecting.test_session import session, short
from tests.flows.collecting.test_watches import with_references

EVENING = datetime(2026, 3, 2, 22, 0, tzinfo=UTC)


def ended(campaign: Campaign, trials: Sequence[str], *moments: datetime) -> None:
    """Let trials have ended at these moments."""
    for trial, moment in zip(trials, moments, strict=True):
        path = campaign.folder / "trials" / trial / PROVENANCE
        write_json(path, {**read_json(path), "ended": moment.isoformat()})


def test_a_store_says_what_is_done_left_excluded_and_by_whom_it_is_held(tmp_path: Path) -> None:
    work, campaign = session(tmp_path, short())
    store = TrialStore.open(tmp_path / "store")
    reader = StatusReader(store)
    trials = [trial.id for trial in work.plan]
    assert reader.read(EVENING).campaigns[0].nights_left is None
    work.take(pending_trials(work.plan, campaign)[:2])
    ended(campaign, trials[:2], EVENING - timedelta(days=1), EVENING - timedelta(days=1, hours=-1))
    control.ask(store, "pause", who="anna", why="lunch")
    with exclusive(store.folder / STORE_LOCK, "the store", about={"collects": "tiny"}):
        found = reader.read(EVENING)
    assert found.collects == "tiny"
    assert found.running is not None
    assert "pid" in found.running
    assert found.paused is not None
    assert "pause by anna" in found.paused
    (item,) = found.campaigns
    assert (item.planned, item.committed, item.missing) == (3, 2, 1)
    assert (item.nights, item.tonight, item.simulated) == (1, 0, True)
    assert item.nights_left is not None
    assert item.nights_left.expected == 1
    assert item.nights_left.low is None
    assert item.nights_left.last == "2026-03-02"
    assert item.bytes_per_trial is not None
    assert item.nights_of_disk == pytest.approx(found.disk_free / (2 * item.bytes_per_trial))
    (item,) = reader.read(EVENING - timedelta(days=1)).campaigns
    assert (item.tonight, item.nights_left) == (2, None)  # the only night is not over
    control.skip(campaign, trials[2:], {"who": "ben", "when": "now", "why": "the tip was worn"})
    reader = StatusReader(store)
    (item,) = reader.read(EVENING).campaigns
    assert (item.missing, item.nights_left, item.seconds_left) == (0, None, None)
    assert [(out["trial"], out["by"]) for out in item.excluded] == [(trials[2], "ben")]
    (shown,) = answer("status", store.folder)["campaigns"]
    assert (shown["missing"], shown["excluded"][0]["by"]) == (0, "ben")
    assert reader.read(EVENING).running is None


def test_a_trial_that_is_cut_short_after_it_was_read_counts_no_longer(tmp_path: Path) -> None:
    work, campaign = session(tmp_path, short())
    reader = StatusReader(TrialStore.open(tmp_path / "store"))
    trials = pending_trials(work.plan, campaign)[:2]
    work.take(trials)
    assert reader.read(EVENING).campaigns[0].committed == 2
    data = campaign.folder / "trials" / trials[0].id / DATA
    data.chmod(0o644)
    data.write_bytes(data.read_bytes()[:1000])
    assert reader.read(EVENING).campaigns[0].committed == 1


def test_a_damaged_campaign_is_named_and_hides_no_other(tmp_path: Path) -> None:
    _, campaign = session(tmp_path, short())
    campaign.protocol_file.write_text("protocol: [")
    (item,) = StatusReader(TrialStore.open(tmp_path / "store")).read(EVENING).campaigns
    assert item.problem is not None
    assert "protocol.yaml" in item.problem


def test_the_drift_of_the_last_reference_trial_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, campaign = session(tmp_path, with_references())
    work.take(pending_trials(work.plan, campaign))
    references = [trial.id for trial in work.plan if trial.role == "reference"]
    rates = dict.fromkeys(references, 500.0) | {references[0]: 1000.0, references[-1]: 1100.0}
    monkeypatch.setattr(
        "sliplab.analysis.references.hold_rate", lambda recording: rates[recording.trial_id]
    )
    (item,) = StatusReader(TrialStore.open(tmp_path / "store")).read(EVENING).campaigns
    (drift,) = item.drift
    assert (drift.key, drift.trial, drift.bound_percent) == ("event_rate", references[-1], 20)
    assert drift.percent == pytest.approx(10)
    assert not drift.reaches()
    rates[references[-1]] = float("nan")
    (item,) = StatusReader(TrialStore.open(tmp_path / "store")).read(EVENING).campaigns
    assert item.drift[0].percent is None
    assert item.drift[0].reaches()
    assert answer("status", tmp_path / "store")["campaigns"][0]["drift"][0]["percent"] is None


@pytest.mark.parametrize(
    ("expected", "value", "percent", "beyond"),
    [
        (1000, 1200, 20, False),
        (1000, 1201, 20.1, True),
        (1000, 799, -20.1, True),
        (0, 0, 0, False),
        (0, 1, 100, True),
        (1000, float("nan"), float("nan"), True),
    ],
)
def test_a_drift_is_beyond_its_bound(
    expected: float, value: float, percent: float, beyond: bool
) -> None:
    drift = ReferenceDrift("event_rate", "a", "b", expected, value, 20)
    assert drift.percent == pytest.approx(percent, nan_ok=True)
    assert drift.beyond is beyond


def test_a_night_is_from_noon_to_noon() -> None:
    noon = datetime(2026, 3, 2, 12, 0, tzinfo=UTC)
    assert night_of(noon) == noon.date()
    assert night_of(noon + timedelta(hours=23, minutes=59)) == noon.date()
    assert night_of(noon - timedelta(seconds=1)) == noon.date() - timedelta(days=1)


def test_the_pace_leaves_out_what_came_between_two_trials(tmp_path: Path) -> None:
    work, _ = session(tmp_path, short())
    first, second, third = work.plan
    seconds = work.plan.seconds(second)
    times = {first.id: EVENING, second.id: EVENING + timedelta(seconds=2 * seconds)}
    assert paces_of(work.plan, {first.id: EVENING}) == []
    assert paces_of(work.plan, times) == [pytest.approx(2)]
    times[third.id] = EVENING + timedelta(hours=10)  # a person changed the skin
    assert paces_of(work.plan, times) == [pytest.approx(2)]


def test_pace_error_shrinks_with_trials() -> None:
    paces = [1.0, 1.2, 0.9, 1.1]
    assert pace_error(paces[:3], 10) is None
    assert pace_error(paces, 0) is None
    few, many = pace_error(paces, 100), pace_error(paces * 10, 100)
    assert few is not None
    assert many is not None
    assert few == pytest.approx(2.353 * 0.1291 * (1 / 100 + 1 / 4) ** 0.5, rel=1e-3)
    assert many < few / 2


@pytest.mark.parametrize(
    ("trials", "missing", "nights"),
    [
        ([40], 400, (10, None, None)),
        ([40, 40], 401, (11, None, None)),
        ([40] * 5, 400, (10, 10, 10)),  # nights that do not differ
        ([100, 1, 1, 1], 1000, (39, 11, None)),  # nothing bounds them
    ],
)
def test_nights_that_are_left(
    trials: list[int], missing: int, nights: tuple[int, int | None, int | None]
) -> None:
    assert nights_needed(trials, missing) == nights


def test_nine_of_ten_intervals_hold_the_nights_that_it_takes() -> None:
    """Independent nights of 8 trials each on average, 120 missing: 300 campaigns."""
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(300):
        past = np.maximum(rng.poisson(8, 6), 1).tolist()
        taken = np.cumsum(np.maximum(rng.poisson(8, 200), 1))
        needed = int(np.searchsorted(taken, 120)) + 1
        _, low, high = nights_needed(past, 120)
        held += (low is None or low <= needed) and (high is None or needed <= high)
    assert held >= 258  # 90 % less 2.3 standard deviations of 300 draws
