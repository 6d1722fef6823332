"""Sections of an adapter: trials, fields, factors, streams, labels and motion."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from sliplab.protocols.file_pattern import parse_pattern, template_fields
from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.shown import did_you_mean
from sliplab.protocols.units import all_symbols, find_unit
from sliplab.protocols.yaml_file import StrictModel, rule

BUILT_IN = ("stem", "folder", "path", "id")
"""Fields of every trial: name of its file without the ending, name of the file's folder, path below
the imported folder without the ending, and the trial's id."""
TIME_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
"""Nanoseconds of each unit."""
TimeUnit = Literal["ns", "us", "ms", "s"]


def _pattern(text: str) -> str:
    parse_pattern(text)
    return text


def _template(text: str) -> str:
    template_fields(text)
    return text


def _field_name(text: str) -> str:
    if text in BUILT_IN:
        raise ValueError(f"is a field that every trial has; choose a name other than {BUILT_IN}")
    return text


Pattern = Annotated[str, Field(max_length=500), AfterValidator(_pattern)]
Template = Annotated[str, Field(min_length=1, max_length=500), AfterValidator(_template)]
FieldName = Annotated[
    str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,31}$"), AfterValidator(_field_name)
]
StreamName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
Column = Annotated[str, Field(min_length=1, max_length=200)] | Annotated[int, Field(ge=0, le=9999)]
"""A column of a table or array: its name, or its index from 0."""
Milliseconds = Annotated[float, Field(ge=0, le=1e9)]
Side = Annotated[int, Field(ge=1, le=16384)]
Size = tuple[Side, Side]


class TrialFiles(StrictModel):
    """Trials of the data set: a file each, or a row each."""

    files: Pattern | tuple[Pattern, ...] = ()
    """Pattern of the files that are a trial each, below the folder that is imported. ``{name}``
    catches a field, ``{name:number}`` a number, ``{name:one|two}`` one of these words; ``*`` is any
    piece of a name, ``**`` any folders. Beside `table`: the file of a row, found by its columns."""
    table: Pattern | None = None
    """Table with a row for each trial, whose columns are fields: CSV, JSON or JSON lines."""
    id: Template | None = None
    """Id of a trial; by default its path without the ending, or column `id` of the table."""

    @property
    def patterns(self) -> tuple[str, ...]:
        """The patterns of `files`."""
        return (self.files,) if isinstance(self.files, str) else self.files

    @rule
    def _some(self) -> TrialFiles:
        if not self.patterns and self.table is None:
            raise KeyedError(".files", None, "is missing; give it, or 'table'")
        if self.table is not None and "{" in self.table:
            raise KeyedError(".table", self.table, "must have no fields: it says what they are")
        return self


class FieldRule(StrictModel):
    """A field that is made from others, or whose values are renamed."""

    source: Template | None = Field(default=None, alias="from")
    """Text that it is made from, such as ``"{folder}"``; by default its own value."""
    pattern: Pattern | None = None
    """What to take of that text: a pattern that catches the field of this name."""
    values: dict[str, str] = Field(default_factory=dict)
    """New values by old ones; others stay as they are."""


class AdapterFactor(StrictModel):
    """A factor whose levels are values of a field."""

    field: str
    """The field."""
    unit: str | None = None
    """Unit of its numbers; without one, levels are words."""
    levels: dict[str, str] = Field(default_factory=dict)
    """Levels by value of the field, such as ``{"0": left}``; others stay as they are."""

    @rule
    def _known_unit(self) -> AdapterFactor:
        if self.unit is not None and find_unit(self.unit) is None:
            known = ", ".join(all_symbols())
            raise KeyedError(".unit", self.unit, f"is no known unit; must be one of {known}")
        return self


