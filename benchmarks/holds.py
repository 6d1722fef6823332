"""Press depths of a gravity trial, by whether the heaviest plate slips in the recorded hold.

`python -m benchmarks.holds [N]` prints the figures of docs/decisions/depth.md: N trials (20 by
default) of the gravity protocol with the heaviest plate, all speeds, on the simulated rig with
other press depths, times and scenes. Simulated; mechanics alone, nothing is trained.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sliplab.plugins.simulation.scene_runs import changed, ideal
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.model import Protocol
from sliplab.protocols.plan import make_plan
from sliplab.rigs.build import build_rig
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.storage.streams import Json, NullSink

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Candidate:
    """Another gravity trial: press depth, mm; rest before the release, release and settling, s."""

    words: str
    depth: float
    rest: float = 0.5
    release: float = 0.5
    settle: float = 1.0
    scene: Mapping[str, Any] = field(default_factory=dict)

    def plan(self) -> Plan:
        """The shipped protocol with these."""
        file = ROOT / "protocols" / "gravity.yaml"
        data = yaml.safe_load(file.read_text("utf-8"))
        collection = data["collection"]
        collection["motion"] |= {
            "depth": f"{self.depth} mm",
            "distance": f"{self.depth + 0.2:.2f} mm",
            "let_go": f"{self.release} s",
            "settle": f"{self.settle} s",
            "rest": f"{self.rest} s",
        }
        return make_plan(Protocol.model_validate(data), str(file))


CANDIDATES = (
    Candidate("3.4 mm", 3.4),
    Candidate("3.4 mm, settling 4 s", 3.4, settle=4.0),
    Candidate("3.4 mm, release over 2 s", 3.4, release=2.0),
    Candidate("3.4 mm, rest 4 s, release over 2 s, settling 4 s", 3.4, 4.0, 2.0, 4.0),
    Candidate("3.4 mm, friction 1.0", 3.4, scene={"friction": {"kinetic": 1.0}}),
    Candidate("3.4 mm, relaxation 10 %", 3.4, scene={"skin": {"relaxation_share": 0.1}}),
    Candidate("3.6 mm", 3.6),
    Candidate("3.6 mm, release over 2 s, settling 3 s", 3.6, release=2.0, settle=3.0),
    Candidate("3.8 mm", 3.8),
    Candidate("3.8 mm, release over 2 s, settling 3 s", 3.8, release=2.0, settle=3.0),
    Candidate("3.9 mm", 3.9),
    Candidate("3.9 mm, found 0.05 mm too shallow", 3.85),
    Candidate("3.9 mm, skin 6", 3.9, scene={"skin": {"seed": 6}}),
    Candidate("**4.0 mm**", 4.0),
    Candidate("4.0 mm, found 0.05 mm too shallow", 3.95),
    *(Candidate(f"4.0 mm, skin {n}", 4.0, scene={"skin": {"seed": n}}) for n in range(2, 7)),
    Candidate("4.0 mm, friction 20 % lower", 4.0, scene={"friction": {"kinetic": 0.68}}),
)


def run(rig: RigFile, plan: Plan, trial: PlannedTrial) -> Json:
    """Run a trial as a campaign's first attempt; the simulation's truth."""
    built = build_rig(rig)
    built.connect()
    try:
        for task in plan.changeovers(None, trial):
            built.operator.ask(task.request, task.prompt, task.expected)
        seed = hash_integer(trial.seed, 0)
        truth = built.run_trial(plan.program(trial), NullSink(), seed, None, 100).truth
    finally:
        built.close()
    assert truth is not None
    return truth


def row(candidate: Candidate, count: int) -> list[str]:
    """Slips in the hold, and when the first slip and the incipient onset come."""
    rig = load_rig_file(ROOT / "rigs" / "rehearsal.yaml")[0]
    scale = rig.frame_camera.scale_px_per_mm
    rig = changed(ideal(rig), {"scene": candidate.scene})
    plan = candidate.plan()
    heaviest = max(plan.mass_kg(trial) or 0.0 for trial in plan)
    trials = [trial for trial in plan if plan.mass_kg(trial) == heaviest]
    truths = [run(rig, plan, trial) for trial in trials[:: max(len(trials) // count, 1)]]
    held = np.array([truth["from_hold"]["hold_slip_mm"] for truth in truths]) * scale
    first = (
        np.array([truth["from_hold"]["first_slip_ns"] - truth["reference_ns"] for truth in truths])
        / 1e9
    )
    apart = [truth["incipient_ns"] - truth["from_hold"]["incipient_ns"] for truth in truths]
    most = held.max(axis=1)
    return [
        candidate.words,
        str(len(truths)),
        str(int((most > 2.0).sum())),
        str(int((most > 0.5).sum())),
        f"{most.max():.2f}",
        f"{np.median((held > 0.5).sum(axis=1)):.0f}",
        f"{first.min():.2f} / {np.median(first):.2f}",
        f"{max(apart) / 1e6:.0f}",
    ]


def main(count: int = 20) -> None:
    """Print the table."""
    titles = (
        "gravity trial, 0.245 kg (simulated)",
        "n",
        "slip > 2 px in the hold",
        "> 0.5 px",
        "most (px)",
        "papillae > 0.5 px, median",
        "first slip after the motion began, least / median (s)",
        "references apart, most (ms)",
    )
    print("| " + " | ".join(titles) + " |")
    print("| --- |" + " --: |" * (len(titles) - 1))
    for candidate in CANDIDATES:
        print("| " + " | ".join(row(candidate, count)) + " |", flush=True)


if __name__ == "__main__":
    main(*(int(text) for text in sys.argv[1:2]))
