"""Further devices in a rig file: `streams:` maps a name to the device that gives that stream.

    streams:
      side: {kind: events, device: {driver: dvxplorer}}
      back: {kind: frames, scale_px_per_mm: 12, region_px: [512, 512], device: {...}}
      plate_temperature: {kind: scalar, unit: degC, device: {...}}

The first event camera and the first frame camera stay in `devices:` and `mock:`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self, Union

from pydantic import (
    Field,
    GetJsonSchemaHandler,
    TypeAdapter,
    field_validator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.shown import did_you_mean
from sliplab.protocols.timing import StreamGrade, StreamTiming
from sliplab.protocols.yaml_file import ChosenModel, StrictModel, rule
from sliplab.rigs.core.device_settings import DriverSettings, FrameCameraSettings
from sliplab.rigs.core.driver import (
    Driver,
    EventCameraDriver,
    ForceSensorDriver,
    FrameCameraDriver,
    ScalarSensorDriver,
)
from sliplab.rigs.core.registry import find_driver
from sliplab.rigs.devices.settings import DeviceSettings, OfKind
from sliplab.rigs.mock.further_settings import (
    Further,
    FurtherEventCamera,
    FurtherFrameCamera,
    Thermometer,
)
from sliplab.rigs.mock.settings import ClockErrors, MockForceSensorSettings

NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
RESERVED = frozenset(
    {
        "events",
        "frames",
        "arm",
        "force",
        "sync",
        "sync_box",
        "event_camera",
        "frame_camera",
        "force_sensor",
    }
)
"""Names of the first devices, in files, records and columns."""
_PLACES = frozenset({"serial", "host", "port", "events_port", "triggers_port", "index", "path"})
"""Keys by which drivers distinguish their devices."""
MOST = 16
"""Further devices of a rig: a limit for people's typing errors, not of the store."""


