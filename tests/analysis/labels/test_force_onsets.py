"""Onsets by force: the knees of a rising curve, wherever they lie, and none where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.force import PlateForces
from sliplab.analysis.labels.force_onsets import force_onsets, knee_s

START = 5_000_000_000


def forces(first_s: float, second_s: float, angle_deg: float = 30.0, seed: int = 0) -> PlateForces:
    """A force that rises at 2 N/s, at 0.8 N/s from the first knee, and at 0.02 from the second."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(-500, 5000) / 1000
    along = (
        2.0 * np.clip(t_s, 0, first_s)
        + 0.8 * np.clip(t_s - first_s, 0, second_s - first_s)
        + 0.02 * np.maximum(t_s - second_s, 0)
    )
    angle = np.deg2rad(angle_deg)
    force = np.stack([along * np.cos(angle), along * np.sin(angle), np.full_like(along, 2.0)], 1)
    force += rng.normal(0, 0.005, force.shape)
    return PlateForces(START + np.rint(t_s * 1e9).astype(np.int64), force, 2e6, True)


@pytest.mark.parametrize("angle", [0.0, 30.0, 180.0, 270.0])
@pytest.mark.parametrize(("first", "second"), [(0.2, 1.2), (0.4, 2.5), (0.15, 3.0)])
def test_both_knees_are_found_in_any_direction(first: float, second: float, angle: float) -> None:
    found = force_onsets(forces(first, second, angle), START, START + 4_999_000_000)
    assert (found.incipient_ns - START) / 1e9 == pytest.approx(first, abs=0.02)
    assert (found.gross_ns - START) / 1e9 == pytest.approx(second, abs=0.06)


def test_a_force_that_only_rises_has_no_onset() -> None:
    found = force_onsets(forces(9.0, 9.5), START, START + 4_999_000_000)
    assert (found.incipient_ns, found.gross_ns) == (None, None)


def test_no_force_has_no_onset() -> None:
    t_ns = START + np.arange(1000, dtype=np.int64) * 1_000_000
    nothing = PlateForces(t_ns, np.zeros((1000, 3)), 1e6, True)
    assert force_onsets(nothing, START, START + 10**9).gross_ns is None
    assert force_onsets(nothing, START, START + 5_000_000).gross_ns is None


def test_a_falling_curve_has_no_knee() -> None:
    t_s = np.arange(100) / 100
    assert knee_s(t_s, -t_s, 0.5) is None
    assert knee_s(t_s[:5], t_s[:5], 0.5) is None
