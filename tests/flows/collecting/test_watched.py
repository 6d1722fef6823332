"""A collection that is watched: its data are those of one that is not."""

from __future__ import annotations

import json
import threading
from pathlib import Path

from sliplab.flows.collecting.live_feed import STATE, LiveFeed, LiveFolder
from tests.flows.collecting.test_session import session, short
from tests.flows.conftest import requested, take_all


def test_viewers_change_no_byte(tmp_path: Path) -> None:
    alone, plain = session(tmp_path / "a", short())
    take_all(alone)
    folder = tmp_path / "b"
    work, watched = session(folder, short())
    feed = LiveFeed(requested(folder))
    work.feed = feed
    live, over, seen = LiveFolder(folder / "store"), threading.Event(), set()

    def watch() -> None:
        while not over.wait(0.02):
            live.watch()
            if text := live.read(STATE)[1]:
                seen.add(json.loads(text).get("trial", ""))

    viewers = [threading.Thread(target=watch) for _ in range(5)]
    with feed.running():
        feed.watched = True  # from the first trial on
        for viewer in viewers:
            viewer.start()
        try:
            take_all(work)
        finally:
            over.set()
            for viewer in viewers:
                viewer.join(10)
    assert seen <= {trial.id for trial in work.plan} | {""}
    trials = sorted(plain.committed())
    assert trials == sorted(watched.committed())
    sums = [[item.recording(trial).raw_checksum for trial in trials] for item in (plain, watched)]
    assert sums[0] == sums[1]
