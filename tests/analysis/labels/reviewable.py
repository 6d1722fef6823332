"""A kinematic campaign of 864 small trials with known labels; one is written, others link to it."""

from __future__ import annotations

import copy
import json
import os
import shutil
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.reviewed import label_key
from sliplab.storage.files import sha256
from sliplab.storage.schema.label import LABELS as STEP
from sliplab.storage.schema.trial import Provenance, TrialRecord
from sliplab.storage.streams import EventChunk, FrameChunk, PoseChunk, PulseChunk
from sliplab.storage.trials import review
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.review import ReviewedOnsets, Verdict
from sliplab.storage.trials.store import Campaign, TrialStore
from tests.conftest import ROOT

NAME = "kinematic"
FRAMES, STEP_NS, START_NS = 60, 10_000_000, 5_000_000
SIZE = 120
HOLD_NS = 200_000_000
"""The start of the slide."""
PER_S = 40.0
"""Pixels a second that a marker moves once it slips."""
MOVES_NS = np.array([400, 260, 280, 300, 320, 340, 360], np.int64) * 1_000_000
"""Slip time of each marker; index 0 is the centre, which slips last."""
SKIN_MM = [[0.0, 0.0], *([5.6 * np.cos(a), 5.6 * np.sin(a)] for a in np.arange(6) * np.pi / 3)]
EVENTS = 3000
DOUBTFUL = 700
"""Place in the plan of the trial whose label is in doubt."""
ADJUSTED = ReviewedOnsets(300_000_000, 500_000_000)
"""Onsets of an adjusted label."""


def frame_times() -> np.ndarray:
    """Of every frame, int64 ns."""
    return START_NS + np.arange(FRAMES, dtype=np.int64) * STEP_NS


def displacements() -> np.ndarray:
    """(frames, markers) float64, pixels."""
    late = (frame_times()[:, None] - MOVES_NS[None]) / 1e9
    return np.maximum(late, 0) * PER_S


def places() -> np.ndarray:
    """(frames, markers, 2) float32, pixels."""
    at_rest = np.asarray(SKIN_MM) * [5.0, -5.0] + SIZE / 2
    moved = displacements()[:, :, None] * [1.0, 0.0]
    return (at_rest[None] + moved).astype(np.float32)


def pictures() -> np.ndarray:
    """(frames, size, size) uint8: bright discs on black."""
    y, x = np.mgrid[:SIZE, :SIZE]
    found = np.zeros((FRAMES, SIZE, SIZE), np.uint8)
    for frame, markers in zip(found, places(), strict=True):
        for column, row in markers:
            frame[np.hypot(x - column, y - row) < 6] = 220
    return found


