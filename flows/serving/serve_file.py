"""The file of schedules that `sliplab serve` reads: nights and weekends, checked like a protocol.

timezone: Europe/Rome
schedules:
  - {name: nights, flow: collect, protocol: kinematic.yaml,
     days: [mon, tue, wed, thu], from: "22:00", until: "06:00"}
  - {name: morning report, flow: report, cron: "30 7 * * mon-fri"}
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, create_model

from sliplab.flows.serving.serve_parameters import SCHEDULED, FlowName, OnRig, Parameters
from sliplab.flows.serving.serve_windows import From, Zone, cron_of
from sliplab.protocols import InputError
from sliplab.protocols.yaml_file import KeyedError, StrictModel, parse_yaml, read_text, validate

Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
_NAME = re.compile(r"[a-z0-9][a-z0-9 _-]{0,60}")


class Timing(StrictModel):
    """When something is started: on days from an hour on, or by a cron line."""

    model_config = ConfigDict(populate_by_name=True)

    name: str
    days: list[Day] | None = Field(default=None, min_length=1)
    from_: From | None = Field(default=None, alias="from")
    cron: str | None = None
    active: bool = True


_TIMING = {*Timing.model_fields, "flow", "timezone"}


def _schedule(flow: FlowName, parameters: type[Parameters]) -> type[BaseModel]:
    """Timing and the parameters of one flow in one mapping, as a person writes it."""
    kind: Any = Literal[flow]
    made: type[BaseModel] = create_model(
        f"{flow} schedule", __base__=(Timing, parameters), flow=(kind, ...)
    )
    return made


_MODELS = {flow: _schedule(flow, parameters) for flow, parameters in SCHEDULED.items()}


class Scheduled(StrictModel):
    """One schedule, ready for Prefect.

    Attributes:
        parameters: of the flow, as JSON.
    """

    name: str
    flow: FlowName
    cron: str
    timezone: str
    active: bool
    parameters: dict[str, Any]


class _File(StrictModel):
    """The file before each schedule is looked at by its flow."""

    timezone: Zone
    schedules: list[dict[str, Any]]


def load_schedules(path: Path) -> list[Scheduled]:
    """The schedules of a file; protocols are named from the file's own folder.

    Raises:
        InputError: anything wrong, with file, key, value and what would be right.
    """
    read = parse_yaml(read_text(path, "schedule file"), path)
    file = validate(_File, read, path)
    made: list[Scheduled] = []
    for number, data in enumerate(file.schedules):
        where = f"schedules[{number}]"
        try:
            made.append(_one(data, file.timezone, path))
        except InputError as error:
            key = f"{where}.{error.key}" if error.key else where
            value = error.value and read.written.get(key, error.value)
            raise InputError(path, key, value, error.expected) from None
        if made[-1].name in {item.name for item in made[:-1]}:
            raise InputError(path, f"{where}.name", made[-1].name, "stands twice")
    return made


def _one(data: dict[str, Any], timezone: str, path: Path) -> Scheduled:
    flow = data.get("flow")
    if not isinstance(flow, str) or flow not in _MODELS:
        raise InputError(path, "flow", flow, f"must be one of {', '.join(get_args(FlowName))}")
    if "timezone" in data:
        raise InputError(path, "timezone", data["timezone"], "stands once, at the file's top")
    model: Any = validate(_MODELS[flow], data, path)
    try:
        cron = _cron(model, timezone)
    except KeyedError as error:
        raise InputError(path, error.key, error.value, str(error)) from None
    if not _NAME.fullmatch(model.name):
        raise InputError(path, "name", model.name, "must be letters a-z, digits, blanks, - and _")
    parameters = model.model_dump(mode="json", exclude=_TIMING, exclude_unset=True)
    if issubclass(SCHEDULED[flow], OnRig):
        parameters["timezone"] = timezone
    if "protocol" in parameters:
        parameters["protocol"] = _protocol(path, model.protocol, model.enable)
        _check_campaign(path, model.campaign)
    return Scheduled(
        name=model.name, flow=flow, cron=cron, timezone=timezone, active=model.active,
        parameters=parameters,
    )  # fmt: skip


def _cron(model: Any, timezone: str) -> str:
    """The cron line.

    Raises:
        KeyedError: there is none, or two ways of saying it, or it is not one.
    """
    if model.cron is None:
        if model.days is None or model.from_ is None:
            missing = "days" if model.days is None else "from"
            raise KeyedError(missing, None, "is missing; give days and from, or else cron")
        return cron_of(model.days, model.from_)
    for key, value in (("days", model.days), ("from", model.from_)):
        if value is not None:
            raise KeyedError(key, value, "stands beside cron; give one of the two")
    from prefect.client.schemas.schedules import CronSchedule

    try:
        CronSchedule(cron=model.cron, timezone=timezone)
    except ValueError:
        raise KeyedError(
            "cron", model.cron, 'is no cron line; one is like "0 22 * * mon-thu"'
        ) from None
    return str(model.cron)


def _protocol(path: Path, name: Path, enable: list[str]) -> str:
    """A protocol's path, found now: a night must not fail for a name.

    Raises:
        InputError: there is none, or it or a level to be enabled is wrong.
    """
    from sliplab.protocols import load_plan

    found = (path.parent / name).resolve()
    if not found.is_file():
        raise InputError(path, "protocol", str(name), f"is no file ({found})")
    try:
        load_plan(found, enable)
    except InputError as error:
        if error.file == "--enable":
            raise InputError(path, "enable", enable, error.expected) from None
        raise InputError(path, "protocol", str(name), error.message) from None
    return str(found)


def _check_campaign(path: Path, name: str | None) -> None:
    from sliplab.storage.names import safe_name
    from sliplab.storage.trials.store import StoreError

    try:
        safe_name("any" if name is None else name)
    except StoreError as error:
        raise InputError(path, "campaign", name, str(error)) from None
