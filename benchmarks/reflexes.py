"""Worth of a reflex in retractions of the gravity protocol: does the plate still slip off?

`python -m benchmarks.reflexes MODEL [--trials N]` prints the table of docs/live.md: N trials of
each plate with no reflex, with `stop` and with `press:0.4`. Times are from the beginning of the
retraction; gross slip is the simulation's own, and a trial has none where the plate stayed with the
sensor until it left. MODEL is a network as `sliplab study` trains it. All is simulated.
"""

from __future__ import annotations

import argparse
import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.flows.detect import detect
from sliplab.flows.detecting.request import DetectRequest, make_detect_request
from sliplab.protocols import Plan, Trial
from sliplab.protocols.program import Step
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile

ROOT = Path(__file__).parents[1]
RIG = ROOT / "rigs" / "rehearsal.yaml"
PROTOCOL = ROOT / "protocols" / "gravity.yaml"
MASSES = ("0.165kg", "0.205kg", "0.245kg")
SPEED = "0.5mmps"
REFLEXES = (None, "stop", "press:0.4")


@dataclass(frozen=True)
class Outcome:
    """One trial.

    Attributes:
        incipient_ms, gross_ms: from the begin of the retraction to the detection of incipient slip
            and to true gross slip; None where there was none.
        done: the reflex was carried out.
    """

    incipient_ms: float | None
    gross_ms: float | None
    done: bool


def outcome(order: DetectRequest) -> Outcome:
    """Run one trial on the simulated rig."""
    begun: list[int] = []
    truths: list[dict[str, Any]] = []

    def build(file: RigFile) -> Rig:
        rig = build_rig(file)
        take_step = rig.take_step

        def watched(index: int, step: Step, *rest: Any) -> Any:
            assert rig.simulation is not None
            if step.phase == "retract":
                begun.append(rig.arm.now_ns())
            elif step.phase == "release":
                truths.append(rig.simulation.truth(begun[0]))
            return take_step(index, step, *rest)

        rig.take_step = watched  # type: ignore[method-assign]
        return rig

    result = detect(order, build=build)
    found = result["onsets"]["incipient"]
    truth = truths[0]

    def since(trial_ns: float | None) -> float | None:
        return None if trial_ns is None else (trial_ns - truth["reference_ns"]) / 1e6

    detected = None if found is None else since(found["trial_s"] * 1e9)
    return Outcome(
        detected, since(truth["gross_ns"]), bool((result["reflex"] or {}).get("done", False))
    )


def trials_of(plan: Plan, mass: str, count: int) -> list[Trial]:
    """Trials with a plate, spread over the speeds and repetitions of the plan."""
    fitting = [t for t in plan if t.role == "measured" and f"mass={mass}" in t.id.split(",")]
    return fitting[:: max(1, len(fitting) // count)][:count]


def row(mass: str, reflex: str | None, outcomes: Sequence[Outcome]) -> str:
    """One line of the table."""
    slipped = [o.gross_ms for o in outcomes if o.gross_ms is not None]
    detected = [o.incipient_ms for o in outcomes if o.incipient_ms is not None]
    low, high = exact_interval(len(slipped), len(outcomes))
    return (
        f"| {mass} | {reflex or 'none'} | {len(outcomes)} | "
        f"{_span(detected)} | {sum(o.done for o in outcomes)} | "
        f"{len(slipped)} ({100 * low:.0f} to {100 * high:.0f} %) | {_span(slipped)} |"
    )


def _span(values: Sequence[float]) -> str:
    if not values:
        return ""
    return f"{median(values):.0f} ({min(values):.0f} to {max(values):.0f})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reflexes")
    parser.add_argument("model", type=Path)
    parser.add_argument("--trials", type=int, default=9, help="of each plate")
    asked = parser.parse_args()
    print(f"simulated; {PROTOCOL.name}, reflexes within the protocol's limit of depth\n")
    print(
        "| plate | reflex | trials | incipient detected (ms, median and range) | reflexes | "
        "gross slips (95 %) | gross slip (ms, median and range) |"
    )
    print("| --- | --- | --: | --- | --: | --- | --- |")
    for mass in MASSES:
        for reflex in REFLEXES:
            order = make_detect_request(
                RIG, asked.model, protocol=PROTOCOL, trial=f"mass={mass},speed={SPEED}",
                reflex=reflex,
            )  # fmt: skip
            assert order.plan is not None
            chosen = trials_of(order.plan, mass, asked.trials)
            with contextlib.redirect_stderr(io.StringIO()):
                outcomes = [outcome(replace(order, trial=trial)) for trial in chosen]
            print(row(mass, reflex, outcomes), flush=True)


if __name__ == "__main__":
    main()
