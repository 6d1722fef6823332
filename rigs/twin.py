"""The section `twin:` of a rig file: how its simulated scene was fitted to a pilot, and on what."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date
from typing import Annotated

from pydantic import Field

from sliplab.protocols.plan import Plan
from sliplab.protocols.program import ACTING, Move
from sliplab.protocols.yaml_file import StrictModel

Number = Annotated[float, Field(ge=-1e12, le=1e12)]


class FittedValue(StrictModel):
    """One number of the section `mock:`."""

    value: Number
    """Median of what the pilot leaves likely; the rig's own value where it was not identified."""
    low: Number | None
    high: Number | None
    """Central 95 % of what the pilot leaves likely; null where a misfit touches the number."""
    unit: str = ""
    identified: bool
    """The pilot says more of it than was assumed; the rest keep the value that was assumed."""


class ConditionRange(StrictModel):
    """Least and most of a condition in the pilot."""

    least: Number
    most: Number


class TwinRecord(StrictModel):
    """A fit of a simulated rig to a pilot."""

    campaign: str
    """The pilot's name."""
    checksum: str
    """Of the trials that were fitted."""
    trials: Annotated[int, Field(ge=1, le=10_000_000)]
    """Their number."""
    simulated: bool
    """The pilot itself was simulated."""
    fitted: date
    method: str
    depth_mm: ConditionRange
    speed_mm_s: ConditionRange
    parameters: dict[str, FittedValue]
    """By key in the section `mock:`."""
    misfits: tuple[str, ...] = ()
    """What the pilot shows and the scene lacks, each after the stream that shows it."""
    needs: dict[str, str] = Field(default_factory=dict)
    """Effects of the scene: whether the pilot asks for them."""


def warnings(twin: TwinRecord, plan: Plan) -> Iterator[str]:
    """Report where a plan leaves the conditions that a twin was fitted on, and the twin's gaps.

    A slide that is pressed deeper or driven faster than any of the pilot's is simulated by numbers
    that no trial has tested.
    """
    depths, speeds = set(), set()
    for trial in plan:
        at_mm = 0.0
        for step in plan.program(trial).steps:
            if not isinstance(step, Move):
                continue
            if step.phase in ACTING:
                # a retraction begins in contact and ends clear of the plate
                depths |= {max(at_mm, 0.0), max(step.to.depth_mm, 0.0)}
                speeds.add(step.speed_mm_s)
            at_mm = step.to.depth_mm
    for name, unit, found, fitted in (
        ("depth", "mm", depths, twin.depth_mm),
        ("speed", "mm/s", speeds, twin.speed_mm_s),
    ):
        low, high = min(found, default=fitted.least), max(found, default=fitted.most)
        if low < fitted.least - 1e-9 or high > fitted.most + 1e-9:
            yield (
                f"{name} {low:g} to {high:g} {unit} in contact; the twin was fitted on "
                f"{fitted.least:g} to {fitted.most:g} {unit}"
            )
    for misfit in twin.misfits:
        yield f"the pilot shows what this scene lacks ({misfit})"
