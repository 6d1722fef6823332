"""A trial as one MCAP file of ROS 2 messages, on the trial's time line.

Data for viewers (events, frames, poses, forces, pulses, phases, onsets) have separate messages,
with the time line as log time and stamp. Events keep their camera's clock inside of their packets.
All other columns go along as the devices gave them, and record, label and campaign as attachments,
so that `mcap.read_mcap` makes the same trial of the file again.
"""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sliplab.plugins.formats.ros import messages as ros2
from sliplab.storage.files import inside, json_text
from sliplab.storage.schema.label import KINDS, LABELS, RULES, RuleOnsets, TrialLabel
from sliplab.storage.streams import (
    CLOCK,
    EVENTS_KIND,
    FRAMES_KIND,
    I64,
    EventChunk,
    Json,
)
from sliplab.storage.trials.checksums import DATA, PROVENANCE, RECORD, stream_file
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.hdf5_reader import StreamReader
from sliplab.storage.trials.hdf5_writer import (
    COLUMNS,
    STREAM_GROUP,
    STREAMS,
    TIMING,
    TRACKS,
)
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import INFO, PROTOCOL, RIG, Campaign, TrialStore
from sliplab.storage.trials.video import frame_rate

if TYPE_CHECKING:
    from mcap.writer import Writer

METADATA, FORMAT = "sliplab", "1"
"""Name of the metadata of a file of ours, and version of what is in it."""
LIBRARY = "sliplab"
"""Name of the program in the header of a file of ours."""
COLUMNS_TOPIC = "/columns"
LABEL_JSON, LABEL_ARRAYS, SYNC_JSON = "label.json", "label.npz", "sync.json"
ARM, BASE = "arm", "arm_base"
_PACKET_US = 10_000
_PACKET_EVENTS = 1 << 16
_ROWS = 1 << 14
_PULSES = {"event_pulses": EVENTS_KIND, "arm_pulses": ARM, "sync_pulses": "sync_box"}

Message = tuple[int, int, bytes]
"""Log time, channel, bytes."""


def write_mcap(
    path: Path,
    store: TrialStore,
    campaign: Campaign,
    recording: Recording,
    personal: Iterable[str] = (),
) -> dict[str, int]:
    """Write one trial to the new file `path`; the caller makes it visible.

    Args:
        personal: keys of its provenance that are left out.

    Returns:
        ``events``, ``frames`` and ``messages`` written.

    Raises:
        FormatError: the trial does not fit the format.
        StoreError: it is damaged.
        ModuleNotFoundError: the extra `publish` is missing.
    """
    from mcap.writer import Writer

    with path.open("xb") as handle:
        writer = Writer(handle)
        writer.start(profile="ros2", library=LIBRARY)
        trial = _Trial(writer, store, campaign, recording)
        counts = trial.write()
        trial.attach(personal)
        writer.finish()
    return counts


