"""Speed against error of the contact alone: `python -m benchmarks.contact_error`.

Turns, a tremor, rough friction and a falling plate at a few steps: all tips of the usual
skin, level L3 with every switch as the mock rig has it (the rough slide: L1 and 30 % over 0.2 mm).
The reference is the same solver at a 64th of a millisecond; tests hold that against event-located
integrations that share nothing with it. Times are those of the processor, the median of five runs,
and everything is simulated: one skin (seed 1) and one friction (seed 3) a case, and for the falling
plate 20 of each (skins of seed 1 to 20, frictions of seed 3 to 22).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

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
from sliplab.storage.streams import F64, I64

DEPTH_MM, SECONDS = 2.8, 8.192
STEPS_MS = (8.0, 2.0, 0.5)
FINE_MS = 1.0 / 64.0
RUNS = 5
FALLS = 20
HANGING_MM, MASS_KG = 3.4, 0.165


def turn(angle_deg: float, speed: float = 2.0) -> Callable[[F64], F64]:
    """Half of the time along x, and then in another direction."""
    a = math.radians(angle_deg)

    def way(t: F64) -> F64:
        first, second = np.minimum(t, SECONDS / 2), np.maximum(t - SECONDS / 2, 0.0)
        return speed * np.stack([first + second * math.cos(a), second * math.sin(a)], axis=1)

    return way


def tremor(t: F64) -> F64:
    """A slide at 1 mm/s with 100 um at 10 Hz."""
    return np.stack([t + 0.1 * np.sin(20 * math.pi * t), 0 * t], axis=1)


def rows(h_ms: float, seconds: float = SECONDS) -> I64:
    """Row times, ns."""
    return np.rint(np.arange(round(seconds * 1e3 / h_ms) + 1) * (h_ms * 1e6)).astype(np.int64)


def pressed(springs: Springs, depth: float) -> Tips:
    """Tips pressed straight in within 1 s and held for 5 s."""
    tips, n = new_tips(len(springs.table)), len(springs.table)
    sensor = np.zeros((2, 5))
    sensor[:, 2] = depth
    advance(
        springs.table,
        springs.friction,
        springs.law,
        tips.state,
        np.array([0, 10**9, 6 * 10**9], np.int64),
        sensor,
        np.zeros(3),
        np.empty((2, track_width(n))),
        np.empty((2, 0)),
        springs.spots,
    )
    return tips


def slide(springs: Springs, way: Callable[[F64], F64], h_ms: float) -> tuple[F64, F64, float]:
    """Forces (k, 3 n) and track every 8 ms, and seconds of computing."""
    t_ns, n = rows(h_ms), len(springs.table)
    sensor = np.zeros((len(t_ns) - 1, 5))
    sensor[:, :2], sensor[:, 2] = way(t_ns[1:] * 1e-9), DEPTH_MM
    tips = pressed(springs, DEPTH_MM)
    track, load = np.empty((len(sensor), track_width(n))), np.empty((len(sensor), 3 * n))
    begun = time.process_time()
    advance(
        springs.table,
        springs.friction,
        springs.law,
        tips.state,
        t_ns,
        sensor,
        np.zeros(len(t_ns)),
        track,
        load,
        springs.spots,
    )
    taken = time.process_time() - begun
    stride = round(8.0 / h_ms)
    return load[stride - 1 :: stride], track[stride - 1 :: stride], taken


def fall(springs: Springs, h_ms: float) -> tuple[F64, float]:
    """Onsets of all tips and the landing, s, and seconds of computing."""
    t_ns, n = rows(h_ms), len(springs.table)
    t = t_ns * 1e-9
    sensor = np.zeros((len(t_ns) - 1, 5))
    sensor[:, 2] = HANGING_MM - 0.5 * np.maximum(t[1:] - 2.048, 0.0)
    tips, motion = pressed(springs, HANGING_MM), np.zeros(2)
    springs = springs.damped(0.01)
    track, load = np.empty((len(sensor), track_width(n))), np.empty((len(sensor), 0))
    begun = time.process_time()
    done, _ = advance_free(
        springs.table,
        springs.friction,
        springs.law,
        tips.state,
        t_ns,
        sensor,
        motion,
        MASS_KG,
        np.minimum(t / 1.024, 1.0) * MASS_KG * 9.81,
        0.001,
        -25.0,
        track,
        load,
        springs.spots,
    )
    taken = time.process_time() - begun
    slips = track[:done, 3 * n : 4 * n]
    first = slips[np.argmax(track[:done, 2 * n : 3 * n] > 1e-6, axis=0), np.arange(n)]
    return np.append(first, t_ns[done] * 1e-9), taken * SECONDS / (t_ns[done] * 1e-9)


def skin_of(seed: int) -> Skin:
    """The mock rig's own skin."""
    return make_skin(
        SkinGeometry(height_scatter_mm=0.08, position_scatter_mm=0.05, friction_scatter=0.05), seed
    )


