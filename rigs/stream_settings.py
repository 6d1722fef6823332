"""Further devices in a rig file: `streams:` maps a name to the device that gives that stream.

    streams:
      side: {kind: events, device: {driver: dvxplorer}}
      back: {kind: frames, scale_px_per_mm: 12, region_px: [512, 512], device: {...}}
      plate_temperature: {kind: scalar, unit: degC, device: {...}}

The first event camera and the first frame camera stay in `devices:` and `mock:`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
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
from sliplab.protocols.shown import one_of
from sliplab.protocols.timing import StreamGrade, StreamTiming
from sliplab.protocols.yaml_file import ChosenModel, StrictModel, rule
from sliplab.rigs.core.device_settings import DriverSettings, FrameCameraSettings
from sliplab.rigs.core.driver import (
    Driver,
    EventCameraDriver,
    ForceSensorDriver,
    FrameCameraDriver,
    SensorDriver,
)
from sliplab.rigs.core.registry import drivers, find_driver
from sliplab.rigs.core.sections import SimulatedStream
from sliplab.rigs.device_section import DeviceSettings, OfKind, Simulated

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
    def _mock_agrees(self) -> Iterator[KeyedError]:
        mock: SimulatedStream | None = getattr(self, "mock", None)
        if mock is not None:
            yield from mock.stream_faults(self)

    @rule
    def _driver_sends_it(self) -> Self:
        driver, kind = self.driver, getattr(self, "kind", "")
        if isinstance(driver, SensorDriver) and driver.sends != kind:
            text = f"must be {driver.sends}, which the driver {driver.name} sends"
            raise KeyedError(".kind", kind, text)
        return self

    @rule
    def _driver_times_so(self) -> Self:
        driver = self.driver
        if isinstance(driver, SensorDriver) and driver.grade is not None:
            grade = driver.grade(getattr(self, "device", None))
            if self.timing.grade != grade:
                text = f"must be {grade}, as the driver {driver.name} times its rows here"
                raise KeyedError(".timing.grade", self.timing.grade, text)
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
    mock: Annotated[SimulatedStream, Simulated("events")] | None = None
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
    mock: Annotated[SimulatedStream, Simulated("frames")] | None = None

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


class ScalarStream(_StreamSettings):
    """A sensor of one quantity, such as a temperature; its readings are timed by arrival."""

    GRADES = ("host arrival",)
    DRIVERS = SensorDriver

    kind: Literal["scalar"]
    unit: str = Field(min_length=1, max_length=20)
    """Unit of the readings, such as `degC`."""
    device: Annotated[DriverSettings, OfKind(SensorDriver)] | None = None
    mock: Annotated[SimulatedStream, Simulated("scalar")] | None = None

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
    mock: Annotated[SimulatedStream, Simulated("wrench")] | None = None
    """The simulated sensor, which feels the same load as the first one."""


class SensorStream(_StreamSettings):
    """A sensor of a kind that another package declares; timed by arrival."""

    GRADES = ("host arrival", "host time")
    DRIVERS = SensorDriver

    kind: str
    device: Annotated[DriverSettings, OfKind(SensorDriver)] | None = None
    """Its driver, on simulated rigs too."""
    mock: None = None

    @field_validator("mock", mode="before")
    @classmethod
    def _by_its_driver(cls, mock: object) -> None:
        if mock is not None:
            raise ValueError("must be left out: the driver of its device simulates this kind")


Stream = EventStream | FrameStream | ForceStream | ScalarStream | SensorStream
KINDS: dict[str, type[Stream]] = {
    "events": EventStream,
    "frames": FrameStream,
    "wrench": ForceStream,
    "scalar": ScalarStream,
}


class _ByKind(ChosenModel):
    """A further device; `kind` selects the model of the other keys."""

    def choose(self, value: dict[str, Any]) -> type[Stream]:
        """Return the model of the kind that `value` names."""
        kind = value.get("kind")
        sent = {driver.sends for driver in drivers(SensorDriver)} if kind not in KINDS else set()
        if kind in sent:
            return SensorStream
        if not isinstance(kind, str) or kind not in KINDS:
            raise KeyedError(".kind", kind, one_of(kind, [*KINDS, *sorted(sent - {*KINDS})]))
        return KINDS[kind]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        choice: Any = Annotated[Union[tuple(KINDS.values())], Field(discriminator="kind")]  # noqa: UP007
        return handler(TypeAdapter(choice).core_schema)


Streams = Annotated[dict[str, Annotated[Stream, _ByKind()]], Field(max_length=MOST)]
"""The `streams:` section of a rig file."""


def stream_faults(
    streams: Mapping[str, Stream], rig_driver: str, sections: Collection[str]
) -> Iterator[KeyedError]:
    """Return what is wrong with names, and what each device lacks that the rig's driver needs.

    Args:
        sections: of such a rig's file: `devices`, `mock`.
    """
    for name, stream in streams.items():
        key = f"streams.{name}"
        if not NAME.fullmatch(name):
            yield KeyedError(key, name, f"a stream's name must match {NAME.pattern}")
        if name in RESERVED:
            yield KeyedError(key, name, "is the name of one of a rig's first devices")
        driver = stream.driver
        needs = {"mock": "mock" in sections, "device": "devices" in sections}
        if needs["mock"] and _simulated_by_driver(stream, needs["device"]):
            needs = {"mock": False, "device": True}
            if isinstance(driver, SensorDriver) and driver.simulate is None:
                text = f"declares no `simulate`, which driver: {rig_driver} needs of it"
                yield KeyedError(f"{key}.device.driver", driver.name, text)
        for part, needed in needs.items():
            found = getattr(stream, part)
            if needed and found is None:
                yield KeyedError(f"{key}.{part}", None, f"is needed by driver: {rig_driver}")
            if not needed and found is not None:
                text = f"has no meaning with driver: {rig_driver}"
                yield KeyedError(f"{key}.{part}", "...", text)


def _simulated_by_driver(stream: Stream, driven: bool) -> bool:
    """Return whether a simulated rig has the stream by the `simulate` of its driver.

    Args:
        driven: the rig has drivers on fakes.
    """
    own = isinstance(stream.driver, SensorDriver) and (driven or stream.mock is None)
    return own or isinstance(stream, SensorStream)


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


def keyed_drivers(
    devices: DeviceSettings | None, streams: Mapping[str, Stream]
) -> Iterator[tuple[str, Driver[Any], Any]]:
    """Yield the key in the rig file, driver and settings of every device, the arm first."""
    for driver, settings in () if devices is None else devices.drivers():
        yield f"devices.{driver.kind.replace(' ', '_')}", driver, settings
    for name, driver, settings in stream_drivers(streams):
        yield f"streams.{name}.device", driver, settings