class _StreamSettings(StrictModel):
    """What every further device has."""

    GRADES: ClassVar[tuple[StreamGrade, ...]]
    """Grades of its kind, the default first."""
    DRIVERS: ClassVar[type[Driver[Any]]]
    TIMING: ClassVar[dict[str, Any]] = {}
    """Other defaults of its timing than those of every stream."""

    timing: StreamTiming
    """How its times come onto the time line, and how good its clock is."""

    @model_validator(mode="before")
    @classmethod
    def _grade_of_the_kind(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        timing = data.get("timing", {})
        if isinstance(timing, dict):
            return {**data, "timing": {"grade": cls.GRADES[0], **cls.TIMING, **timing}}
        return data

    @rule
    def _has_the_grade(self) -> Self:
        if self.timing.grade not in self.GRADES:
            text = f"must be {' or '.join(self.GRADES)}, for this kind of device"
            raise KeyedError(".timing.grade", self.timing.grade, text)
        return self

    @rule
    def _mock_keeps_its_promises(self) -> Self:
        """Check that the simulated clock and delays are no worse than `timing` states."""
        mock: Further | None = getattr(self, "mock", None)
        if mock is None:
            return self
        timing, ppm = self.timing, getattr(mock, "clock_ppm", 0.0)
        if ppm > timing.drift_ppm:
            text = f"must be at most timing.drift_ppm = {timing.drift_ppm:g}"
            raise KeyedError(".mock.clock_ppm", ppm, text)
        if timing.grade == "arm clock":
            text = "must be host time: the simulated sensor has its own clock"
            raise KeyedError(".timing.grade", timing.grade, text)
        by_delay = timing.grade in {"host arrival", "host time"}
        if by_delay and not isinstance(mock, FurtherEventCamera):
            shortest, longest = timing.delay.shortest_us, timing.delay.longest_us
            if mock.latency_us < shortest:
                text = f"must be at least timing.delay.shortest_us = {shortest:g}"
                raise KeyedError(".mock.latency_us", mock.latency_us, text)
            if mock.latency_us + mock.arrival_jitter_us > longest:
                text = (
                    f"must be at most {longest - mock.latency_us:g}: with latency_us, "
                    f"timing.delay.longest_us = {longest:g}"
                )
                raise KeyedError(".mock.arrival_jitter_us", mock.arrival_jitter_us, text)
        return self

    @property
    def driver(self) -> Driver[Any] | None:
        """The driver of the device; None on a mock rig."""
        device: DriverSettings | None = getattr(self, "device", None)
        return None if device is None else find_driver(device.driver, self.DRIVERS)


class EventStream(_StreamSettings):
    """A further event camera, on the sync line as the first one."""

    GRADES = ("trigger input",)
    DRIVERS = EventCameraDriver

    kind: Literal["events"]
    device: Annotated[DriverSettings, OfKind(EventCameraDriver, "dvxplorer")] | None = None
    """Its driver; not for `mock`."""
    mock: FurtherEventCamera | None = None
    """The simulated camera; not for `devices`."""


class FrameStream(_StreamSettings):
    """A further frame camera."""

    GRADES = ("hardware trigger", "device time stamps", "host arrival")
    DRIVERS = FrameCameraDriver

    kind: Literal["frames"]
    scale_px_per_mm: float = Field(gt=0, le=200)
    region_px: tuple[Annotated[int, Field(ge=16, le=16384)], Annotated[int, Field(ge=16, le=16384)]]
    """Columns and rows of the centred region that is recorded."""
    rate_hz: float | None = Field(default=None, gt=0, le=1000)
    """Frames a second of a camera that runs by itself, for counting losses; a triggered one has the
    protocol's `sync_rate`."""
    device: Annotated[FrameCameraSettings, OfKind(FrameCameraDriver, "basler")] | None = None
    mock: FurtherFrameCamera | None = None

    @rule
    def _rate_of_its_own(self) -> Self:
        by_itself = self.timing.grade != "hardware trigger"
        if by_itself and self.rate_hz is None:
            text = f"is needed with timing.grade: {self.timing.grade}"
            raise KeyedError(".rate_hz", None, text)
        if not by_itself and self.rate_hz is not None:
            text = "has no meaning with timing.grade: hardware trigger"
            raise KeyedError(".rate_hz", self.rate_hz, text)
        return self

    @rule
    def _mock_meets_it(self) -> Self:
        if self.mock is None:
            return self
        for side, px in zip(("width", "height"), self.region_px, strict=True):
            if px > getattr(self.mock, side):
                text = f"exceeds mock.{side} = {getattr(self.mock, side)}"
                raise KeyedError(".region_px", list(self.region_px), text)
        if self.scale_px_per_mm != self.mock.px_per_mm:
            text = f"must be mock.px_per_mm = {self.mock.px_per_mm:g}"
            raise KeyedError(".scale_px_per_mm", self.scale_px_per_mm, text)
        if self.rate_hz is not None and self.rate_hz != self.mock.rate_hz:
            text = f"must be mock.rate_hz = {self.mock.rate_hz:g}"
            raise KeyedError(".rate_hz", self.rate_hz, text)
        return self


class ScalarStream(_StreamSettings):
    """A sensor of one quantity, such as a temperature; its readings are timed by arrival."""

    GRADES = ("host arrival",)
    DRIVERS = ScalarSensorDriver

    kind: Literal["scalar"]
    unit: str = Field(min_length=1, max_length=20)
    """Unit of the readings, such as `degC`."""
    device: Annotated[DriverSettings, OfKind(ScalarSensorDriver)] | None = None
    mock: Thermometer | None = None

    @field_validator("unit")
    @classmethod
    def _printable(cls, unit: str) -> str:
        if not unit.isprintable():
            raise ValueError("must be printable text")
        return unit


class ForceStream(_StreamSettings):
    """A further force/torque sensor. It neither limits the arm nor ends a press."""

    GRADES = ("host time", "arm clock")
    DRIVERS = ForceSensorDriver
    TIMING = {"delay": {"shortest_us": 0, "longest_us": 5_000}}  # noqa: RUF012

    kind: Literal["wrench"]
    device: Annotated[DriverSettings, OfKind(ForceSensorDriver)] | None = None
    mock: MockForceSensorSettings | None = None
    """The simulated sensor, which feels the same load as the first one."""


Stream = EventStream | FrameStream | ForceStream | ScalarStream
KINDS: dict[str, type[Stream]] = {
    "events": EventStream,
    "frames": FrameStream,
    "wrench": ForceStream,
    "scalar": ScalarStream,
}


class _ByKind(ChosenModel):
    """A further device; `kind` selects the model of the other keys."""

    def read(self, value: Any) -> Stream:
        """Return the settings in `value`, checked by the model of their kind."""
        if isinstance(value, _StreamSettings):
            return value  # type: ignore[return-value]
        if not isinstance(value, dict):
            raise ValueError("must be a mapping (key: value)")
        kind = value.get("kind")
        if not isinstance(kind, str) or kind not in KINDS:
            hint = did_you_mean(str(kind), KINDS) if kind is not None else ""
            raise KeyedError(".kind", kind, f"must be one of {', '.join(KINDS)}{hint}")
        return self.checked(KINDS[kind], value)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        choice: Any = Annotated[Union[tuple(KINDS.values())], Field(discriminator="kind")]  # noqa: UP007
        return handler(TypeAdapter(choice).core_schema)


Streams = Annotated[dict[str, Annotated[Stream, _ByKind()]], Field(max_length=MOST)]
"""The `streams:` section of a rig file."""


def stream_faults(
    streams: Mapping[str, Stream], rig_driver: str, clocks: ClockErrors | None = None
) -> Iterator[KeyedError]:
    """Return what is wrong with names, and what each device lacks that the rig's driver needs.

    Args:
        clocks: of a simulated rig.
    """
    for name, stream in streams.items():
        key = f"streams.{name}"
        if not NAME.fullmatch(name):
            yield KeyedError(key, name, f"a stream's name must match {NAME.pattern}")
        if name in RESERVED:
            yield KeyedError(key, name, "is the name of one of a rig's first devices")
        for part, needed in (("mock", rig_driver != "devices"), ("device", rig_driver != "mock")):
            found = getattr(stream, part)
            if needed and found is None:
                yield KeyedError(f"{key}.{part}", None, f"is needed by driver: {rig_driver}")
            if not needed and found is not None:
                text = f"has no meaning with driver: {rig_driver}"
                yield KeyedError(f"{key}.{part}", "...", text)
        jitter = {"events": "pulse_jitter_us", "frames": "frame_jitter_us"}.get(stream.kind)
        if clocks is None or jitter is None or stream.timing.grade == "host arrival":
            continue
        promised = stream.timing.jitter_us
        if getattr(clocks, jitter) > promised:
            text = f"must be at most {key}.timing.jitter_us = {promised:g}"
            yield KeyedError(f"mock.clocks.{jitter}", getattr(clocks, jitter), text)


def check_distinct(devices: DeviceSettings | None, streams: Mapping[str, Stream]) -> None:
    """Check that no two devices of one driver are the same one.

    Raises:
        KeyedError: two have the same serial number, address or port, or both leave it out.
    """
    known: dict[tuple[str, str], str] = {}
    first = [] if devices is None else list(devices.drivers())
    named = [(f"devices.{driver.kind.replace(' ', '_')}", driver, used) for driver, used in first]
    named += [
        (f"streams.{name}.device", driver, used) for name, driver, used in stream_drivers(streams)
    ]
    for key, driver, settings in named:
        place = _place(settings.model_dump(mode="json"))
        if not place:
            continue
        found = driver.name, json.dumps(place, sort_keys=True)
        if found in known and key.startswith("streams."):
            text = f"is the same device as {known[found]}: say which by {', '.join(place)}"
            raise KeyedError(key, driver.name, text)
        known[found] = key


def _place(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return the settings that distinguish devices of one driver, by key."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            found |= _place(value, f"{before}{key}.")
        elif key in _PLACES:
            found[f"{before}{key}"] = value
    return found


def stream_drivers(streams: Mapping[str, Stream]) -> Iterator[tuple[str, Driver[Any], Any]]:
    """Yield name, driver and settings of every further device that has a driver."""
    for name, stream in streams.items():
        driver = stream.driver
        if driver is not None:
            yield name, driver, stream.device


def named_drivers(
    devices: DeviceSettings | None, streams: Mapping[str, Stream]
) -> Iterator[tuple[str, Driver[Any], Any]]:
    """Yield the part in the rig, driver and settings of every device, the arm first."""
    if devices is not None:
        for driver, settings in devices.drivers():
            yield driver.kind, driver, settings
    for name, driver, settings in stream_drivers(streams):
        yield f"{name} ({driver.kind})", driver, settings


def simulated_streams(
    streams: Mapping[str, Stream],
) -> dict[str, tuple[Further, StreamTiming, str]]:
    """Return settings, timing and unit of every simulated further device, by its name."""
    return {
        name: (stream.mock, stream.timing, getattr(stream, "unit", ""))
        for name, stream in streams.items()
        if stream.mock is not None
    }
