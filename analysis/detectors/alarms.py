"""Alarms of evidence above a level, and the level that promises a rate of false ones.

Evidence above the level is an alarm. It lasts a second, in which the detector says nothing else;
evidence that is above the level afterwards is the next alarm. So a detector that always triggers
has an alarm each second. Alarms before the first tip slides are false, in a hold as in the motion
that follows it. The first alarm after that, before gross slip, detects the slip; where a false
alarm lasts until the slip, the slip counts as missed, since the alarm does not show it.

The bench, the comparison of a store's detectors and live detection set their levels here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import Evidence, Slip
from sliplab.analysis.metrics.alarm_rates import alarm_rate
from sliplab.storage.schema.evaluation import AlarmRate

ALARM_US = 1_000_000
US_PER_HOUR = 3_600_000_000
BOUND_OF_NONE = -math.log(0.025)
"""Upper end of the 95 % interval of a Poisson count of which none was seen (Garwood 1936)."""


@dataclass(frozen=True)
class SceneEvidence:
    """Evidence on a scene with the truth, and the scene's world, empty if it shares none."""

    evidence: Evidence
    slip: Slip
    world: str = ""


@dataclass(frozen=True)
class SceneAlarms:
    """Alarms of one scene.

    Attributes:
        false: alarms before the first tip slid.
        detected_us: the alarm that detected the slip; None where none did.
        early: a false alarm lasted until the slip.
    """

    slip: Slip
    false: int
    detected_us: int | None
    early: bool


def alarm_times(t_us: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the beginnings of alarms, of the times at which evidence exceeds the level."""
    found = []
    at = 0
    while at < len(t_us):
        begin = int(t_us[at])
        found.append(begin)
        at = int(np.searchsorted(t_us, begin + ALARM_US))
    return np.array(found, np.int64)


def outcome(judged: SceneEvidence, level: float) -> SceneAlarms:
    """Return a scene's alarms above a level."""
    slip, evidence = judged.slip, judged.evidence
    above = evidence.t_us[evidence.value > level]
    split = int(np.searchsorted(above, slip.physical_us))
    false = alarm_times(above[:split])
    if len(false) and false[-1] + ALARM_US > slip.physical_us:
        return SceneAlarms(slip, len(false), None, True)
    after = above[split:]
    detected = int(after[0]) if len(after) and after[0] < slip.gross_us else None
    return SceneAlarms(slip, len(false), detected, False)


def hours_without_slip(scenes: Sequence[SceneEvidence]) -> float:
    """Return the hours of scenes in which nothing slips."""
    return sum(scene.slip.physical_us for scene in scenes) / US_PER_HOUR


def level_at(scenes: Sequence[SceneEvidence], allowed: int) -> float:
    """Return the lowest level at which scenes have at most so many false alarms.

    Found exactly: fewer times exceed a higher level, and fewer times are in as many alarms at most.
    It is a value of the evidence, which must be exceeded, or -inf where nothing bounds it.
    """
    before = []
    for scene in scenes:
        quiet = slice(0, int(np.searchsorted(scene.evidence.t_us, scene.slip.physical_us)))
        before.append((scene.evidence.t_us[quiet], scene.evidence.value[quiet]))

    def fits(level: float) -> bool:
        count = 0
        for t_us, value in before:
            count += len(alarm_times(t_us[value > level]))
            if count > allowed:
                return False
        return True

    levels = np.unique(np.concatenate([[-np.inf], *(value for _, value in before)]))
    low, high = 0, len(levels) - 1
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if fits(levels[middle]) else (middle + 1, high)
    return float(levels[low])


def worlds_of(scenes: Sequence[SceneEvidence]) -> list[str]:
    """Return the world of each scene; one that shares none has its place as a name."""
    return [scene.world or f"scene {place}" for place, scene in enumerate(scenes)]


def false_alarm_rate(scenes: Sequence[SceneEvidence], level: float) -> AlarmRate:
    """Return the rate of false alarms at a level, with its interval over worlds."""
    _, world = np.unique(worlds_of(scenes), return_inverse=True)
    counts = np.bincount(world, [outcome(scene, level).false for scene in scenes])
    times = np.bincount(world, [hours_without_slip([scene]) for scene in scenes])
    return alarm_rate(counts, times)


@dataclass(frozen=True)
class Level:
    """A level of evidence, set on scenes that test nothing.

    Attributes:
        asked: false alarms an hour.
        found: false alarms of these scenes at the level.
        promised: the upper end of their rate's 95 % interval is at most `asked`. If not, there
            were too few hours for that, and the level is that without a false alarm.
    """

    asked: float
    value: float
    found: AlarmRate
    promised: bool

    @property
    def words(self) -> str:
        """What the level promises, or why it cannot promise what was asked."""
        if self.promised:
            return f"at most {self.asked:g} false alarms an hour, 95 % sure"
        return unsupported(self.asked, self.found)


def needed_hours(rate: float) -> float:
    """Return the hours without slip that show a rate, 1/h, where they have no alarm."""
    return BOUND_OF_NONE / rate


def unsupported(asked: float, found: AlarmRate) -> str:
    """Return why recorded time cannot promise a rate, 1/h, and how much would."""
    high = "no rate" if found.high is None else f"it at {found.high:.3g} an hour"
    return (
        f"a rate of {asked:g} an hour cannot be promised: {found.hours:.3g} h without slip "
        f"bound {high}; it takes {needed_hours(asked):.3g} h without an alarm"
    )


def promised_levels(scenes: Sequence[SceneEvidence], rates: Sequence[float]) -> list[Level]:
    """Return the lowest level that promises each rate of false alarms.

    A level promises a rate if the upper end of the 95 % interval over the scenes' worlds
    (`analysis.metrics.intervals.rate_interval`) is not above it. Levels are tried from the highest
    one down to the first that fails, one for each number of allowed alarms of a series that does
    not depend on the scenes: so the choice errs no more often than one interval does (fixed
    sequence testing; Angelopoulos et al. 2021, arXiv 2110.01052, section 2.3).
    """
    tried: list[tuple[float, AlarmRate]] = []  # levels, and the rates at them
    allowed = [0]

    def trial(place: int) -> tuple[float, AlarmRate]:
        while place >= len(tried):
            level = level_at(scenes, allowed[-1])
            tried.append((level, false_alarm_rate(scenes, level)))
            allowed.append(max(allowed[-1] + 1, allowed[-1] * 5 // 4))
        return tried[place]

    found = []
    for rate in rates:
        kept = 0
        while _below(trial(kept)[1], rate) and (kept == 0 or np.isfinite(trial(kept - 1)[0])):
            kept += 1
        level, alarms = trial(max(kept - 1, 0))
        found.append(Level(rate, level, alarms, promised=kept > 0))
    return found


def _below(found: AlarmRate, rate: float) -> bool:
    return found.high is not None and found.high <= rate
