"""Drivers of real arms, each an `Arm` of `rigs.capabilities`.

`build_arm` is the way in; drivers are imported only when one of their arms is built, because each
brings its maker's client with it.
"""

from __future__ import annotations

from rigs.arms.settings import AbbSettings, AbbSocketSettings, ArmSettings, UrSettings
from rigs.capabilities import Arm

__all__ = ["AbbSettings", "AbbSocketSettings", "ArmSettings", "UrSettings", "build_arm"]


def build_arm(settings: ArmSettings) -> Arm:
    """The arm that `settings` describe, not connected yet."""
    if isinstance(settings, UrSettings):
        from rigs.arms.ur import UrArm

        return UrArm(settings)
    if isinstance(settings, AbbSettings):
        from rigs.arms.abb import AbbArm

        return AbbArm(settings)
    from rigs.arms.abb_socket import AbbSocketArm

    return AbbSocketArm(settings)
