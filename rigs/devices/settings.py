"""The devices of a real rig as its rig file names them: which driver, and how to reach it.

Cheap to import: `sliplab plan` reads rig files, and no maker's library is needed for that.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.protocols.yaml_file import StrictModel, register_tags_of
from sliplab.rigs.devices.abb.settings import AbbSettings, AbbSocketSettings
from sliplab.rigs.devices.basler.settings import BaslerSettings
from sliplab.rigs.devices.dvxplorer.settings import DvxplorerSettings
from sliplab.rigs.devices.sync_box.settings import SyncBoxSettings
from sliplab.rigs.devices.ur.settings import UrSettings

ArmSettings = UrSettings | AbbSettings | AbbSocketSettings

register_tags_of("arm", "ur", "abb", "abb_socket")
register_tags_of("source", "usb", "network")


class OperatedPlate(StrictModel):
    """A plate on its slider that a person raises, releases and catches when asked."""

    driver: Literal["person"] = "person"
    mass_kg: Annotated[float, Field(gt=0, le=5)]
    """Mounted when the session begins, kg; a changeover asks for another one."""


class DeviceSettings(StrictModel):
    """The `devices:` section of a rig file."""

    arm: Annotated[ArmSettings, Field(discriminator="driver")]
    event_camera: DvxplorerSettings = DvxplorerSettings()
    frame_camera: BaslerSettings
    sync_box: SyncBoxSettings | None = None
    """Needed by a real rig; a rig of stand-ins brings its own."""
    plate: OperatedPlate | None = None
    """Left out, the rig has no sliding plate, and takes kinematic protocols only."""
