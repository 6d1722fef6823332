"""An open bench of slip detectors: scenes and figures, and the detectors that ship."""

from __future__ import annotations

from sliplab.protocols.plugin import Plugin

_BENCH = "sliplab.plugins.bench"
PLUGIN = Plugin(
    studies={"bench": f"{_BENCH}.study:STUDY", "stress": f"{_BENCH}.stress.study:STUDY"},
    detectors={
        "paper": f"{_BENCH}.entries.network:PaperEntry",
        "ours": f"{_BENCH}.entries.network:Ours",
        "paper_physical": f"{_BENCH}.entries.network:PaperByPhysicalOnset",
        "ours_2px": f"{_BENCH}.entries.network:OursByPaperOnset",
        "cnn": f"{_BENCH}.entries.nets:Cnn",
        "cnn_2px": f"{_BENCH}.entries.nets:CnnByPaperOnset",
        "gru": f"{_BENCH}.entries.nets:Gru",
        "boosting": f"{_BENCH}.entries.boosting:Boosting",
        "hyperdimensional": f"{_BENCH}.entries.hyperdimensional:Hyperdimensional",
        "tips": f"{_BENCH}.entries.tips:TipNetwork",
        "tips_disturbed": f"{_BENCH}.entries.tips:DisturbedTipNetwork",
        "tips_joined": f"{_BENCH}.entries.tips:JoinedTipNetwork",
        "rate": f"{_BENCH}.entries.thresholds:EventRate",
        "flow": f"{_BENCH}.entries.thresholds:Flow",
        "always": f"{_BENCH}.entries.trivial:Always",
        "never": f"{_BENCH}.entries.trivial:Never",
        "random": f"{_BENCH}.entries.trivial:Random",
        "clock": f"{_BENCH}.entries.trivial:ByTheClock",
    },
    hooks={
        "false_alarms": f"{_BENCH}.stress.rates:report_alarms",
        "foreign_detector": f"{_BENCH}.entries:foreign_detector",
    },
)