def events() -> EventChunk:
    """Two hundred before the slide, the rest evenly over it."""
    rng = np.random.default_rng(3)
    early = rng.integers(START_NS // 1000, HOLD_NS // 1000, 200)
    late = rng.integers(HOLD_NS // 1000, 590_000, EVENTS - 200)
    times = np.sort(np.concatenate([early, late])).astype(np.int64)
    return EventChunk(
        rng.integers(0, 640, EVENTS).astype(np.uint16),
        rng.integers(0, 480, EVENTS).astype(np.uint16),
        rng.integers(0, 2, EVENTS).astype(np.uint8),
        times,
    )


def record(trial: str, condition: dict[str, str]) -> dict[str, Any]:
    """Return the record that a session would store for such a trial."""
    line = {"device_ns": [0], "reference_ns": [0], "drift": [0]}
    clock = {"map": line, "uncertainty_ns": 1000.0, "grade": "trigger input"}
    steps = [("hold", START_NS, HOLD_NS), ("slide", HOLD_NS, 600_000_000)]
    gate = {"value": 0, "limit": 0, "passed": True}
    truth = {"incipient_ns": 310_000_000, "gross_ns": 450_000_000, "simulated": True}
    return (
        {"format": 1, "trial": trial, "campaign": NAME, "experiment": "kinematic"}
        | {"role": "measured", "block": 0, "repetition": 1, "attempt": 0, "condition": condition}
        | {"simulated": True, "recorded_s": 0.6, "motion_s": 1.0, "simulation_truth": truth}
        | {"counts": {"events": EVENTS, "frames": FRAMES, "poses": 50, "pulses": 12}}
        | {"clocks": {"reference": "sync box", "events": clock, "arm": clock, "frames": clock}}
        | {"quality": {"passed": True, "gates": {"frames_lost": gate}}}
        | {
            "geometry": {
                "centre": 0,
                "event_px": [640, 480],
                "frame_px": [SIZE, SIZE],
                "px_per_mm": 5.0,
                "skin_mm": SKIN_MM,
            },
            "steps": [
                {"phase": phase, "start_ns": start, "end_ns": end, "recorded": True}
                for phase, start, end in steps
            ],
        }
    )


def label() -> dict[str, Any]:
    """The label of such a trial by the paper's rule: 2 px, 50 ms after a marker begins to move."""
    over = displacements() > 2.0
    slips = frame_times()[over.argmax(axis=0)]
    return (
        {"incipient_ns": int(slips.min()), "gross_ns": int(slips[0]), "end_ns": 600_000_000}
        | {"doubts": {"incipient": None, "gross": None}, "per_marker_ns": slips.tolist()}
        | {"first_marker": 1, "markers_lost": 0, "plate_lost": 0, "source": "video"}
    )


class Reviewable:
    """The campaign in its store."""

    def __init__(self, folder: Path, trials: int | None = None) -> None:
        self.store = TrialStore.create(folder)
        campaign = self.store.campaign(NAME)
        protocol = (ROOT / "protocols" / "kinematic.yaml").read_text()
        campaign.update({"name": NAME, "simulated": True}, protocol, "rig: 1\n")
        self.ids: list[str] = []
        for trial in list(self.item.plan)[:trials]:
            condition = self.item.plan.describe(trial)
            (self._link if self.ids else self._write)(campaign, trial.id, condition)
            self.ids.append(trial.id)
        self.keys = {trial: self._label(trial) for trial in self.ids}

    def copied(self, folder: Path) -> Self:
        """The same in a folder of its own; files are linked, as nothing is written into one."""
        made = copy.copy(self)
        made.__dict__.pop("item", None)
        made.keys = dict(self.keys)
        shutil.copytree(self.store.folder, folder, copy_function=os.link)
        made.store = TrialStore.open(folder)
        return made

    @cached_property
    def item(self) -> Collected:
        """The campaign as the steps see it."""
        return Collected(self.store.campaign(NAME))

    def recording(self, trial: str) -> Recording:
        """Open a trial."""
        return self.item.campaign.recording(trial)

    def decide(self, trial: str, verdict: Verdict, new: ReviewedOnsets = ADJUSTED) -> None:
        """Write a reviewer's decision on a trial's label as it is now."""
        known = label()
        old = ReviewedOnsets(known["incipient_ns"], known["gross_ns"])
        seen = review.counts(self.store, NAME).get(trial, 0)
        known = {"label": self.keys[trial], "old": old, "new": new, "seen": seen}
        review.decide(self.store, NAME, trial, verdict, **known, who="anna", why="because")

    def _write(self, campaign: Campaign, trial: str, condition: dict[str, str]) -> None:
        writer = campaign.begin(trial, (SIZE, SIZE), 100)
        writer.add("events", events())
        pulses = PulseChunk(START_NS + np.arange(12, dtype=np.int64) * 50_000_000)
        for device in ("events", "arm", "sync_box"):
            writer.add(device, pulses)
        times = START_NS + np.arange(50, dtype=np.int64) * 12_000_000
        xyz = np.stack([400 + times / 1e8, times * 0.0, 300 + times * 0.0], axis=1)
        writer.add("arm", PoseChunk(times, times, xyz, np.zeros((50, 3))))
        numbers = np.arange(FRAMES, dtype=np.int64)
        level = np.zeros(FRAMES, np.uint8)
        writer.add("frames", FrameChunk(pictures(), numbers, frame_times(), frame_times(), level))
        self._first = writer.commit(
            TrialRecord.model_validate(record(trial, condition)), Provenance(host="test")
        )
        self._sums = json.loads((self._first / "checksums.json").read_text())

    def _link(self, campaign: Campaign, trial: str, condition: dict[str, str]) -> None:
        folder = campaign.folder / "trials" / trial
        folder.mkdir()
        for name in ("data.h5", "frames.mkv", "provenance.json"):
            os.link(self._first / name, folder / name)
        path = folder / "record.json"
        path.write_text(json.dumps(record(trial, condition)))
        own = {"record.json": {"sha256": sha256(path), "bytes": path.stat().st_size}}
        (folder / "checksums.json").write_text(json.dumps({**self._sums, **own}))

    def _label(self, trial: str) -> str:
        recording = self.item.campaign.recording(trial)
        key = label_key(recording, self.item.settings.labelling)
        derived = Derived.of(self.store, STEP, NAME)
        data = label()
        if trial == self.ids[0]:
            arrays = {"frame_ns": frame_times(), "xy_px": places()}
            arrays["displacement_px"] = displacements().astype(np.float32)
            derived.write(trial, key, data, arrays)
            return key
        if len(self.ids) > DOUBTFUL and trial == self.ids[DOUBTFUL]:
            reason = "marker 3 could not be followed from 0.05 s after the motion began"
            data |= {"doubts": {"incipient": reason, "gross": reason}, "markers_lost": 9}
            data |= {"incipient_ns": None, "gross_ns": None}
        os.link(derived.arrays_path(self.ids[0]), derived.arrays_path(trial))
        (derived.folder / f"{trial}.json").write_text(json.dumps({"key": key, **data}))
        return key
