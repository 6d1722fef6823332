"""Identity of a simulated camera: its settings, its random numbers and its clock.

A rig's first cameras draw from the rig's seed and the trial's, and have the clocks that faults
disturb. Each further one draws from these seeds and its own name, so that it changes nothing of
the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from sliplab.plugins.simulation.scene.randomness import key
from sliplab.plugins.simulation.settings import MockEventCameraSettings, MockFrameCameraSettings
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.storage.clockmap import ClockMap

SettingsT = TypeVar("SettingsT", MockEventCameraSettings, MockFrameCameraSettings)
_SEEDS = 2**63


@dataclass(frozen=True)
class Identity(Generic[SettingsT]):
    """One simulated camera of a rig.

    Attributes:
        name: ``event_camera`` or ``frame_camera``, or the name of a further camera's stream.
        clock_ppm: of a further camera, the largest drift of its clock; None for a first camera.
        seed: of a further camera's fabrication; None: the rig's.
    """

    name: str
    settings: SettingsT
    clock_ppm: float | None = None
    seed: int | None = None

    @property
    def first(self) -> bool:
        """True for the rig's first camera of its kind, which faults may hit."""
        return self.clock_ppm is None

    def fabrication_seed(self, world: SimulatedWorld) -> int:
        """Return the seed of what does not change from trial to trial."""
        seed = world.settings.seed if self.seed is None else self.seed
        return seed if self.first else key(seed, f"stream {self.name}") % _SEEDS

    def trial_seed(self, world: SimulatedWorld) -> int:
        """Return the seed of what a trial draws."""
        return world.seed if self.first else key(world.seed, f"stream {self.name}") % _SEEDS

    def clock(self, world: SimulatedWorld) -> ClockMap:
        """Return the map from true time to the camera's clock in the running trial."""
        if self.clock_ppm is not None:
            return world.further_clock(self.name, self.clock_ppm)
        clocks = world.clocks
        return clocks.event_camera if self.name == "event_camera" else clocks.frame_camera
