"""Onsets by force against those by markers: `python -m benchmarks.force_onsets`.

Slides of the shipped rig `mock_force` on its contact law, over the depths and speeds of the
kinematic grid. Both onsets of the label rule `force` are compared with what the simulation knows:
the first slip of a tip, the first marker that has moved by 2 pixels, and the centre's 2 pixels.
Forces have noise of 5 mN a sample and no other error of a sensor. Everything is simulated; a cell
has one skin, and a friction and a noise for each of its seeds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sliplab.analysis.force import PlateForces
from sliplab.analysis.labels.force_onsets import force_onsets
from sliplab.plugins.simulation.physics import springs_of
from sliplab.plugins.simulation.scene.contact import advance
from sliplab.plugins.simulation.scene.springs import Springs, Tips, new_tips, track_width
from sliplab.plugins.simulation.settings import scene_of, skin_of
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs
from sliplab.storage.streams import F64

DEPTHS_MM, SPEEDS_MM_S, SEEDS = (2.4, 2.8, 3.4), (0.6, 1.0, 1.6), 4
DISTANCE_MM, STEP_S, PRESS_MM_S, HOLD_S = 9.0, 2e-3, 2.0, 3.0
THRESHOLD_MM, NOISE_N = 0.1, 0.005
"""2 pixels of the outside camera, and the noise of a sample of the force."""


@dataclass(frozen=True)
class SlideOnsets:
    """Onsets of a slide by force and by what is true, ms after the motion began."""

    incipient_ms: float
    gross_ms: float
    first_slip_ms: float
    first_crossing_ms: float
    centre_crossing_ms: float


def _run(springs: Springs, tips: Tips, path: F64, step_s: float) -> tuple[F64, F64]:
    """Return the track (steps, columns) and the plate's force (steps, 3) along a path."""
    n, steps = len(springs.gap), len(path)
    sensor = np.zeros((steps, 5))
    sensor[:, :3] = path
    track, load = np.zeros((steps, track_width(n))), np.zeros((steps, 3 * n))
    t_ns = np.rint(np.arange(steps + 1) * step_s * 1e9).astype(np.int64)
    advance(
        springs.table,
        springs.friction,
        springs.law,
        tips.state,
        t_ns,
        sensor,
        np.zeros(steps + 1),
        track,
        load,
        springs.spots,
    )
    return track, load.reshape(steps, n, 3).sum(axis=1)


def slide(depth_mm: float, speed_mm_s: float, seed: int) -> SlideOnsets:
    """Press, hold and slide; return the onsets."""
    rig, _ = load_rig_file(shipped_rigs()["mock_force"])
    skin = skin_of(scene_of(rig))
    springs, n = springs_of(scene_of(rig), skin, seed), len(skin)
    tips = new_tips(n)
    down = np.linspace(0, depth_mm, 101)[1:]
    _run(springs, tips, np.stack([0 * down, 0 * down, down], 1), depth_mm / PRESS_MM_S / 100)
    _run(springs, tips, np.array([[0.0, 0.0, depth_mm]]), HOLD_S)
    before = tips.place.copy()
    count = round(DISTANCE_MM / speed_mm_s / STEP_S)
    along = np.linspace(0, DISTANCE_MM, count + 1)[1:]
    path = np.stack([along, 0 * along, 0 * along + depth_mm], axis=1)
    track, force = _run(springs, tips, path, STEP_S)
    t_ms = 1e3 * STEP_S * np.arange(1, count + 1)
    force += np.random.default_rng(seed).normal(0, NOISE_N, force.shape)
    t_ns = np.rint(1e6 * t_ms).astype(np.int64)
    by_force = force_onsets(PlateForces(t_ns, force, 0.0, True), 0, int(t_ns[-1]))
    moved = np.hypot(track[:, 0 : 2 * n : 2] - before[:, 0], track[:, 1 : 2 * n : 2] - before[:, 1])
    far = moved > THRESHOLD_MM
    crossed = np.where(far.any(axis=0), t_ms[far.argmax(axis=0)], np.nan)
    slips = 1e3 * track[:, 3 * n : 4 * n]
    incipient, gross = (
        np.nan if ns is None else 1e-6 * ns for ns in (by_force.incipient_ns, by_force.gross_ns)
    )
    return SlideOnsets(
        float(incipient),
        float(gross),
        float(np.nanmin(slips)),
        float(np.nanmin(crossed)),
        float(crossed[0]),
    )


def table() -> Iterator[list[str]]:
    """Yield a row of text a cell: depth, speed, n, and differences from least to most, ms."""
    for depth_mm in DEPTHS_MM:
        for speed_mm_s in SPEEDS_MM_S:
            found = [slide(depth_mm, speed_mm_s, seed) for seed in range(SEEDS)]
            pairs = (
                [it.incipient_ms - it.first_crossing_ms for it in found],
                [it.incipient_ms - it.first_slip_ms for it in found],
                [it.gross_ms - it.centre_crossing_ms for it in found],
            )
            spans = [f"{min(of):+.0f} to {max(of):+.0f}" for of in pairs]
            yield [f"{depth_mm:g}", f"{speed_mm_s:g}", str(len(found)), *spans]


def main() -> None:
    """Print the table."""
    print(
        "| depth (mm) | speed (mm/s) | n | incipient - first 2 pixels (ms) "
        "| incipient - first slip (ms) | gross - the centre's 2 pixels (ms) |"
    )
    print("| --: | --: | --: | --: | --: | --: |")
    for row in table():
        print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
