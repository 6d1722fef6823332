"""Labels of trials whose places are known: from where displacements count, slips in the hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sliplab.analysis.labels.label import Label
from sliplab.analysis.labels.labelling import label_places
from sliplab.analysis.labels.places import Places
from sliplab.analysis.labels.plate_tracking import PlateTrack
from sliplab.protocols.labelling import Labelling

FRAME_NS = 10_000_000
START = 200
"""The frame with which the motion begins: a hold of 2 s comes before it."""
N, M = 420, 7


def places(
    slip_px: float = 0.0, *, plate: bool = True, noise: float = 0.004, still: int = 30
) -> Places:
    """Markers that let go one after the other from 0.3 s after the start on, the centre (0) last.

    Marker 3 has moved by `slip_px` between 0.5 and 1.5 s of the hold, and slips first. With a
    plate, everything sinks by 3 px in the hold, the plate too.
    """
    frames, draw = np.arange(N), np.random.default_rng(4)
    xy = np.stack(np.meshgrid([0.0, 100.0, 200.0], [0.0, 100.0, 200.0]), -1).reshape(-1, 2)[:M]
    starts = START + np.array([150, 60, 80, still, 100, 120, 140])
    way = 0.45 * np.maximum(0, frames[:, None] - starts).astype(np.float64)
    way[:, 3] += slip_px * np.clip((frames - 50) / 100, 0.0, 1.0)
    at = xy + np.stack([0.6 * way, 0.8 * way], -1)
    sunk = 3.0 * np.clip(frames / 150, 0.0, 1.0)
    if plate:
        at[..., 1] += sunk[:, None]
    at += draw.normal(0, noise, at.shape)
    track = PlateTrack(
        np.stack([np.full(N, 400.0), 400.0 + sunk], -1),
        np.full((N, 4, 2), np.nan),
        np.ones(N, np.bool_),
        np.full(N, 0.01),
    )
    sigma = np.full((N, M), max(noise, 1e-6))
    return Places(at, sigma, np.ones((N, M)), track if plate else None)


def label(seen: Places, **settings: Any) -> Label:
    frame_ns = np.arange(N, dtype=np.int64) * FRAME_NS
    return label_places(
        seen,
        frame_ns,
        (START * FRAME_NS, N * FRAME_NS),
        Labelling(**settings),
        centre=0,
        exposure_ns=2_000_000,
        source="tracks",
    )


def crossing(label: Label, reference: str) -> float:
    """The incipient onset counted from a reference, frames."""
    found: int = label.document().to_json()["references"][reference]["incipient_ns"]
    return found / FRAME_NS


@pytest.mark.parametrize("plate", [True, False])
def test_a_slip_in_the_hold_counts_from_its_start_and_is_hidden_from_its_end(plate: bool) -> None:
    found = label(places(4.0, plate=plate))
    # 0.04 px a frame from frame 50 on, beyond 2 px after 50 more
    assert crossing(found, "hold_start") == pytest.approx(101, abs=1)
    # and counted from the hold's end 0.45 px a frame from frame 230 on
    assert crossing(found, "hold_end") == pytest.approx(235, abs=1)
    kept = found.document().to_json()
    assert kept["reference"] == "hold_start"
    assert kept["paper"]["incipient_ns"] == kept["references"]["hold_start"]["incipient_ns"]
    assert kept["hold_slip_px"][3] == pytest.approx(4.0, abs=0.02)
    assert max(v for i, v in enumerate(kept["hold_slip_px"]) if i != 3) < 0.02
    assert kept["incipient_ns"] is kept["gross_ns"] is None
    assert kept["doubts"]["incipient"] == "marker 3 moved by 4.0 px in the hold, before the motion"
    rest = ["the plate was not seen to rest: its slip ends with the motion"] if plate else []
    assert kept["flags"] == ["markers that moved in the hold: 1, by 4.0 px", *rest]


def test_a_setting_says_from_where_the_ruling_onsets_count() -> None:
    slipped = places(1.2)
    for reference, frame in (("hold_start", 232), ("hold_end", 235)):
        found = label(slipped, reference=reference, hold_slip_px=None)
        kept = found.document().to_json()
        assert kept["reference"] == reference
        assert kept["doubts"]["incipient"] is None
        assert kept["incipient_ns"] / FRAME_NS == pytest.approx(frame, abs=1)
        assert found.displacement_px[START - 1, 3] == pytest.approx(
            1.2 if reference == "hold_start" else 0.0, abs=0.02
        )


def test_the_limit_of_a_slip_in_the_hold_is_a_setting() -> None:
    slipped = places(1.2)
    assert label(slipped).document().doubts.incipient is not None
    assert label(slipped, hold_slip_px=1.25).document().doubts.incipient is None
    assert label(places(4.0), hold_slip_px=None).document().incipient_ns is not None


@pytest.mark.parametrize("plate", [True, False])
def test_after_a_still_hold_both_references_agree(plate: bool) -> None:
    kept = label(places(0.0, plate=plate, noise=0.0)).document().to_json()
    first, last = (kept["references"][name] for name in ("hold_start", "hold_end"))
    assert first == last
    assert first["per_marker_ns"] == kept["per_marker_ns"]
    assert max(kept["hold_slip_px"]) < 1e-9
    assert kept["doubts"] == {"incipient": None, "gross": None}
    assert kept["incipient_ns"] == (START + 30 + 5) * FRAME_NS


@pytest.mark.parametrize("hidden", [slice(0, 40), slice(START - 30, START)])
def test_a_marker_hidden_at_one_end_of_the_hold_counts_from_the_other(hidden: slice) -> None:
    seen = places()
    xy, sigma = seen.xy.copy(), seen.sigma.copy()
    xy[hidden, 3], sigma[hidden, 3] = np.nan, np.nan
    found = label(replace(seen, xy=xy, sigma=sigma)).document().to_json()
    assert found["doubts"] == {"incipient": None, "gross": None}
    assert found["hold_slip_px"][3] is None
    assert found["incipient_ns"] == pytest.approx((START + 35) * FRAME_NS, abs=FRAME_NS)


def test_a_camera_knocked_in_the_hold_is_no_slip() -> None:
    seen = places(plate=False)
    xy = seen.xy.copy()
    xy[90:] += np.array([2.5, 1.0])
    found = label(replace(seen, xy=xy)).document().to_json()
    assert max(found["hold_slip_px"]) < 0.1
    assert found["incipient_ns"] == pytest.approx((START + 35) * FRAME_NS, abs=FRAME_NS)


def test_change_points_do_not_depend_on_the_reference() -> None:
    first, last = (
        label(places(0.5), reference=name).document() for name in ("hold_start", "hold_end")
    )
    assert first.change_point == last.change_point


def test_a_recording_without_a_hold_has_no_reference() -> None:
    frame_ns = np.arange(N, dtype=np.int64) * FRAME_NS
    with pytest.raises(ValueError, match="no reference frame: the recording starts after the hold"):
        label_places(
            places(), frame_ns, (0, 1), Labelling(), centre=0, exposure_ns=0, source="tracks"
        )