class StreamClock(StrictModel):
    """Relation of a stream's times to the events' clock; without one it is marked unknown."""

    offset_ms: Annotated[float, Field(ge=-1e12, le=1e12)] = 0.0
    """Time on the events' clock at time 0 of the stream."""
    drift_ppm: Annotated[float, Field(ge=-1e4, le=1e4)] = 0.0
    """By how much the events' clock gains on the stream's."""
    uncertainty_ms: Milliseconds | None = None
    """Bound of the error; unknown by default."""


Axis = Literal["taxel", "polarity", "step", "x", "y"]
OWN_FORMATS = ("counts", "csv", "numpy")
"""Formats of events that an adapter describes; others are those of `import`."""
_COUNTS = ("axes", "step_ms", "polarity_order")
_TABLES = ("columns", "unit", "positive")


class EventColumns(StrictModel):
    """Columns of events."""

    t: Column
    """Times."""
    x: Column
    """Columns of the pixels, or taxels."""
    y: Column | None = None
    """Rows of the pixels; of taxels there are none."""
    p: Column | None = None
    """Polarities; without them all events are positive."""


class EventFiles(StrictModel):
    """Files of the events: a format that `import` knows, a table, or an array of counts."""

    files: Pattern | None = None
    """Pattern of the file of a trial, found by the fields in it; by default the trial's file."""
    format: Annotated[str, Field(min_length=1, max_length=100)]
    """``counts`` is an array of whole counts per time step, ``csv`` and ``numpy`` have an event a
    row; others are the names of formats that `import` knows, those of plug-ins among them."""
    axes: tuple[Axis, ...] = ()
    """Of counts: meaning of the array's axes in their order, such as ``[taxel, polarity, step]``
    or ``[step, polarity, y, x]``."""
    step_ms: Annotated[float, Field(gt=0, le=1e7)] | None = None
    """Of counts: length of a time step."""
    polarity_order: tuple[Literal["positive", "negative"], ...] = ("negative", "positive")
    """Of counts: meaning of the indices of the axis `polarity`."""
    columns: EventColumns | None = None
    """Of csv and numpy: the columns."""
    unit: TimeUnit | None = None
    """Of csv and numpy: unit of the times."""
    positive: tuple[int, ...] = ()
    """Of csv and numpy: polarities that are positive; by default all above 0."""
    size_px: Size | None = None
    """Columns and rows of the sensor; of N taxels ``[N, 1]``. Needed where the file does not say
    it: csv and numpy."""

    @rule
    def _of_one_format(self) -> EventFiles:
        tables, counts = self.format in {"csv", "numpy"}, self.format == "counts"
        for keys, right, of in (
            (_COUNTS, counts, "counts"),
            (_TABLES, tables, "csv and numpy"),
            (("size_px",), tables or counts, "counts, csv and numpy"),
        ):
            for key in keys:
                if key in self.model_fields_set and not right:
                    if near := did_you_mean(self.format, ("csv", "numpy", "counts")):
                        text = f"is not of format {of}, and has {key}{near}"
                        raise KeyedError(".format", self.format, text)
                    raise KeyedError(f".{key}", getattr(self, key), f"is for format: {of}")
        needed = (("axes", "step_ms") if counts else ("columns", "unit", "size_px")) * (
            tables or counts
        )
        for key in needed:
            if not getattr(self, key):
                raise KeyedError(
                    f".{key}", None, f"is missing; events of format {self.format} need it"
                )
        if counts:
            self._check_counts()
        return self

    def _check_counts(self) -> None:
        axes = list(self.axes)
        places = {"taxel"} & set(axes) or {"x", "y"} & set(axes)
        wanted = {"step"} | places | ({"polarity"} & set(axes))
        if (
            len(set(axes)) != len(axes)
            or set(axes) != wanted
            or places not in ({"taxel"}, {"x", "y"})
        ):
            raise KeyedError(
                ".axes", axes, "must name each axis once: step, taxel (or y and x), and polarity"
            )
        order = self.polarity_order
        if sorted(order) not in (["negative", "positive"], ["negative"], ["positive"]):
            raise KeyedError(".polarity_order", list(order), "must name each polarity once")
        step_us = (self.step_ms or 0.0) * 1000
        if abs(step_us - round(step_us)) > 1e-6 or step_us < 1:
            raise KeyedError(".step_ms", self.step_ms, "must be whole microseconds")


