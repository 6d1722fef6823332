"""Filmstrips of one kinematic and one gravity trial on the simulated rig, for these pages.

`python docs/filmstrip.py` writes docs/images/filmstrip_NAME.png. Rows, from above: where the tips
are and which of them stick, what the event camera sees in 30 ms, what the outside camera sees,
and the event rate of the whole trial. Simulated, and it says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.rig import simulated_rig
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.plan import load_plan
from sliplab.rigs.physics_levels import with_level
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.streams import Chunk, EventChunk, FrameChunk, NullSink

ROOT = Path(__file__).parent.parent
WINDOW_US = 30_000
STICKS, SLIDES, CLEAR = "#1f5fa8", "#d1495b", "#b9b9b9"


@dataclass
class Film(NullSink):
    """A sink that keeps what a filmstrip shows."""

    events: list[EventChunk] = field(default_factory=list)
    images: list[Any] = field(default_factory=list)
    image_ns: list[int] = field(default_factory=list)

    def add(self, device: str, chunk: Chunk) -> None:
        """Keep the events and every fifth frame."""
        if isinstance(chunk, EventChunk):
            self.events.append(chunk)
        if not isinstance(chunk, FrameChunk):
            return
        for index in np.flatnonzero(chunk.number % 5 == 0).tolist():
            self.images.append(chunk.images[index].copy())
            self.image_ns.append(int(chunk.t_ns[index]))


def take(plan: Plan, trial: PlannedTrial) -> tuple[MockDevices, Film, dict[str, Any]]:
    """One trial on the default rig."""
    file, _ = load_rig_file(ROOT / "rigs" / "mock.yaml")
    file = with_level(file, plan)
    devices, film = build_mock(file.mock, file.timing), Film()
    rig = simulated_rig(file, devices)
    rig.connect()
    mass = plan.mass_kg(trial)
    if mass is not None:
        rig.operator.ask("changeover", "mount the plate", f"{mass:g} kg")
    rate = plan.protocol.collection.recording.sync_rate
    run = rig.run_trial(plan.program(trial), film, trial.seed, file.frame_px(plan), rate)
    return devices, film, run.truth or {}


def draw(name: str, title: str, devices: MockDevices, film: Film, truth: dict[str, Any]) -> None:
    """Write the filmstrip of a trial that was just taken."""
    world, box = devices.world, devices.sync.clock
    first, gross = (box.to_device(truth[key]) for key in ("first_slip_ns", "gross_ns"))
    start = box.to_device(truth["reference_ns"])
    fall = "gravity" in name
    moments = [
        start - 500_000_000,
        start + (first - start) // 2,
        first + (gross - first) // 6,
        first + (gross - first) // 2,
        gross - 30_000_000,
        gross + (90_000_000 if fall else 700_000_000),
    ]
    labels = ["holding", "loading", "first slips", "half way", "just before gross", "gross slip"]
    figure, axes = plt.subplots(
        4, 6, figsize=(15, 11), height_ratios=[1, 0.78, 1, 0.62], layout="constrained"
    )
    for column, (moment, label) in enumerate(zip(moments, labels, strict=True)):
        _tips(axes[0, column], devices, moment)
        axes[0, column].set_title(f"{label}\n{(moment - start) * 1e-9:+.2f} s", fontsize=11)
        _events(axes[1, column], devices, film, moment)
        _picture(axes[2, column], devices, film, moment)
    for axis in axes[3]:
        axis.remove()
    _rate(figure.add_subplot(axes[3, 0].get_gridspec()[3, :]), devices, film, start, moments, truth)
    figure.suptitle(f"{title}: simulated", fontsize=14)
    figure.savefig(ROOT / "docs" / "images" / f"filmstrip_{name}.png", dpi=80)
    plt.close(figure)
    assert world.physics.track.end_ns > moments[-1]


def _tips(axis: Any, devices: MockDevices, moment: int) -> None:
    world, n = devices.world, len(devices.world.skin)
    before, here = world.physics.track.at(np.array([moment - 20_000_000, moment], np.int64))
    places = here[: 2 * n].reshape(n, 2) + np.array([0.0, here[4 * n]])
    sensor = world.path.states(np.array([moment], np.int64))[0, 6:]
    bases = world.skin.layout_mm + sensor[:2]
    deep = sensor[2] + world.skin.layout_mm @ sensor[3:5] - world.skin.gap_mm
    slides = here[2 * n : 3 * n] - before[2 * n : 3 * n] > 1e-5
    colours = np.where(deep <= 0.0, CLEAR, np.where(slides, SLIDES, STICKS))
    for base, place, colour in zip(bases, places, colours, strict=True):
        axis.plot([base[0], place[0]], [base[1], place[1]], color="#888888", lw=1)
        axis.add_patch(plt.Circle(tuple(place), 1.0, color=str(colour)))
    axis.set(xlim=(-21, 21), ylim=(-21, 21), aspect="equal", xticks=[], yticks=[])
    if axis.get_subplotspec().is_first_col():
        axis.set_ylabel("tips on the plate\nblue sticks, red slides")


def _events(axis: Any, devices: MockDevices, film: Film, moment: int) -> None:
    clock = devices.world.clocks.event_camera
    end = clock.to_reference(moment) // 1000
    shown = np.full((480, 640, 3), 255, np.uint8)
    for chunk in film.events:
        here = (chunk.t_us > end - WINDOW_US) & (chunk.t_us <= end)
        for polarity, colour in ((1, (31, 95, 168)), (0, (209, 73, 91))):
            mine = here & (chunk.p == polarity)
            for dy in (0, 1):
                for dx in (0, 1):
                    rows = np.minimum(chunk.y[mine] + dy, 479)
                    shown[rows, np.minimum(chunk.x[mine] + dx, 639)] = colour
    axis.imshow(shown)
    axis.set(xticks=[], yticks=[])
    if axis.get_subplotspec().is_first_col():
        axis.set_ylabel("events in 30 ms\nblue brighter, red darker")


def _picture(axis: Any, devices: MockDevices, film: Film, moment: int) -> None:
    clock = devices.world.clocks.frame_camera
    nearest = int(np.abs(np.array(film.image_ns) - clock.to_reference(moment)).argmin())
    axis.imshow(film.images[nearest], cmap="gray", vmin=0, vmax=255)
    axis.set(xticks=[], yticks=[])
    if axis.get_subplotspec().is_first_col():
        axis.set_ylabel("outside camera")


def _rate(
    axis: Any,
    devices: MockDevices,
    film: Film,
    start: int,
    moments: list[int],
    truth: dict[str, Any],
) -> None:
    clock, box = devices.world.clocks.event_camera, devices.sync.clock
    t_us = np.concatenate([chunk.t_us[chunk.p == 1] for chunk in film.events])
    t_s = (clock.to_device(t_us * 1000) - start) * 1e-9
    edges = np.arange(np.floor(t_s[0] * 20) / 20, t_s[-1], 0.05)
    counts = np.histogram(t_s, edges)[0] / 0.05 / 1000
    axis.fill_between(edges[:-1], counts, step="post", color="#9db8d9")
    for key, colour in (("first_slip_ns", STICKS), ("gross_ns", SLIDES)):
        axis.axvline((box.to_device(truth[key]) - start) * 1e-9, color=colour, lw=2)
    for moment in moments:
        axis.axvline((moment - start) * 1e-9, color="#444444", lw=0.8, ls=":")
    axis.set(
        xlabel="time after the motion's start (s); blue line: first slip, red line: gross slip",
        ylabel="positive events\n(1000 a second)",
        xlim=(edges[0], edges[-1]),
        ylim=(0, None),
    )


def main() -> None:
    """Both filmstrips."""
    for name, protocol, title in (
        ("kinematic", "kinematic", "A slide of 15 mm at 1 mm/s, pressed in by 2.8 mm"),
        ("gravity", "gravity", "A plate of 0.165 kg, the sensor drawn back at 0.5 mm/s"),
    ):
        plan = load_plan(ROOT / "protocols" / f"{protocol}.yaml", ())
        for trial in plan:
            known = {key: value.split()[0] for key, value in plan.describe(trial).items()}
            if protocol == "kinematic":
                wanted = (known["depth"], known["speed"], known["direction"]) == ("2.8", "1", "0")
            else:
                wanted = (known["mass"], known["speed"]) == ("0.165", "0.5")
            if wanted:
                break
        else:
            raise SystemExit(f"{protocol}: no such trial among {known}")
        draw(name, title, *take(plan, trial))


if __name__ == "__main__":
    main()
