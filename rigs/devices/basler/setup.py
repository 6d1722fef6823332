"""What is written to a Basler camera when it is opened, and read back for each trial's record.

What pylon Viewer, or whoever had the camera before, left in it must not change a recording: a user
set that is known is loaded first, then every setting that changes frames or their times is
written. Names are those of the ace 2 family, older ones after them; where a camera has none of
them, there is nothing to write. What is in force is read back.
"""

from __future__ import annotations

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.devices.basler.nodes import DEVICE, Nodes
from sliplab.rigs.devices.basler.settings import BaslerSettings
from sliplab.storage.streams import Json

LOAD_S = 10.0
"""The longest that a camera takes to load a user set, s."""
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
    "ReverseX", "ReverseY", "LUTEnable", "BslMultipleROIColumnsEnable", "BslMultipleROIRowsEnable",
)  # fmt: skip
"""All of them off."""
_SCALES = (
    "BinningHorizontal", "BinningVertical", "DecimationHorizontal", "DecimationVertical",
    "BslScalingFactor",
)  # fmt: skip
"""All of them 1: the rig file's pixels for a millimetre are those of the sensor."""
_NUMBERS = (
    ("BlackLevel", 0.0),
    ("DigitalShift", 0),
    ("Gamma", 1.0),
    ("BslContrast", 0.0),
    ("BslBrightness", 0.0),
    ("BslNoiseReduction", 0.0),
    ("BslSharpnessEnhancement", 0.0),
)
"""As near as the camera goes."""
_LINE_TIMES = ("BslInputFilterTime", "BslInputHoldOffTime", "LineDebouncerTime")
"""Of an input, us: all of them 0, for they delay its edges."""
_RATES = ("BslResultingAcquisitionFrameRate", "ResultingFrameRate")
_READ_BACK = (
    *(name for name, _ in _CHOICES), *_SWITCHES, *_SCALES, *(name for name, _ in _NUMBERS),
    "PixelFormat", "Gain", "ExposureTime", "ExposureTimeAbs", "AcquisitionFrameRateEnable",
    "AcquisitionFrameRate", "AcquisitionFrameRateAbs", *_RATES, "BinningHorizontalMode",
    "BinningVerticalMode", "BslColorSpace", "BslLightSourcePreset", "BslSaturation", "BslHue",
    "ColorTransformationEnable", "BslSensorBitDepthMode", "BslConversionGainMode",
    "SensorShutterMode", "SensorReadoutMode", "BslStaticDefectPixelCorrectionMode",
    "DeviceLinkThroughputLimitMode", "DeviceLinkThroughputLimit",
)  # fmt: skip
_OF_TRIGGER = ("TriggerMode", "TriggerSource", "TriggerActivation", "TriggerDelay")
_OF_LINE = ("LineMode", "LineInverter", "LineSource", *_LINE_TIMES)


def write_settings(nodes: Nodes, settings: BaslerSettings) -> None:
    """Load the user set and write all settings. The trigger selector is left at `FrameStart`.

    Raises:
        RigError: a line, a user set or a value that this camera does not have.
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
    # the emulation keeps both names and obeys the older one
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
    """Every trigger off but that of a frame's start, which is ours."""
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
    """Hold the rate that is asked for against what the camera says it can do now.

    Raises:
        RigError: it would miss triggers, or run slower.
    """
    most = nodes.peek(*_RATES)
    # free run asks the camera for a rate, which it rounds
    if settings.trigger == "software" or most is None or most > 0.999 * settings.rate_hz:
        return
    raise RigError(
        DEVICE,
        f"rate_hz = {settings.rate_hz:g}: with exposure_us = {settings.exposure_us:g}, this region "
        f"and this link it gives at most {most:.1f} frames/s; shorten the exposure or the region's "
        "height, or lower the rate",
    )


def read_back(nodes: Nodes) -> Json:
    """Settings that change frames or times, as the camera says them; `Name[choice]` of a selector.

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
