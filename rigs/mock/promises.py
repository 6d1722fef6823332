"""Does a simulated rig keep what its rig file promises about clocks and delays?

The analysis takes `timing` at its word: a simulation beyond it would be refused there, or believed
where it is wrong.
"""

from __future__ import annotations

from sliplab.protocols.timing import Delay, Timing
from sliplab.protocols.yaml_file import KeyedError
from sliplab.rigs.mock.settings import MockSettings


def check_promises(mock: MockSettings, timing: Timing) -> None:
    """Hold a simulated rig's clocks and delays against `timing`.

    Raises:
        KeyedError: the first setting that is beyond it.
    """
    for device, drift, jitters in (
        ("sync_box", "sync_box_ppm", _jitters("exposure", timing.frames == "exposure line")),
        ("event_camera", "event_camera_ppm", _jitters("pulse", True)),
        ("frame_camera", "frame_camera_ppm", _jitters("frame", timing.frames != "host arrival")),
        ("arm_controller", "arm_ppm", _jitters("pulse", timing.arm == "digital input")),
    ):
        promised = getattr(timing, device)
        for name, key in ((drift, "drift_ppm"), *((jitter, "jitter_us") for jitter in jitters)):
            value, limit = getattr(mock.clocks, name), getattr(promised, key)
            if value > limit:
                raise KeyedError(
                    f"mock.clocks.{name}",
                    value,
                    f"must be at most timing.{device}.{key} = {limit:g}",
                )
    if timing.frames == "host arrival":
        camera = mock.frame_camera
        _check_delay(
            "frame_camera", camera.latency_us, camera.arrival_jitter_us,
            "frame_delay", timing.frame_delay,
        )  # fmt: skip
    if timing.arm == "host time":
        _check_delay(
            "arm", mock.arm.latency_us, mock.arm.arrival_jitter_us,
            "pose_delay", timing.pose_delay,
        )  # fmt: skip


def _jitters(stream: str, used: bool) -> tuple[str, ...]:
    """The settings of jitter that show in this rig's stamps."""
    return (f"{stream}_jitter_us",) if used else ()


def _check_delay(
    device: str, latency_us: float, jitter_us: float, name: str, promised: Delay
) -> None:
    if latency_us < promised.shortest_us:
        raise KeyedError(
            f"mock.{device}.latency_us",
            latency_us,
            f"must be at least timing.{name}.shortest_us = {promised.shortest_us:g}",
        )
    if latency_us + jitter_us > promised.longest_us:
        raise KeyedError(
            f"mock.{device}.arrival_jitter_us",
            jitter_us,
            f"must be at most {promised.longest_us - latency_us:g}: with latency_us, "
            f"timing.{name}.longest_us = {promised.longest_us:g}",
        )
