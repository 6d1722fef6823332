"""Settings of the detector's search, and the short list that validation trials pick."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from sliplab.plugins.studies.detector.document import DetectorRow
from sliplab.plugins.studies.detector.grid import (
    PAPER,
    Axes,
    NetworkSetting,
    counted_stride,
    make_grid,
    strides,
)
from sliplab.plugins.studies.detector.rows import short_list
from sliplab.protocols.errors import InputError
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.windows import Windows


def test_lines_and_the_small_cross_are_tried_once_each() -> None:
    grid = make_grid(Axes(), Windows(), NetworkSettings())
    assert grid.settings[0] == PAPER
    assert len(grid.settings) == len(set(grid.settings)) == 16
    assert NetworkSetting(length_ms=5, pool_px=10) in grid.settings
    assert NetworkSetting(length_ms=10, pool_px=10) not in grid.settings
    assert grid.left_out == {}
    whole = make_grid(Axes(), Windows(), NetworkSettings(), full=True)
    # 6 x 3 x 3 x 3, without steps of 2 ms in windows of 5 ms
    assert len(whole.settings) == 162 - 9
    assert len(whole.left_out) == 9
    assert all("do not divide a window of 5 ms" in why for why in whole.left_out.values())
    assert set(grid.settings) <= set(whole.settings)


def test_what_no_network_can_have_is_refused_by_name() -> None:
    for axes, words in (
        (Axes(pool_px=(30,)), "--pool = 30: must divide the crop of 400 px"),
        (Axes(width=(0.01,)), "--width = 0.01: must leave each layer"),
        (Axes(width=(100.0,)), "--width"),
        (Axes(length_ms=(0,)), "--length = 0: must lie between 1 and 1000"),
    ):
        with pytest.raises(InputError, match=words):
            make_grid(axes, Windows(), NetworkSettings())


def test_widths_and_windows_are_those_asked_for() -> None:
    setting = NetworkSetting(length_ms=10, step_ms=5, pool_px=40, width=0.5)
    assert setting.windows(Windows()).steps == 2
    assert setting.windows(Windows()).cells == 10
    network = setting.network(NetworkSettings())
    assert (network.conv1_channels, network.conv2_channels, network.hidden) == (4, 8, 16)


def test_strides_are_multiples_of_the_finest_and_the_length() -> None:
    assert strides(30, 10) == [10, 20, 30]
    assert strides(5, 10) == [5]
    assert strides(25, 10) == [10, 20, 25]
    assert [counted_stride(length, 10) for length in (30, 5, 25)] == [10, 5, 5]


def test_the_short_list_is_picked_by_validation_trials_alone() -> None:
    def row(late: float, early: float, missed: float, work: float, test: float) -> DetectorRow:
        return DetectorRow(
            **asdict(PAPER),
            precision="trained",
            stride_ms=30,
            smoothing=4,
            margin=8.0,
            paper=False,
            validation={
                "mean_ms": (late,),
                "false_early_either": (early,),
                "lost_either": (missed,),
            },
            test={"mean_ms": (test,)},
            work={"synaptic_operations_per_s": (work,)},
        )

    rows = [
        row(100, 0.02, 0.0, 5, 1),
        row(90, 0.03, 0.0, 5, 900),
        row(90, 0.05, 0.05, 4, 900),
        row(10, 0.0, 0.06, 1, 1),
        row(5, 0.21, 0.0, 1, 1),
    ]
    found = [(budget, rows.index(one)) for budget, one in short_list(rows)]
    assert found == [(0.02, 0), (0.05, 2), (0.1, 2), (0.2, 2)]
    assert short_list(rows[3:]) == []
