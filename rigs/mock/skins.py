"""From a rig's settings to its skin, without loading anything that is slow to load."""

from __future__ import annotations

from sliplab.rigs.mock.settings import MockSettings
from sliplab.rigs.scene.skin import Skin, SkinGeometry, make_skin


def skin_of(settings: MockSettings) -> Skin:
    """The skin that belongs to a simulated rig."""
    made = settings.scene.skin
    geometry = SkinGeometry(
        **made.model_dump(exclude={"seed", "relaxation_share", "relaxation_s"}),
        friction_scatter=settings.scene.friction.papilla_scatter,
    )
    return make_skin(geometry, settings.seed if made.seed is None else made.seed)
