"""The figure of one trial's forces: over time, and as friction cone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import matplotlib.pyplot as plt

from sliplab.analysis.report.figures.style import (
    BLUE,
    GREY,
    ONSET_COLOURS,
    ORANGE,
    RED,
    STYLE,
    Array,
    svg_text,
)


def force_overview(
    time_s: Array,
    normal_n: Array,
    tangential_n: Array,
    friction: float,
    onsets_s: Sequence[float | None],
    knees_s: Sequence[float | None],
    *,
    simulated: bool,
) -> str:
    """Normal and tangential force over time, and one against the other with the friction cone.

    Args:
        time_s, normal_n, tangential_n: (n,).
        friction: largest ratio of the two; NaN where it is not known.
        onsets_s: incipient and gross onset by the label's rule; knees_s: by the force.
    """
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(6.4, 3.2), width_ratios=(2, 1))
        left.plot(time_s, normal_n, color=BLUE, lw=1.2, label="normal")
        left.plot(time_s, tangential_n, color=RED, lw=1.2, label="along the plate")
        for which, style in ((onsets_s, "-"), (knees_s, ":")):
            for onset, colour in zip(which, ONSET_COLOURS, strict=True):
                if onset is not None:
                    left.axvline(onset, color=colour, lw=1.1, ls=style)
        left.plot([], [], color="black", lw=1.1, label="onsets: label")
        left.plot([], [], color="black", lw=1.1, ls=":", label="onsets: force")
        left.set_xlabel("time since the recording began (s)")
        left.set_ylabel("force on the plate (N)")
        left.set_ylim(bottom=min(0.0, float(normal_n.min(initial=0.0))))
        right.plot(normal_n, tangential_n, ",", color=GREY, alpha=0.5, rasterized=True)
        most = 1.05 * float(normal_n.max(initial=1e-3))
        if math.isfinite(friction):
            edge = [0.0, friction * most]
            right.plot([0.0, most], edge, color=ORANGE, lw=1.2, label=f"ratio {friction:.2f}")
            right.legend(loc="upper left", fontsize=8)
        right.set_xlim(0.0, most)
        right.set_ylim(bottom=0.0)
        right.set_xlabel("normal force (N)")
        right.set_ylabel("force along the plate (N)")
        handles, titles = left.get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=4, fontsize=8)
        return svg_text(figure, simulated)
