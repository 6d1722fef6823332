"""The moving picture of a reflex in README: a plate without it and with it, simulated.

`python docs/reflex_film.py OUT/reflex.json docs/images/reflex.gif [--trial ID] [--reflex R]`, where
`sliplab reflex` wrote OUT.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle
from PIL import Image

from sliplab.analysis.report.figures.style import BLUE, GREEN, GREY, ORANGE, RED, STYLE
from sliplab.plugins.reflex.document import ReflexStudy, ReflexTrial

FPS = 20
SLOWER = 2.0
"""Film seconds for a second of the trial."""
SIZE = (5.6, 3.4)
DPI = 100
STROKE_MM = 25.0
WAIT_S = 1.0
"""Time for which the last picture stays."""


def chosen(
    study: ReflexStudy, trial: str | None, reflex: str, detector: str | None
) -> tuple[ReflexTrial, ReflexTrial]:
    """Return a trial without a reflex, and with one that prevented its drop."""
    trials = list(study.trials.values())
    bare = {it.trial: it for it in trials if it.reflex is None and it.dropped}
    for it in trials:
        fits = it.reflex == reflex and not it.dropped and trial in (None, it.trial)
        if fits and detector in (None, it.detector) and it.trial in bare:
            return bare[it.trial], it
    raise SystemExit(f"no trial that {reflex} prevented from dropping")


def height_at(it: ReflexTrial, t_ms: float) -> float:
    """Height of a plate at a time after the retraction began, mm."""
    times = np.arange(len(it.heights_mm)) * it.step_ms
    return float(np.interp(t_ms, times, it.heights_mm))


def draw_plate(axes: Any, it: ReflexTrial, t_ms: float) -> None:
    """Draw one plate on its slider, and the sensor that holds it."""
    height = height_at(it, t_ms)
    slips = it.slip_ms is not None and t_ms >= it.slip_ms
    seen = it.detected_ms is not None and t_ms >= it.detected_ms
    gone = height < -0.8 * STROKE_MM
    axes.add_patch(Rectangle((-16, -STROKE_MM - 17), 32, 2, color=GREY))
    axes.add_patch(Rectangle((-12, height - 14), 24, 28, color=BLUE, alpha=0.35, lw=0))
    axes.add_patch(Rectangle((8.6, height + 10.6), 2.4, 2.4, color="black"))
    for ring, count in ((0, 1), (4, 6), (8, 12)):
        angle = 2 * np.pi * np.arange(count) / count
        colour = GREEN if seen else (ORANGE if slips else GREY)
        axes.scatter(ring * np.cos(angle), ring * np.sin(angle), s=18, color=colour, lw=0)
    axes.set_xlim(-18, 18)
    axes.set_ylim(-STROKE_MM - 19, 18)
    axes.set_aspect("equal")
    axes.axis("off")
    title = "no reflex" if it.reflex is None else f"reflex: {it.reflex}"
    state = "tips slip" if slips else "held"
    if gone:
        state = "dropped"
    elif seen:
        state = "slip detected: gripped"
    axes.set_title(f"{title}\n{state}", fontsize=9, color=RED if gone else "black")


def frame(bare: ReflexTrial, held: ReflexTrial, t_ms: float, end_ms: float) -> Image.Image:
    """Return the picture at a time after the retraction began."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 3, figsize=SIZE, width_ratios=(1, 1, 1.25))
        for place, it in zip(axes, (bare, held), strict=False):
            draw_plate(place, it, t_ms)
        times = np.arange(0.0, t_ms + 1e-9, 10.0)
        for it, colour in ((bare, RED), (held, GREEN)):
            label = it.reflex or "no reflex"
            axes[2].plot(times, [height_at(it, t) for t in times], color=colour, label=label)
        axes[2].set_xlim(0, end_ms)
        axes[2].set_ylim(-STROKE_MM - 1, 1)
        axes[2].set_xlabel("ms of retraction")
        axes[2].set_ylabel("plate (mm)")
        axes[2].legend(loc="lower left", fontsize=7.5)
        where = f"{1e3 * bare.mass_kg:.0f} g, {bare.speed_mm_s:g} mm/s"
        figure.suptitle(f"simulated; {where}", x=0.995, ha="right", fontsize=8, color=GREY)
        buffer = io.BytesIO()
        figure.savefig(buffer, dpi=DPI)
        plt.close(figure)
    return Image.open(buffer).convert("RGB").quantize(32, dither=Image.Dither.NONE)


def main() -> None:
    """Write the moving picture."""
    parser = argparse.ArgumentParser(prog="python docs/reflex_film.py")
    parser.add_argument("study", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--trial")
    parser.add_argument("--detector")
    parser.add_argument("--reflex", default="grip:0.4")
    asked = parser.parse_args()
    study = ReflexStudy.load(asked.study)
    bare, held = chosen(study, asked.trial, asked.reflex, asked.detector)
    fallen = int(np.argmin(np.array(bare.heights_mm))) * bare.step_ms
    end_ms = fallen + 250.0
    step_ms = 1e3 / FPS / SLOWER
    frames = [frame(bare, held, t, end_ms) for t in np.arange(0.0, end_ms, step_ms)]
    durations = [round(1e3 / FPS)] * len(frames)
    durations[-1] = round(1e3 * WAIT_S)
    frames[0].save(
        asked.out,
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        optimize=True,
    )
    size_kb = asked.out.stat().st_size / 1e3
    print(f"{asked.out}: {len(frames)} pictures, {size_kb:.0f} kB, simulated")


if __name__ == "__main__":
    main()
