"""Nuisances on the simulated rig: each is a fault of the trial, at times drawn from its seed.

Those that the arm makes are steps of the program. Movements of the sensor against the plate go
through the contact: a tap that is strong enough makes tips slip, as it would on a real skin.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.fault_book import FaultBook
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.settings import MockEventCameraSettings
from sliplab.protocols.nuisances import (
    AnyNuisance,
    Brush,
    FlickerNuisance,
    HotPixels,
    LostPackets,
    Tap,
    TrialNuisances,
    VibrationNuisance,
    Warmth,
)
from sliplab.rigs.core.faults import (
    AnyFault,
    EventGap,
    EventNoise,
    Knock,
    MainsLight,
    Shaking,
    SkinBrushed,
)

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

DOUBLING_C = 8.0
"""Rise that doubles the noise: the order of dark currents of silicon, which double every 5 to 10
degrees."""
DAMPING = 0.05
"""Of the oscillation after a knock, over critical damping."""


def faults_of(
    nuisances: TrialNuisances, camera: MockEventCameraSettings, seed: int
) -> list[AnyFault]:
    """Return the faults that simulate a trial's nuisances; those of the arm have none.

    Args:
        camera: warmth multiplies its noise.
        seed: of the trial.
    """
    found: list[AnyFault] = []
    for index, each in enumerate(nuisances.elements):
        make = _maker(each, camera)
        if make is None:
            continue
        if isinstance(each, Tap | Brush | LostPackets):
            rng, every, at_s = generator(seed, "nuisance", index), float(each.every), 0.0
            while (at_s := at_s + every * rng.uniform(0.5, 1.5)) < nuisances.seconds:
                found.append(make(at_s))
        else:
            found.append(make(0.0))
    return found


def _maker(
    nuisance: AnyNuisance, camera: MockEventCameraSettings
) -> Callable[[float], AnyFault] | None:
    """Make the fault of a nuisance from its time, s."""
    match nuisance:
        case Tap():
            return lambda at_s: Knock(
                kind="knock", at_s=at_s, um=1000 * float(nuisance.distance), hz=float(nuisance.ring)
            )
        case VibrationNuisance():
            return lambda at_s: Shaking(
                kind="shaking",
                at_s=at_s,
                mm_s=float(nuisance.speed),
                low_hz=float(nuisance.low),
                high_hz=float(nuisance.high),
                sweep_s=float(nuisance.sweep),
            )
        case FlickerNuisance():
            return lambda at_s: MainsLight(
                kind="mains_light",
                at_s=at_s,
                share=float(nuisance.share) / 100,
                hz=float(nuisance.frequency),
            )
        case Brush():
            return lambda at_s: SkinBrushed(
                kind="skin_brushed",
                at_s=at_s,
                newtons=float(nuisance.force),
                mm_s=float(nuisance.speed),
                width_mm=float(nuisance.width),
            )
        case LostPackets():
            return lambda at_s: EventGap(
                kind="event_gap", at_s=at_s, seconds=float(nuisance.duration)
            )
        case HotPixels():
            return lambda at_s: EventNoise(
                kind="event_noise",
                at_s=at_s,
                hz=float(nuisance.rate),
                pixels=nuisance.pixels,
                positive=1.0,
            )
        case Warmth():
            more = 2.0 ** (float(nuisance.rise) / DOUBLING_C) - 1.0
            if not camera.noise_hz:
                return None
            return lambda at_s: EventNoise(
                kind="event_noise",
                at_s=at_s,
                hz=camera.noise_hz * more,
                positive=0.5 + 0.5 * camera.leak_share,
            )
    return None


class Shake:
    """Movement of the sensor against the plate after knocks, and while it is shaken."""

    def __init__(self, faults: FaultBook, seed: int) -> None:
        self._faults, self._seed = faults, seed

    def __bool__(self) -> bool:
        return bool(self._faults.of(Knock) or self._faults.of(Shaking))

    def at(self, t_ns: I64) -> F64:
        """Displacement along the plate's x, y and z, mm, (k, 3) from true times (k,)."""
        moved = np.zeros((len(t_ns), 3))
        for index, (knock, begin, _) in enumerate(self._faults.spans(Knock)):
            seconds = np.maximum((t_ns - begin) * 1e-9, 0.0)
            turned = 2 * np.pi * knock.hz * seconds
            ringing = knock.um * 1e-3 * np.exp(-DAMPING * turned) * np.sin(turned)
            moved += ringing[:, None] * self._direction("knock", index)
        for index, (shaking, begin, _) in enumerate(self._faults.spans(Shaking)):
            seconds = np.asarray((t_ns - begin) * 1e-9, np.float64)
            moved += swept(shaking, seconds)[:, None] * self._direction("shaking", index)
        return moved

    def _direction(self, purpose: str, index: int) -> F64:
        drawn: F64 = generator(self._seed, purpose, index).normal(size=3)
        return drawn / np.linalg.norm(drawn)


def swept(shaking: Shaking, seconds: F64) -> F64:
    """Displacement of a sweep, mm, (k,): zero before it begins, and whenever it begins again."""
    factor = shaking.high_hz / shaking.low_hz
    share = np.maximum(seconds, 0.0) % shaking.sweep_s / shaking.sweep_s
    hz = shaking.low_hz * factor**share
    # the integral of the frequency over time
    turns = shaking.low_hz * shaking.sweep_s / np.log(factor) * (factor**share - 1.0)
    moved: F64 = shaking.mm_s / (2 * np.pi * hz) * np.sin(2 * np.pi * turns)
    return moved


def brushing(faults: FaultBook, layout_mm: F64, seed: int, t_ns: I64) -> F64 | None:
    """Side forces of brushing objects on the papillae, N, (k, n, 2); None if there are none.

    Args:
        layout_mm: of the papillae, in the sensor's axes, (n, 2).
        t_ns: true times, (k,).
    """
    force = None
    reach_mm = float(np.hypot(*layout_mm.T).max())
    for index, (brush, begin, _) in enumerate(faults.spans(SkinBrushed)):
        first_mm = reach_mm + 4 * brush.width_mm
        front_mm = brush.mm_s * (t_ns - begin) * 1e-9 - first_mm
        if not ((t_ns >= begin) & (front_mm <= first_mm)).any():
            continue
        angle = generator(seed, "brush", index).uniform(0, 2 * np.pi)
        if brush.direction_deg is not None:
            angle = np.radians(brush.direction_deg)
        way = np.array([np.cos(angle), np.sin(angle)])
        from_tip = (front_mm[:, None] - layout_mm @ way) / brush.width_mm
        strength = brush.newtons * np.exp(-0.5 * from_tip**2) * (t_ns >= begin)[:, None]
        force = np.zeros((*strength.shape, 2)) if force is None else force
        force += strength[:, :, None] * way
    return force