class FrameTimes(StrictModel):
    """Times of the frames in a table or array."""

    files: Pattern
    """Pattern of the file, found by the fields in it."""
    column: Column = 0
    """The times."""
    unit: TimeUnit


class FrameFiles(StrictModel):
    """Frames of the outside camera: a video, images in order, or an array."""

    files: Pattern
    """Pattern of the video or array of a trial, or of its images, found by the fields in it;
    images are taken in natural order of their names."""
    format: Literal["video", "images", "numpy"]
    """``numpy``: grey levels of shape (frames, height, width)."""
    times: FrameTimes | None = None
    """Middles of the exposures."""
    rate_hz: Annotated[float, Field(gt=0, le=1e5)] | None = None
    """Frames a second from time 0 on, where there are no times."""
    clock: StreamClock | None = None

    @rule
    def _timed(self) -> FrameFiles:
        if (self.times is None) == (self.rate_hz is None):
            raise KeyedError(".rate_hz", self.rate_hz, "give either times or rate_hz")
        return self


class PoseColumns(StrictModel):
    """Columns of poses of the tool's centre."""

    t: Column
    x: Column
    y: Column
    z: Column
    rx: Column | None = None
    """Rotation vector, with ry and rz; without it there is no rotation."""
    ry: Column | None = None
    rz: Column | None = None


class WrenchColumns(StrictModel):
    """Columns of forces and torques in the sensor's axes."""

    t: Column
    fx: Column
    fy: Column
    fz: Column
    tx: Column | None = None
    """Torque, with ty and tz; without it there is none."""
    ty: Column | None = None
    tz: Column | None = None


class ScalarColumns(StrictModel):
    """Columns of readings of one quantity."""

    t: Column
    value: Column


class _Table(StrictModel):
    files: Pattern
    """Pattern of the file of a trial, found by the fields in it."""
    format: Literal["csv", "numpy"]
    unit: TimeUnit
    """Of the times."""
    clock: StreamClock | None = None


class PoseFiles(_Table):
    """Poses of an arm."""

    columns: PoseColumns
    length: Literal["mm", "m"] = "mm"
    """Unit of the places."""
    angle: Literal["deg", "rad"] = "rad"
    """Unit of the rotation vectors."""


class WrenchFiles(_Table):
    """Forces of a sensor in newtons, torques in newton metres."""

    columns: WrenchColumns


class ScalarFiles(_Table):
    """Readings of one quantity, such as a temperature."""

    columns: ScalarColumns
    quantity_unit: Annotated[str, Field(max_length=32)] = ""
    """Unit of the readings."""


class AdaptedStreams(StrictModel):
    """Streams of every trial."""

    events: EventFiles | None = None
    frames: FrameFiles | None = None
    poses: PoseFiles | None = None
    wrenches: dict[StreamName, WrenchFiles] = Field(default_factory=dict)
    """Force sensors by name, such as ``force``."""
    scalars: dict[StreamName, ScalarFiles] = Field(default_factory=dict)
    """Further sensors by name, such as ``temperature``."""

    @rule
    def _some(self) -> AdaptedStreams:
        if not any((self.events, self.frames, self.poses, self.wrenches, self.scalars)):
            raise KeyedError(
                ".events",
                None,
                "is missing; a trial needs a stream: events, frames, poses, wrenches or scalars",
            )
        if self.events is None and self.frames is not None and self.frames.clock is not None:
            raise KeyedError(
                ".frames.clock",
                None,
                "is for streams other than events; without them its own counts",
            )
        if both := set(self.wrenches) & set(self.scalars):
            raise KeyedError(f".scalars.{min(both)}", None, "is the name of a wrench, too")
        return self


LabelClock = Literal["events", "frames", "start"]
"""``events``: the events' own clock; ``frames``: the frames'; ``start``: from the recording's
beginning."""


