"""The paper's way to track, kept as the reference: threshold every frame and name its blobs.

It looks at every pixel of every frame and knows nothing of prediction, so it cannot be led astray
by it; `analysis.labels.markers` has to agree with it, and is faster by two orders of magnitude.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.distance import pdist

from sliplab.analysis.labels.blobs import Floats, Frame, find_blobs, match_layout


def reference_track(frames: Iterable[Frame], layout_px: Floats) -> Floats:
    """(n, m, 2) px, NaN where a marker has no blob.

    Args:
        frames: (h, w) uint8, in order.
        layout_px: (m, 2) nominal positions relative to the centre marker.
    """
    layout = np.array(layout_px, np.float64)
    spacing = float(pdist(layout).min()) if len(layout) > 1 else 100.0
    limits = (np.pi * (0.15 * spacing) ** 2, np.pi * (0.5 * spacing) ** 2)
    last, rows = layout, []
    for frame in frames:
        blobs = find_blobs(frame, *limits)
        shift, index = match_layout(blobs.xy, last, 0.35 * spacing)
        found = np.full(layout.shape, np.nan)
        seen = index >= 0
        if seen.sum() * 2 >= len(index):
            found[seen] = blobs.xy[index[seen]]
            # unseen markers move with the others
            last = np.where(seen[:, None], found, last + shift)
        rows.append(found)
    return np.stack(rows) if rows else np.empty((0, len(layout), 2))
