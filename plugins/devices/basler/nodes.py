"""Reading and writing a GenICam camera's settings by name, where they exist.

Names differ between families (`ExposureTime`, `ExposureTimeAbs`); SFNC 2 names come first.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.streams import ClockReads, Json

DEVICE = "frame camera"
_POLL_S = 0.01
# command, value and clock frequency, by family; None: nanoseconds
_LATCHES = (
    ("TimestampLatch", "TimestampLatchValue", None),
    ("GevTimestampControlLatch", "GevTimestampValue", "GevTimestampTickFrequency"),
)


class Nodes:
    """The node map of an open camera.

    Args:
        node_map: result of `GetNodeMap` of pypylon's device.
    """

    def __init__(self, node_map: Any) -> None:
        from pypylon import genicam

        self._map, self._genicam = node_map, genicam

    def has(self, name: str) -> bool:
        """Return whether a setting exists and is writable now."""
        node = self._map.GetNode(name)
        return node is not None and node.GetAccessMode() in (self._genicam.RW, self._genicam.WO)

    def offers(self, name: str, choice: str) -> bool:
        """Return whether a setting is writable and `choice` is one of its values."""
        return self.has(name) and choice in self._map.GetNode(name).Symbolics

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values of a writable enumeration; empty otherwise."""
        return tuple(getattr(self._map.GetNode(name), "Symbolics", ())) if self.has(name) else ()

    def select(self, name: str, *choices: str) -> None:
        """Set a selector to the first of `choices` that it offers, if any."""
        for choice in choices:
            if self.offers(name, choice):
                self.put(choice, name)
                return

    def each(self, selector: str) -> Iterator[str]:
        """Iterate over a selector's values, setting each; once without setting if there is none."""
        for choice in self.choices(selector) or ("",):
            if choice:
                self.put(choice, selector)
            yield choice

    def get(self, name: str) -> Any:
        """Return the value of a setting.

        Raises:
            RigError: it does not exist, or the camera is disconnected.
        """
        try:
            return self._map.GetNode(name).Value
        except (self._genicam.GenericException, AttributeError) as error:
            raise RigError(DEVICE, f"{name} cannot be read: {_short(error)}") from None

    def peek(self, *names: str) -> Any:
        """Return the value of the first readable one of `names`; None if none is."""
        for name in names:
            node = self._map.GetNode(name)
            if node is None:
                continue
            if node.GetAccessMode() in (self._genicam.RW, self._genicam.RO):
                with suppress(self._genicam.GenericException):
                    return node.Value
        return None

    def limit(self, name: str, which: str) -> int:
        """Return `Min`, `Max` or `Inc` of an integer setting."""
        try:
            return int(getattr(self._map.GetNode(name), which))
        except (self._genicam.GenericException, AttributeError) as error:
            raise RigError(DEVICE, f"{name} has no {which}: {_short(error)}") from None

    def put(self, value: Any, *names: str) -> None:
        """Set every one of `names` that exists.

        Raises:
            RigError: none exists, or the camera refuses the value.
        """
        found = [name for name in names if self.has(name)]
        if not found:
            raise RigError(DEVICE, f"this camera has no writable {' or '.join(names)}")
        for name in found:
            try:
                self._map.GetNode(name).Value = value
            except self._genicam.GenericException as error:
                raise RigError(DEVICE, f"{name} = {value}: {self._why(name, error)}") from None

    def _why(self, name: str, error: Exception) -> str:
        """Return the reason for a refused value; pylon's text omits an enumeration's choices."""
        choices, text = self.choices(name), _short(error)
        if choices and text.startswith("Feature "):
            return f"this camera has {', '.join(choices)}"
        return text

    def put_near(self, value: float, name: str) -> None:
        """Set a number to `value`, clipped to its range, if it exists. Raises RigError."""
        if not self.has(name):
            return
        node = self._map.GetNode(name)
        self.put(type(value)(min(max(value, node.Min), node.Max)), name)

    def execute(self, name: str, within_s: float = 0.0) -> None:
        """Execute a command, and wait until it is done if a timeout is given.

        Raises:
            RigError: it does not exist, fails or takes longer.
        """
        try:
            node = self._map.GetNode(name)
            node.Execute()
            end = time.monotonic() + within_s
            while within_s and not node.IsDone():
                if time.monotonic() > end:
                    raise RigError(DEVICE, f"{name} is not done within {within_s:g} s")
                threading.Event().wait(_POLL_S)
        except (self._genicam.GenericException, AttributeError) as error:
            raise RigError(DEVICE, f"{name} failed: {_short(error)}") from None