class _LabelTable(StrictModel):
    file: Pattern | None = None
    """Pattern of the table: CSV, JSON or JSON lines. With fields in it each trial has a table of
    its own; without the key the columns are fields of the trial."""
    match: dict[str, Template] = Field(default_factory=dict)
    """Columns that name the trial, each with what stands there, such as ``{trial: "{id}"}``. Needed
    where one table is of all trials."""
    unit: TimeUnit
    """Unit of the times."""
    clock: LabelClock = "events"
    """Clock of the times: ``events``, ``frames``, or ``start`` from the beginning of the
    recording."""
    uncertainty_ms: Milliseconds | None = None
    """Bound of the times' error; unknown by default."""

    @rule
    def _matched(self) -> _LabelTable:
        if self.file is not None and "{" not in self.file and not self.match:
            raise KeyedError(
                ".match", None, 'is missing: which column names the trial, such as {trial: "{id}"}'
            )
        if self.file is None and self.match:
            raise KeyedError(".match", self.match, "needs the key 'file'")
        return self


class GivenOnsets(_LabelTable):
    """Onsets of slip."""

    incipient: str
    """Column of the first slip."""
    gross: str | None = None
    """Column of gross slip."""


class GivenSpans(_LabelTable):
    """Intervals, each of one class: a row each."""

    start: str
    """Column of the begin."""
    end: str
    """Column of the end."""
    name: str = Field(alias="class")
    """Column of the class."""
    names: dict[str, str] = Field(default_factory=dict)
    """New names by those in the table; an empty one leaves the interval out. In an experiment of
    slip they become ``no_slip``, ``incipient`` and ``gross``."""


class AdapterLabels(StrictModel):
    """Labels that came with the data, in one of these ways."""

    whole: Template | None = Field(default=None, alias="class")
    """Class of the whole recording, such as ``"{object}"``."""
    onsets: GivenOnsets | None = None
    spans: GivenSpans | None = None

    @rule
    def _one(self) -> AdapterLabels:
        ways = {"class": self.whole, "onsets": self.onsets, "spans": self.spans}
        given = [key for key, value in ways.items() if value is not None]
        if len(given) > 1:
            raise KeyedError(f".{given[1]}", None, f"is given with '{given[0]}'; give one of them")
        return self


TimeText = Annotated[Template, WithJsonSchema({"type": ["string", "number"], "minLength": 1})]


Place = Annotated[float, Field(ge=-1e6, le=1e6)]


class Markers(StrictModel):
    """Layout of the skin's markers, without which our own rules find no onsets in frames."""

    places_mm: tuple[tuple[Place, Place], ...] = Field(min_length=1, max_length=4096)
    """Places of the markers at rest, to the right and up in the picture, from its middle."""
    centre: Annotated[int, Field(ge=0)] = 0
    """Index of the marker in the centre of contact, whose slip is gross slip."""
    px_per_mm: Annotated[float, Field(gt=0, le=1e6)]
    """Scale of the frames."""

    @rule
    def _one_of_them(self) -> Markers:
        if self.centre >= len(self.places_mm):
            raise KeyedError(
                ".centre",
                self.centre,
                f"must be below the number of markers, {len(self.places_mm)}",
            )
        return self


class GivenMotion(StrictModel):
    """Begin and end of the slide, which become the record's steps ``hold`` and ``slide``."""

    start: TimeText
    """A number, or a field such as ``"{slide_start}"``."""
    end: TimeText
    unit: TimeUnit
    clock: LabelClock = "events"

    @model_validator(mode="before")
    @classmethod
    def _numbers(cls, data: Any) -> Any:
        """Numbers as the text that they are in the file."""
        if not isinstance(data, dict):
            return data
        plain = {
            key: str(value)
            for key, value in data.items()
            if key in {"start", "end"}
            and not isinstance(value, (str, bool, list, dict, type(None)))
        }
        return {**data, **plain}