@dataclass
class _Trial:
    writer: Writer
    store: TrialStore
    campaign: Campaign
    recording: Recording

    def __post_init__(self) -> None:
        self.schemas: dict[str, int] = {}
        self.sequences: dict[int, int] = {}
        self.shift_ns = 0
        """Offset of log times, which cannot be negative, from the time line."""
        self.label = self._label()
        self.counts = {"events": 0, "frames": 0, "messages": 0}

    def _label(self) -> TrialLabel | None:
        stored = Derived.of(self.store, LABELS, self.campaign.name)
        try:
            return stored.load(self.recording.folder.name, TrialLabel)
        except FileNotFoundError:
            return None

    def attach(self, personal: Iterable[str]) -> None:
        """Write the documents of the trial and its campaign, and the facts about the file."""
        recording, trial = self.recording, self.recording.folder.name
        made = self.campaign.provenance(recording).to_json()
        documents = {
            RECORD: recording.files()[RECORD].read_bytes(),
            PROVENANCE: _text({key: made[key] for key in made if key not in set(personal)}),
            **{
                name: (self.campaign.folder / name).read_bytes()
                for name in (INFO, PROTOCOL, RIG)
                if (self.campaign.folder / name).is_file()
            },
        }
        labels = Derived.of(self.store, LABELS, self.campaign.name)
        derived = {
            LABEL_JSON: labels.folder / f"{trial}.json",
            LABEL_ARRAYS: labels.arrays_path(trial),
        }
        if recording.refitted:
            derived[SYNC_JSON] = self.campaign.sync_file(trial)
        for name, path in derived.items():
            if path.is_file():
                documents[name] = inside(path, self.store.folder).read_bytes()
        about = {"format": FORMAT, "trial": trial, "campaign": self.campaign.name}
        about["simulated"] = "true" if recording.simulated else "false"
        about["log_time_minus_time_line_ns"] = str(self.shift_ns)
        for name in recording.streams(FRAMES_KIND):
            if (video := recording.video(name)) is not None:
                about["frame_rate_hz"] = str(frame_rate(video))
        for name, data in documents.items():
            kind = "application/json" if name.endswith(".json") else "application/octet-stream"
            self.writer.add_attachment(0, self.shift_ns, name, kind, data)
            about[f"sha256 {name}"] = hashlib.sha256(data).hexdigest()
        self.writer.add_metadata(METADATA, about)

    def write(self) -> dict[str, int]:
        """Write all messages in order of their log times; return counts."""
        merged = heapq.merge(*self._topics(), key=lambda message: message[0])
        head = next(merged, None)
        start = 0 if head is None else head[0]
        self.shift_ns = max(0, -start)
        for channel, data in self._columns(start):
            self._add(start, channel, data)
        for message in () if head is None else (head,):
            self._add(*message)
        for message in merged:
            self._add(*message)
        self.counts["messages"] = sum(self.sequences.values())
        return self.counts

    def _add(self, t_ns: int, channel: int, data: bytes) -> None:
        number = self.sequences.get(channel, 0)
        self.sequences[channel] = number + 1
        # a label or a phase may be earlier than all that was recorded
        log_ns = max(t_ns + self.shift_ns, 0)
        self.writer.add_message(channel, log_ns, data, log_ns, number)

    def _topics(self) -> Iterator[Iterator[Message]]:
        recording = self.recording
        for name in recording.streams(EVENTS_KIND):
            yield self._events(name)
        for name in recording.streams(FRAMES_KIND):
            if recording.video(name) is not None:
                yield self._frames(name)
        yield self._poses()
        for name in recording.streams("wrench"):
            yield self._wrenches(name)
        for name in recording.streams("scalar"):
            yield self._scalars(name)
        for name, kind in recording.record.streams.items():
            if not kind.of_camera and kind.kind not in {*STREAMS, CLOCK.name} and kind.rows:
                yield self._table(name)
        for group, device in _PULSES.items():
            yield self._pulses(group, device)
        yield self._phases()
        yield self._onsets()

    def _channel(self, topic: str, message: str, **metadata: str) -> int:
        if message not in self.schemas:
            self.schemas[message] = self.writer.register_schema(
                message, "ros2msg", ros2.definition(message)
            )
        return self.writer.register_channel(topic, "cdr", self.schemas[message], metadata)

    def _line(self, device: str, t_ns: I64) -> I64:
        """Return times of a device on the time line; zeros where it has no clock."""
        known = self.recording.clocks.devices().get(device)
        if known is None:
            return np.zeros(len(t_ns), np.int64)
        return np.asarray(known.map.to_reference(np.asarray(t_ns, np.int64)), np.int64)

    def _columns(self, t_ns: int) -> Iterator[tuple[int, bytes]]:
        """Yield every column but those of events, as it is, with its channel."""
        channel = self._channel(COLUMNS_TOPIC, ros2.COLUMN)
        for stream in (None, *self.recording.record.streams):
            if stream is not None and not self.recording.record.streams[stream].of_camera:
                continue
            file = DATA if stream is None else stream_file(stream)
            with self.recording.open(stream) as reader:
                for name, unit in _column_units(reader).items():
                    values = reader.column(name)
                    for low in range(0, len(values), _ROWS):
                        rows = ros2.RowsMessage(file, name, unit, values[low : low + _ROWS])
                        yield channel, rows.message(t_ns)

    def _events(self, name: str) -> Iterator[Message]:
        size = self._size(name)
        channel = self._channel(
            f"/{name}",
            ros2.EVENTS,
            clock="event packets: the camera's; stamp: the time line",
            camera=name,
            width=str(size[0]),
            height=str(size[1]),
        )
        for seq, chunk in enumerate(_packets(self.recording, name)):
            (t_ns,) = self._line(name, chunk.t_us[:1] * 1000).tolist()
            yield t_ns, channel, ros2.event_packet(t_ns, name, size, seq, chunk)
            self.counts["events"] += len(chunk)

    def _size(self, name: str) -> tuple[int, int]:
        """Return columns and rows of an event camera, 0 where they are unknown."""
        record = self.recording.record
        size = record.geometry.event_px if name == EVENTS_KIND else record.streams[name].size_px
        return size or (0, 0)

    def _frames(self, name: str) -> Iterator[Message]:
        channel = self._channel(f"/{name}", ros2.IMAGE, camera=name)
        times = self._frame_line(name)
        for t_ns, levels in zip(times, self.recording.frames(stream=name), strict=True):
            yield t_ns, channel, ros2.image(t_ns, name, levels)
            self.counts["frames"] += 1

    def _frame_line(self, name: str) -> list[int]:
        with self.recording.open(name) as reader:
            found: list[int] = self._line(name, reader.column("frames/t")).tolist()
        return found

    def _poses(self) -> Iterator[Message]:
        from scipy.spatial.transform import Rotation

        with self.recording.open() as reader:
            poses = reader.poses()
        if not len(poses):
            return
        channel = self._channel("/arm/pose", ros2.POSE)
        turned = Rotation.from_rotvec(poses.rotvec_deg, degrees=True).as_quat().tolist()
        times = self._line(ARM, poses.t_ns).tolist()
        for t_ns, xyz, quaternion in zip(times, poses.xyz_mm.tolist(), turned, strict=True):
            yield t_ns, channel, ros2.pose(t_ns, BASE, xyz, quaternion)

    def _wrenches(self, name: str) -> Iterator[Message]:
        found = self.recording.wrenches(name)
        channel = self._channel(f"/{name}", ros2.WRENCH)
        times = self._line(name, found.t_ns).tolist()
        rows = zip(times, found.force_n.tolist(), found.torque_nm.tolist(), strict=True)
        for t_ns, force, torque in rows:
            yield t_ns, channel, ros2.wrench(t_ns, name, force, torque)

    def _scalars(self, name: str) -> Iterator[Message]:
        found = self.recording.scalars(name)
        channel = self._channel(f"/{name}", ros2.SCALAR)
        times = self._line(name, found.t_ns).tolist()
        for t_ns, value in zip(times, found.value.tolist(), strict=True):
            yield t_ns, channel, ros2.scalar(t_ns, name, value, found.unit)

    def _table(self, name: str) -> Iterator[Message]:
        with self.recording.open() as reader:
            columns = reader.stream(name)
            units = {part: reader.column_unit(name, part) for part in columns}
        times = self._line(name, columns["t"]).tolist()
        shown = []
        for part, values in columns.items():
            if values.dtype.kind != "f":
                continue
            components = values.reshape(len(times), -1).T.astype(np.float64).tolist()
            for index, component in enumerate(components):
                topic = f"/{name}/{part}" + (f"/{index}" if values.ndim > 1 else "")
                shown.append((self._channel(topic, ros2.SCALAR), component, units[part]))
        for row, t_ns in enumerate(times):
            for channel, component, unit in shown:
                yield t_ns, channel, ros2.scalar(t_ns, name, component[row], unit)

    def _pulses(self, group: str, device: str) -> Iterator[Message]:
        with self.recording.open() as reader:
            seen = reader.pulses(group)
        if not len(seen):
            return
        channel = self._channel(f"/{group}", ros2.PULSE)
        line = seen if group == "sync_pulses" else self._line(device, seen)
        for t_ns, device_ns in zip(line.tolist(), seen.tolist(), strict=True):
            yield t_ns, channel, ros2.pulse(t_ns, device, device_ns)

    def _phases(self) -> Iterator[Message]:
        steps = self.recording.record.steps
        clock = self.recording.clocks.arm
        if not steps or clock is None:
            return
        channel = self._channel("/phases", ros2.PHASE)
        for step in sorted(steps, key=lambda step: step.start_ns):
            start, end = (clock.map.to_reference(t) for t in (step.start_ns, step.end_ns))
            yield start, channel, ros2.phase(start, step.phase, end, recorded=step.recorded)

    def _onsets(self) -> Iterator[Message]:
        if self.label is None:
            return
        channel = self._channel("/onsets", ros2.ONSET)
        rules: dict[str, RuleOnsets] = {"own": self.label}
        for rule in RULES:
            found: RuleOnsets | None = getattr(self.label, rule)
            if found is not None:
                rules[rule] = found
        known = [
            (t_ns, kind, by, each.doubts.of(kind))
            for by, each in rules.items()
            for kind in KINDS
            if (t_ns := each.at_ns(kind)) is not None
        ]
        for t_ns, kind, by, doubt in sorted(known, key=lambda item: item[0]):
            yield t_ns, channel, ros2.onset(t_ns, kind, by, doubt)


def _packets(recording: Recording, name: str) -> Iterator[EventChunk]:
    """Yield events in packets of at most 10 ms and 65,536 events."""
    first = None
    with recording.open(name) as reader:
        for chunk in reader.event_chunks():
            first = int(chunk.t_us[0]) if first is None else first
            edges = np.flatnonzero(np.diff((chunk.t_us - first) // _PACKET_US)) + 1
            whole = np.union1d(edges, np.arange(0, len(chunk), _PACKET_EVENTS)).tolist()
            for low, high in zip(whole, [*whole[1:], len(chunk)], strict=True):
                yield chunk[low:high]


def _column_units(reader: StreamReader) -> dict[str, str]:
    """Return the units of all columns that have rows, but those of events, by name."""
    known = {**COLUMNS, **TRACKS, **TIMING}
    counts = reader.counts()
    found = {
        name: column.unit
        for name, column in known.items()
        if counts[name] and not name.startswith("events/")
    }
    for name in reader.streams():
        for part in reader.parts(name):
            found[f"{STREAM_GROUP}/{name}/{part}"] = reader.column_unit(name, part)
    return found


def _text(data: Json) -> bytes:
    return json_text(data).encode()
