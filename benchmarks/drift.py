"""References of simulated campaigns: how often drift is found, and how often it is a false alarm.

Each campaign is another skin and other pixels, its parameters drawn 20 % around the defaults; depth
zero is off by up to 0.05 mm at each reference. In every third campaign, friction falls by 10 % from
the first reference to the last; the others are steady. They are fitted by one bank of worlds of the
default skin, which is kept in FOLDER.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import yaml

from sliplab.flows.running import orchestration
from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.drift.document import FRICTION
from sliplab.plugins.twin.drift.estimates import drifts
from sliplab.plugins.twin.drift.flow import OneSpecimen
from sliplab.plugins.twin.parameters import drawn
from sliplab.plugins.twin.statistics import of_names
from sliplab.plugins.twin.worlds import DrawnWorld, Slides, guess_of, other_specimen, simulated
from sliplab.protocols import load_plan
from sliplab.protocols.shipped import shipped_protocols
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

SPREAD, SPECIMENS, ZERO_MM = 0.5, 0.2, 0.05
FALL = 0.9
CONDITION = {"depth": 2.8, "speed": 1.6, "direction": 0}


def main() -> None:
    """Print a line for each campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--campaigns", type=int, default=9)
    parser.add_argument("--bank", type=int, default=100, help="worlds to compare with")
    parser.add_argument("--without-forces", action="store_true")
    asked = parser.parse_args()
    with_forces = not asked.without_forces
    folder: Path = asked.folder
    store = TrialStore(folder) if folder.exists() else TrialStore.create(folder)
    data = yaml.safe_load(shipped_protocols()["pilot"].read_text())
    data["collection"]["references"] = {"every": 4, "condition": CONDITION}
    protocol = folder / "references.yaml"
    protocol.write_text(yaml.safe_dump(data))
    plan = load_plan(protocol)
    trials = [trial for trial in plan if trial.role == "reference"]
    rig = changed(
        load_rig_file(Path("mock-force" if with_forces else "rehearsal"))[0],
        {"scene": {"level": "L3"}, "frame_camera": {"level": "tracks"}},
    )
    prior = OneSpecimen(rig, SPREAD, 1, with_forces)
    slides = Slides(plan, (trials[0],), frozenset({trials[0].id}))
    stored = Derived.of(store, "drift-worlds")
    orchestration.configure_prefect(folder)
    bank = prior.bank(simulated("reference (worlds)", prior, slides, asked.bank, stored))
    places = np.array([trial.index + 1.0 for trial in trials])
    along = (places - places[0]) / np.ptp(places)
    rng = np.random.default_rng(5)
    for number in range(asked.campaigns):
        fall = FALL if number % 3 == 2 else 1.0
        specimen = int(rng.integers(2**31))
        values = drawn(scene_of(rig), prior.parameters, SPECIMENS, rng)
        observed = []
        for trial, share in zip(trials, along, strict=True):
            now = {**values, FRICTION: values[FRICTION] * fall**share}
            made = other_specimen(rig, now, specimen, float(rng.uniform(-ZERO_MM, ZERO_MM)))
            world = DrawnWorld(
                made, Slides(plan, (trial,), frozenset({trial.id})), number, guess_of(rig)
            )
            observed.append(of_names(world.statistics().fitted, bank.statistics))
        parameters = drifts(bank, np.stack(observed), places)
        found = [one for one in parameters if one.identified]
        alarms = [one.parameter for one in found if one.line.p < 0.05 / len(found)]
        line = next(one.line for one in parameters if one.parameter == FRICTION)
        change, low, high = (
            100.0 * np.expm1(np.ptp(places) * x) for x in (line.slope, line.low, line.high)
        )
        print(
            f"simulated campaign {number}: friction {100 * (fall - 1):+.0f} %, found "
            f"{change:+.1f} % ({low:+.1f} to {high:+.1f}); called changed of {len(found)}: "
            f"{', '.join(alarms) or 'none'}",
            flush=True,
        )


if __name__ == "__main__":
    main()