def centre_region(nodes: Nodes, width_px: int, height_px: int) -> None:
    """Read out only a centred region. Raises RigError if the sensor cannot."""
    for size, offset, wanted in (
        ("Width", "OffsetX", width_px),
        ("Height", "OffsetY", height_px),
    ):
        nodes.put(0, offset)
        most, step = nodes.limit(size, "Max"), nodes.limit(size, "Inc")
        least = nodes.limit(size, "Min")
        if not least <= wanted <= most or (wanted - least) % step:
            raise RigError(
                DEVICE,
                f"{size.lower()} of {wanted} px: must lie between {least} and {most} px "
                f"in steps of {step}",
            )
        nodes.put(wanted, size)
        step = nodes.limit(offset, "Inc")
        nodes.put((most - wanted) // 2 // step * step, offset)


def has_latch(nodes: Nodes) -> bool:
    """Return whether the host can read the camera's clock."""
    return any(nodes.has(command) for command, _, _ in _LATCHES)


def latch_clock(nodes: Nodes) -> ClockReads:
    """Latch the camera's clock and read it: one row. Raises RigError if it has none."""
    for command, value, frequency in _LATCHES:
        if not nodes.has(command):
            continue
        per_s = int(nodes.get(frequency)) if frequency else 10**9
        before_ns = time.monotonic_ns()
        nodes.execute(command)
        after_ns = time.monotonic_ns()
        # the clock was latched between the two; reading the value may take longer
        row = (int(nodes.get(value)) * 10**9 // per_s, before_ns, after_ns)
        return ClockReads(*(np.array([each], np.int64) for each in row))
    raise RigError(DEVICE, "this camera has no clock that the host can read")


def _short(error: Exception) -> str:
    """Return GenICam's text without its source location."""
    return str(error).split(" : ")[0].strip() or type(error).__name__


LOAD_S = 10.0
"""Timeout for a camera to load a user set, s."""
_OFF = "Off"
_CHOICES = (
    ("AcquisitionMode", "Continuous"),
    ("SequencerMode", _OFF),
    ("BslAcquisitionBurstMode", "Standard"),
    ("ExposureMode", "Timed"),
    ("BslExposureTimeMode", "Standard"),
    ("ExposureAuto", _OFF),
    ("GainAuto", _OFF),
    ("BalanceWhiteAuto", _OFF),
    ("BslContrastMode", "Linear"),
    ("ImageCompressionMode", _OFF),
    ("TestPattern", _OFF),
)
_SWITCHES = (
    "ReverseX",
    "ReverseY",
    "LUTEnable",
    "BslMultipleROIColumnsEnable",
    "BslMultipleROIRowsEnable",
)
"""Switches that are turned off."""
_SCALES = (
    "BinningHorizontal",
    "BinningVertical",
    "DecimationHorizontal",
    "DecimationVertical",
    "BslScalingFactor",
)
"""Factors that are set to 1: the rig file's scale applies to the sensor's full resolution."""
_NUMBERS = (
    ("BlackLevel", 0.0),
    ("DigitalShift", 0),
    ("Gamma", 1.0),
    ("BslContrast", 0.0),
    ("BslBrightness", 0.0),
    ("BslNoiseReduction", 0.0),
    ("BslSharpnessEnhancement", 0.0),
)
"""Numbers that are set as close as the camera allows."""
_LINE_TIMES = ("BslInputFilterTime", "BslInputHoldOffTime", "LineDebouncerTime")
"""Delays of an input, us, which are set to 0."""
_RATES = ("BslResultingAcquisitionFrameRate", "ResultingFrameRate")
_READ_BACK = (
    *(name for name, _ in _CHOICES),
    *_SWITCHES,
    *_SCALES,
    *(name for name, _ in _NUMBERS),
    "PixelFormat",
    "Gain",
    "ExposureTime",
    "ExposureTimeAbs",
    "AcquisitionFrameRateEnable",
    "AcquisitionFrameRate",
    "AcquisitionFrameRateAbs",
    *_RATES,
    "BinningHorizontalMode",
    "BinningVerticalMode",
    "BslColorSpace",
    "BslLightSourcePreset",
    "BslSaturation",
    "BslHue",
    "ColorTransformationEnable",
    "BslSensorBitDepthMode",
    "BslConversionGainMode",
    "SensorShutterMode",
    "SensorReadoutMode",
    "BslStaticDefectPixelCorrectionMode",
    "DeviceLinkThroughputLimitMode",
    "DeviceLinkThroughputLimit",
)
_OF_TRIGGER = ("TriggerMode", "TriggerSource", "TriggerActivation", "TriggerDelay")
_OF_LINE = ("LineMode", "LineInverter", "LineSource", *_LINE_TIMES)


def write_settings(nodes: Nodes, settings: BaslerSettings) -> None:
    """Load the user set and write all settings. The trigger selector is left at `FrameStart`.

    Raises:
        RigError: the camera lacks a line, a user set or a value.
    """
    _load_user_set(nodes, settings.user_set)
    nodes.put("Mono8", "PixelFormat")
    for name, choice in _CHOICES:
        if nodes.offers(name, choice):
            nodes.put(choice, name)
    for name in _SWITCHES:
        if nodes.has(name):
            nodes.put(False, name)
    for _ in nodes.each("BinningSelector"):
        for name in _SCALES:
            if nodes.has(name):
                nodes.put(1, name)
    nodes.select("BlackLevelSelector", "All")
    for name, value in _NUMBERS:
        nodes.put_near(value, name)
    nodes.select("GainSelector", "All", "AnalogAll")
    if nodes.has("Gain"):
        nodes.put(settings.gain_db, "Gain")
    elif settings.gain_db:
        raise RigError(DEVICE, f"gain_db = {settings.gain_db:g}: this camera has no Gain in dB")
    # the emulation has both names, and only the older one takes effect
    nodes.put(settings.exposure_us, "ExposureTime", "ExposureTimeAbs")
    _write_lines(nodes, settings)
    _write_trigger(nodes, settings)


def _load_user_set(nodes: Nodes, name: str) -> None:
    if not nodes.has("UserSetSelector"):
        return
    if not nodes.offers("UserSetSelector", name):
        raise RigError(
            DEVICE,
            f"user_set = {name}: this camera has {_listed(nodes.choices('UserSetSelector'))}",
        )
    nodes.put(name, "UserSetSelector")
    nodes.execute("UserSetLoad", LOAD_S)


def _write_lines(nodes: Nodes, settings: BaslerSettings) -> None:
    there = nodes.choices("LineSelector")
    inputs = []
    if settings.trigger == "hardware":
        sources = [name for name in nodes.choices("TriggerSource") if name.startswith("Line")]
        if settings.trigger_line not in sources:
            raise RigError(
                DEVICE,
                f"trigger_line = {settings.trigger_line}: this camera is triggered by "
                f"{_listed(sources)}",
            )
        inputs.append(settings.trigger_line)
    if settings.sync_line is not None:
        inputs.append(f"Line{settings.sync_line}")
        if there and inputs[-1] not in there:
            raise RigError(
                DEVICE, f"sync_line = {settings.sync_line}: this camera has {_listed(there)}"
            )
    for line in inputs:
        if line not in there:
            continue
        nodes.put(line, "LineSelector")
        if nodes.offers("LineMode", "Input"):
            nodes.put("Input", "LineMode")
        if nodes.has("LineInverter"):
            nodes.put(False, "LineInverter")
        for name in _LINE_TIMES:
            nodes.put_near(0.0, name)
    if settings.exposure_line is None:
        return
    outputs = [
        line
        for line in nodes.each("LineSelector")
        if nodes.offers("LineMode", "Output") or nodes.peek("LineMode") == "Output"
    ]
    if settings.exposure_line not in outputs:
        raise RigError(
            DEVICE,
            f"exposure_line = {settings.exposure_line}: outputs of this camera are "
            f"{_listed(outputs)}",
        )
    nodes.put(settings.exposure_line, "LineSelector")
    if nodes.offers("LineMode", "Output"):  # some lines cannot be anything else
        nodes.put("Output", "LineMode")
    if nodes.has("LineInverter"):
        nodes.put(False, "LineInverter")
    nodes.put("ExposureActive", "LineSource")


def _write_trigger(nodes: Nodes, settings: BaslerSettings) -> None:
    """Configure the frame-start trigger, and turn every other trigger off."""
    for _ in nodes.each("TriggerSelector"):
        if nodes.offers("TriggerMode", _OFF):
            nodes.put(_OFF, "TriggerMode")
    nodes.select("TriggerSelector", "FrameStart")
    nodes.put_near(0.0, "TriggerDelay")
    if settings.trigger == "free run":
        nodes.put(True, "AcquisitionFrameRateEnable")
        nodes.put(settings.rate_hz, "AcquisitionFrameRate", "AcquisitionFrameRateAbs")
        return
    if nodes.has("AcquisitionFrameRateEnable"):
        nodes.put(False, "AcquisitionFrameRateEnable")
    nodes.put(
        "Software" if settings.trigger == "software" else settings.trigger_line, "TriggerSource"
    )
    if settings.trigger == "hardware":
        nodes.put("RisingEdge", "TriggerActivation")
    nodes.put("On", "TriggerMode")


def check_rate(nodes: Nodes, settings: BaslerSettings) -> None:
    """Check the requested rate against the rate that the camera reports as possible.

    Raises:
        RigError: the camera would miss triggers, or run slower.
    """
    most = nodes.peek(*_RATES)
    # free run asks the camera for a rate, which it rounds
    if settings.trigger == "software" or most is None or most > 0.999 * settings.rate_hz:
        return
    raise RigError(
        DEVICE,
        f"rate_hz = {settings.rate_hz:g}: with exposure_us = {settings.exposure_us:g}, this region "
        f"and this link it reaches at most {most:.1f} frames/s; shorten exposure or region height, "
        "or lower the rate",
    )


def read_back(nodes: Nodes) -> Json:
    """Read back the settings that affect frames or times; `Name[choice]` with a selector.

    The trigger selector is left at `FrameStart`.
    """
    found: Json = {name: nodes.peek(name) for name in ("UserSetSelector", *_READ_BACK)}
    for selector, names in (("TriggerSelector", _OF_TRIGGER), ("LineSelector", _OF_LINE)):
        for choice in nodes.each(selector):
            found |= {f"{name}[{choice}]": nodes.peek(name) for name in names}
    nodes.select("TriggerSelector", "FrameStart")
    return {name: value for name, value in found.items() if value is not None}


def _listed(names: tuple[str, ...] | list[str]) -> str:
    return ", ".join(names) or "none"
