"""Drivers of real arms, each an `Arm` of `rigs.capabilities`.

`build_arm` is the way in; the settings are in `rigs.arms.settings`. Nothing is imported before it
is needed: each driver brings its maker's client with it, and the UR driver's child process starts
in a tenth of the time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sliplab.rigs.arms.settings import ArmSettings
    from sliplab.rigs.capabilities import Arm


def build_arm(settings: ArmSettings) -> Arm:
    """The arm that `settings` describe, not connected yet."""
    if settings.driver == "ur":
        from sliplab.rigs.arms.ur import UrArm

        return UrArm(settings)
    if settings.driver == "abb":
        from sliplab.rigs.arms.abb import AbbArm

        return AbbArm(settings)
    from sliplab.rigs.arms.abb_socket import AbbSocketArm

    return AbbSocketArm(settings)
