"""Parameters that a command, a deployment and a schedule have in common, each with its help.

A command has an option for each field (`flows.cli.model_options`); deployments and schedules add
what only they have (`plugins.web.server.schedules`).
"""

from __future__ import annotations

import re
from typing import Any, Literal, TypeVar

from pydantic import Field, ValidationError

from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import faults_of
from sliplab.protocols.yaml_file import StrictModel

Period = Literal["week", "month"]
"""Of a report: the last 7 days, or the last month."""
_UNIT = re.compile("_(c|percent)$")
OptionsT = TypeVar("OptionsT", bound=StrictModel)


def made(kind: type[OptionsT], **values: Any) -> OptionsT:
    """Return parameters of a kind.

    Raises:
        InputError: with all faults; keys lack their units, as arguments of functions do.
    """
    try:
        return kind(**values)
    except ValidationError as error:
        faults = faults_of(kind, error)
        raise InputError.joined(
            InputError(_UNIT.sub("", each.key), "", each.value, str(each)) for each in faults
        ) from None


class TrialChoice(StrictModel):
    """Which trials to collect, into which campaign."""

    enable: list[str] = Field(
        default=[], description="Enable an optional level: factor=level. Repeatable."
    )
    trials: int | None = Field(
        default=None, ge=1, le=1_000_000, description="Collect at most this many trials."
    )
    campaign: str | None = Field(
        default=None, description="Campaign name; default: the protocol's name."
    )


class SessionMetadata(StrictModel):
    """Operator and conditions of one session at the rig."""

    operator: str = Field(default="", description="Name of the operator at the rig.")
    temperature_c: float | None = Field(
        default=None, ge=-50, le=100, description="Room temperature, degrees Celsius."
    )
    humidity_percent: float | None = Field(
        default=None, ge=0, le=100, description="Relative humidity, percent."
    )
    note: str = Field(default="", description="A note to store with the session.")


NO_METADATA = SessionMetadata()


class CollectOptions(SessionMetadata, TrialChoice):
    """Parameters of collecting the missing trials of a protocol."""

    no_stopping: bool = Field(
        default=False, description="Go on where the protocol's claims would end it."
    )

    def arguments(self) -> dict[str, Any]:
        """Return them as arguments of `run_request.make_request`."""
        return {
            "enable": tuple(self.enable),
            "campaign": self.campaign,
            "metadata": self,
            "most": self.trials,
            "claims": "overrule" if self.no_stopping else "use",
        }


class RuleOptions(StrictModel):
    """The rule that decides on slip; of the model or the protocol by default."""

    margin: float | None = Field(
        default=None, ge=0, le=1e6, description="Spikes by which the winner must lead."
    )
    smoothing: int | None = Field(
        default=None, ge=1, le=1000, description="Number of windows to average."
    )


class Reason(StrictModel):
    """The reason of a request to a collection."""

    why: str = Field(default="", description="The reason, stored with the request.")


class Requester(StrictModel):
    """The author of a request, and how long to wait for its answer."""

    who: str = Field(default="", description="Your name; default: the login name.")
    wait_s: float = Field(
        default=600.0,
        ge=0,
        le=86400,
        description="Maximum wait until the request is carried out, s.",
    )

    def arguments(self) -> dict[str, Any]:
        """Return them as arguments of the functions in `collecting.requests`."""
        return {"limit_s": self.wait_s, **self.model_dump(exclude={"wait_s"})}


class ControlOptions(Requester, Reason):
    """Parameters of a request to the current collection."""
