"""Labels from events alone against the simulation's truth and against the labels from frames.

`python -m benchmarks.event_labels [TRIALS]` takes slides spread over the kinematic grid on the
simulated rig, with events and tracks, and labels them from their events: as they are, with ten
times the noise, and with events lost or added. Prints the figures of
docs/decisions/one-camera.md, by speed and nuisance. All figures are simulated.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.labels.event_labels import onsets_by_events
from sliplab.analysis.labels.label import Label
from sliplab.analysis.labels.labelling import label_recording
from sliplab.analysis.sweeps.runner import sample_trials
from sliplab.protocols.labelling import Labelling
from sliplab.protocols.shipped import shipped_protocols
from sliplab.storage.schema.label import KINDS
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

ROOT = Path(__file__).parents[1]
F64 = npt.NDArray[np.float64]
Change = Callable[[EventChunk, int, np.random.Generator], EventChunk]
WRONG_MS = 150.0
"""Half of the widest 95 % interval of an onset that is not in doubt."""


class ChangedRecording:
    """A recording whose events come out of a function of them and of a time, microseconds."""

    def __init__(self, recording: Recording, change: Change, about: str) -> None:
        self._recording, self._change, self._about = recording, change, about

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)

    def events(self) -> EventChunk:
        """The changed events."""
        truth = self._recording.simulation_truth() or {}
        about_us = int(self.clock("events").to_device(truth[f"{self._about}_ns"])) // 1000
        draw = np.random.default_rng(self._recording.record.seed or 0)
        return self._change(self._recording.events(), about_us, draw)


def lost(share: float, from_s: float = -99.0, to_s: float = 99.0) -> Change:
    """Lose a share of the events over a time."""

    def change(events: EventChunk, about_us: int, draw: np.random.Generator) -> EventChunk:
        since_s = (events.t_us - about_us) * 1e-6
        gone = (since_s > from_s) & (since_s < to_s) & (draw.random(len(events)) < share)
        return _kept(events, ~gone)

    return change


def limited(per_ms: int) -> Change:
    """A read-out that gives so many events a millisecond at most."""

    def change(events: EventChunk, about_us: int, draw: np.random.Generator) -> EventChunk:
        ms = events.t_us // 1000
        return _kept(events, np.arange(len(ms)) - np.searchsorted(ms, ms) < per_ms)

    return change


def hot(pixels: int, rate_hz: float) -> Change:
    """More hot pixels."""

    def change(events: EventChunk, about_us: int, draw: np.random.Generator) -> EventChunk:
        begin, end = int(events.t_us[0]), int(events.t_us[-1])
        count = draw.poisson(rate_hz * (end - begin) * 1e-6, pixels)
        x, y = (np.repeat(draw.integers(0, size, pixels), count) for size in (640, 480))
        times = draw.integers(begin, end, int(count.sum()))
        return _merged(events, times, x, y, np.ones(len(times)))

    return change


def burst(million_per_s: float, seconds: float) -> Change:
    """Noise all over the array for a while."""

    def change(events: EventChunk, about_us: int, draw: np.random.Generator) -> EventChunk:
        n = round(million_per_s * 1e6 * seconds)
        times = about_us + draw.integers(round(-seconds * 5e5), round(seconds * 5e5), n)
        x, y, p = (draw.integers(0, size, n) for size in (640, 480, 2))
        return _merged(events, times, x, y, p)

    return change


def darker_lost(share: float) -> Change:
    """Lose a share of the negative events: a higher threshold of one polarity."""

    def change(events: EventChunk, about_us: int, draw: np.random.Generator) -> EventChunk:
        return _kept(events, (events.p > 0) | (draw.random(len(events)) >= share))

    return change


def _kept(events: EventChunk, mask: npt.NDArray[np.bool_]) -> EventChunk:
    return events[mask]


def _merged(events: EventChunk, t_us: Any, x: Any, y: Any, p: Any) -> EventChunk:
    order = np.argsort(np.concatenate([events.t_us, t_us]), kind="stable")
    return EventChunk(
        np.concatenate([events.x, x.astype(np.uint16)])[order],
        np.concatenate([events.y, y.astype(np.uint16)])[order],
        np.concatenate([events.p, p.astype(np.uint8)])[order],
        np.concatenate([events.t_us, t_us])[order],
    )


CAMERAS = {
    "ten times the noise": "noise_hz: 0.1",
    "negative threshold 0.25": "threshold_off: 0.25",
    "pixels of 30 Hz": "cutoff_hz: 30",
    "read-out of 1000 scans a second": "readout_hz: 1000, scan_us: 0",
    "contrast 1.2": "contrast: 1.2",
}
"""Other event cameras, by settings of the simulated one."""
CASES: dict[str, tuple[str, Change]] = {
    "500 more hot pixels, 2 Hz": ("gross", hot(500, 2.0)),
    "burst of 1 M/s for 0.1 s at gross": ("gross", burst(1.0, 0.1)),
    "half of the negative events lost": ("gross", darker_lost(0.5)),
    "a third of all events lost": ("gross", lost(0.33)),
    "two thirds of all events lost": ("gross", lost(0.67)),
    "read-out of 10 events/ms": ("gross", limited(10)),
    "half lost for 0.3 s at incipient": ("incipient", lost(0.5, -0.15, 0.15)),
    "half lost for 0.5 s before gross": ("gross", lost(0.5, -0.8, -0.3)),
    "all lost for 50 ms before gross": ("gross", lost(1.0, -0.3, -0.25)),
    "all lost for 0.2 s, 1 s before gross": ("gross", lost(1.0, -1.3, -1.1)),
}


@dataclass
class OnsetErrors:
    """Onsets of many trials: errors and intervals of the known ones, and how many are in doubt."""

    errors_ms: dict[str, list[float]] = field(default_factory=lambda: {k: [] for k in KINDS})
    doubts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 0))
    inside: list[bool] = field(default_factory=list)
    apart_ms: list[float] = field(default_factory=list)
    wrong: int = 0
    seconds: float = 0.0

    def add(self, found: Label, recording: Recording) -> None:
        """Hold a trial's onsets by the paper's rule against the true crossings."""
        truth = recording.simulation_truth() or {}
        for kind in KINDS:
            doubts = found.paper_doubts
            if doubts.incipient is not None or (kind == "gross" and doubts.gross is not None):
                self.doubts[kind] += 1
                continue
            at, true = getattr(found.paper, f"{kind}_ns"), truth.get(f"{kind}_ns")
            if true is not None and true > found.frame_ns[-1]:
                true = None  # it came with the release
            if at is None or true is None:
                self.wrong += at is not true
                continue
            error = (at - true) / 1e6
            interval = getattr(found.intervals, f"{kind}_ns")
            self.errors_ms[kind].append(error)
            self.inside.append(interval is not None and interval[0] <= true <= interval[1])
            self.wrong += abs(error) > WRONG_MS

    def row(self, name: str) -> str:
        """A row of the table."""
        cells = [name]
        for kind in KINDS:
            off = np.abs(self.errors_ms[kind])
            known = f"{np.median(off):.0f} / {np.quantile(off, 0.95):.0f}" if len(off) else "-"
            cells += [known, f"{self.doubts[kind]} of {self.doubts[kind] + len(off)}"]
        share = f"{np.mean(self.inside):.3f}" if self.inside else "-"
        return "| " + " | ".join([*cells, share, str(self.wrong)]) + " |"


HEAD = (
    "| simulated slides | incipient, median / 95 % (ms) | in doubt | gross (ms) | in doubt | "
    "interval right | wrong, not in doubt |\n| --- | --: | --: | --: | --: | --: | --: |"
)


def main(trials: int = 72) -> None:
    """Take the slides and print the tables."""
    with tempfile.TemporaryDirectory() as folder:
        plain = take(Path(folder) / "plain", trials)
        print(HEAD)
        by_speed: dict[str, OnsetErrors] = {}
        total = OnsetErrors()
        for recording in plain:
            begun = time.process_time()
            found = onsets_by_events(recording, Labelling())
            total.seconds += time.process_time() - begun
            for each in (
                by_speed.setdefault(recording.record.condition["speed"], OnsetErrors()),
                total,
            ):
                each.add(found, recording)
        for speed in sorted(by_speed):
            print(by_speed[speed].row(speed))
        print(total.row("all"))
        for number, (name, camera) in enumerate(CAMERAS.items()):
            seen = take(Path(folder) / str(number), trials // 3, camera)
            print(_labelled(seen).row(name), flush=True)
        skin = take(Path(folder) / "skin", trials // 3, seed=7)
        print(_labelled(skin).row("another skin"))
        twists = take(Path(folder) / "twists", trials // 3, protocol="press_twist")
        print(_labelled(twists).row("twists"), flush=True)
        for name, (about, change) in CASES.items():
            changed = [ChangedRecording(recording, change, about) for recording in plain[::3]]
            print(_labelled(changed).row(name), flush=True)
        print(f"\n{1e3 * total.seconds / len(plain):.0f} ms of processor time a trial")
        for line in tracks(plain[::3]):
            print(line)


def take(
    folder: Path, trials: int, camera: str = "", seed: int = 1, protocol: str = "kinematic"
) -> list[Recording]:
    """Collect trials spread over a grid, with events and tracks.

    Args:
        camera: settings of the event camera, as in a rig file. seed: of the skin.
    """
    from sliplab.flows.collect import collect
    from sliplab.flows.planning.run_request import make_request
    from sliplab.flows.steps import prepare_store

    folder.mkdir()
    prepare_store(folder / "store")
    path = folder / "rig.yaml"
    path.write_text(
        f"extends: {ROOT / 'rigs' / 'rehearsal.yaml'}\nname: benchmark\n"
        f"mock: {{seed: {seed}, event_camera: {{{camera}}}}}\n"
    )
    request = make_request(shipped_protocols()[protocol], path, folder / "store")
    chosen = sample_trials(request.plan, trials)
    collect(replace(request, only=frozenset(trial.id for trial in chosen)))
    campaign = TrialStore.open(folder / "store").campaign(request.campaign)
    return list(campaign.recordings())


def _labelled(recordings: Sequence[Any]) -> OnsetErrors:
    total = OnsetErrors()
    for recording in recordings:
        total.add(onsets_by_events(recording, Labelling()), recording)
    return total


def tracks(recordings: Sequence[Recording]) -> list[str]:
    """Compare distances slid and slips' beginnings with frames and truth, over all papillae."""
    off, z, apart, began, inside = [], [], [], [], []
    for recording in recordings:
        found, frames = (
            onsets_by_events(recording, Labelling()),
            label_recording(recording, Labelling()),
        )
        seen = np.stack(
            [np.interp(found.frame_ns, frames.frame_ns, row) for row in frames.displacement_px.T], 1
        )
        near = (found.frame_ns > frames.start_ns)[:, None] & (seen < 4.0)
        near &= (seen > 0.5) & np.isfinite(found.displacement_px)
        off.append((found.displacement_px - seen)[near])
        z.append(np.abs(off[-1]) / found.places.sigma[near])
        for kind in KINDS:
            mine, other = (getattr(each.paper, f"{kind}_ns") for each in (found, frames))
            doubts = found.paper_doubts
            known = doubts.incipient is None and (kind == "incipient" or doubts.gross is None)
            if known and mine is not None and other is not None:
                apart.append((mine - other) / 1e6)
        truth = (recording.simulation_truth() or {})["slip_per_papilla_ns"]
        for at, low, high, true in zip(
            found.slips.at_ns, found.slips.low_ns, found.slips.high_ns, truth, strict=True
        ):
            if at != -1 and true is not None:
                began.append(abs(at - true) / 1e6)
                inside.append(low <= true <= high)
    errors, sigmas = np.abs(np.concatenate(off)), np.concatenate(z)
    return [
        f"distance slid, from 0.5 to 4 px (0.2 mm): median {np.median(errors):.2f} px, 95 % "
        f"{np.quantile(errors, 0.95):.2f} px; within two deviations {(sigmas < 2).mean():.3f}",
        f"onsets less those from frames: median {np.median(apart):.0f} ms, "
        f"absolute {np.median(np.abs(apart)):.0f} / {np.quantile(np.abs(apart), 0.95):.0f} ms",
        f"beginning of a papilla's slip (n = {len(began)}): median {np.median(began):.0f} ms, 95 % "
        f"{np.quantile(began, 0.95):.0f} ms; interval right {np.mean(inside):.3f}",
    ]


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
