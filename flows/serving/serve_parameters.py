"""What each deployment may be asked for. Prefect's page makes its forms from these models.

Store and rig are not among them: they are what `sliplab serve` was started with, so that nobody
can send an arm's data elsewhere from a page.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from sliplab.flows.serving.serve_windows import Until, Zone
from sliplab.protocols.yaml_file import StrictModel


class Parameters(StrictModel):
    """Base of all: an unknown parameter is an error."""


class OnRig(Parameters):
    """What everything that moves the arm may be told."""

    operator: str = Field(default="", description="Who stands at the rig.")
    temperature_c: float | None = Field(
        default=None, ge=-50, le=100, description="Room, degrees Celsius."
    )
    humidity_percent: float | None = Field(
        default=None, ge=0, le=100, description="Relative, percent."
    )
    note: str = Field(default="", description="Anything worth keeping.")
    until: Until | None = Field(
        default=None,
        description='When the rig must be free again: "06:00" or "mon 06:00". No trial is begun '
        "that would not be over by then.",
    )
    timezone: Zone = Field(default="UTC", description="Of `until`, such as Europe/Rome.")
    patience_min: float = Field(
        default=10.0,
        ge=0,
        le=1440,
        description="How long to wait for a rig or a store that another program uses, minutes; "
        "with `until`, as long as the window lasts.",
    )


class Collect(OnRig):
    """Takes the trials that the store lacks."""

    protocol: Path = Field(description="A protocol file (.yaml) below the service's own folder.")
    trials: int | None = Field(
        default=None, ge=1, le=1_000_000, description="Take so many of the missing, no more."
    )
    enable: list[str] = Field(default=[], description="Optional levels to switch on: factor=level.")
    campaign: str | None = Field(default=None, description="Its name; the protocol's by default.")


class Chain(Collect):
    """Collection, then labels and evaluation of what there is."""

    train: bool = Field(
        default=True,
        description="Train again where trials came in; else evaluate a fresh model only.",
    )


class Study(OnRig):
    """The whole chain over the shipped protocols, to the report."""

    pilot: bool = Field(default=False, description="The small protocols.")
    extra: bool = Field(
        default=True, description="Also the disturbance of 125 % that the paper left out."
    )


class Step(Parameters):
    """One step on what is stored."""

    campaigns: list[str] = Field(default=[], description="Only these campaigns; all by default.")


class Evaluate(Step):
    """Scores the network on trials it has never seen."""

    margin: float | None = Field(
        default=None, ge=0, le=1e6, description="Spikes a winner must lead by."
    )
    smoothing: int | None = Field(
        default=None, ge=1, le=1000, description="Windows to average over."
    )


class Ask(Parameters):
    """A word to the collection that runs."""

    who: str = Field(default="", description="Who asks; kept with the request.")
    why: str = Field(default="", description="The reason; kept with the request.")
    wait_s: float = Field(
        default=600.0, ge=0, le=86400, description="How long to wait until it is carried out, s."
    )


FlowName = Literal["collect", "label", "train", "evaluate", "report", "study", "chain"]
SCHEDULED: dict[FlowName, type[Parameters]] = {
    "collect": Collect,
    "label": Step,
    "train": Step,
    "evaluate": Evaluate,
    "report": Step,
    "study": Study,
    "chain": Chain,
}
"""What a schedule may start; `pause`, `resume` and `stop` are for people."""
