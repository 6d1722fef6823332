"""Summary of label checks against the truth: figures and tables (docs/labels.md has excerpts)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from benchmarks.measure import Figures

F64 = npt.NDArray[np.float64]
FRAME_MS = 10.0


@dataclass(frozen=True)
class Checked:
    """One trial: what was found less what is true; times in ms, m markers."""

    speed: float
    error_px: float
    """RMS over all coordinates of all markers in all frames."""
    swaps: int
    crossed_ms: F64
    """(m,) the paper's rule less the true crossing; NaN where there is none."""
    paper_ms: F64
    """(m,) the paper's rule less the true start of slip."""
    slip_ms: F64
    """(m,) the change point less the true start of slip."""
    low_ms: F64
    high_ms: F64
    wrong: dict[str, str]
    """Onset by rule and kind: right, wrong, doubted, or silent."""


def summary(trials: Sequence[Checked]) -> Figures:
    """Figures of a set of trials."""
    crossed, paper, slip, low, high = (
        np.concatenate([getattr(trial, name) for trial in trials])
        for name in ("crossed_ms", "paper_ms", "slip_ms", "low_ms", "high_ms")
    )
    known = np.isfinite(slip)
    covered = (low[known] <= 0) & (high[known] >= 0)
    paper_slip = float(np.nanmedian(np.abs(paper)))
    return {
        "trials": float(len(trials)),
        "slips": float(known.sum()),
        "centroid_rms_px": float(np.sqrt(np.mean([trial.error_px**2 for trial in trials]))),
        "swaps": float(sum(trial.swaps for trial in trials)),
        "crossing_median_frames": float(np.nanmedian(np.abs(crossed))) / FRAME_MS,
        "crossing_p95_frames": float(np.nanpercentile(np.abs(crossed), 95)) / FRAME_MS,
        "paper_slip_median_ms": paper_slip,
        "slip_median_ms": float(np.median(np.abs(slip[known]))),
        "slip_p95_ms": float(np.percentile(np.abs(slip[known]), 95)),
        "slip_bias_ms": float(np.median(slip[known])),
        "slip_width_ms": float(np.median((high - low)[known])),
        "coverage_95": float(covered.mean()),
        "share_of_paper": float(np.median(np.abs(slip[known]))) / paper_slip,
    }


def verdicts(trials: Sequence[Checked]) -> dict[str, dict[str, int]]:
    """Count right, wrong and doubted onsets by rule and kind."""
    result: dict[str, dict[str, int]] = {}
    for trial in trials:
        for name, verdict in trial.wrong.items():
            counts = result.setdefault(name, {"right": 0, "doubted": 0, "wrong": 0})
            counts[verdict] += 1
    return result


_COLUMNS = (
    ("slips", "papilla slips", 0),
    ("centroid_rms_px", "centroids RMS (px)", 4),
    ("crossing_median_frames", "paper's rule: median (frames)", 2),
    ("crossing_p95_frames", "95 % (frames)", 2),
    ("paper_slip_median_ms", "paper's rule after the slip (ms)", 0),
    ("slip_median_ms", "change point: median (ms)", 2),
    ("slip_p95_ms", "95 % (ms)", 2),
    ("slip_width_ms", "interval's width (ms)", 2),
    ("coverage_95", "interval right", 3),
)


def tables(sets: Sequence[Sequence[Checked]]) -> str:
    """Return the tables, of which docs/labels.md has excerpts."""
    clean, fallen, hard = sets
    lines = ["| | " + " | ".join(title for _, title, _ in _COLUMNS) + " |"]
    lines.append("| --- |" + " ---: |" * len(_COLUMNS))
    rows = [
        (f"{speed:g} mm/s", [trial for trial in clean if trial.speed == speed])
        for speed in sorted({trial.speed for trial in clean})
    ]
    rows += [("all slides", clean), ("falling plates", fallen), ("slides under stress", hard)]
    for name, trials in rows:
        if trials:
            found = summary(trials)
            values = [f"{found[key]:.{digits}f}" for key, _, digits in _COLUMNS]
            lines.append(f"| {name} | " + " | ".join(values) + " |")
    for title, trials in (("all slides", clean), ("falling plates", fallen), ("stress", hard)):
        lines += [
            "",
            f"| {title}: onset | right | doubted | wrong |",
            "| --- | ---: | ---: | ---: |",
        ]
        lines += [
            f"| {name} | {counts['right']} | {counts['doubted']} | {counts['wrong']} |"
            for name, counts in verdicts(trials).items()
        ]
    lines += ["", f"Identity swaps: {sum(trial.swaps for each in sets for trial in each)}."]
    return "\n".join(lines)
