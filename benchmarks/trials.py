"""Whole trials of the kinematic grid on a simulated rig, from the first motion to the commit.

Simulated, like everything that comes out of it. `python -m benchmarks.trials RIG` takes one trial
in a process of its own and prints the most memory it held, MB.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from benchmarks.measure import SEED, peak_mb
from sliplab.flows.collecting.live_feed import LiveFeed
from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.planning.run_request import describe_campaign, make_request
from sliplab.protocols import PlannedTrial
from sliplab.rigs.build import build_rig
from sliplab.storage.trials.store import TrialStore

ROOT = Path(__file__).parent.parent


@dataclass(frozen=True)
class SimulatedSession:
    """Session at a simulated rig with its store, ready to take trials."""

    collector: TrialCollector
    trials: list[PlannedTrial]
    feed: LiveFeed

    def take(self, count: int | None = None) -> float:
        """Take the next trials (all by default); return the planned seconds of their motion.

        The time of moving to the start is part of the wall time only.
        """
        wanted = self.trials[:count]
        del self.trials[: len(wanted)]
        self.collector.take(wanted)
        return sum(self.collector.plan.seconds(trial) for trial in wanted)


@contextmanager
def open_session(rig: str, count: int, protocol: str = "kinematic") -> Iterator[SimulatedSession]:
    """Open a session that can take `count` random trials of a protocol's grid."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        text = yaml.safe_load((ROOT / "protocols" / f"{protocol}.yaml").read_text("utf-8"))
        # random trials are no neighbours: depth zero would be found before each
        del text["collection"]["maintenance"]
        file = Path(folder) / f"{protocol}.yaml"
        file.write_text(yaml.safe_dump(text, sort_keys=False), "utf-8")
        run_request = make_request(file, ROOT / "rigs" / f"{rig}.yaml", Path(folder) / "store")
        store = TrialStore.create(run_request.store)
        campaign = describe_campaign(store, run_request)
        device = build_rig(run_request.rig)
        device.connect()
        every = list(run_request.plan)
        chosen = np.random.default_rng(SEED).choice(len(every), count, replace=False)
        feed = LiveFeed(run_request)
        collector = TrialCollector(run_request.plan, run_request.rig, device, campaign, feed=feed)
        try:
            with feed.running():
                yield SimulatedSession(collector, [every[index] for index in sorted(chosen)], feed)
        finally:
            device.close()


def main(rig: str) -> None:
    """Take one trial and print the peak memory, MB."""
    with open_session(rig, 1) as work:
        work.take()
    print(f"{peak_mb():.1f}")


if __name__ == "__main__":
    main(sys.argv[1])
