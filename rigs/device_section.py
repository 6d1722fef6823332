"""The devices of a real rig in its rig file: the driver of each, and how to reach it.

A device's driver defines its other keys (`rigs.core.registry`). Cheap to import:
`sliplab plan` reads rig files without any vendor library.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal, Union

from pydantic import BaseModel, Field, GetJsonSchemaHandler, TypeAdapter
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import KeyedError, register_tags_of
from sliplab.protocols.plan import Plan
from sliplab.protocols.program import Twist
from sliplab.protocols.yaml_file import ChosenModel, StrictModel
from sliplab.rigs.core.arm_settings import BaseArmSettings
from sliplab.rigs.core.device_settings import DriverSettings, FrameCameraSettings, GripperSettings
from sliplab.rigs.core.driver import (
    ArmDriver,
    Driver,
    EventCameraDriver,
    ForceSensorDriver,
    FrameCameraDriver,
    GripperDriver,
    RigDriver,
    SyncBoxDriver,
)
from sliplab.rigs.core.gripper_range import GripperRange
from sliplab.rigs.core.registry import DriverError, drivers, find_driver
from sliplab.rigs.core.sections import RigSection

register_tags_of("source", "usb", "network")


_KINDS: dict[str, type[Driver[Any]]] = {
    "arm": ArmDriver,
    "event_camera": EventCameraDriver,
    "frame_camera": FrameCameraDriver,
    "sync_box": SyncBoxDriver,
    "force_sensor": ForceSensorDriver,
    "gripper": GripperDriver,
}
"""Kinds of drivers, by the key of the device in a rig file."""


class OfKind(ChosenModel):
    """Settings of any installed driver of a kind; `driver` selects the model of the other keys."""

    def __init__(self, kind: type[Driver[Any]], default: str | None = None) -> None:
        self._kind, self._default = kind, default

    def choose(self, value: dict[str, Any]) -> type[BaseModel]:
        """Return the settings of the driver that `value` names."""
        name = value.get("driver", self._default)
        try:
            return find_driver(str(name), self._kind).settings
        except DriverError as error:
            raise KeyedError(".driver", name, str(error)) from None

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """One choice a driver, of those that are installed."""
        models = tuple(driver.settings for driver in drivers(self._kind))
        if not models:  # none is installed; a package may bring one
            return handler(TypeAdapter(DriverSettings).core_schema)
        if len(models) == 1:
            return handler(TypeAdapter(models[0]).core_schema)
        choice: Any = Annotated[Union[models], Field(discriminator="driver")]  # noqa: UP007
        return handler(TypeAdapter(choice).core_schema)


class Simulated(ChosenModel):
    """Settings of the simulated rig, or of a further device of it."""

    def __init__(self, stream: str | None = None) -> None:
        self._stream = stream

    def choose(self, value: dict[str, Any]) -> type[BaseModel]:
        """Return the settings as the driver `mock` declares them."""
        mock = find_driver("mock", RigDriver)
        return mock.settings if self._stream is None else mock.streams[self._stream]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        models = core_schema.list_schema(self.choose({}).__pydantic_core_schema__)
        return {"allOf": [handler(models)["items"]]}  # a reference, instead of the whole model


class OperatedPlate(StrictModel):
    """A plate on a slider that the operator raises, releases and catches on request."""

    driver: Literal["person"] = "person"
    mass_kg: Annotated[float, Field(gt=0, le=5)]
    """Mass mounted when the session begins, kg; a changeover requests another one."""


class DeviceSettings(RigSection):
    """The `devices:` section of a rig file."""

    arm: Annotated[BaseArmSettings, OfKind(ArmDriver)]
    event_camera: Annotated[DriverSettings, OfKind(EventCameraDriver, "dvxplorer")] | None = Field(
        default={"driver": "dvxplorer"}, validate_default=True
    )
    """null where the rig's `cameras` has no `events`."""
    frame_camera: Annotated[FrameCameraSettings, OfKind(FrameCameraDriver, "basler")] | None = None
    """Left out where the rig's `cameras` has no `frames`."""
    sync_box: Annotated[DriverSettings, OfKind(SyncBoxDriver, "sync_box")] | None = None
    """Required by a real rig; a loopback rig has its own."""
    force_sensor: Annotated[DriverSettings, OfKind(ForceSensorDriver)] | None = None
    """If left out, the rig has no force sensor."""
    gripper: Annotated[GripperSettings, OfKind(GripperDriver)] | None = None
    """Gripper that holds the sensor; if left out, the rig has none."""
    plate: OperatedPlate | None = None
    """If left out, the rig has no sliding plate, and supports only kinematic protocols."""

    def drivers(self) -> Iterator[tuple[Driver[Any], DriverSettings]]:
        """The driver of every device, with its settings, the arm first."""
        for role, kind in _KINDS.items():
            settings = getattr(self, role)
            if settings is not None:
                yield find_driver(settings.driver, kind), settings

    @property
    def arm_driver(self) -> ArmDriver[Any]:
        """The driver of the arm."""
        return find_driver(self.arm.driver, ArmDriver)

    @property
    def event_camera_driver(self) -> EventCameraDriver[Any]:
        """The driver of the event camera."""
        assert self.event_camera is not None
        return find_driver(self.event_camera.driver, EventCameraDriver)

    @property
    def frame_camera_driver(self) -> FrameCameraDriver[Any]:
        """The driver of the frame camera."""
        assert self.frame_camera is not None
        return find_driver(self.frame_camera.driver, FrameCameraDriver)

    @property
    def sync_box_driver(self) -> SyncBoxDriver[Any]:
        """The driver of the sync box."""
        name = "sync_box" if self.sync_box is None else self.sync_box.driver
        return find_driver(name, SyncBoxDriver)

    @property
    def force_sensor_driver(self) -> ForceSensorDriver[Any] | None:
        """The driver of the force sensor, if the rig has one."""
        if self.force_sensor is None:
            return None
        return find_driver(self.force_sensor.driver, ForceSensorDriver)

    @property
    def gripper_driver(self) -> GripperDriver[Any] | None:
        """The driver of the gripper, if the rig has one."""
        return None if self.gripper is None else find_driver(self.gripper.driver, GripperDriver)

    @property
    def has_force(self) -> bool:
        """True if there is a force sensor."""
        return self.force_sensor is not None

    @property
    def gripper_range(self) -> GripperRange | None:
        """Values that the gripper's commands may have; None without a gripper."""
        driver = self.gripper_driver
        return None if driver is None else driver.range(self.gripper)

    def plan_faults(self, plan: Plan, file: str) -> Iterator[InputError]:
        """Check that the arm can twist, if the plan does."""
        driver = self.arm_driver
        if driver.twists:
            return
        for trial in plan:
            if any(isinstance(step, Twist) for step in plan.program(trial).steps):
                yield InputError(
                    file,
                    "devices.arm.driver",
                    driver.name,
                    f"cannot turn the tool evenly on the spot, and trial {trial.id} of {plan.file} "
                    "does; use another driver, such as 'abb'",
                )
                return
