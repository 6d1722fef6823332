"""Programs beside a service, such as its alerts: started again, and ended with it."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from sliplab.plugins.web.server.helpers import keep_running
from sliplab.plugins.web.server.schedules import has_alerts, load_schedules
from sliplab.storage.process import send
from sliplab.storage.trials.lock import current_holder
from sliplab.storage.trials.store import TrialStore

pytestmark = pytest.mark.programs


async def holder_of(store: TrialStore, other_than: int | None = None) -> dict[str, object]:
    """Wait until a program watches the store."""
    async with asyncio.timeout(120):
        while True:
            holder = current_holder(store.folder / ".alerts.lock")
            if holder and holder.get("pid") not in {None, other_than}:
                return holder
            await asyncio.sleep(0.05)


def test_alerts_are_started_again_and_end_with_the_service(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    file = tmp_path / "schedules.yaml"
    file.write_text("timezone: UTC\nschedules: []\nalerts: {to: ['json://localhost']}\n")
    assert load_schedules(file) == []
    assert has_alerts(file)

    words = ("alerts", str(store.folder), str(file))

    async def run() -> None:
        stopped = asyncio.Event()
        task = asyncio.create_task(keep_running(words, stopped, again_s=0.1))
        first = await holder_of(store)
        assert send(first, signal.SIGKILL)
        second = await holder_of(store, int(str(first["pid"])))
        stopped.set()
        async with asyncio.timeout(60):
            await task
        assert current_holder(store.folder / ".alerts.lock") is None
        assert not send(second, signal.SIGTERM)

    asyncio.run(run())


def test_file_without_alerts_has_none(tmp_path: Path) -> None:
    file = tmp_path / "schedules.yaml"
    file.write_text("timezone: UTC\nschedules: []\n")
    assert not has_alerts(file)
