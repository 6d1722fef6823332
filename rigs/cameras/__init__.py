"""Drivers of the real cameras: Basler through pylon, DVXplorer through dv-processing.

`build_frame_camera` and `build_event_camera` are the way in; the settings are in
`rigs.cameras.settings`. Neither library is loaded before a camera is opened, so that a simulated
rig needs none of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sliplab.rigs.cameras.settings import BaslerSettings, DvxplorerSettings
    from sliplab.rigs.capabilities import EventCamera, FrameCamera


def build_frame_camera(settings: BaslerSettings, device: Any = None) -> FrameCamera:
    """The frame camera that `settings` describe, open and not grabbing yet. Raises RigError.

    Args:
        device: pylon's camera behind the driver; searched for where None.
    """
    from sliplab.rigs.cameras.basler import BaslerCamera

    return BaslerCamera(settings, device)


def build_event_camera(settings: DvxplorerSettings) -> EventCamera:
    """The event camera that `settings` describe, open and not streaming yet. Raises RigError."""
    from sliplab.rigs.cameras.dvxplorer import DvxplorerCamera

    return DvxplorerCamera(settings)
