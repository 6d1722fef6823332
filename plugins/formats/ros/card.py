"""Text on MCAP files in the data card of a publication."""

from __future__ import annotations

from sliplab.plugins.formats.ros import messages as ros2
from sliplab.plugins.formats.ros.mcap_writer import COLUMNS_TOPIC

_TOPICS = (
    (
        "/events",
        ros2.EVENTS,
        "packets of at most 10 ms; encoding `mono`: 64 bits an event, "
        "bits 0 to 31 ns after `time_base` on the camera's clock, 32 to 47 column, 48 to 62 row, "
        "63 brighter",
    ),
    ("/frames", ros2.IMAGE, "grey levels, `mono8`, stamped with the middle of the exposure"),
    ("/arm/pose", ros2.POSE, "tool centre point in the arm's base frame, m and quaternion"),
    (
        "/event_pulses, /arm_pulses, /sync_pulses",
        ros2.PULSE,
        "sync pulses that a device saw or sent",
    ),
    ("/phases", ros2.PHASE, "phases of the motion"),
    ("/onsets", ros2.ONSET, "onsets of the label, by each rule"),
    (
        "/NAME, /NAME/COLUMN",
        f"{ros2.WRENCH}, {ros2.SCALAR}, {ros2.EVENTS} or {ros2.IMAGE}",
        "further sensors and cameras: N and N m along the sensor's axes, readings in their unit",
    ),
    (COLUMNS_TOPIC, ros2.COLUMN, "all columns but events as the devices gave them, see below"),
)
CARD = "\n".join(
    [
        "## Topics",
        "",
        "Log times are on the trial's time line, plus `log_time_minus_time_line_ns` of the file's "
        "metadata `sliplab` (0, unless the time line begins below 0); stamps are on the time line. "
        "Attachments: record, provenance, label with its arrays, campaign, protocol, rig.",
        "",
        "| topic | message | contents |",
        "| --- | --- | --- |",
        *(f"| {topic} | {message} | {contents} |" for topic, message, contents in _TOPICS),
    ]
)
"""Topics of a file, as Markdown."""
