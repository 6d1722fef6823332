"""Samples of a simulated scene: the shares that lie in the hold and that are silent.

A sample without a single signal event looks the same whatever its class. In a scene whose steady
sliding is silent, a network that takes silence for gross slip loses the no-slip samples of the
hold, a share h of one class of three: it cannot be right more often than 1 - h/3. So h and the
silent shares say how hard a scene is before anything is trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sliplab.analysis.metrics.classification import CLASSES, NO_SLIP
from sliplab.analysis.windows.samples import choose_windows
from sliplab.analysis.windows.windows import list_events
from sliplab.plugins.simulation.scene_runs import SceneRun
from sliplab.protocols.windows import SampleSettings, Windows

PHASES = ("hold", "loading", "incipient", "gross")


@dataclass(frozen=True)
class SceneWindows:
    """Counts of one trial."""

    samples: tuple[int, int, int]
    """Number of samples by class, by the protocol's own rule."""
    silent: tuple[int, int, int]
    """Number of samples without a single event, by class."""
    in_hold: int
    """No-slip samples that end before the motion begins."""
    seconds: tuple[float, float, float, float]
    """Recorded seconds of each phase; see `PHASES`."""
    events: tuple[int, int, int, int]
    """Events of the selected polarity inside the crop, by phase."""


def look(seen: SceneRun, windows: Windows, samples: SampleSettings, seed: int) -> SceneWindows:
    """Count the samples and events of one run.

    Hold ends with the start of the motion, loading with the incipient onset and incipient slip
    with the gross one; what never begins has no time.

    Args:
        seed: of the random windows in incipient slip.

    Raises:
        ValueError: the run holds no events or no markers.
    """
    if seen.events is None or seen.markers is None:
        raise ValueError("the run was not simulated: it has no events, or no markers")
    begin_ns, end_ns = seen.begin_us * 1000, seen.end_us * 1000
    chosen = choose_windows(
        begin_ns, end_ns, *seen.markers, windows.length_ms * 1_000_000, samples.per_class, seed
    )
    silent = []
    for name in sorted(chosen):
        found = list_events(seen.events, chosen[name] // 1000, windows, *seen.size_px)
        silent.append(int(np.count_nonzero(found.totals == 0)))
    in_hold = np.count_nonzero(chosen[NO_SLIP] + windows.length_ms * 1_000_000 <= 0)
    incipient, gross = (end_ns if onset is None else onset for onset in seen.markers)
    borders = np.array([begin_ns, 0, incipient, gross, end_ns]) // 1000
    selected = seen.events.t_us[_selected(seen, windows)]
    counts = np.diff(np.searchsorted(selected, borders))
    return SceneWindows(
        samples=(len(chosen[0]), len(chosen[1]), len(chosen[2])),
        silent=(silent[0], silent[1], silent[2]),
        in_hold=int(in_hold),
        seconds=tuple(float(value) for value in np.diff(borders) / 1e6),  # type: ignore[arg-type]
        events=tuple(int(value) for value in counts),  # type: ignore[arg-type]
    )


def _selected(seen: SceneRun, windows: Windows) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Mask of events that have the selected polarity and lie in the centred crop, (n,)."""
    assert seen.events is not None
    retained = np.ones(len(seen.events), np.bool_)
    for place, size in zip((seen.events.x, seen.events.y), seen.size_px, strict=True):
        first = (size - windows.crop_px) // 2
        retained &= (place >= first) & (place < first + windows.crop_px)
    if windows.polarity != "both":
        retained &= (seen.events.p > 0) == (windows.polarity == "positive")
    return retained


def pooled(trials: Sequence[SceneWindows]) -> dict[str, Any]:
    """Return all trials together, as JSON; a share or rate of nothing is None.

    Returns:
        `hold_share` h: of no-slip samples that lie in the hold; `ceiling`: 1 - h/3, the best
        accuracy where gross slip is silent; `silent_share` by class; `events_per_s` by phase;
        `samples` by class.
    """

    def share(part: float, whole: float) -> float | None:
        return part / whole if whole else None

    samples = [sum(trial.samples[k] for trial in trials) for k in range(len(CLASSES))]
    silent = [sum(trial.silent[k] for trial in trials) for k in range(len(CLASSES))]
    hold = share(sum(trial.in_hold for trial in trials), samples[NO_SLIP])
    rates = [
        share(sum(trial.events[k] for trial in trials), sum(trial.seconds[k] for trial in trials))
        for k in range(len(PHASES))
    ]
    return {
        "simulated": True,
        "hold_share": hold,
        "ceiling": None if hold is None else 1.0 - hold / 3.0,
        "silent_share": {name: share(silent[k], samples[k]) for k, name in enumerate(CLASSES)},
        "events_per_s": dict(zip(PHASES, rates, strict=True)),
        "samples": dict(zip(CLASSES, samples, strict=True)),
    }
