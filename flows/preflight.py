"""`sliplab check`: all that can be known before anything moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from flows.console import size
from flows.orders import Order, check_disk, make_order, missing_bytes, pending_trials
from protocols import InputError
from rigs.calibration import COMMANDS, find_faults, measured_on
from rigs.rig_inheritance import read_rig, rig_path
from storage.store import Store


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    passed: bool
    finding: str


def check(protocol: Path, rig: Path, store: Path, enable: tuple[str, ...]) -> list[Check]:
    """Look at protocol, rig file, space, devices and clocks; nothing moves.

    Raises:
        InputError: protocol or rig file cannot be used at all.
    """
    order = make_order(protocol, rig, store, enable=enable)
    pending = pending_trials(order.plan, Store(store).campaign(order.campaign))
    found = [
        Check("protocol and limits", True, f"{len(order.plan)} trials within all limits"),
        Check("campaign", True, f"{len(pending)} of {len(order.plan)} still to take"),
    ]
    found.append(Check("outside camera", True, _outside_camera(order)))
    found += [Check("hint", True, text) for text in order.plan.warnings()]
    try:
        free = check_disk([order])
        needed = size(missing_bytes(order))
        found.append(Check("space", True, f"needs {needed}, {size(free)} free"))
    except InputError as error:
        found.append(Check("space", False, error.expected))
    found += _check_calibration(order, rig)
    found += _check_devices(order)
    return found


def _check_calibration(order: Order, rig: Path) -> list[Check]:
    """Whether what was measured on the rig is there, recent, and of one piece."""
    plan, calibration = order.plan.protocol.collection, order.rig.calibration
    needed = {"contact_plane", "tool_centre_point", "event_crop"}
    if "frames" in plan.recording.streams:
        needed.add("lens")
    if plan.maintenance.rezero is None:
        needed.add("depth_zero")
    faults = find_faults(
        calibration,
        simulated=order.rig.simulated,
        needed=needed,
        scale_px_per_mm=order.rig.frame_camera.scale_px_per_mm,
        today=date.today(),
    )
    source = read_rig(rig_path(rig))
    found = [
        Check(
            "calibration",
            False,
            InputError(
                source.blame(f.key),
                f.key,
                f.value,
                f"{f.expected}: run `{f.command} --rig {rig}`",
            ).message,
        )
        for f in faults
    ]
    if not found:
        entries = [name for name in COMMANDS if getattr(calibration, name) is not None]
        days = ", ".join(f"{name} {measured_on(calibration, name)}" for name in entries)
        age = " (simulated: of any age)" if order.rig.simulated else ""
        found.append(Check("calibration", True, f"{days}{age}"))
    return found


def _outside_camera(order: Order) -> str:
    """What the labels will be read from."""
    size = order.rig.frame_px(order.plan)
    if size is None:
        return "not recorded: these trials cannot be labelled"
    simulated = "simulated " if order.rig.simulated else ""
    if order.rig.frame_source == "tracks":
        return f"{simulated}tracks of the markers, no video"
    return f"{simulated}video, {size[0]} x {size[1]} px"


def _check_devices(order: Order) -> list[Check]:
    from analysis.clocks import fit_clock
    from rigs.build import build_rig
    from storage.hdf5 import StreamReader
    from storage.writer import DATA, TrialWriter

    found: list[Check] = []

    def attempt(name: str, action: Callable[[], str]) -> bool:
        try:
            found.append(Check(name, True, action()))
        except Exception as error:
            found.append(Check(name, False, str(error) or type(error).__name__))
        return found[-1].passed

    rig = build_rig(order.rig)

    def arm() -> str:
        rig.connect()
        state = rig.arm.state()
        if not state.healthy:
            raise RuntimeError(f"is in {state.value}")
        return state.value

    def clocks() -> str:
        rate = order.plan.protocol.collection.recording.sync_rate
        with TemporaryDirectory() as folder:
            aside = Path(folder) / "check"
            writer = TrialWriter(aside, aside.with_name("none"), None, rate)
            rig.listen(3.0, writer, rate)
            with StreamReader(writer.seal() / DATA) as reader:
                reference = reader.pulses("sync_pulses")
                fits = {
                    name: fit_clock(reader.pulses(f"{group}_pulses"), reference)
                    for name, group in (("event camera", "event"), ("arm", "arm"))
                }
        return ", ".join(
            f"{name} {fit.drift_ppm:+.1f} ppm, 95 % within {fit.uncertainty_ns / 1000:.1f} us"
            for name, fit in fits.items()
        )

    try:
        if attempt("arm", arm):
            attempt("clocks", clocks)
    finally:
        rig.close()
    return found


def as_json(found: list[Check]) -> dict[str, Any]:
    """The checks as one JSON object."""
    return {
        "passed": all(item.passed for item in found),
        "checks": [vars(item) for item in found],
    }