def springs_of(
    skin: Skin, variation: float, correlation_mm: float, level: int, seed: int = 3
) -> Springs:
    """The mock rig's own numbers but for how rough friction is."""
    return make_springs(
        skin,
        friction_knots(skin, 0.85, variation, correlation_mm, seed),
        level,
        static_excess=0.03,
        strengthening=0.01,
        relaxation_share=0.2,
    )


def main() -> None:
    """Print a table in Markdown."""
    skin = skin_of(1)
    usual, rough = springs_of(skin, 0.05, 0.5, 3), springs_of(skin, 0.3, 0.2, 1)
    cases: dict[str, tuple[Springs, Callable[[F64], F64]]] = {
        f"turn by {angle} degrees, 2 mm/s": (usual, turn(angle)) for angle in (0, 30, 90, 150)
    }
    cases["tremor, 100 um at 10 Hz"] = usual, tremor
    cases["rough: 30 % over 0.2 mm"] = rough, turn(0)
    n = len(skin)
    print("| case | step (ms) | x real time | force, 95 % (mN) | largest (mN) | slid (um) |")
    print("| --- | --: | --: | --: | --: | --: |")
    for name, (springs, way) in cases.items():
        fine_load, fine_track, _ = slide(springs, way, FINE_MS)
        for h_ms in STEPS_MS:
            load, track, _ = slide(springs, way, h_ms)
            taken = sorted(slide(springs, way, h_ms)[2] for _ in range(RUNS))[RUNS // 2]
            off = (load - fine_load).reshape(len(load), n, 3)
            miss = np.hypot(off[..., 0], off[..., 1]) * 1e3
            slid = np.abs(track - fine_track)[:, 2 * n : 3 * n].max() * 1e3
            print(
                f"| {name} | {h_ms:g} | {SECONDS / taken:.0f} | {np.percentile(miss, 95):.2g} "
                f"| {miss.max():.2g} | {slid:.2g} |"
            )
    print("\n| plate: step (ms) | x real time | onsets, median (us) | 95 % | largest | landing |")
    print("| --: | --: | --: | --: | --: | --: |")
    draws = [springs_of(skin_of(seed), 0.05, 0.5, 3, seed + 2) for seed in range(1, FALLS + 1)]
    fine = np.array([fall(springs, FINE_MS)[0] for springs in draws])
    for h_ms in (4.0, 2.0, 1.0, 0.5, 0.25):
        off = np.abs(np.array([fall(springs, h_ms)[0] for springs in draws]) - fine) * 1e6
        taken = sorted(fall(usual, h_ms)[1] for _ in range(RUNS))[RUNS // 2]
        onsets = off[:, :-1]
        print(
            f"| {h_ms:g} | {SECONDS / taken:.0f} | {np.median(onsets):.2g} "
            f"| {np.percentile(onsets, 95):.2g} | {onsets.max():.2g} | {off[:, -1].max():.2g} |"
        )


if __name__ == "__main__":
    main()
