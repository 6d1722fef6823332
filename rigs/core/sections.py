"""What a rig file asks of its sections: of real devices, and of simulated ones."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

from sliplab.protocols.errors import InputError
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.plan import Plan
from sliplab.protocols.yaml_file import StrictModel
from sliplab.rigs.core.gripper_range import GripperRange


class RigSection(StrictModel):
    """A section of a rig file that holds a rig's devices."""

    @property
    @abstractmethod
    def has_force(self) -> bool:
        """True if there is a force sensor."""

    @property
    @abstractmethod
    def gripper_range(self) -> GripperRange | None:
        """Values that the gripper's commands may have; None without a gripper."""

    def plan_faults(self, plan: Plan, file: str) -> Iterator[InputError]:
        """Return what these devices cannot do of a plan."""
        yield from ()


class SimulatedRig(RigSection):
    """The section of a simulated scene and its devices."""

    @property
    @abstractmethod
    def frame_source(self) -> str:
        """Output of the outside camera: ``video`` or ``tracks``."""

    @abstractmethod
    def rig_faults(self, rig: Any) -> Iterator[KeyedError]:
        """Return what disagrees with the rest of a `rigs.rig_file.RigFile`."""


class SimulatedStream(StrictModel):
    """The section of a simulated further device."""

    @property
    def frame_source(self) -> str:
        """Output of a camera: ``video`` or ``tracks``."""
        return "video"

    def stream_faults(self, stream: Any) -> Iterator[KeyedError]:
        """Return what disagrees with its stream (`rigs.stream_settings.Stream`), keys below it."""
        yield from ()
