"""Compile what most tests call, once: simulated trials and their labels.

    python .ci/kernels.py RIG...

It needs the core and the extra `video`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from sliplab.analysis.labels.event_labels import onsets_by_events
from sliplab.analysis.labels.labelling import label_recording
from sliplab.flows.collecting.session import TrialCollector
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import describe_campaign, make_request
from sliplab.rigs.build import build_rig
from sliplab.storage.trials.store import TrialStore

ROOT = Path(__file__).parents[1]
TRIALS = [("pilot", "rehearsal"), ("pilot_gravity", "rehearsal"), ("pilot", "mock")]


def main(rigs: list[str]) -> None:
    """Take the shortest trial of each protocol on these rigs, and label it by both cameras."""
    for protocol, rig_name in TRIALS:
        if rig_name not in rigs:
            continue
        with tempfile.TemporaryDirectory() as folder:
            request = make_request(
                ROOT / "protocols" / f"{protocol}.yaml",
                ROOT / "rigs" / f"{rig_name}.yaml",
                Path(folder) / "store",
            )
            campaign = describe_campaign(TrialStore.create(request.store), request)
            rig = build_rig(request.rig)
            rig.connect()
            collector = TrialCollector(request.plan, request.rig, rig, campaign)
            collector.take([min(pending_trials(request.plan, campaign), key=request.plan.seconds)])
            rig.close()
            for recording in campaign.recordings():
                label_recording(recording, request.plan.protocol.analysis.labelling)
                if protocol == "pilot":
                    onsets_by_events(recording, request.plan.protocol.analysis.labelling)


if __name__ == "__main__":
    main(sys.argv[1:])
