"""Defaults of a study: protocols, checked labels, held-out trials."""

from __future__ import annotations

from pathlib import Path

from sliplab.protocols.shipped import shipped_protocols

FULL = ("kinematic", "gravity", "disturbance")
PILOT = ("pilot", "pilot_gravity")
EXTRA = ("disturbance=125",)
LABELS_CHECKED = 60
"""Trials whose labels by tracks a study checks with video."""
NETWORKS = 3
"""Networks, each of another seed, from which on a study knows by how much seeds differ."""
HELD_OUT = 144
"""Trials that choose nothing: half of the conditions of the kinematic grid, each once."""


def study_protocols(pilot: bool, extra: bool) -> dict[Path, tuple[str, ...]]:
    """Return a study's protocols, and the optional levels that are switched on in each.

    Args:
        pilot: the small ones, which have none.
        extra: with the disturbance of 125 % that the paper left out.
    """
    on = {"disturbance": EXTRA} if extra else {}
    files = shipped_protocols()
    return {files[name]: on.get(name, ()) for name in (PILOT if pilot else FULL)}
