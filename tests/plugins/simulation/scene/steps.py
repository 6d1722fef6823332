"""Driving tips through waypoints: what the tests of the contact law share."""

import numpy as np

from sliplab.plugins.simulation.scene.contact import advance
from sliplab.plugins.simulation.scene.friction import friction_knots
from sliplab.plugins.simulation.scene.plate import advance_free
from sliplab.plugins.simulation.scene.skin import Skin, SkinGeometry, make_skin
from sliplab.plugins.simulation.scene.springs import (
    Springs,
    Tips,
    make_springs,
    new_tips,
    track_width,
)

MU = 0.85
H = 1e-3
RICH = {"static_excess": 0.03, "strengthening": 0.01, "relaxation_share": 0.2}
QUIET = {"noise_hz": 0.0, "hot_pixels": 0, "threshold_sigma": 0.0}
QUIET |= {"refractory_us": 0.0, "readout_hz": 0.0}


def ideal_skin() -> Skin:
    """The default skin without any scatter."""
    return make_skin(SkinGeometry(), seed=1)


def springs_of(skin: Skin, level: int = 3, mu: float = MU, **options) -> Springs:
    """Springs with even friction."""
    return make_springs(skin, friction_knots(skin, mu, 0.0, 0.5, 1), level, **options)


def rough(skin: Skin, variation: float, seed: int, level: int = 3, **options) -> Springs:
    """Springs with friction that varies along the way."""
    return make_springs(skin, friction_knots(skin, MU, variation, 0.5, seed), level, **options)


def times(steps: int, h: float) -> np.ndarray:
    """Row times of `steps` steps of `h` seconds, ns."""
    return np.rint(np.arange(steps + 1) * (h * 1e9)).astype(np.int64)


def run(
    springs: Springs, tips: Tips, sensor: np.ndarray, h: float = H, t_ns: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Track and load (steps, n, 3) of `tips` under `sensor` (steps, 2 to 6 columns)."""
    n, steps = len(springs.gap), len(sensor)
    full = np.zeros((steps, max(sensor.shape[1], 5)))
    full[:, : sensor.shape[1]] = sensor
    track, load = np.zeros((steps, track_width(n))), np.zeros((steps, 3 * n))
    rows = times(steps, h) if t_ns is None else t_ns
    law = springs.table, springs.friction, springs.law
    advance(*law, tips.state, rows, full, np.zeros(steps + 1), track, load, springs.spots)
    return track, load.reshape(steps, n, 3)


def fall(
    springs: Springs,
    tips: Tips,
    motion: np.ndarray,
    sensor: np.ndarray,
    mass: float,
    *,
    weight: np.ndarray | float | None = None,
    stiction: float = 0.0,
    h: float = H,
    t_ns: np.ndarray | None = None,
) -> tuple[np.ndarray, int]:
    """Track of a released plate under `sensor` (depth alone, or x, y, depth), and steps taken."""
    steps, n = len(sensor), len(springs.gap)
    full = np.zeros((steps, 5))
    full[:, [2] if sensor.ndim == 1 else range(sensor.shape[1])] = sensor.reshape(steps, -1)
    pull = np.broadcast_to(mass * 9.81 if weight is None else weight, steps).astype(float)
    pull = np.concatenate([[2 * pull[0] - pull[min(1, steps - 1)]], pull])
    track, load = np.zeros((steps, track_width(n))), np.zeros((steps, 3 * n))
    rows = times(steps, h) if t_ns is None else t_ns
    law = springs.table, springs.friction, springs.law
    plate = motion, mass, pull, stiction, -25.0
    done, _ = advance_free(*law, tips.state, rows, full, *plate, track, load, springs.spots)
    return track[:done], done


def at(x: float, y: float, depth: float, steps: int = 1) -> np.ndarray:
    """Standing still."""
    return np.tile([x, y, depth], (steps, 1)).astype(float)


def line(start: tuple[float, ...], end: tuple[float, ...], steps: int) -> np.ndarray:
    """A straight way, its first point left out."""
    share = np.arange(1, steps + 1)[:, None] / steps
    return np.asarray(start) + share * (np.asarray(end) - np.asarray(start))


def pressed(springs: Springs, depth: float = 2.8) -> Tips:
    """Tips pressed straight in within 0.2 s."""
    tips = new_tips(len(springs.gap))
    run(springs, tips, line((0, 0, 0), (0, 0, depth), 200))
    return tips


def slid(track: np.ndarray) -> np.ndarray:
    """Length of each tip's way, (steps, n)."""
    n = (track.shape[1] - 1) // 4
    return track[:, 2 * n : 3 * n]


def places(track: np.ndarray) -> np.ndarray:
    """Tips and plate, without the times of slips that never were."""
    n = (track.shape[1] - 1) // 4
    return np.delete(track, np.s_[3 * n : 4 * n], axis=1)
